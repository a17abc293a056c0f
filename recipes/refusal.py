"""One line instead of a traceback for what a user can put right."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Turns errors about settings, files and placements into ``SystemExit("error: ...")``."""
    try:
        yield
    except (ValueError, OSError, RuntimeError) as error:
        raise SystemExit(f"error: {error}") from error


def at_least(low: int, **settings: int | tuple[int, ...]) -> None:
    """Raises ``ValueError`` for the first of the numbers (or tuples of them, which may not be empty) below ``low``."""
    for name, value in settings.items():
        values = value if isinstance(value, tuple) else (value,)
        option = f"--{name.replace('_', '-')}"
        if not values:
            raise ValueError(f"{option} is empty: name at least one number")
        if min(values) < low:
            raise ValueError(f"{option} must be at least {low}, got {min(values)}")
