"""The index that ends an MCAP file. Where its checksum holds, nothing before it has to be trusted."""

from __future__ import annotations

import io
import mmap
import struct
import zlib
from dataclasses import dataclass, field

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, McapRecord, MetadataIndex, Schema, Statistics

__all__ = ["HEAD", "MAGIC", "FileIndex", "IndexedChunk", "parsed", "read_index"]

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode, length of the body
_FOOTER = struct.Struct("<BQQQI")
_CHUNK = struct.Struct("<QQQQI")
_KINDS: dict[int, type[McapRecord]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
}


@dataclass(frozen=True)
class IndexedChunk:
    """Times (ns) of a chunk, where it lies, how large its messages are packed and unpacked."""

    start_time: int
    end_time: int
    offset: int
    length: int
    compression: str
    packed: int
    size: int


@dataclass
class FileIndex:
    """Where a file's records are. Its data end, and the index begins, at byte ``end``."""

    end: int
    schemas: list[Schema] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    chunks: list[IndexedChunk] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)


def read_index(data: bytes | mmap.mmap, size: int) -> FileIndex | None:
    """The index of a file of ``size`` bytes; None if it is missing, damaged or (which is allowed) not complete."""
    footer = size - 8 - _FOOTER.size
    if footer < 8 or data[size - 8 : size] != MAGIC:
        return None
    opcode, length, start, _, crc = _FOOTER.unpack_from(data, footer)
    if opcode != Opcode.FOOTER or length != 20 or not 8 < start < footer or not crc:
        return None
    if zlib.crc32(data[start : size - 12]) != crc:
        return None
    found: dict[int, list] = {kind: [] for kind in (*_KINDS, Opcode.CHUNK_INDEX)}
    counts, position = None, start
    while position + HEAD.size <= footer:
        opcode, length = HEAD.unpack_from(data, position)
        body = data[position + HEAD.size : position + HEAD.size + length]
        if opcode == Opcode.STATISTICS:
            counts = Statistics.read(ReadDataStream(io.BytesIO(body)))
        elif opcode == Opcode.CHUNK_INDEX:
            found[opcode].append(_chunk(body))
        elif opcode in _KINDS:
            found[opcode].append(_KINDS[opcode].read(ReadDataStream(io.BytesIO(body))))
        position += HEAD.size + length
    index = FileIndex(
        end=start,
        schemas=found[Opcode.SCHEMA],
        channels=found[Opcode.CHANNEL],
        chunks=found[Opcode.CHUNK_INDEX],
        metadata=found[Opcode.METADATA_INDEX],
        attachments=found[Opcode.ATTACHMENT_INDEX],
    )
    complete = counts is not None and (
        (len(index.schemas), len(index.channels), len(index.chunks), len(index.metadata), len(index.attachments))
        == (
            counts.schema_count,
            counts.channel_count,
            counts.chunk_count,
            counts.metadata_count,
            counts.attachment_count,
        )
    )
    return index if complete else None


def _chunk(body: bytes) -> IndexedChunk:
    first, last, offset, length, offsets = _CHUNK.unpack_from(body)
    _, name = struct.unpack_from("<QI", body, _CHUNK.size + offsets)
    at = _CHUNK.size + offsets + 12
    packed, size = struct.unpack_from("<QQ", body, at + name)
    return IndexedChunk(first, last, offset, length, body[at : at + name].decode(), packed, size)


def parsed(kind: type[McapRecord], body: bytes) -> McapRecord | None:
    """A record from its bytes, None if they are not exactly one such record."""
    try:
        record = kind.read(ReadDataStream(io.BytesIO(body)))
    except (struct.error, ValueError, McapError, IndexError, MemoryError, OverflowError):
        return None
    builder = RecordBuilder()
    record.write(builder)
    return record if builder.end()[HEAD.size :] == body else None
