"""Small rollouts, an environment and a file to record them into."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NonTensorData, TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import make_composite_from_td

from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter


def make_rollouts(rows: int = 4, steps: int = 10, size: int = 32) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (rows, steps + 1, 3, size, size), generator=generator, dtype=torch.uint8)
    return TensorDict(
        {
            "observation": {"image": image[:, :-1]},
            keys.ACTION: torch.randn(rows, steps, 7, generator=generator),
            keys.INSTRUCTION: NonTensorData("do it", batch_size=[rows, steps]),
            "next": {"observation": {"image": image[:, 1:]}, "reward": torch.ones(rows, steps, 1)},
        },
        batch_size=[rows, steps],
    )


class NoiseEnv(EnvBase):
    """Rows that show noise, after the first reset nothing yet if ``dark``."""

    def __init__(self, rows: int, dark: bool = False) -> None:
        super().__init__(batch_size=[rows])
        self.dark = dark
        shape = (rows, 3, 32, 32)
        image = Bounded(0, 255, shape, dtype=torch.uint8, domain="discrete")
        self.observation_spec = Composite({"observation": Composite(image=image, shape=[rows])}, shape=[rows])
        self.action_spec, self.reward_spec = Unbounded([rows, 7]), Unbounded([rows, 1])

    def _reset(self, tensordict=None):
        shown = self.observation_spec["observation"].rand()
        if self.dark:
            shown["image"].zero_()
            self.dark = False
        return TensorDict({"observation": shown}, self.batch_size)

    def _step(self, tensordict):
        flags = {name: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for name in ("done", "terminated")}
        return self._reset().update({"reward": torch.zeros(*self.batch_size, 1), **flags})

    def _set_seed(self, seed):
        return seed


class FilmEnv(EnvBase):
    """Decisions of three steps whose frames, by camera, are noise; every second row stops after two of them.

    ``frames=None`` shows none of them.
    """

    def __init__(self, rows: int, cameras: Sequence[str] = ("image",), frames: str | None = keys.FRAMES) -> None:
        super().__init__(batch_size=[rows])
        self.cameras, self.frames, self._generator = tuple(cameras), frames, torch.Generator().manual_seed(0)
        self.action_spec, self.reward_spec = Unbounded([rows, 3, 7]), Unbounded([rows, 1])
        shown = self._shown(torch.zeros(rows, 3, dtype=torch.bool))
        self.observation_spec = make_composite_from_td(shown)

    def _pixels(self, *shape: int) -> torch.Tensor:
        size = (*self.batch_size, *shape, 3, 16, 16)
        return torch.randint(0, 256, size, generator=self._generator, dtype=torch.uint8)

    def _shown(self, mask: torch.Tensor) -> TensorDict:
        out = TensorDict({keys.STEP_MASK: mask}, self.batch_size)
        for camera in self.cameras:
            frames = self._pixels(3) * mask.any(-1)[:, None, None, None, None]
            last = frames[torch.arange(len(frames)), mask.sum(-1) - 1]
            out["observation", camera] = torch.where(mask.any(-1)[:, None, None, None], last, self._pixels())
            if self.frames is not None:
                out[self.frames, camera] = frames
        return out

    def _reset(self, tensordict=None):
        return self._shown(torch.zeros(*self.batch_size, 3, dtype=torch.bool))

    def _step(self, tensordict):
        executed = 3 - torch.arange(self.batch_size[0]) % 2
        flags = {name: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for name in ("done", "terminated")}
        shown = self._shown(torch.arange(3) < executed[:, None])
        return shown.update({"reward": torch.zeros(*self.batch_size, 1), **flags})

    def _set_seed(self, seed):
        return seed


def record(path, *rollouts: TensorDict) -> None:
    with RolloutWriter(path, metadata={"seed": 1}) as writer:
        for part in rollouts:
            writer.write(part)
