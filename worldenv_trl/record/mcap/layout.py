"""How the entries of a rollout are laid out in a file: which once, which per step, which as images."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase, is_non_tensor
from torch import Tensor

from worldenv_trl.keys import FRAMES, MASK, STEP_MASK
from worldenv_trl.record.mcap.protobuf import FixedMessage, MessageField

__all__ = ["Entry", "Layout", "executed_entries", "from_bytes", "leaves", "same_camera", "to_bytes"]

_TOPICS = ("step", "reset", "hand", "instruction")  # that are no images
_INDEX_FIELDS = [MessageField("rollout", torch.int64, 1), MessageField("step", torch.int64, 1)]


@dataclass(frozen=True)
class Entry:
    """One key of a rollout.

    ``stored`` is ``root`` or ``next`` for an entry kept at every step, ``chained`` when the root value of each step is
    the next value of the step before: then the first root value and all next values are kept. Images have further
    ways: ``chained_from_zero`` (the first root value is all zero and not kept) and ``last_of_frames`` (every next value
    is the last executed one of its camera's ``frames``: only the first root value is kept).
    """

    key: tuple[str, ...]
    stored: str
    dtype: str
    shape: tuple[int, ...]
    topic: str = ""
    field: str = ""

    @property
    def torch_dtype(self) -> torch.dtype:
        return getattr(torch, self.dtype)

    @property
    def count(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def nbytes(self) -> int:
        return self.count * self.torch_dtype.itemsize

    @property
    def chained(self) -> bool:
        return self.stored not in ("root", "next")


@dataclass(frozen=True)
class Layout:
    """The entries of one or several writes: images, numbers, texts."""

    images: tuple[Entry, ...]
    numbers: tuple[Entry, ...]
    texts: tuple[tuple[str, ...], ...]  # full paths, below "next" or not
    steps_per_entry: int  # C for decisions, else 1

    @classmethod
    def of(cls, flat: dict[tuple[str, ...], Tensor], texts: Iterable[tuple[str, ...]], valid: Tensor) -> Layout:
        """The layout that keeps tensors [R, T, ...] by path without loss where ``valid`` bool [R, T]."""
        flat = {key: value for key, value in flat.items() if key != MASK}
        _check_storable(flat)
        count = valid.shape[0]
        images: list[Entry] = []
        numbers: list[Entry] = []
        for key, value in flat.items():
            below = key[1:] if key[0] == "next" else key
            if key[0] != "next" and ("next", *key) in flat:
                continue  # handled with its next value
            stored = "next" if key[0] == "next" else "root"
            entry = Entry(below, stored, str(value.dtype).removeprefix("torch."), tuple(value.shape[2:]))
            root = flat.get(below) if stored == "next" else None
            kept = [entry]
            if root is not None:
                kept = [_replace(entry, stored="chained")]
                if not _is_chained(root, value, valid):
                    # The root value may have another dtype or shape than the next one.
                    kind = str(root.dtype).removeprefix("torch.")
                    kept = [Entry(below, "root", kind, tuple(root.shape[2:])), entry]
            for each in kept:
                own = root if each.stored == "root" and root is not None else value
                (images if _is_image(own) else numbers).append(each)
        images = _name_images(images, flat, valid) if count else images
        decisions = [e.shape[0] for e in images if len(e.shape) == 4]
        decisions += [e.shape[0] for e in numbers if e.key == (STEP_MASK,) and e.stored != "root" and e.shape]
        return cls(tuple(images), _name_fields(numbers), tuple(sorted(texts)), max(decisions, default=1))

    def step_message(self) -> FixedMessage:
        fields = [MessageField(e.field, e.torch_dtype, e.count) for e in self.numbers]
        return FixedMessage("worldenv_trl.Step", _INDEX_FIELDS + fields)

    def reset_message(self) -> FixedMessage:
        fields = [MessageField(e.field, e.torch_dtype, e.count) for e in self.numbers if e.chained]
        return FixedMessage("worldenv_trl.Reset", _INDEX_FIELDS[:1] + fields)

    def entry(self, key: str | tuple[str, ...], *stored: str) -> Entry | None:
        key = (key,) if isinstance(key, str) else key
        found = (e for e in (*self.images, *self.numbers) if e.key == key and (not stored or e.stored in stored))
        return next(found, None)

    def splits(self, entry: Entry) -> bool:
        """Whether ``entry`` is frames of which those past a stop inside a chunk go to a topic of their own."""
        image = same_camera(entry.key) if entry.key[0] == FRAMES else None
        return image is not None and self.entry(image, "last_of_frames") is not None

    @property
    def splits_frames(self) -> bool:
        """Whether it does so for any camera."""
        return any(entry.stored == "last_of_frames" for entry in self.images)

    def to_json(self) -> dict:
        return asdict(self)

    @classmethod
    def from_json(cls, value: dict, one_camera: bool = False) -> Layout:
        """The layout that :meth:`to_json` described; ``one_camera``: by a release whose frames were one tensor."""

        def entries(rows: list[dict]) -> tuple[Entry, ...]:
            return tuple(Entry(**row | {"key": key(row["key"]), "shape": tuple(row["shape"])}) for row in rows)

        def key(path: list[str]) -> tuple[str, ...]:
            return (*path, "image") if one_camera and path in ([FRAMES], ["recorded", FRAMES]) else tuple(path)

        texts = tuple(tuple(path) for path in value["texts"])
        return cls(entries(value["images"]), entries(value["numbers"]), texts, int(value["steps_per_entry"]))


def same_camera(key: tuple[str, ...]) -> tuple[str, ...] | None:
    """``("frames", entry)`` for ``("observation", entry)`` and the other way round; None for any other entry."""
    other = {"observation": FRAMES, FRAMES: "observation"}.get(key[0])
    return (other, key[1]) if other is not None and len(key) == 2 else None


def leaves(rollouts: TensorDictBase) -> tuple[dict[tuple[str, ...], Tensor], dict[tuple[str, ...], list | str]]:
    """The tensors by path, and the texts by path as nested lists [*B, T] (or one string for all)."""
    tensors: dict[tuple[str, ...], Tensor] = {}
    texts: dict[tuple[str, ...], list | str] = {}

    def walk(part: TensorDictBase, above: tuple[str, ...]) -> None:
        for name in part.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            value, path = part.get(name), (*above, name)
            if path == ("text",) and isinstance(value, Tensor):
                raise ValueError(f"entry {path} has a name that recordings use themselves: call it something else")
            if isinstance(value, str):
                texts[path] = value
            elif is_non_tensor(value):
                texts[path] = value.tolist()
            elif isinstance(value, TensorDictBase):
                walk(value, path)
            elif isinstance(value, Tensor):
                tensors[path] = value.detach().cpu()
            else:
                raise ValueError(f"entry {path} is a {type(value).__name__}: only tensors and text can be recorded")

    walk(rollouts, ())
    return tensors, texts


def executed_entries(rollouts: TensorDictBase) -> Tensor:
    """Which entries belong to a rollout, bool [R, T]: the mask, or up to the first ``done``.

    Raises:
        ValueError: for a mask with holes.
    """
    rows = (-1, rollouts.shape[-1])
    mask, done = rollouts.get(MASK, None), rollouts.get(("next", "done"), None)
    if mask is None and done is None:
        return torch.ones(rollouts.shape, dtype=torch.bool).reshape(rows)
    if mask is None:
        done = done.cpu().reshape(rows).long()
        return (done.cumsum(-1) - done) == 0
    mask = mask.cpu().reshape(rows).bool()
    if bool((mask[:, 1:] & ~mask[:, :-1]).any()):
        raise ValueError(f"{MASK} has holes: a rollout's entries must come first, its padding last")
    return mask


def to_bytes(value: Tensor) -> np.ndarray:
    """The raw little-endian bytes of [n, ...]: uint8 [n, nbytes]."""
    flat = value.contiguous().reshape(len(value), -1)
    if flat.numel() == 0:
        return np.zeros((len(value), 0), np.uint8)
    return flat.view(torch.uint8).numpy()


def from_bytes(raw: np.ndarray, entry: Entry) -> Tensor:
    """[n, nbytes] -> [n, *shape]."""
    if entry.nbytes == 0:
        return torch.zeros(len(raw), *entry.shape, dtype=entry.torch_dtype)
    values = torch.from_numpy(raw.copy()).view(entry.torch_dtype)
    return values.reshape(len(raw), *entry.shape)


def _check_storable(flat: dict[tuple[str, ...], Tensor]) -> None:
    """Raises ``ValueError`` for entries that could not be read back."""
    topics: dict[str, tuple[str, ...]] = {}
    for key, value in flat.items():
        if value.dtype in (torch.uint16, torch.uint32, torch.uint64):
            raise ValueError(f"entry {key} is {value.dtype}, which torch can hardly index: record it as int32 or int64")
        below = key[1:] if key[0] == "next" else key
        name = "/".join(below)
        if not _is_image(value):
            continue
        if topics.setdefault(name, below) != below:
            raise ValueError(f"entries {topics[name]} and {below} would both be the image topic /{name}: rename one")
        if name in _TOPICS:
            raise ValueError(f"the image {key} would be on the topic /{name} of a recording: call it something else")


def _replace(entry: Entry, **changes: Any) -> Entry:
    return Entry(**asdict(entry) | changes)


def _is_image(value: Tensor) -> bool:
    shape = value.shape[2:]
    return value.dtype == torch.uint8 and len(shape) in (3, 4) and shape[-3] == 3 and min(shape[-2:]) >= 8


def _is_chained(root: Tensor, after: Tensor, valid: Tensor) -> bool:
    if root.dtype != after.dtype or root.shape != after.shape:
        return False
    inner = valid[:, 1:]
    if not bool(inner.any()):
        return True
    rows, steps = inner.shape
    # Bit patterns are compared: -0 differs from 0 and NaN equals itself.
    left = to_bytes(root[:, 1:].reshape(rows * steps, *root.shape[2:]))
    right = to_bytes(after[:, :-1].reshape(rows * steps, *after.shape[2:]))
    return bool(((left == right).all(-1) | ~inner.reshape(-1).numpy()).all())


def _name_images(images: list[Entry], flat: dict[tuple[str, ...], Tensor], valid: Tensor) -> list[Entry]:
    """Decides how the images of decisions are kept, and their topics."""
    chained = {entry.key for entry in images if entry.stored == "chained"}
    pairs = {key: other for key in chained if key[0] != FRAMES and (other := same_camera(key)) in chained}
    image_of = {frames: key for key, frames in pairs.items() if _last_frames_match(flat, valid, key, frames)}
    named = []
    for entry in images:
        topic = "/" + "/".join(entry.key)
        if entry.stored == "root" and any(e.key == entry.key and e.stored == "next" for e in images):
            topic = "/root" + topic
        # Before the first decision there are no frames; any other first image may be black by chance.
        frames = entry.stored == "chained" and entry.key[0] == FRAMES
        if frames and not bool(flat[entry.key][:, 0].any()):
            entry = _replace(entry, stored="chained_from_zero")
        if entry.key in image_of.values():
            entry = _replace(entry, stored="last_of_frames")
        if entry.key in image_of:
            topic = "/" + "/".join(image_of[entry.key])  # the reset image, then all frames: one video
        named.append(_replace(entry, topic=topic))
    # The reset image comes before the frames on their common topic.
    return sorted(named, key=lambda e: e.stored != "last_of_frames")


def _last_frames_match(
    flat: dict[tuple[str, ...], Tensor], valid: Tensor, image: tuple[str, ...], frames: tuple[str, ...]
) -> bool:
    """Whether every next image is the last executed one of the decision's frames."""
    mask = flat.get(("next", STEP_MASK))
    if mask is None or bool((mask[..., 1:] & ~mask[..., :-1]).any()):
        return False
    shown, video = flat["next", *image], flat["next", *frames]
    rows, steps = valid.nonzero(as_tuple=True)
    last = mask[rows, steps].sum(-1) - 1
    if (
        video.shape[2:3] != mask.shape[2:]
        or video.shape[3:] != shown.shape[2:]
        or not len(rows)
        or bool((last < 0).any())
    ):
        return False
    return bool((video[rows, steps, last] == shown[rows, steps]).all())


def _name_fields(numbers: list[Entry]) -> tuple[Entry, ...]:
    """Field names: the key joined by underscores; a root value beside a next value is called ``root_...``."""
    named, used = [], {field.name for field in _INDEX_FIELDS}
    for entry in numbers:
        name = re.sub(r"[^A-Za-z0-9_]", "_", "_".join(entry.key))
        if entry.stored == "root" and any(e.key == entry.key and e.stored == "next" for e in numbers):
            name = f"root_{name}"
        name = name if re.match(r"[A-Za-z]", name) else f"entry_{name}"
        unique, number = name, 2
        while unique in used:
            unique, number = f"{name}_{number}", number + 1
        used.add(unique)
        named.append(_replace(entry, field=unique))
    return tuple(named)
