"""How the commands of this folder say what went wrong: in one line, in the words of their options."""

from __future__ import annotations

import dis
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import ParamSpec

import worldenv_trl
from processes import FailedElsewhere, end_quietly, is_main

P = ParamSpec("P")

_OURS = tuple(f"{Path(file).resolve().parent}{os.sep}" for file in (__file__, worldenv_trl.__file__))
_RAISE = dis.opmap["RAISE_VARARGS"]

_OPTIONS = (
    ("pass overwrite=True", "pass --overwrite"),
    ("or pass replays=True to read them", "name them one by one"),
    ("pass replays=True to read them", "name them one by one"),
    ("pass a policy, or no seed", "pass --policy, or no --seed"),
    ("pass its world_model", "pass --world-model"),
    ("pass a reflector, too", "pass --reflector, too"),
    ("or another target", "or another --target"),
)

_SMALLER = (
    "smaller --sft.batch-size, --world-model.batch-size, --post-train.minibatch-size or --post-train.groups take less; "
    "a vision-language policy does in bfloat16 and with gradient_checkpointing"
)


INTERRUPTED = 130  # what a shell makes of SIGINT


def one_line_errors(main: Callable[P, int | None]) -> Callable[P, int]:
    """``main`` with :func:`expected` errors, warnings and Ctrl-C as lines on stderr; returns 1 after an error, 130 when
    interrupted."""

    @wraps(main)
    def run(*arguments: P.args, **options: P.kwargs) -> int:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
            try:
                return main(*arguments, **options) or 0
            except KeyboardInterrupt:
                print("interrupted", file=sys.stderr)
                return INTERRUPTED
            except Exception as error:
                if not expected(error):
                    raise
                print(f"error: {in_options(error)}", file=sys.stderr)
                return 1

    return run


@contextmanager
def refusals() -> Iterator[None]:
    """Turns :func:`expected` errors into ``SystemExit("error: ...")``, Ctrl-C into a line and ``SystemExit(130)``."""
    try:
        yield
    except KeyboardInterrupt as error:
        if is_main():
            print("interrupted", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from error
    except FailedElsewhere:
        end_quietly()
    except Exception as error:
        if not expected(error):
            raise
        raise SystemExit(f"error: {in_options(error)}") from error


def expected(error: Exception) -> bool:
    """Whether an error is about settings, files or the machine, so that one line is enough: no programming error.

    It is if a ``raise`` of this project made it, which knows what is wrong, or the system says it of a file or disk, or
    a GPU's memory is full.
    The same ``ValueError`` out of a library, or of a line that raises nothing itself, is a mistake of the program.
    """
    if isinstance(error, OSError) and error.errno is not None and not isinstance(error, ConnectionError):
        return True
    if _out_of_memory(error):
        return True
    if not isinstance(error, ValueError | OSError | RuntimeError | ImportError):
        return False
    where = error.__traceback__
    while where is not None and where.tb_next is not None:
        where = where.tb_next
    if where is None:
        return False
    code = where.tb_frame.f_code
    return code.co_filename.startswith(_OURS) and code.co_code[where.tb_lasti] == _RAISE


def at_least(low: int, **settings: int | tuple[int, ...]) -> None:
    """Raises ``ValueError`` for the first of the numbers (or tuples of them, which may not be empty) below ``low``."""
    for name, value in settings.items():
        values = value if isinstance(value, tuple) else (value,)
        option = f"--{name.replace('_', '-')}"
        if not values:
            raise ValueError(f"{option} is empty: name at least one number")
        if min(values) < low:
            raise ValueError(f"{option} must be at least {low}, got {min(values)}")


def writable(out: Path, *, plot: bool = False, option: str = "--out") -> Path:
    """``out``, for which a folder is there now: asked before the work whose figures would be lost.

    Args:
        out: what the option names, or its default.

    Keyword Args:
        plot: it must end like a format of matplotlib's.
        option: that names it.

    Raises:
        OSError: if no file can be written there.
        ValueError: for another ending.
    """
    if plot:
        from matplotlib.backend_bases import FigureCanvasBase  # not for the commands that draw nothing

        if out.suffix.lower().removeprefix(".") not in FigureCanvasBase.get_supported_filetypes():
            raise ValueError(
                f"{option} must end like a picture, for instance {out.with_suffix('.png').name}, got {out}"
            )
    if out.is_dir():
        raise IsADirectoryError(f"{option} must be a file, {out} is a folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    with open(out, "a") if out.exists() else tempfile.TemporaryFile(dir=out.parent):
        return out


def in_options(error: Exception) -> str:
    """What an error says, for someone who has options and no arguments."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    if _out_of_memory(error):
        text = f"{text.split('. ')[0]}: {_SMALLER}"
    for argument, option in _OPTIONS:
        text = text.replace(argument, option)
    return " ".join(text.split())


def _out_of_memory(error: Exception) -> bool:
    return type(error).__name__ == "OutOfMemoryError"  # torch's, by name: commands that need no torch import none
