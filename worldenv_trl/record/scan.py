"""What an MCAP file holds, as far as it goes: also when its end is missing or some of its bytes were changed."""

from __future__ import annotations

import io
import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, ChunkIndex, Metadata, Schema

__all__ = ["Chunk", "McapScan", "Message"]

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<BQQQI")
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_TRUNCATED = "is truncated"

Message = tuple[int, int, int, memoryview]  # channel, sequence, log time (ns), data


@dataclass(frozen=True)
class Chunk:
    """A compressed run of messages: their times (ns) and where it lies in the file."""

    start_time: int
    end_time: int
    position: int
    compression: str
    size: int
    crc: int
    data: slice
    complete: bool


class McapScan:
    """The records of a file in their order, without its messages, which :meth:`messages` opens chunk by chunk.

    ``losses`` says, one line each, what is missing; it grows while damaged chunks are opened. Records behind a damaged
    one are found again by the file's index.

    Raises:
        ValueError: if the file is no MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: list[Metadata] = []
        self.attachments: list[Attachment] = []
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.chunks: list[Chunk] = []
        self.losses: list[str] = []
        size = path.stat().st_size
        if size < 8:
            raise ValueError(f"{path} is not an MCAP file: it has {size} bytes")
        with open(path, "rb") as file:
            self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if self._bytes[:8] != _MAGIC:
            raise ValueError(f"{path} is not an MCAP file")
        self._walk()

    @property
    def truncated(self) -> bool:
        return _TRUNCATED in self.losses

    @property
    def intact(self) -> bool:
        return not self.losses

    def _walk(self) -> None:
        data, size = self._bytes, len(self._bytes)
        position = 8
        while position + 9 <= size:
            opcode, length = _HEAD.unpack_from(data, position)
            body = position + 9
            if opcode == Opcode.FOOTER and body + length + 8 == size:
                if data[-8:] != _MAGIC:
                    self.losses.append("is damaged at its end")
                return
            whole = body + length <= size
            known = Opcode.HEADER <= opcode <= Opcode.DATA_END
            if known and whole and self._record(opcode, position, body, length):
                position = body + length
                continue
            later = [place for place in self._indexed() if place > position]
            if later:
                self.losses.append(f"is damaged between byte {position} and byte {later[0]}")
                position = later[0]
                continue
            if opcode == Opcode.CHUNK and not whole:
                self._unfinished(position, body)
            self.losses.append(_TRUNCATED if not whole else f"is damaged behind byte {position}")
            return
        self.losses.append(_TRUNCATED)

    def _record(self, opcode: int, position: int, body: int, length: int) -> bool:
        """Notes a record; False if it makes no sense."""
        try:
            if opcode == Opcode.CHUNK:
                start, end, size, crc, name = _CHUNK.unpack_from(self._bytes, body)
                first = body + _CHUNK.size + name + 8
                compression = self._bytes[body + _CHUNK.size : first - 8].decode()
                self.chunks.append(
                    Chunk(start, end, position, compression, size, crc, slice(first, body + length), complete=True)
                )
            elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.CHANNEL, Opcode.SCHEMA):
                stream = ReadDataStream(io.BytesIO(self._bytes[body : body + length]))
                if opcode == Opcode.METADATA:
                    self.metadata.append(Metadata.read(stream))
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(stream)
                    self.channels[channel.id] = channel
                elif opcode == Opcode.SCHEMA:
                    schema = Schema.read(stream)
                    self.schemas[schema.id] = schema
                else:
                    self._attachment(stream, body, length)
        except (struct.error, ValueError, McapError, IndexError, MemoryError, OverflowError):
            return False
        return True

    def _attachment(self, stream: ReadDataStream, body: int, length: int) -> None:
        attachment = Attachment.read(stream)
        (crc,) = struct.unpack_from("<I", self._bytes, body + length - 4)
        if crc and zlib.crc32(self._bytes[body : body + length - 4]) != crc:
            self.losses.append(f"has a damaged attachment {attachment.name!r}")
        else:
            self.attachments.append(attachment)

    def _indexed(self) -> list[int]:
        """Where chunks begin and what follows the last one, by the index at the end of the file, if it is there."""
        data, size = self._bytes, len(self._bytes)
        if size < 45 or data[-8:] != _MAGIC:
            return []
        opcode, length, summary, offsets, _ = _FOOTER.unpack_from(data, size - 8 - _FOOTER.size)
        if opcode != Opcode.FOOTER or length != 20 or not 8 < summary < size:
            return []
        places, position, end = [summary], summary, offsets or size - 8 - _FOOTER.size
        while position + 9 <= end:
            opcode, length = _HEAD.unpack_from(data, position)
            if opcode == Opcode.CHUNK_INDEX:
                index = ChunkIndex.read(ReadDataStream(io.BytesIO(data[position + 9 : position + 9 + length])))
                places += [index.chunk_start_offset, index.chunk_start_offset + index.chunk_length]
            position += 9 + length
        return sorted(places)

    def _unfinished(self, position: int, body: int) -> None:
        """A chunk whose end is missing."""
        if body + _CHUNK.size > len(self._bytes):
            return
        start, end, size, crc, name = _CHUNK.unpack_from(self._bytes, body)
        first = body + _CHUNK.size + name + 8
        if name > 16 or first > len(self._bytes):
            return
        compression = self._bytes[body + _CHUNK.size : first - 8].decode(errors="replace")
        data = slice(first, len(self._bytes))
        self.chunks.append(Chunk(start, end, position, compression, size, crc, data, complete=False))

    # --------------------------------------------------------------------------------------------- messages

    def messages(self, chunk: Chunk) -> Iterator[Message]:
        """The messages of a chunk; of a damaged one none, of one whose end is missing those that are complete."""
        data = self._opened(chunk)
        view, position, size = memoryview(data), 0, len(data)
        while position + 9 <= size:
            opcode, length = _HEAD.unpack_from(data, position)
            body, end = position + 9, position + 9 + length
            if end > size:
                return
            if opcode == Opcode.MESSAGE:
                channel, sequence, time, _ = _MESSAGE.unpack_from(data, body)
                yield channel, sequence, time, view[body + _MESSAGE.size : end]
            elif opcode == Opcode.CHANNEL:
                record = Channel.read(ReadDataStream(io.BytesIO(data[body:end])))
                self.channels[record.id] = record
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(io.BytesIO(data[body:end])))
                self.schemas[schema.id] = schema
            position = end

    def _opened(self, chunk: Chunk) -> bytes:
        packed = self._bytes[chunk.data]
        if not chunk.complete:
            return _prefix(packed) if chunk.compression == "zstd" else packed if not chunk.compression else b""
        try:
            if chunk.compression not in ("", "zstd"):
                raise ValueError(f"compression {chunk.compression!r} is not supported")
            zstd = zstandard.ZstdDecompressor()
            data = zstd.decompress(packed, max_output_size=chunk.size) if chunk.compression else packed
            if len(data) != chunk.size or (chunk.crc and zlib.crc32(data) != chunk.crc):
                raise ValueError("its checksum differs")
        except (zstandard.ZstdError, ValueError, MemoryError) as error:
            self.losses.append(f"is damaged behind byte {chunk.position} ({chunk.size} bytes of messages: {error})")
            return b""
        return data


def _prefix(data: bytes) -> bytes:
    """What a zstd stream without its end still gives."""
    decompressor = zstandard.ZstdDecompressor().decompressobj()
    out = bytearray()
    try:
        for start in range(0, len(data), 4096):
            out += decompressor.decompress(data[start : start + 4096])
    except zstandard.ZstdError:
        pass
    return bytes(out)
