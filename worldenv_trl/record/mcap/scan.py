"""What an MCAP file holds, as far as it goes: also when its end is missing or some of its bytes were changed."""

from __future__ import annotations

import json
import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from worldenv_trl.record.mcap.index import HEAD, MAGIC, FileIndex, parsed, read_index

__all__ = ["METADATA_COPY", "Chunk", "McapScan", "Message"]

METADATA_COPY = "worldenv_trl.metadata.json"  # attachment, hence with a checksum: all metadata records of the file
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_TRUNCATED = "is truncated"
# The head of a record: any record of the data, of less than 2**40 bytes.
_RECORD = re.compile(rb"[\x01-\x0f](?=.{5}\x00\x00\x00)", re.DOTALL)

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

    ``losses`` says, one line each, what is missing; it grows while damaged chunks are opened. Where the index at the
    end of the file is whole (``indexed``), records are found by it, whatever happened to the bytes around them. Where
    it is not, they are found one behind the other, and behind a damaged one by what a record looks like.

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
        index = read_index(self._bytes, size) or self._index_before_junk(size)
        self.indexed = index is not None
        if index is not None:
            self._adopt(index)
        elif self._bytes[:8] == MAGIC or self._record_at(8) is not None:
            self._walk()
        else:
            raise ValueError(f"{path} is not an MCAP file")
        self._use_copy()

    @property
    def intact(self) -> bool:
        return not self.losses

    # --------------------------------------------------------------------------------------------- by the index

    def _index_before_junk(self, size: int) -> FileIndex | None:
        end = self._bytes.rfind(MAGIC) + len(MAGIC)
        index = read_index(self._bytes, end) if 16 < end < size else None
        if index is not None:
            self.losses.append(f"has {size - end} bytes behind its end")
        return index

    def _adopt(self, index: FileIndex) -> None:
        self.schemas = {schema.id: schema for schema in index.schemas}
        self.channels = {channel.id: channel for channel in index.channels}
        for each in index.chunks:
            end = each.offset + each.length
            self.chunks.append(
                Chunk(
                    each.start_time,
                    each.end_time,
                    each.offset,
                    each.compression,
                    each.size,
                    struct.unpack_from("<I", self._bytes, each.offset + HEAD.size + 24)[0],
                    slice(end - each.packed, end),
                    complete=True,
                )
            )
        for each in index.attachments:
            self._note_attachment(each.offset + HEAD.size, each.offset + each.length, each.name)
        copied = any(attachment.name == METADATA_COPY for attachment in self.attachments)
        for each in index.metadata:
            record = parsed(Metadata, self._bytes[each.offset + HEAD.size : each.offset + each.length])
            if record is not None:
                self.metadata.append(record)
            elif not copied:
                self.losses.append(f"has a damaged metadata record {each.name!r}")
        broken = self._broken_chain(index.end)
        if broken is not None and self.intact:
            self.losses.append(f"is damaged at byte {broken}, where other programs may stop")

    def _broken_chain(self, end: int) -> int | None:
        """Where, before ``end``, a record is not followed by another one."""
        if self._bytes[:8] != MAGIC:
            return 0
        position, last = 8, None
        while position + HEAD.size <= end:
            opcode, length = HEAD.unpack_from(self._bytes, position)
            if not Opcode.HEADER <= opcode <= Opcode.DATA_END:
                break
            last, position = position, position + HEAD.size + length
        return None if position == end else last if last is not None else 8

    def _use_copy(self) -> None:
        """The copy of the metadata has a checksum, the records have none."""
        copies = [attachment for attachment in self.attachments if attachment.name == METADATA_COPY]
        self.attachments = [attachment for attachment in self.attachments if attachment.name != METADATA_COPY]
        if copies:
            whole = [Metadata(name=name, metadata=values) for name, values in json.loads(copies[0].data)]
            if whole != self.metadata:
                self.losses.append("has damaged metadata (their copy was read)")
            self.metadata = whole

    # --------------------------------------------------------------------------------------------- one by one

    def _walk(self) -> None:
        size, position = len(self._bytes), 8
        while position + HEAD.size <= size:
            end = self._record_at(position)
            if end is not None:
                opcode = self._bytes[position]
                self._note(opcode, position, end)
                if opcode == Opcode.DATA_END:
                    whole = self._bytes[-8:] == MAGIC
                    self.losses.append("has a damaged index" if whole else _TRUNCATED)
                    return
                position = end
                continue
            later = self._next_record(position + 1)
            if later is None:
                break
            self.losses.append(f"is damaged between byte {position} and byte {later}")
            position = later
        self._unfinished(position)
        self.losses.append(_TRUNCATED)

    def _record_at(self, position: int) -> int | None:
        """Where the record that begins at ``position`` ends; None if there is no sound one."""
        data = self._bytes
        if position + HEAD.size > len(data):
            return None
        opcode, length = HEAD.unpack_from(data, position)
        body, end = position + HEAD.size, position + HEAD.size + length
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END or end > len(data):
            return None
        if opcode == Opcode.CHUNK:
            parts = self._chunk_parts(body)
            sound = parts is not None and parts[-1].stop == end
        elif opcode == Opcode.MESSAGE_INDEX:
            sound = length >= 6 and struct.unpack_from("<I", data, body + 2)[0] == length - 6
        elif opcode == Opcode.METADATA:
            sound = parsed(Metadata, data[body:end]) is not None
        elif opcode == Opcode.ATTACHMENT:
            sound = length >= 36
        elif opcode == Opcode.HEADER:
            sound = length >= 8 and sum(struct.unpack_from("<I", data, body)) <= length
        else:
            sound = opcode == Opcode.DATA_END and length == 4
        return end if sound else None

    def _next_record(self, position: int) -> int | None:
        """The next place from which two sound records follow each other, or one that ends the data."""
        for match in _RECORD.finditer(self._bytes, position):
            end = self._record_at(match.start())
            if end is not None and (self._bytes[match.start()] == Opcode.DATA_END or self._record_at(end) is not None):
                return match.start()
        return None

    def _note(self, opcode: int, position: int, end: int) -> None:
        body = position + HEAD.size
        if opcode == Opcode.CHUNK:
            parts = self._chunk_parts(body)
            if parts is not None:
                start, last, size, crc, compression, data = parts
                self.chunks.append(Chunk(start, last, position, compression, size, crc, data, complete=True))
        elif opcode == Opcode.METADATA:
            self.metadata.append(parsed(Metadata, self._bytes[body:end]))
        elif opcode == Opcode.ATTACHMENT:
            self._note_attachment(body, end)

    def _note_attachment(self, body: int, end: int, name: str = "") -> None:
        data = self._bytes[body : end - 4]
        (crc,) = struct.unpack_from("<I", self._bytes, end - 4)
        record = parsed(Attachment, data + struct.pack("<I", zlib.crc32(data)))
        if record is not None and (not crc or zlib.crc32(data) == crc):
            self.attachments.append(record)
        elif name != METADATA_COPY:  # the records themselves are left
            self.losses.append(f"has a damaged attachment{f' {name!r}' if name else ''}")

    def _note_named(self, kind: type[Channel | Schema], body: bytes, known: dict) -> None:
        record = parsed(kind, body)
        if record is not None:
            known[record.id] = record

    def _chunk_parts(self, body: int) -> tuple[int, int, int, int, str, slice] | None:
        """Times, size, checksum and compression of a chunk, and where its data lie."""
        data = self._bytes
        if body + _CHUNK.size > len(data):
            return None
        start, end, size, crc, name = _CHUNK.unpack_from(data, body)
        first = body + _CHUNK.size + name + 8
        if name > 16 or first > len(data):
            return None
        (packed,) = struct.unpack_from("<Q", data, first - 8)
        compression = data[body + _CHUNK.size : first - 8].decode(errors="replace")
        return start, end, size, crc, compression, slice(first, first + packed)

    def _unfinished(self, position: int) -> None:
        """A chunk whose end is missing."""
        if position + HEAD.size > len(self._bytes) or self._bytes[position] != Opcode.CHUNK:
            return
        parts = self._chunk_parts(position + HEAD.size)
        if parts is not None and parts[-1].stop > len(self._bytes):
            start, end, size, crc, compression, data = parts
            rest = slice(data.start, len(self._bytes))
            self.chunks.append(Chunk(start, end, position, compression, size, crc, rest, complete=False))

    # --------------------------------------------------------------------------------------------- messages

    def messages(self, chunk: Chunk) -> Iterator[Message]:
        """The messages of a chunk; of a damaged one none, of one whose end is missing those that are complete."""
        data = self._opened(chunk)
        view, position, size = memoryview(data), 0, len(data)
        while position + 9 <= size:
            opcode, length = HEAD.unpack_from(data, position)
            body, end = position + 9, position + 9 + length
            if end > size:
                return
            if opcode == Opcode.MESSAGE:
                channel, sequence, time, _ = _MESSAGE.unpack_from(data, body)
                yield channel, sequence, time, view[body + _MESSAGE.size : end]
            elif opcode == Opcode.CHANNEL:
                self._note_named(Channel, data[body:end], self.channels)
            elif opcode == Opcode.SCHEMA:
                self._note_named(Schema, data[body:end], self.schemas)
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
            checked = chunk.compression and zstandard.get_frame_parameters(packed).has_checksum
            if len(data) != chunk.size or (chunk.crc and not checked and zlib.crc32(data) != chunk.crc):
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
