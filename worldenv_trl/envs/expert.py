"""The scripted expert as a policy of the physics environment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.transforms import TransformedEnv

from worldenv_trl.envs.tabletop import TabletopEnv
from worldenv_trl.keys import ACTION, ACTION_DIM, INSTRUCTION, NUM_STEPS
from worldenv_trl.language import instructions_of
from worldenv_trl.scenes import PerturbedExpert, ScriptedExpert, Task

__all__ = ["ExpertPolicy"]

Expert = ScriptedExpert | PerturbedExpert


class ExpertPolicy(TensorDictModuleBase):
    """Writes the expert's ``action`` [B, 7] for the state that ``env`` is in; it looks behind the observation.

    Args:
        env: the environment whose rollouts it acts in (not a copy of it), with transforms around it or without.
        make_expert: makes the expert of a task, for instance
            ``lambda task: PerturbedExpert(task, early_release=0.5)`` for failures on purpose.

    Raises:
        TypeError: if there is no :class:`TabletopEnv` in ``env``.
        ValueError: when it is called with a tensordict that does not show what ``env`` is at: of another number of
            rows, or other tasks, initial states or steps.

    Examples:
        >>> env = TabletopEnv("starter/open_the_top_drawer", 2, cameras=(), seed=0)
        >>> env.rollout(200, ExpertPolicy(env), break_when_any_done=False)["next", "success"].any(1).tolist()
        [[True], [True]]
    """

    def __init__(self, env: EnvBase, make_expert: Callable[[Task], Expert] = ScriptedExpert) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [NUM_STEPS], [ACTION]
        while isinstance(env, TransformedEnv):
            env = env.base_env
        if not isinstance(env, TabletopEnv):
            raise TypeError(
                f"ExpertPolicy needs a TabletopEnv of this process, got {type(env).__name__}: it reads its simulations"
            )
        self._parts = [(make_expert(scene.task), scene, rows) for scene, rows in env.scenes]
        self._num_envs, self._progress = env.num_envs, env.progress
        self._words = [""] * env.num_envs
        for scene, rows in env.scenes:
            for row in rows:
                self._words[row] = scene.task.language

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        started = (tensordict[NUM_STEPS].reshape(-1) == 0).numpy()
        self._check_same_env(tensordict, started)
        action = np.zeros((self._num_envs, ACTION_DIM), np.float32)
        for expert, scene, rows in self._parts:
            expert.reset(np.flatnonzero(started[rows]))
            action[rows] = expert(scene)
        return tensordict.set(ACTION, torch.from_numpy(action))

    def _check_same_env(self, tensordict: TensorDictBase, started: np.ndarray) -> None:
        remedy = "make an ExpertPolicy of the env that it acts in, ExpertPolicy(env)"
        if tensordict.numel() != self._num_envs:
            raise ValueError(
                f"this expert acts in its own env of {self._num_envs} rows, got {tensordict.numel()} rows: {remedy}"
            )
        for key, own in self._progress().items():
            shown = tensordict.get(key, None)
            if shown is None:
                continue
            apart = np.flatnonzero(shown.reshape(-1).numpy() != own.reshape(-1))
            if len(apart):
                row = int(apart[0])
                raise ValueError(
                    f"this expert's env has {key}={int(own[row, 0])} in row {row}, the tensordict "
                    f"{int(shown.reshape(-1)[row])}: {remedy}, and call it with what that env showed last"
                )
        if (
            started.any() and tensordict.get(INSTRUCTION, None) is not None
        ):  # not every step: texts take time to compare
            for row, (text, words) in enumerate(zip(instructions_of(tensordict), self._words, strict=True)):
                if text != words:
                    raise ValueError(
                        f"this expert's env asks to {words!r} in row {row}, the tensordict {text!r}: {remedy}"
                    )
