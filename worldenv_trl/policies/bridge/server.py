"""A server that answers the bridge's requests with a policy's actions."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .description import ACTION_DIM, Description
from .messages import ProtocolError, receive_message, send_message, socket_address

__all__ = ["PolicyServer", "serve"]

STATE_DIM = 7

Act = Callable[[Mapping[str, np.ndarray], np.ndarray, Sequence[str]], Any]
"""From uint8 [n, 3, H, W] by camera, float32 [n, 7] and n texts to actions, [n, C, 7], or to actions and the logarithms
of their Laplace scale, two such arrays."""


class PolicyServer:
    """Answers at an address until it is closed: a thread for each client, one call of the policy at a time.

    It trusts whoever can connect: keep the address on this machine (the default), or tunnel it.

    Args:
        act: the policy; an exception that it raises goes to the client as one line.
        description: what it is.
        address: ``host:port``, 0 for any free port, or ``unix:/path``.
        say: takes a line when a client comes, goes or sends what cannot be read.

    Attributes:
        address: where it can be reached.

    Raises:
        ValueError: if it cannot listen there.
    """

    def __init__(
        self,
        act: Act,
        description: Description,
        address: str = "127.0.0.1:0",
        *,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.act, self.description, self.say = act, description, say
        self._acting = threading.Lock()
        self._connections: set[socket.socket] = set()
        self._began = False
        family, where = socket_address(address)
        self._path = where if family == socket.AF_UNIX else None
        try:
            if self._path is not None:
                _remove_dead_socket(self._path)
            self._server = _listener(family)(where, self._serve_client)
        except OSError as error:
            raise ValueError(
                f"cannot listen at {address} ({error.strerror or error}): choose another address, or end what is there"
            ) from error
        if self._path is not None:
            os.chmod(self._path, 0o600)  # for this user alone
            self.address = address
        else:
            host, port = self._server.socket.getsockname()[:2]
            self.address = f"[{host}]:{port}" if family == socket.AF_INET6 else f"{host}:{port}"

    def serve_forever(self) -> None:
        """Answers until :meth:`close` is called from another thread, or an exception comes from a signal."""
        self._began = True
        self._server.serve_forever(poll_interval=0.1)

    def close(self) -> None:
        """Ends :meth:`serve_forever`, lets go of the address and cuts the clients off."""
        if self._began:
            self._server.shutdown()
        self._server.server_close()
        for connection in tuple(self._connections):
            with contextlib.suppress(OSError):  # it has just gone by itself
                connection.shutdown(socket.SHUT_RDWR)
        if self._path is not None and os.path.exists(self._path):
            os.unlink(self._path)

    def _serve_client(self, connection: socket.socket, client: Any, server: Any) -> None:
        who = "a client"
        if connection.family != socket.AF_UNIX:
            who = f"{client[0]}:{client[1]}"
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else an answer waits 40 ms for its end
        self.say(f"{who} is here")
        self._connections.add(connection)
        try:
            while True:
                header, arrays = receive_message(connection)
                send_message(connection, *self._reply(header, arrays))
        except EOFError:
            self.say(f"{who} is gone")
        except ProtocolError as error:
            self.say(f"{who} is cut off: {error}")
            with contextlib.suppress(OSError):  # whoever speaks the protocol, in whichever version, learns why
                send_message(connection, {"kind": "error", "message": str(error)}, deadline=time.monotonic() + 5)
        except OSError as error:
            self.say(f"{who} is gone: {error}")
        finally:
            self._connections.discard(connection)

    def _reply(
        self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        number = {"id": header.get("id")}
        if header["kind"] == "hello":
            return {"kind": "hello", "policy": dataclasses.asdict(self.description)} | number, {}
        try:
            if header["kind"] != "act":
                raise ValueError(f"a request is of the kind hello or act, got {header['kind']!r}")
            images, state, instructions = _request(self.description, header, arrays)
            with self._acting:
                actions = _actions(self.act(images, state, instructions), len(state), self.description.chunk_length)
            return {"kind": "actions"} | number, actions
        except Exception as error:  # whatever a policy raises: the client is told, and the server lives on
            line = " ".join(f"{type(error).__name__}: {error}".split())
            self.say(f"a request failed: {line}")
            return {"kind": "error", "message": line} | number, {}


def serve(act: Act, description: Description, address: str = "127.0.0.1:8765") -> None:
    """Serves a policy until Ctrl-C or SIGTERM, and says so on standard output; call it from the main thread.

    Raises:
        ValueError: if it cannot listen there.
    """

    def say(line: str) -> None:
        with contextlib.suppress(OSError):  # nobody reads any more: no reason to leave a client alone
            print(f"{line}\n", end="", flush=True)  # one write: lines of several clients stay whole

    server = PolicyServer(act, description, address, say=say)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    say(f"{description.name} is served at {server.address}; Ctrl-C ends it")
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        say("ended")
    finally:
        server.close()
        signal.signal(signal.SIGTERM, before)


def _listener(family: int) -> Any:
    base: Any = socketserver.UnixStreamServer if family == socket.AF_UNIX else socketserver.TCPServer

    class Listener(socketserver.ThreadingMixIn, base):
        daemon_threads = True  # a client that says nothing keeps no server alive
        allow_reuse_address = True
        address_family = family

    return Listener


def _remove_dead_socket(path: str) -> None:
    """Takes away what a killed server has left; where one answers, binding fails and says so."""
    if not os.path.exists(path):
        return
    with socket.socket(socket.AF_UNIX) as asking:
        try:
            asking.connect(path)
        except ConnectionRefusedError:
            os.unlink(path)


def _request(
    description: Description, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    size, instructions = description.image_size, header.get("instructions")
    if not isinstance(instructions, list) or not all(isinstance(text, str) for text in instructions):
        raise ValueError(f"instructions must be a list of texts, got {instructions!r}")
    rows = len(instructions)
    state = _array(arrays, "state", "float32", (rows, STATE_DIM))
    images = {
        camera: _array(arrays, f"image.{camera}", "uint8", (rows, 3, size, size)) for camera in description.cameras
    }
    return images, state, instructions


def _array(arrays: Mapping[str, np.ndarray], name: str, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    array = arrays.get(name)
    if array is None or array.dtype != dtype or array.shape != shape:
        got = "none" if array is None else f"{array.dtype} {list(array.shape)}"
        raise ValueError(f"{name} must be {dtype} {list(shape)}, got {got}")
    return array


def _actions(given: Any, rows: int, chunk_length: int) -> dict[str, np.ndarray]:
    given = given if isinstance(given, tuple) else (given,)
    arrays = {name: np.asarray(array, np.float32) for name, array in zip(("actions", "log_scale"), given, strict=False)}
    for name, array in arrays.items():
        if array.shape != (rows, chunk_length, ACTION_DIM) or not np.isfinite(array).all():
            raise ValueError(
                f"the policy's {name} must be {[rows, chunk_length, ACTION_DIM]} finite numbers, got "
                f"{list(array.shape)}{'' if np.isfinite(array).all() else ', some not finite'}"
            )
    return arrays
