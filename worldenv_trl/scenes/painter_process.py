"""What runs in a process that draws for another one's :class:`RendererPool`.

It imports little, to be ready soon. Standard input brings drawings, and rows of them that nobody else draws; a pipe
that all painters read brings the others. What is done is reported on standard output. It ends with its parent.
"""

from __future__ import annotations

import os
import select
import sys

import mujoco
from mujoco.rendering.classic import gl_context

from worldenv_trl.scenes.canvas import Canvas, Glow
from worldenv_trl.scenes.shared_rows import RECORD, Layout, SharedRows

_LOOK = 5000  # ms between looks whether the parent lives: a copy of it may hold the pipes open


def main(memory: int, tickets: int) -> None:
    """Draws until standard input ends; ``memory`` and ``tickets`` are descriptors of the shared file and the pipe."""
    reports = os.dup(1)
    os.dup2(2, 1)  # what libraries print is not a report
    parent = os.getppid()
    context = gl_context.GLContext(64, 64)
    context.make_current()
    drawings: list[tuple[Canvas, SharedRows]] = []
    last = None

    def draw(ticket: bytes) -> None:
        nonlocal last
        number, first, count = RECORD.unpack(ticket)
        canvas, shared = drawings[number]
        if canvas is not last:
            canvas.make_current()
            last = canvas
        for row in range(first, first + count):
            canvas.draw(*shared.pose(row), [image[row] for image in shared.images])
        os.write(reports, ticket)

    orders, poll = sys.stdin.buffer.raw, select.poll()  # type: ignore[union-attr] # a pipe, which has one
    poll.register(orders, select.POLLIN)
    poll.register(tickets, select.POLLIN)
    unread = b""
    while True:
        ready = [file for file, _ in poll.poll(_LOOK)]
        if orders.fileno() in ready:
            data = orders.read(1 << 16)
            if not data:
                break
            *lines, unread = (unread + data).split(b"\n")
            for line in lines:
                if line.startswith(b"{"):
                    drawings.append(_opened(memory, Layout.from_line(line)))
                    last = None
                    os.write(reports, RECORD.pack(len(drawings) - 1, 0, 0))
                else:
                    draw(bytes.fromhex(line.decode()))
        elif tickets in ready:
            try:
                ticket = os.read(tickets, RECORD.size)
            except BlockingIOError:  # another painter was faster
                continue
            if not ticket:
                break
            draw(ticket)
        elif not ready and os.getppid() != parent:
            break
    for canvas, _ in drawings:
        canvas.close()
    context.free()


def _opened(memory: int, layout: Layout) -> tuple[Canvas, SharedRows]:
    shared = SharedRows(memory, layout)
    model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": shared.model.tobytes()})
    return Canvas(model, layout.cameras, layout.image_size, [Glow(*glow) for glow in layout.glows]), shared
