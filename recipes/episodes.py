"""The run's recorded rollouts as episodes, read from disk where training needs their frames."""

from __future__ import annotations

import random
from collections.abc import Iterable

import torch

import processes
from config import WorldEnvConfig
from explore import rows_of_scale
from run import Run
from worldenv_trl import keys
from worldenv_trl.data import Episodes, episodes_from_rollouts, fill_store, open_store
from worldenv_trl.record import read_rollouts


def demonstrations(run: Run) -> Episodes:
    """In memory: they are few."""
    return episodes_from_rollouts(read_rollouts(run.folder.require_rollouts("demonstrations", "demonstrate")))


def round_of(suffix: str) -> int:
    """The number of the round whose models have this suffix."""
    return int(suffix.removeprefix("_") or 1)


def demonstrations_and_exploration(run: Run, rounds: int) -> tuple[Episodes, Episodes]:
    """Demonstrations, and the exploration of the first ``rounds`` rounds; frames stay on disk, in ``episodes/``."""
    demonstrated, *explored = recorded_episodes(run, rounds)
    return demonstrated, Episodes.cat(explored)


def recorded_episodes(run: Run, rounds: int) -> list[Episodes]:
    """The demonstrations, then the exploration of each of the first ``rounds`` rounds; frames as above."""
    files = [run.folder.require_rollouts("demonstrations", "demonstrate")]
    names = ["explore" + ("" if number == 1 else f"_{number}") for number in range(1, rounds + 1)]
    files += [run.folder.require_rollouts(name, "explore") for name in names]
    store = run.folder.path / "episodes"
    with processes.main_first():
        try:
            parts = open_store(store, files)
        except FileNotFoundError:
            parts = fill_store(store, files)
        except ValueError as error:  # the recordings are the record: nothing is lost with a store
            print(f"{str(error).split(': fill_store')[0]}: it is made anew from the recordings")
            parts = fill_store(store, files)
    return parts


def explored_at(run: Run, number: int, factors: Iterable[float]) -> Episodes:
    """What round ``number`` explored at these factors of the scale; frames as above."""
    explored = recorded_episodes(run, number)[-1]
    rows = torch.arange(len(explored))
    tasks = len(run.config.tasks)
    return explored[torch.cat([rows[rows_of_scale(run.config.explore, tasks, factor)] for factor in factors])]


def quiet_factors(config: WorldEnvConfig) -> list[float]:
    """The factors of exploration's scale that LOOP's does not exceed."""
    return [factor for factor in config.explore.scale_factors if factor <= config.post_train.scale_factor]


def split_by_context(episodes: Episodes, share: float, seed: int) -> tuple[Episodes, Episodes]:
    """Episodes for training, and those of about a ``share`` of the initial states for figures; at least one state each.

    Whether a state is kept out is drawn for itself, from ``seed`` and its number alone. So with one seed for all rounds
    and both models a later round, which may see other states, does not show what an earlier one was trained on, and the
    states of a smaller share are among those of a larger.
    """
    contexts = episodes[keys.CONTEXT_ID].squeeze(-1)
    drawn = {number: random.Random(f"{seed} {number}").random() for number in contexts.unique().tolist()}
    order = sorted(drawn, key=lambda number: drawn[number])
    count = min(max(1, sum(value < share for value in drawn.values())), max(1, len(order) - 1))
    kept_out = torch.isin(contexts, torch.tensor(order[:count]))
    return episodes[~kept_out], episodes[kept_out]
