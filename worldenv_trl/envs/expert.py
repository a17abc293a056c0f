"""The scripted expert as a policy of the physics environment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from worldenv_trl.envs.tabletop import TabletopEnv
from worldenv_trl.keys import ACTION, ACTION_DIM, NUM_STEPS
from worldenv_trl.scenes import PerturbedExpert, ScriptedExpert, Task

__all__ = ["ExpertPolicy"]

Expert = ScriptedExpert | PerturbedExpert


class ExpertPolicy(TensorDictModuleBase):
    """Writes the expert's ``action`` [B, 7] for the state that ``env`` is in; it looks behind the observation.

    Args:
        env: the environment whose rollouts it acts in (not a copy of it).
        make_expert: makes the expert of a task, for instance
            ``lambda task: PerturbedExpert(task, early_release=0.5)`` for failures on purpose.
    """

    def __init__(self, env: TabletopEnv, make_expert: Callable[[Task], Expert] = ScriptedExpert) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [NUM_STEPS], [ACTION]
        self._parts = [(make_expert(scene.task), scene, rows) for scene, rows in env.scenes]
        self._num_envs = env.num_envs

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        started = (tensordict[NUM_STEPS].reshape(-1) == 0).numpy()
        action = np.zeros((self._num_envs, ACTION_DIM), np.float32)
        for expert, scene, rows in self._parts:
            expert.reset(np.flatnonzero(started[rows]))
            action[rows] = expert(scene)
        return tensordict.set(ACTION, torch.from_numpy(action))
