"""Protobuf messages of fixed size: thousands are packed or unpacked as one array."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

__all__ = ["FixedMessage", "MessageField", "image_data", "varint"]

_DOUBLE, _FLOAT, _BOOL, _STRING, _MESSAGE, _BYTES, _SFIXED32, _SFIXED64 = 1, 2, 8, 9, 11, 12, 15, 16
_TYPES = {
    torch.float64: _DOUBLE,
    torch.float32: _FLOAT,
    torch.bool: _BOOL,
    torch.int32: _SFIXED32,
    torch.int64: _SFIXED64,
}  # every other dtype is stored as bytes
_WIRE = {_DOUBLE: 1, _SFIXED64: 1, _FLOAT: 5, _SFIXED32: 5, _BOOL: 0}
_LENGTH_DELIMITED = 2


@dataclass(frozen=True)
class MessageField:
    """One field: ``count`` numbers of ``dtype``. A single number is a plain field, so that viewers plot it by name."""

    name: str
    dtype: torch.dtype
    count: int

    @property
    def nbytes(self) -> int:
        return self.count * self.dtype.itemsize


class FixedMessage:
    """A message type whose fields always have the same sizes, so every message has the same bytes but for its values.

    Args:
        name: full name, for instance ``worldenv_trl.Step``.
        fields: numbered from 1 in their order.
    """

    def __init__(self, name: str, fields: list[MessageField]) -> None:
        self.name, self.fields = name, fields
        template, self._places = bytearray(), []
        for number, field in enumerate(fields, 1):
            template += _header(number, field)
            self._places.append(slice(len(template), len(template) + field.nbytes))
            template += bytes(field.nbytes)
        self._template = np.frombuffer(bytes(template), np.uint8)
        self._constant = np.ones(len(template), bool)
        for place in self._places:
            self._constant[place] = False

    @property
    def nbytes(self) -> int:
        return len(self._template)

    def pack(self, values: list[np.ndarray]) -> list[bytes]:
        """Messages from the fields' raw bytes, uint8 [n, nbytes of the field] each."""
        joined = self.fill(np.empty((len(values[0]), self.nbytes), np.uint8), values).tobytes()
        return [joined[start : start + self.nbytes] for start in range(0, len(joined), self.nbytes)]

    def fill(self, messages: np.ndarray, values: list[np.ndarray]) -> np.ndarray:
        """Writes messages uint8 [n, nbytes] in place, from the fields' raw bytes, and returns them."""
        messages[:] = self._template
        for place, value in zip(self._places, values, strict=True):
            messages[:, place] = value
        return messages

    def unpack(self, messages: Sequence[bytes | memoryview]) -> list[np.ndarray]:
        """The fields' raw bytes, uint8 [n, nbytes of the field] each.

        Raises:
            ValueError: for messages of another type.
        """
        joined = np.frombuffer(b"".join(messages), np.uint8)
        if joined.size != len(messages) * self.nbytes:
            raise ValueError(f"{self.name} messages must have {self.nbytes} bytes each")
        packed = joined.reshape(len(messages), self.nbytes)
        if (packed[:, self._constant] != self._template[self._constant]).any():
            raise ValueError(f"these are not {self.name} messages")
        return [packed[:, place] for place in self._places]

    def schema(self) -> bytes:
        """A serialised ``google.protobuf.FileDescriptorSet``."""
        package, _, name = self.name.rpartition(".")
        message = _bytes_field(1, name.encode())
        for number, field in enumerate(self.fields, 1):
            kind, repeated = _kind(field)
            message += _bytes_field(
                2,
                _bytes_field(1, field.name.encode())
                + _varint_field(3, number)
                + _varint_field(4, 3 if repeated else 1)
                + _varint_field(5, kind),
            )
        file = _bytes_field(1, f"{self.name}.proto".encode()) + _bytes_field(2, package.encode())
        file += _bytes_field(4, message) + _bytes_field(12, b"proto3")
        return _bytes_field(1, file)


def image_data(message: bytes | memoryview) -> tuple[int, int, int]:
    """Width, height and where the pixels start in a serialised ``foxglove.RawImage``.

    Raises:
        ValueError: for a message that is no rgb8 image.
    """
    width = height = 0
    data = encoding = None
    position = 0
    try:
        while position < len(message):
            tag, position = _read_varint(message, position)
            number, wire = tag >> 3, tag & 7
            if wire == _LENGTH_DELIMITED:
                size, position = _read_varint(message, position)
                if number == 4:
                    encoding = message[position : position + size]
                elif number == 6:
                    data = (position, size)
                position += size
            elif wire == 5:
                value = int.from_bytes(message[position : position + 4], "little")
                width, height = (value, height) if number == 2 else (width, value) if number == 3 else (width, height)
                position += 4
            elif wire == 1:
                position += 8
            else:
                _, position = _read_varint(message, position)
    except IndexError as error:
        raise ValueError("the image message ends too early") from error
    if data is None or encoding != b"rgb8" or data[1] != width * height * 3 or sum(data) > len(message):
        raise ValueError(f"the message is no rgb8 image of {width} x {height} px")
    return width, height, data[0]


def _kind(field: MessageField) -> tuple[int, bool]:
    """Protobuf type, and whether the field is repeated."""
    kind = _TYPES.get(field.dtype, _BYTES)
    return kind, kind != _BYTES and field.count != 1


def _header(number: int, field: MessageField) -> bytes:
    kind, repeated = _kind(field)
    if repeated or kind == _BYTES:
        return varint(number << 3 | _LENGTH_DELIMITED) + varint(field.nbytes)
    return varint(number << 3 | _WIRE[kind])


@lru_cache(65536)
def varint(value: int) -> bytes:
    """A protobuf varint."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _read_varint(message: bytes | memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7


def _bytes_field(number: int, value: bytes) -> bytes:
    return varint(number << 3 | _LENGTH_DELIMITED) + varint(len(value)) + value


def _varint_field(number: int, value: int) -> bytes:
    return varint(number << 3) + varint(value)
