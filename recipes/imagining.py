"""Recorded episodes imagined in a stage that may be interrupted."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from resumable import Outside, Resumable
from run import Run
from worldenv_trl.data import Episodes, ImaginedSoFar, imagine_episodes
from worldenv_trl.world_models import WorldModel


def imagined(run: Run, world_model: WorldModel, episodes: Episodes, target: str, name: str, scratch: Path) -> Episodes:
    """The same actions from the same first frames (:func:`~worldenv_trl.data.imagine_episodes`), their frames in
    ``scratch``; the batches that the stage has done are not done again.

    Args:
        target: what the stage makes; with ``name`` it seeds the world model's noise.
        name: of the episodes.
        scratch: from which the stage continues (:meth:`run_folder.RunFolder.lasting_scratch`).
    """

    def batches(count: int, made: ImaginedSoFar) -> Iterable[int]:
        left = Resumable(run, f"imagines {name}", count, made=Outside(made))
        return left.bar(f"{target} imagines {name}", "batch")

    seed = run.seed(target, f"imagines {name}")
    return imagine_episodes(
        world_model, episodes, run.kinematics, seed=seed, folder=f"{scratch}/{name}", batches=batches
    )
