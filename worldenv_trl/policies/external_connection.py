"""The client's side of the bridge: one connection to a policy server, and what is said when there is none."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from worldenv_trl.policies.bridge import (
    Description,
    ProtocolError,
    VersionError,
    receive_message,
    send_message,
    socket_address,
)

__all__ = ["ExternalConnection"]

_START = "start it there (ours: python recipes/serve.py CHECKPOINT --address ADDRESS), or name its address"


class ExternalConnection:
    """Asks a policy server. It connects when it is first asked, and anew in every process and copy.

    A connection that breaks is made anew once, which a server that was started again answers as if nothing had been;
    a server that is too slow is not asked twice.

    Args:
        address: ``host:port`` or ``unix:/path``.
        timeout: seconds within which it has to answer.
        expected: what the server said of itself when it was first met; another one behind the address is refused.
            None takes any.

    Raises:
        ValueError: for what is no address, or a timeout that is not positive.
    """

    def __init__(self, address: str, timeout: float, expected: Description | None = None) -> None:
        socket_address(address)
        if not 0 < timeout < float("inf"):
            raise ValueError(f"timeout must be a positive number of seconds, got {timeout}")
        self.address, self.timeout, self.expected = address, timeout, expected
        self._socket: socket.socket | None = None
        self._forget()

    def describe(self) -> Description:
        """What the server says of itself, asked anew.

        Raises:
            OSError, RuntimeError: see :meth:`act`.
        """
        self.close()
        with self._lock:
            for last in (False, True):
                description = self._guarded(self._connect, last)
                if description is not None:
                    return description
        raise AssertionError("the last attempt raises")

    def act(self, arrays: Mapping[str, np.ndarray], instructions: list[str]) -> dict[str, np.ndarray]:
        """The server's actions, [n, C, 7], and ``log_scale`` of the same shape if it has one.

        Raises:
            ConnectionError: if nobody answers at the address, or the server dies.
            TimeoutError: if it takes longer than the timeout.
            RuntimeError: if it speaks another version or no protocol of ours, is not the policy that was met before,
                or cannot act.
        """
        if self._process != os.getpid():
            self._forget()  # the parent process goes on with its connection: two askers would mix their answers
        with self._lock:
            for last in (False, True):
                found = self._guarded(lambda: self._ask(arrays, instructions), last)
                if found is not None:
                    return found
        raise AssertionError("the last attempt raises")

    def close(self) -> None:
        """Lets the server go; the next question connects again."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def __getstate__(self) -> dict[str, Any]:
        return {"address": self.address, "timeout": self.timeout, "expected": self.expected}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()

    def _forget(self) -> None:
        self._socket = None
        self._lock, self._process, self._number = threading.Lock(), os.getpid(), 0

    def _guarded(self, work: Any, last: bool) -> Any:
        """What ``work`` returns; None if the connection broke and may be made anew. Errors name address and remedy."""
        try:
            return work()
        except TimeoutError as error:
            self.close()  # its late answer must not pass for that to the next question
            raise TimeoutError(
                f"the policy server at {self.address} did not answer within {self.timeout:g} s: look whether it is "
                "stuck, or allow it more with timeout="
            ) from error
        except VersionError as error:
            self.close()
            raise RuntimeError(
                f"the policy server at {self.address} cannot be talked to, {error}: copy worldenv_trl/policies/bridge "
                "of this release into its environment"
            ) from error
        except ProtocolError as error:
            self.close()
            raise RuntimeError(
                f"what answers at {self.address} is no policy server: {error}. Name the address of one"
            ) from error
        except (OSError, EOFError) as error:
            self.close()
            if last:
                why = getattr(error, "strerror", None) or str(error)
                raise ConnectionError(
                    f"no policy server answers at {self.address} ({why}): {_START.replace('ADDRESS', self.address)}"
                ) from error
            return None
        except BaseException:
            self.close()  # Ctrl-C between question and answer, too
            raise

    def _connect(self) -> Description:
        deadline = time.monotonic() + self.timeout
        family, where = socket_address(self.address)
        if family == socket.AF_UNIX:
            connection = socket.socket(family)
            self._socket = connection
            connection.settimeout(self.timeout)
            connection.connect(where)
        else:
            connection = self._socket = socket.create_connection(where, self.timeout)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        send_message(connection, {"kind": "hello"}, deadline=deadline)
        header, _ = receive_message(connection, deadline=deadline)
        self._refused(header, "hello")
        try:
            description = Description.from_dict(header["policy"])
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"its description is wrong ({error})") from error
        if self.expected is not None and description != self.expected:
            changed = [key for key in vars(description) if getattr(description, key) != getattr(self.expected, key)]
            raise RuntimeError(
                f"the policy server at {self.address} serves another policy than before, its {changed[0]} is "
                f"{getattr(description, changed[0])!r} and was {getattr(self.expected, changed[0])!r}: start the one "
                "from before, or make a new ExternalPolicy.connect"
            )
        return description

    def _ask(self, arrays: Mapping[str, np.ndarray], instructions: list[str]) -> dict[str, np.ndarray]:
        if self._socket is None:
            self._connect()
        assert self._socket is not None
        self._number += 1
        deadline = time.monotonic() + self.timeout
        request = {"kind": "act", "id": self._number, "instructions": instructions}
        send_message(self._socket, request, arrays, deadline=deadline)
        header, answer = receive_message(self._socket, deadline=deadline)
        self._refused(header, "actions")
        if header.get("id") != self._number:
            raise ProtocolError(f"it answers request {header.get('id')!r} when asked {self._number}")
        return answer

    def _refused(self, header: Mapping[str, Any], kind: str) -> None:
        if header["kind"] == "error":
            raise RuntimeError(
                f"the policy server at {self.address} could not answer: {str(header.get('message'))[:500]}. "
                "Its own output says more"
            )
        if header["kind"] != kind:
            raise ProtocolError(f"it answers with {header['kind']!r}, not {kind!r}")
