"""Imagination as the stages use it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, TransformedEnv

from parts import PROPRIO
from run import Run
from worldenv_trl import keys
from worldenv_trl.envs import FramesAside, ImaginedEnv, Reflect
from worldenv_trl.record import read_rollouts
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.world_models import WorldModel


@dataclass(frozen=True)
class Imagination:
    """A world model, its judge and where rollouts begin."""

    world_model: WorldModel
    reflector: Reflector
    rule: StopRule
    contexts: TensorDict

    @classmethod
    def load(cls, run: Run, suffix: str) -> Imagination:
        """That of a round."""
        world_model = run.world_model(suffix)
        contexts = read_contexts(run, world_model.cameras)
        return cls(world_model, run.reflector(suffix), run.rules(suffix)["imagined"], contexts)

    def env(self, run: Run, batch_size: Sequence[int], contexts: TensorDict | None = None) -> TransformedEnv:
        """FK, action map, world model; the reflector gives the reward and stops; frames are not carried along."""
        env = ImaginedEnv(
            self.world_model,
            run.kinematics,
            self.contexts if contexts is None else contexts,
            batch_size=list(batch_size),
            max_steps=run.config.max_steps,
            proprio=PROPRIO,
            seed=run.config.seed,
        )
        return TransformedEnv(env, Compose(Reflect(self.reflector, self.rule), FramesAside()))


def frames_aside(env: EnvBase) -> FramesAside | None:
    """What keeps the frames of ``env`` out of its waves; None for an env that shows none."""
    transform = getattr(env, "transform", None)
    return next((each for each in getattr(transform, "transforms", ()) if isinstance(each, FramesAside)), None)


def read_contexts(run: Run, cameras: Sequence[str]) -> TensorDict:
    """The distinct training contexts (g, o_1, s_1) among the logged exploration rollouts; no simulator is touched."""
    wanted: list[str | tuple[str, ...]] = [
        *(keys.image_key(camera) for camera in cameras),
        keys.STATE,
        keys.KINEMATIC_STATE,
    ]
    wanted += [keys.INSTRUCTION, keys.TASK_ID, keys.CONTEXT_ID]
    first = read_rollouts(run.folder.require_rollouts("explore", "explore"), steps=slice(0, 1), keys=wanted)[:, 0]
    ids = first[keys.CONTEXT_ID].squeeze(-1)
    rows = [int((ids == value).nonzero()[0, 0]) for value in ids.unique()]
    return first[rows]
