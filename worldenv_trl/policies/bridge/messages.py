"""Messages of the bridge: a prefix (magic, version, lengths), a header in JSON, arrays in safetensors' format.

Nothing that is read can run code.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

__all__ = ["PROTOCOL_VERSION", "ProtocolError", "VersionError", "receive_message", "send_message", "socket_address"]

PROTOCOL_VERSION = 1

_MAGIC = b"WEPB"
_PREFIX = struct.Struct("!4sHIQ")  # magic, version, bytes of the header, bytes of the arrays
_MAX_HEADER, _MAX_ARRAYS = 1 << 20, 1 << 30  # what asks for more is no message of ours


class ProtocolError(ValueError):
    """What came is no message of this protocol."""


class VersionError(ProtocolError):
    """The other side speaks another version of the protocol."""


def send_message(
    connection: socket.socket,
    header: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray] | None = None,
    *,
    deadline: float | None = None,
) -> None:
    """Sends one message.

    Args:
        connection: to whom.
        header: what JSON can hold.
        arrays: by name.

    Keyword Args:
        deadline: ``time.monotonic()`` by which it has to be gone; None waits for ever.

    Raises:
        TimeoutError: at the deadline.
        OSError: if the connection is gone.
    """
    text = json.dumps(header).encode()
    data = safetensors.numpy.save({name: np.ascontiguousarray(value) for name, value in (arrays or {}).items()})
    connection.settimeout(_remaining(deadline))
    connection.sendall(_PREFIX.pack(_MAGIC, PROTOCOL_VERSION, len(text), len(data)) + text)
    connection.settimeout(_remaining(deadline))
    connection.sendall(data)


def receive_message(
    connection: socket.socket, *, deadline: float | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of the next message.

    Keyword Args:
        deadline: ``time.monotonic()`` by which all of it has to be here; None waits for ever.

    Raises:
        EOFError: if the other side has closed the connection between two messages.
        ConnectionError: if it did inside one.
        TimeoutError: at the deadline.
        VersionError: if it speaks another version.
        ProtocolError: if what came is no message.
    """
    start = _receive(connection, _PREFIX.size, deadline, at_start=True)
    magic, version, header_bytes, array_bytes = _PREFIX.unpack(start)
    if magic != _MAGIC:
        raise ProtocolError(f"a message begins with {_MAGIC!r}, this one with {bytes(start[:8])!r}")
    if version != PROTOCOL_VERSION:
        raise VersionError(f"it speaks version {version} of the protocol, this side speaks {PROTOCOL_VERSION}")
    if header_bytes > _MAX_HEADER or array_bytes > _MAX_ARRAYS:
        raise ProtocolError(f"a message of {header_bytes + array_bytes} bytes is announced, which is none of ours")
    text, data = (_receive(connection, count, deadline) for count in (header_bytes, array_bytes))
    try:
        header = json.loads(text.decode())
        arrays = safetensors.numpy.load(bytes(data))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError, KeyError, safetensors.SafetensorError) as error:
        raise ProtocolError(f"the message cannot be read ({error})") from error
    if not isinstance(header, dict) or not isinstance(header.get("kind"), str):
        raise ProtocolError(f"a header must be an object with a kind, got {text[:80].decode(errors='replace')}")
    return header, arrays


def socket_address(address: str) -> tuple[int, Any]:
    """Family and address of ``host:port``, ``[IPv6]:port`` or ``unix:/path/of/a/socket``.

    Raises:
        ValueError: for anything else.

    Examples:
        >>> socket_address("unix:pi0.sock")[1], socket_address("localhost:8765")[1]
        ('pi0.sock', ('localhost', 8765))
    """
    if address.startswith("unix:") and len(address) > len("unix:"):
        return socket.AF_UNIX, address[len("unix:") :]
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and int(port) < 1 << 16):
        raise ValueError(f"an address is host:port or unix:/path, got {address!r}")
    if host.startswith("[") and host.endswith("]"):
        return socket.AF_INET6, (host[1:-1], int(port))
    return socket.AF_INET, (host, int(port))


def _receive(connection: socket.socket, count: int, deadline: float | None, at_start: bool = False) -> bytearray:
    data = bytearray(count)
    view, filled = memoryview(data), 0
    while filled < count:
        connection.settimeout(_remaining(deadline))
        received = connection.recv_into(view[filled:])
        if not received:
            if at_start and not filled:
                raise EOFError("the other side has closed the connection")
            raise ConnectionError("the other side has closed the connection inside a message")
        filled += received
    return data


def _remaining(deadline: float | None) -> float | None:
    if deadline is None:
        return None
    remaining = deadline - time.monotonic()
    if remaining <= 0:
        raise TimeoutError("the deadline is over")
    return remaining
