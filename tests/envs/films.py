"""An env that plays films decision by decision, and reflectors that read their scores from the first pixel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NonTensorStack, TensorDict
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, NonTensor, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from worldenv_trl import keys
from worldenv_trl.reflectors import Reflector


def film(scores: Sequence[Sequence[int]] | Tensor, size: int = 16) -> Tensor:
    """uint8 [R, T + 1, 3, H, W]: a black first frame, then frames whose first pixel's red is the score, of 255."""
    scores = torch.as_tensor(scores)
    frames = torch.zeros(len(scores), scores.shape[1] + 1, 3, size, size, dtype=torch.uint8)
    frames[:, 1:, 0, 0, 0] = scores.to(torch.uint8)
    return frames


class FilmEnv(EnvBase):
    """Plays ``films``, uint8 [R, T + 1, 3, H, W] by camera, as ImaginedEnv shows frames; states count them."""

    def __init__(self, films: Mapping[str, Tensor], texts: Sequence[str] = ("shine",), chunk_length: int = 4) -> None:
        count, length = next(iter(films.values())).shape[:2]
        super().__init__(batch_size=[count])
        self.films, self.chunk_length, self.max_steps = dict(films), chunk_length, length - 1
        self.texts = [texts[row % len(texts)] for row in range(count)]
        self.now = torch.zeros(count, dtype=torch.int64)

        def pixels(video: Tensor, *chunk: int) -> Bounded:
            return Bounded(0, 255, shape=(count, *chunk, *video.shape[2:]), dtype=torch.uint8)

        def real(*shape: int) -> Unbounded:
            return Unbounded(shape=(count, *shape))

        images = {keys.image_entry(camera): pixels(video) for camera, video in films.items()}
        chunks = {keys.image_entry(camera): pixels(video, chunk_length) for camera, video in films.items()}
        flag = Binary(shape=(count, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            {
                "observation": Composite({**images, "state": real(keys.STATE_DIM)}, shape=[count]),
                keys.KINEMATIC_STATE: real(keys.KINEMATIC_DIM),
                keys.INSTRUCTION: NonTensor(shape=[count], example_data=self.texts[0]),
                keys.NUM_STEPS: Unbounded(shape=(count, 1), dtype=torch.int64),
                keys.FRAMES: Composite(chunks, shape=[count]),
                keys.STATES: real(chunk_length, keys.STATE_DIM),
                keys.KINEMATIC_STATES: real(chunk_length, keys.KINEMATIC_DIM),
                keys.STEP_MASK: Binary(shape=(count, chunk_length), dtype=torch.bool),
            },
            shape=[count],
        )
        chunk = real(chunk_length, keys.ACTION_DIM)
        self.action_spec = Composite(vla_action=Composite(chunk=chunk, shape=[count]), shape=[count])
        self.reward_spec = real(1)
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=[count])

    def _observe(self, begun: Tensor, active: Tensor) -> TensorDict:
        place = begun.unsqueeze(-1) + torch.arange(1, self.chunk_length + 1)  # [R, C]
        executed = active.unsqueeze(-1) & (place <= self.max_steps)
        rows, frame = torch.arange(len(begun)), place.clamp(max=self.max_steps)
        seen = frame.unsqueeze(-1).float()
        out = TensorDict(
            {
                "observation": {"state": self.now.unsqueeze(-1).float().expand(-1, keys.STATE_DIM).clone()},
                keys.KINEMATIC_STATE: self.now.unsqueeze(-1).float().expand(-1, keys.KINEMATIC_DIM).clone(),
                keys.NUM_STEPS: self.now.unsqueeze(-1).clone(),
                keys.STATES: seen.expand(-1, -1, keys.STATE_DIM).clone(),
                keys.KINEMATIC_STATES: seen.expand(-1, -1, keys.KINEMATIC_DIM).clone(),
                keys.STEP_MASK: executed,
            },
            batch_size=self.batch_size,
        )
        for camera, video in self.films.items():
            out[keys.image_key(camera)] = video[rows, self.now]
            out[keys.frames_key(camera)] = video[rows.unsqueeze(-1), frame]
        return out.set(keys.INSTRUCTION, NonTensorStack(*self.texts))

    def _reset(self, tensordict: TensorDict | None = None, **_) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.now[slice(None) if mask is None else mask.reshape(-1)] = 0
        out = self._observe(self.now, torch.zeros_like(self.now, dtype=torch.bool))
        return out.update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDict) -> TensorDict:
        active, begun = tensordict.get("_step", None), self.now.clone()
        active = torch.ones_like(begun, dtype=torch.bool) if active is None else active.reshape(-1)
        self.now[active] = (begun[active] + self.chunk_length).clamp(max=self.max_steps)
        out, over = self._observe(begun, active), (self.now >= self.max_steps).unsqueeze(-1)
        ends = {
            "done": over,
            "terminated": torch.zeros_like(over),
            "truncated": over,
            "reward": torch.zeros(len(over), 1),
        }
        return out.update({name: value.clone() for name, value in ends.items()})

    def _set_seed(self, seed: int | None) -> None:
        pass


def roll(env: EnvBase, decisions: int | None = None) -> TensorDict:
    """Steps the rows that are not done until all are (or so many times): [T, R], and ``mask`` bool [T, R]."""
    td, played = env.reset(), []
    while not td["done"].all() and len(played) != decisions:
        td["_step"] = ~td["done"]
        td[keys.CHUNK] = torch.zeros(*env.batch_size, 4, keys.ACTION_DIM)
        td = env.step(td)
        played.append(TensorDict({"next": td["next"], "mask": td["_step"].squeeze(-1)}, batch_size=env.batch_size))
        td = step_mdp(td, exclude_action=True)
    return torch.stack(played)


class FirstPixel(Reflector):
    """Scores a frame by the red of its first pixel; counts what it was shown."""

    def __init__(self, **trained_for) -> None:
        super().__init__(**trained_for)
        self.shown = 0

    def read(self, frames: Mapping[str, Tensor]) -> Tensor:
        video = frames[self.cameras[0]]
        self.shown += video[..., 0, 0, 0].numel()
        return video[..., 0, 0, 0].float() / 255

    def begin(self, frames, instructions):
        score = self.read(frames)
        return TensorDict({"score": score}, batch_size=[len(score)])

    def extend(self, state, frames):
        scores = self.read(frames)
        return state.copy().set("score", scores[:, -1]), scores
