"""Policy servers that tests talk to: ours in a process of its own, and ones that misbehave."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]


class ServerProcess:
    """``recipes/serve.py`` in a process of its own, once it says that it serves."""

    def __init__(self, checkpoint: Path, address: str = "127.0.0.1:0") -> None:
        command = [sys.executable, str(ROOT / "recipes" / "serve.py"), str(checkpoint), "--address", address]
        self.process = subprocess.Popen(
            [*command, "--device", "cpu"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        self.said = self.process.stdout.readline()
        found = re.search(r"is served at (\S+);", self.said)
        if found is None:
            self.said += self.process.communicate(timeout=30)[0]
        self.address = found.group(1) if found else ""

    def end(self, number: int) -> str:
        """Sends a signal; returns what the server said until its end."""
        self.process.send_signal(number)
        return self.process.communicate(timeout=20)[0]

    def __enter__(self) -> ServerProcess:
        return self

    def __exit__(self, *_) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


@contextmanager
def talking(answer: Callable[[socket.socket], None]) -> Iterator[str]:
    """The address of a thread that gives each connection, one after another, to ``answer``."""
    listener = socket.create_server(("127.0.0.1", 0))

    def accept() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                try:
                    answer(connection)
                except (OSError, EOFError):
                    continue

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join(5)


@contextmanager
def serving(server) -> Iterator[str]:
    """The address of a :class:`PolicyServer` in a thread of this process."""
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.address
    finally:
        server.close()
        thread.join(10)
