"""Imagination as the stages use it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform, TransformedEnv

from episodes import demonstrations_and_exploration, round_of
from parts import PROPRIO
from run import Run
from worldenv_trl import keys
from worldenv_trl.data import Episodes
from worldenv_trl.devices import to_device
from worldenv_trl.envs import FramesAside, ImaginedEnv, Reflect
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.row_texts import row_texts
from worldenv_trl.world_models import WorldModel


@dataclass(frozen=True)
class Imagination:
    """A world model, its judge, and the contexts where rollouts begin."""

    world_model: WorldModel
    reflector: Reflector
    rule: StopRule
    contexts: TensorDict

    @classmethod
    def load(cls, run: Run, suffix: str) -> Imagination:
        """That of a round."""
        world_model = run.world_model(suffix)
        _, explored = demonstrations_and_exploration(run, rounds=round_of(suffix))
        contexts = contexts_of(explored, world_model.cameras)
        rule = run.rules(suffix)["imagined"]
        judge = run.reflector(suffix).for_world("imagined")
        return cls(world_model, judge, rule, to_device(contexts, run.device))

    def env(
        self,
        run: Run,
        batch_size: Sequence[int],
        contexts: TensorDict | None = None,
        *,
        seed: int,
    ) -> TransformedEnv:
        """FK, action map, world model; the reflector gives the reward and stops; frames are not carried along."""
        groups, group_size = batch_size
        make = self.makes(run, group_size, contexts, seed=seed)
        return make(groups, transforms=[FramesAside(run.folder.scratch)])

    def makes(
        self, run: Run, group_size: int, contexts: TensorDict | None = None, *, seed: int
    ) -> Callable[..., TransformedEnv]:
        """``makes(...)(groups)`` is the same env for so many groups; frames are carried along."""
        return partial(
            _imagined,
            self if contexts is None else replace(self, contexts=contexts),
            run.kinematics,
            group_size,
            max_steps=run.config.max_steps,
            proprio=PROPRIO,
            seed=seed,
        )


def _imagined(
    imagination: Imagination,
    kinematics: ForwardKinematics,
    group_size: int,
    groups: int,
    *,
    transforms: Sequence[Transform] = (),
    **options: Any,
) -> TransformedEnv:
    env = ImaginedEnv(
        imagination.world_model,
        kinematics,
        imagination.contexts,
        batch_size=[groups, group_size],
        **options,
    )
    return TransformedEnv(env, Compose(Reflect(imagination.reflector, imagination.rule), *transforms))


def frames_aside(env: EnvBase) -> FramesAside | None:
    """What keeps the frames of ``env`` out of its waves; None for an env that shows none."""
    transform = getattr(env, "transform", None)
    return next((each for each in getattr(transform, "transforms", ()) if isinstance(each, FramesAside)), None)


def contexts_of(explored: Episodes, cameras: Sequence[str]) -> TensorDict:
    """The distinct contexts (g, o_1, s_1) that ``explored`` episodes begin with; no simulator is touched."""
    ids = explored[keys.CONTEXT_ID].squeeze(-1)
    rows = torch.tensor([int((ids == value).nonzero()[0, 0]) for value in ids.unique()])
    first = torch.zeros_like(rows)
    contexts = TensorDict(
        {
            keys.STATE: explored["states"][rows, 0],
            keys.KINEMATIC_STATE: explored["kinematic_states"][rows, 0],
            keys.TASK_ID: explored[keys.TASK_ID][rows],
            keys.CONTEXT_ID: explored[keys.CONTEXT_ID][rows],
        },
        batch_size=[len(rows)],
    )
    for camera in cameras:
        contexts[keys.image_key(camera)] = explored.frames(camera, rows, first)
    return contexts.set(keys.INSTRUCTION, row_texts([explored.instructions[row] for row in rows.tolist()]))
