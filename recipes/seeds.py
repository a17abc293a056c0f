"""Where every random number of a run comes from: a hash of the run's seed, the stage with its round, and the use."""

from __future__ import annotations

import hashlib
import json


def stage_seed(seed: int, stage: str, use: str = "") -> int:
    """A seed of 63 bits for one use of random numbers in one stage.

    Sums like ``seed + round`` meet: round 1 of seed 1 would draw what round 2 of seed 0 has drawn. A hash does not.

    Args:
        seed: of the run.
        stage: its name, which ends in the round: ``explore``, ``explore_2``.
        use: what the numbers are for, where a stage draws from several generators.

    Examples:
        >>> stage_seed(0, "explore") == stage_seed(0, "explore")
        True
        >>> len({stage_seed(seed, stage) for seed in range(100) for stage in ("explore", "explore_2")})
        200
    """
    digest = hashlib.sha256(json.dumps([seed, stage, use]).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def another_draw(draw: int, use: str = "") -> str:
    """A use of random numbers, told from the same of other draws; the first one, 0, is the use alone."""
    return f"{use} (draw {draw})" if draw else use
