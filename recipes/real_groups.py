"""Groups of rollouts as LOOP draws them, lived in the physics and labelled there: made once, then only read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import Module
from tqdm import tqdm

from physics import chunk_player, exploring_actor, recording, starting_at, step_env
from run import Run
from seeds import stage_seed
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import Episodes, fill_store, open_store
from worldenv_trl.metrics import first_success
from worldenv_trl.policies import Policy
from worldenv_trl.record import RolloutWriter, read_metadata
from worldenv_trl.record.mcap.provenance import model_hash
from worldenv_trl.scenes import load_task

_ROWS = 48  # of the physics at a time


@dataclass(frozen=True)
class Draw:
    """Which groups are drawn."""

    contexts: int
    """G, in all; as many of each task."""
    group_size: int
    """N, rollouts of each."""
    scale_factor: float
    """Multiple of the policy's scale that is sampled with."""
    noise: str
    """What is drawn by itself: ``step`` or ``chunk``."""
    seed: int


@dataclass(frozen=True)
class RealGroups:
    """G groups of N rollouts that share a training initial state, those of a group following each other.

    ``episodes`` are [G * N], each to the step limit whether the goal is reached or not: nothing but the reflector ends
    a rollout in imagination, so its length must not tell the outcome.
    """

    episodes: Episodes
    group_size: int

    @property
    def reached(self) -> Tensor:
        """Frame at which the goal first holds, int64 [G * N]; -1 if never."""
        return first_success(self.episodes["success"])

    @property
    def success(self) -> Tensor:
        """Whether the goal is reached, bool [G, N]."""
        return self.grouped(self.reached >= 0)

    @property
    def mixed(self) -> Tensor:
        """Groups in which some rollouts succeed and some fail, bool [G]: the others teach nothing."""
        return self.success.any(1) & ~self.success.all(1)

    @property
    def task_id(self) -> Tensor:
        """int64 [G]."""
        return self.grouped(self.episodes[keys.TASK_ID].squeeze(-1))[:, 0]

    @property
    def context_id(self) -> Tensor:
        """int64 [G]."""
        return self.grouped(self.episodes[keys.CONTEXT_ID].squeeze(-1))[:, 0]

    def grouped(self, values: Tensor) -> Tensor:
        """Values [G * N, ...] of rollouts as [G, N, ...]."""
        return values.unflatten(0, (-1, self.group_size))


def real_groups(run: Run, policy: Policy, draw: Draw, folder: Path, overwrite: bool = False) -> RealGroups:
    """The groups in ``folder`` (``groups.mcap``, and a store of their frames), drawn first if there are none.

    Raises:
        ValueError: for settings out of range, or groups that were drawn otherwise.
    """
    check_draw(run, draw)
    path = folder / "groups.mcap"
    made = partial(_live, run, policy, draw, path)
    return RealGroups(kept_episodes(run, path, draw, {"policy": policy}, made, overwrite), draw.group_size)


def kept_episodes(
    run: Run, path: Path, draw: Draw, models: Mapping[str, Module], make: Callable[[], None], overwrite: bool = False
) -> Episodes:
    """The episodes recorded in ``path``, by ``make`` if there are none; their frames are in a store beside it.

    Raises:
        ValueError: for a recording of another draw, other models or another run.
    """
    if path.is_file() and not overwrite:
        _check_same(run, models, draw, path)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        make()
    store = path.parent / "episodes"
    try:
        (episodes,) = open_store(store, [path])
    except (FileNotFoundError, ValueError):  # the recording is the record: nothing is lost with a store
        (episodes,) = fill_store(store, [path])
    return episodes


def check_draw(run: Run, draw: Draw) -> None:
    """Raises ``ValueError`` for a draw that cannot be had of the run's tasks and training initial states."""
    tasks, states = len(run.config.tasks), run.config.train_states
    if draw.group_size < 2:
        raise ValueError(f"group_size must be at least 2, got {draw.group_size}")
    if draw.contexts < 1 or draw.contexts % tasks:
        raise ValueError(f"contexts must be a multiple of the run's {tasks} tasks, got {draw.contexts}")
    if draw.contexts > tasks * states:
        raise ValueError(
            f"contexts must be at most {tasks * states}, {states} training initial states (train_states) of each "
            f"task, got {draw.contexts}"
        )
    if not draw.scale_factor > 0:
        raise ValueError(f"scale_factor must be positive, got {draw.scale_factor}")


def _check_same(run: Run, models: Mapping[str, Module], draw: Draw, path: Path) -> None:
    metadata, config = read_metadata(path), run.config
    env = metadata.get("env", {})
    pairs = {
        **{name: (metadata.get("draw", {}).get(name), value) for name, value in asdict(draw).items()},
        **{name: (metadata.get("models", {}).get(name), model_hash(model)) for name, model in models.items()},
        "the tasks": (metadata.get("digests"), [load_task(task).digest for task in config.tasks]),
        "cameras": (env.get("cameras"), list(config.cameras)),
        "image_size": (env.get("image_size"), config.image_size),
    }
    for name, (before, now) in pairs.items():
        if before != now:
            short = [str(value)[:12] for value in (before, now)]
            raise ValueError(
                f"the groups in {path} were drawn with another {name} ({short[0]}, now {short[1]}): "
                "name another folder with --groups, the settings as they were, or pass overwrite=True"
            )


def _live(run: Run, policy: Policy, draw: Draw, path: Path) -> None:
    """Draws the groups: LOOP's behaviour policy, in the physics."""
    config = run.config
    torch.manual_seed(stage_seed(draw.seed, "groups"))
    actor = exploring_actor(config, policy.eval(), draw.scale_factor, draw.noise)
    player = chunk_player(actor, config.chunk_length)
    per_task, at_once = draw.contexts // len(config.tasks), max(1, _ROWS // draw.group_size)
    # Spread over all states: the first ones are the demonstrations' own.
    indices = torch.linspace(0, config.train_states - 1, per_task).long().split(at_once)
    waves = [(task, wave.tolist()) for task in config.tasks for wave in indices]
    with ExitStack() as stack:
        writer: RolloutWriter | None = None
        for task, wave in tqdm(waves, desc="groups in the physics", unit="wave"):
            env = step_env(
                config,
                "train",
                len(wave) * draw.group_size,
                [task],
                group_repeats=draw.group_size,
                terminate_on_success=False,
                with_sim_state=True,
                **starting_at(config, "train", task, wave),
            )
            if writer is None:
                about = recording(config, env, "groups", {"policy": policy}, draw=asdict(draw))
                writer = stack.enter_context(RolloutWriter(path, **about, overwrite=True))
            collector = GroupCollector(
                env,
                player,
                groups_per_batch=len(wave),
                total_groups=len(wave),
                group_size=draw.group_size,
                max_decisions=config.max_steps,
            )
            writer.write(next(iter(collector)).flatten(0, 1))
            collector.shutdown()
