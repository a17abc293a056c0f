"""What becomes known of recorded rollouts later: advantages, ratios, clip flags."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import numpy as np
import torch
from tensordict import TensorDictBase

from worldenv_trl.record.mcap.file import McapFile
from worldenv_trl.record.mcap.layout import Layout, leaves, to_bytes
from worldenv_trl.record.mcap.protobuf import FixedMessage, MessageField

__all__ = ["Annotator", "annotation_message"]


class Annotator:
    """Adds entries to rollouts that are in the file already.

    Args:
        file: where to.
        name: of the metadata record that announces a kind of annotation.
        length: entries of a rollout, by its number; raises ``KeyError`` for one that is not there.
        time: when (ns) a step of a rollout plays.
        known: layouts that the file has announced already.
    """

    def __init__(
        self,
        file: McapFile,
        name: str,
        length: Callable[[int], int],
        time: Callable[[int, int], int],
        known: Sequence[Layout] = (),
    ) -> None:
        self._file, self._name, self._length, self._time = file, name, length, time
        self._known = list(known)

    def write(self, entries: TensorDictBase, numbers: Sequence[int]) -> None:
        """Entries [*B, T] of the rollouts with these numbers; raises ``ValueError`` where they do not fit."""
        tensors, texts = leaves(entries)
        count, steps = int(np.prod(entries.shape[:-1], dtype=np.int64)), entries.shape[-1]
        if texts or count != len(numbers):
            raise ValueError(f"{count} rollouts of numbers must be given for the rollouts {list(numbers)}")
        try:
            lengths = [self._length(number) for number in numbers]
        except KeyError as error:
            raise ValueError(f"rollout {error} is not in the file: annotate what was recorded") from error
        if steps < max(lengths, default=0):
            raise ValueError(f"the rollouts have up to {max(lengths)} entries, the annotation has {steps}")
        flat = {key: value.reshape(count, steps, *value.shape[entries.ndim :]) for key, value in tensors.items()}
        layout = Layout.of(flat, (), torch.ones(count, steps, dtype=torch.bool))
        if layout.images or any(e.chained for e in layout.numbers):
            raise ValueError("an annotation holds numbers, root or next: neither images nor entries given as both")
        layout = Layout((), layout.numbers, (), 1)
        if layout not in self._known:
            self._known.append(layout)
            topic = f"/annotation_{len(self._known)}"
            record = {"layout": layout.to_json(), "topic": topic}
            self._file.write_metadata(self._name, {"json": json.dumps(record)})
        message = annotation_message(layout)
        topic = f"/annotation_{self._known.index(layout) + 1}"
        channel = self._file.channel(topic, message.name, message.schema())
        for row, (number, length) in enumerate(zip(numbers, lengths, strict=True)):
            if not length:
                continue
            values = [flat[e.key if e.stored == "root" else ("next", *e.key)][row, :length] for e in layout.numbers]
            index = np.stack([np.full(length, number, np.int64), np.arange(length, dtype=np.int64)])[..., None]
            times = np.array([self._time(number, step) for step in range(length)])
            body = self._file.block(channel, times, np.full(length, number), message.nbytes)
            message.fill(body, [*index.view(np.uint8), *map(to_bytes, values)])
        self._file.flush()


def annotation_message(layout: Layout) -> FixedMessage:
    """The messages of an annotation: which rollout and step, and a field for each entry."""
    index = [MessageField("rollout", torch.int64, 1), MessageField("step", torch.int64, 1)]
    fields = [MessageField(e.field, e.torch_dtype, e.count) for e in layout.numbers]
    return FixedMessage("worldenv_trl.Annotation", index + fields)
