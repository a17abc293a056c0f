"""Episodes: what every training stage reads. Numbers in memory, frames wherever they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.keys import CONTEXT_ID, FRAMES, TASK_ID, camera_of, frames_key
from worldenv_trl.memmap import Reading

__all__ = ["Episodes"]

ONCE = ("length", TASK_ID, CONTEXT_ID)  # entries of an episode, not of its steps


class Episodes:
    """R episodes of at most T steps.

    ``episodes[name]`` gives a small entry, ``episodes[rows]`` (numbers, mask or slice) some of the episodes, which
    share their frames with these. Entries:

    - ``states`` float32 [R, T + 1, 7], ``kinematic_states`` float32 [R, T + 1, 20]: from the reset on; past the end of
      an episode the last one is repeated;
    - ``actions`` float32 [R, T, 7]: executed, clipped to [-1, 1]; zero past the end;
    - ``success`` bool [R, T + 1]: of the physics, repeated past the end; absent where nobody knows it (imagination);
    - ``length`` int64 [R, 1]: executed steps; ``task_id``, ``context_id`` int64 [R, 1].

    Frames are read with :meth:`frames` or :meth:`recall`, from a TensorDict in memory or on disk.

    Args:
        entries: TensorDict [R] of the entries above.
        instructions: R texts.
        frames: ``("frames", entry)`` uint8 [F, 3, H, W] by camera: the frames of all episodes, one after the other,
            from the reset to the last executed step of each.
        first: int64 [R], which of these is each episode's first; by default they follow each other in order.

    Raises:
        ValueError: if the numbers of episodes, texts and frames do not go together.

    Examples:
        >>> from worldenv_trl.data import episodes_from_rollouts
        >>> from worldenv_trl.envs import TabletopEnv
        >>> episodes = episodes_from_rollouts(TabletopEnv("starter/open_the_top_drawer", 3, seed=0).rollout(5))
        >>> episodes["actions"].shape, episodes.instructions[0]
        (torch.Size([3, 5, 7]), 'open the top drawer of the cabinet')
        >>> some = Episodes.cat([episodes[:2], episodes[torch.tensor([2, 0])]])
        >>> some.frames("agentview", torch.arange(4), torch.tensor(5)).shape  # the last one of each
        torch.Size([4, 3, 64, 64])
    """

    def __init__(
        self,
        entries: TensorDictBase,
        instructions: Sequence[str],
        frames: TensorDictBase,
        first: Tensor | None = None,
    ) -> None:
        count = entries["length"].squeeze(-1) + 1
        first = count.cumsum(0) - count if first is None else first
        if len(instructions) != len(entries):
            raise ValueError(f"{len(entries)} episodes need as many instructions, got {len(instructions)}")
        if len(first) and int((first + count).max()) > len(frames):
            raise ValueError(f"the episodes need {int((first + count).max())} frames, there are {len(frames)}")
        self.entries, self.instructions = entries, list(instructions)
        self._parts, self._part, self._first = [frames], torch.zeros_like(first), first
        self.reading = Reading()

    # ------------------------------------------------------------------------------------------------- reading

    def __len__(self) -> int:
        return len(self.entries)

    def __contains__(self, name: str) -> bool:
        return name in self.entries.keys()  # noqa: SIM118 - a TensorDict iterates over rows

    @overload
    def __getitem__(self, item: str) -> Tensor: ...

    @overload
    def __getitem__(self, item: slice | Tensor | Sequence[int]) -> Episodes: ...

    def __getitem__(self, item: str | slice | Tensor | Sequence[int]) -> Tensor | Episodes:
        if isinstance(item, str):
            return self.entries[item]
        rows = torch.arange(len(self))[item]
        return self._with(self.entries[rows], [self.instructions[row] for row in rows.tolist()], rows)

    def __setitem__(self, name: str, value: Tensor) -> None:
        self.entries[name] = value

    def _with(self, entries: TensorDictBase, instructions: list[str], rows: Tensor) -> Episodes:
        out = Episodes.__new__(Episodes)
        out.entries, out.instructions = entries, instructions
        out._parts, out._part, out._first = self._parts, self._part[rows], self._first[rows]
        out.reading = self.reading
        return out

    @property
    def cameras(self) -> tuple[str, ...]:
        """Scene cameras of which there are frames."""
        return tuple(camera_of(entry) for entry in self._parts[0][FRAMES].keys())  # noqa: SIM118

    @property
    def image_size(self) -> int:
        """Height and width of the frames (px)."""
        return self._parts[0][frames_key(self.cameras[0])].shape[-1]

    @property
    def alive(self) -> Tensor:
        """Which frames belong to their episode: bool [R, T + 1]."""
        return torch.arange(self["actions"].shape[1] + 1) <= self["length"]

    def require(self, part: str, cameras: Sequence[str], image_size: int | None) -> None:
        """Raises ``ValueError`` unless these episodes show what ``part`` ("the reflector") looks at."""
        missing = [camera for camera in cameras if camera not in self.cameras]
        if missing:
            raise ValueError(
                f"{part} looks at {', '.join(map(repr, missing))}, the episodes show "
                f"{', '.join(map(repr, self.cameras))} only: record them with cameras={tuple(cameras)}"
            )
        if image_size not in (None, self.image_size):
            raise ValueError(
                f"{part} looks at frames of {image_size} px, the episodes' are {self.image_size} px: "
                f"record them with image_size={image_size}"
            )

    @property
    def video(self) -> tuple[TensorDictBase, Tensor]:
        """All frames [F] and, int64 [R], which of them is each episode's first.

        Raises:
            ValueError: for episodes that were put together from several stores.
        """
        if len(self._parts) > 1:
            raise ValueError("these episodes come from several stores: fill one from all recordings, with fill_store")
        return self._parts[0], self._first

    def frames(self, camera: str, episode: Tensor, frame: Tensor) -> Tensor:
        """Frames of one camera, uint8 [*B, 3, H, W].

        Args:
            camera: of :attr:`cameras`.
            episode, frame: int64, broadcast to [*B]; past its end an episode shows its last frame.

        Raises:
            ValueError: for a frame before the first.
        """
        part, index = self._places(episode, frame)
        return self._gather(frames_key(camera), part, index)

    def recall(self, episode: Tensor, frame: Tensor) -> TensorDict:
        """Frames of all cameras, TensorDict [*B] of ``("frames", entry)``; see :meth:`frames`."""
        part, index = self._places(episode, frame)
        out = TensorDict(batch_size=index.shape)
        for camera in self.cameras:
            out[frames_key(camera)] = self._gather(frames_key(camera), part, index)
        return out

    def _places(self, episode: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        episode, frame = torch.broadcast_tensors(torch.as_tensor(episode), torch.as_tensor(frame))
        if bool((frame < 0).any()):  # it would show the episode before
            first = tuple((frame < 0).nonzero()[0])
            raise ValueError(f"there is no frame {int(frame[first])} of episode {int(episode[first])}: they begin at 0")
        inside = torch.minimum(frame, self["length"].squeeze(-1)[episode])
        return self._part[episode], self._first[episode] + inside

    def _gather(self, key: tuple[str, str], part: Tensor, index: Tensor) -> Tensor:
        size = self.image_size
        self.reading.add(3 * size * size * index.numel(), *self._parts)
        if len(self._parts) == 1:
            return self._parts[0][key][index]
        out: Tensor | None = None
        for number, frames in enumerate(self._parts):
            here = part == number
            found = frames[key][index[here]]
            out = found.new_empty(*index.shape, *found.shape[1:]) if out is None else out
            out[here] = found
        assert out is not None  # there is at least one store
        return out

    # ------------------------------------------------------------------------------------------------- together

    def with_video(self, frames: TensorDictBase, **entries: Tensor) -> Episodes:
        """The same episodes with other frames, ``("frames", entry)`` [F, 3, H, W] in their order, and other entries."""
        changed = self.entries.clone(False)
        for name, value in entries.items():
            changed[name] = value
        return Episodes(changed, self.instructions, frames)

    def through(self, cameras: Sequence[str]) -> Episodes:
        """The same episodes as some of their cameras show them.

        Raises:
            ValueError: for a camera of which there are no frames.
        """
        missing = [camera for camera in cameras if camera not in self.cameras]
        if missing:
            raise ValueError(f"the episodes show {', '.join(self.cameras)}, not {', '.join(missing)}")
        if tuple(cameras) == self.cameras:
            return self
        out = self._with(self.entries, self.instructions, torch.arange(len(self)))
        out._parts = [part.select(*(frames_key(camera) for camera in cameras)) for part in self._parts]
        return out

    @staticmethod
    def cat(parts: Sequence[Episodes]) -> Episodes:
        """Several sets of episodes as one, which reads each one's frames where they are.

        Raises:
            ValueError: for no episodes at all, or sets with other entries, cameras or image sizes.
        """
        parts = [part for part in parts if len(part)]
        if not parts:
            raise ValueError("there are no episodes to put together")
        check_alike(parts)
        texts = [text for part in parts for text in part.instructions]
        out = Episodes.__new__(Episodes)
        out.entries, out.instructions = concatenated([part.entries for part in parts]), texts
        stores: list[TensorDictBase] = []
        numbers = []
        for part in parts:
            places = []
            for frames in part._parts:
                known = next((place for place, each in enumerate(stores) if _same_store(each, frames)), len(stores))
                if known == len(stores):
                    stores.append(frames)
                places.append(known)
            numbers.append(torch.tensor(places)[part._part])
        out._parts, out._part, out.reading = stores, torch.cat(numbers), Reading()
        out._first = torch.cat([part._first for part in parts])
        return out


def _same_store(first: TensorDictBase, second: TensorDictBase) -> bool:
    """Whether two hold the very same frames, of all cameras."""
    mine, other = (dict(each.items(True, True)) for each in (first, second))
    return mine.keys() == other.keys() and all(value is other[key] for key, value in mine.items())


def check_alike(parts: Sequence[Episodes]) -> None:
    """Raises ``ValueError`` for sets with other entries, cameras or image sizes than the first one's."""
    first = parts[0]
    for part in parts[1:]:
        if set(part.entries.keys()) != set(first.entries.keys()):
            names = [sorted(map(str, each.entries.keys())) for each in (first, part)]
            raise ValueError(
                f"episodes hold different entries, {names[0]} and {names[1]}: "
                "episodes of the physics carry success labels, imagined ones none until they are given"
            )
        if (set(part.cameras), part.image_size) != (set(first.cameras), first.image_size):
            seen = [f"{', '.join(each.cameras)} at {each.image_size} px" for each in (first, part)]
            raise ValueError(
                f"episodes hold frames of different cameras or sizes, {seen[0]} and {seen[1]}: record alike"
            )


def concatenated(parts: Sequence[TensorDictBase]) -> TensorDict:
    """Entries [R] of several sets, padded to the longest: observations repeat the last one, actions are zero."""
    steps = max(part["actions"].shape[1] for part in parts)
    count = sum(len(part) for part in parts)
    out = TensorDict(batch_size=[count])
    for key in parts[0].keys():  # noqa: SIM118 - a TensorDict iterates over rows
        if key in ONCE:
            out[key] = torch.cat([part[key] for part in parts])
            continue
        extra = 0 if key == "actions" else 1
        sample = parts[0][key]
        values = sample.new_zeros(count, steps + extra, *sample.shape[2:])
        start = 0
        for part in parts:
            rows, have = slice(start, start + len(part)), part[key].shape[1]
            values[rows, :have] = part[key]
            if extra:
                values[rows, have:] = part[key][:, -1:]
            start += len(part)
        out[key] = values
    return out
