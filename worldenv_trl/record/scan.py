"""Records of an MCAP file in their order, as far as the file goes."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

__all__ = ["Truncated", "scan"]


class Truncated(Exception):
    """The file ends before it is complete; every record up to there was delivered."""


def scan(path: Path) -> Iterator[McapRecord]:
    """Yields records; chunks are opened, the readable part of an unfinished one included.

    Raises:
        ValueError: if the file is no MCAP, or bytes in it were changed.
        Truncated: at the end of a file that was cut off or never closed.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        records = StreamReader(file, emit_chunks=True, record_size_limit=max(size, 1)).records
        start = 8  # where the record that is being read begins, behind the magic
        try:
            while (record := next(records, None)) is not None:
                if isinstance(record, Chunk):
                    yield from breakup_chunk(record, validate_crc=True)
                else:
                    yield record
                start = file.tell()
            return
        except InvalidMagic as error:
            if start > 8:
                raise ValueError(f"{path} is damaged at its end. Restore it from a copy") from error
            raise ValueError(f"{path} is not an MCAP file") from error
        except (CRCValidationError, McapError, zstandard.ZstdError, struct.error, UnicodeDecodeError) as error:
            if size < 8:
                raise ValueError(f"{path} is not an MCAP file: it has {size} bytes") from error
            if not _reaches_past(file, start, size):
                raise ValueError(f"{path} is damaged behind byte {start}: {error}. Restore it from a copy") from error
        yield from _unfinished_chunk(file, start)
    raise Truncated(str(path))


def _reaches_past(file: io.BufferedReader, start: int, size: int) -> bool:
    """Whether the record at ``start`` ends behind the file, as the last one of an interrupted recording does."""
    file.seek(start)
    head = file.read(9)
    if len(head) < 9:
        return True
    opcode, length = struct.unpack("<BQ", head)
    return start + 9 + length + (8 if opcode == Opcode.FOOTER else 0) > size


def _unfinished_chunk(file: io.BufferedReader, start: int) -> Iterator[McapRecord]:
    """The complete records of a chunk whose end is missing, if that is what begins at ``start``."""
    file.seek(start)
    head = file.read(9 + 8 + 8 + 8 + 4 + 4)  # opcode, length; times, size, CRC, length of the compression's name
    if len(head) < 41 or head[0] != Opcode.CHUNK:
        return
    (name_length,) = struct.unpack("<I", head[37:41])
    name = file.read(name_length)
    data = file.read()[8:]
    if name == b"zstd":
        data = _decompressed(data)
    elif name:
        return
    stream = ReadDataStream(io.BytesIO(data))
    while stream.count + 9 <= len(data):
        opcode, length = stream.read1(), stream.read8()
        if stream.count + length > len(data):
            return
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)


def _decompressed(data: bytes) -> bytes:
    """What a zstd stream without its end still gives."""
    decompressor = zstandard.ZstdDecompressor().decompressobj()
    out = bytearray()
    try:
        for start in range(0, len(data), 4096):
            out += decompressor.decompress(data[start : start + 4096])
    except (zstandard.ZstdError, zlib.error):
        pass
    return bytes(out)
