"""What is left of a recording whose process was killed: ``python recipes/benchmarks/kill.py [--kills 50]``.

Processes that write finished rollouts, and processes whose env is recorded while it runs, get SIGKILL at random
moments. Whatever was flushed must be in the file bit for bit, and of a recorded env everything that is a second old.
"""

from __future__ import annotations

import multiprocessing
import random
import signal
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

from command_line import refusals
from threads import use_threads
from worldenv_trl import keys
from worldenv_trl.envs import TabletopEnv
from worldenv_trl.record import RolloutWriter, read_rollouts, recorded

_WORKER = "killed"
TASK = "starter/put_the_bowl_on_the_plate"
EPISODE_STEPS = 20
COMPARED = (keys.IMAGE, keys.STATE, keys.ACTION, keys.SIM_STATE, ("next", *keys.IMAGE), ("next", keys.SIM_STATE))

_START = multiprocessing.get_context("forkserver")  # imports torch once for all processes
_START.set_forkserver_preload(["worldenv_trl.envs", "worldenv_trl.record"])


@dataclass(frozen=True)
class Benchmark:
    """How often processes are killed, and when."""

    kills: int = 50
    """Of each kind."""
    rows: int = 8
    """Of the recorded env."""
    within: float = 2.0
    """Seconds after the first step in which the kill comes."""
    num_threads: int = 1
    """Of each process."""


@dataclass
class Kills:
    """What was left, summed over kills: units are steps of a recorded env, or writes of finished rollouts."""

    flushed: int = 0
    lost: int = 0
    """Of the flushed ones."""
    old: int = 0
    """Put at least a second before the kill, flushed or not."""
    old_lost: int = 0
    seconds: list[float] = field(default_factory=list)
    """How much of each process's work before the kill is not in the file."""


def make_env(rows: int) -> TabletopEnv:
    return TabletopEnv(TASK, rows, seed=0, max_steps=EPISODE_STEPS, terminate_on_success=False, with_sim_state=True)


def steps_of(env):
    """Endless steps [rows] of random actions, the same ones at every call."""
    generator = torch.Generator().manual_seed(0)
    shown = env.reset()
    while True:
        shown["action"] = 2 * torch.rand(*env.batch_size, 7, generator=generator) - 1
        step, shown = env.step_and_maybe_reset(shown)
        yield step


def finished_rollouts(seed: int):
    """Endless small rollouts [2, 8] whose images do not compress."""
    generator = torch.Generator().manual_seed(seed)
    for number in range(10**6):
        image = torch.randint(0, 256, (2, 9, 3, 64, 64), dtype=torch.uint8, generator=generator)
        entries = {"observation": {"image": image[:, :-1]}, "number": torch.full((2, 8, 1), number)}
        yield TensorDict(entries | {"next": {"observation": {"image": image[:, 1:]}}}, [2, 8])


def record_steps(target: Path, rows: int, say: Connection) -> None:
    """Records an env for ever; says when each step was over, and after each flush how many steps it kept."""
    env = recorded(make_env(rows), target, worker=_WORKER)
    for number, _ in enumerate(steps_of(env)):
        say.send(("step", time.monotonic()))
        if number % 50 == 20:
            env.transform.flush()
            say.send(("flushed", number + 1))


def write_rollouts(target: Path, seed: int, say: Connection) -> None:
    """Writes finished rollouts for ever; says how many writes have returned."""
    writer = RolloutWriter(target.with_name(f"{target.stem}_{_WORKER}.mcap"))
    for number, rollouts in enumerate(finished_rollouts(seed)):
        writer.write(rollouts)
        say.send(("flushed", number + 1))


def killed(work: Callable, target: Path, argument: int, seconds: float) -> tuple[list[tuple[str, float]], float]:
    """What the process had said ``seconds`` after its first word, when it was killed, and when that was.

    Raises:
        RuntimeError: if it ended by itself.
    """
    hear, say = _START.Pipe(duplex=False)
    process = _START.Process(target=work, args=(target, argument, say), daemon=True)
    process.start()
    say.close()
    said = []
    try:
        said.append(hear.recv())
        time.sleep(seconds)
        at = time.monotonic()
        process.kill()
        while True:
            said.append(hear.recv())
    except (EOFError, OSError):  # killed; half of a word may be left
        process.join()
    if process.exitcode != -signal.SIGKILL:
        raise RuntimeError(f"the process that should be killed ended by itself, with code {process.exitcode}")
    return said, at


def partial_of(target: Path) -> Path:
    """The file that the process leaves."""
    return target.with_name(f"{target.stem}_{_WORKER}.partial.mcap")


def recovered(target: Path) -> TensorDict | list:
    """The rollouts, or none if the kill came before the first flush."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that it is unfinished
        try:
            return read_rollouts(partial_of(target))
        except ValueError as error:
            if "holds no rollouts" not in str(error):
                raise
            return []


def kill_recorders(kills: int, folder: Path, rows: int = 8, within: float = 2.0, seed: int = 0) -> Kills:
    """Kills processes that step a recorded env; what their files hold is compared with a run of the env here."""
    draw, found = random.Random(seed), Kills()
    env = make_env(rows)
    steps, reference = steps_of(env), []
    for index in range(kills):
        target = folder / f"recorder_{index}.mcap"
        said, at = killed(record_steps, target, rows, draw.uniform(0, within))
        taken = [value for word, value in said if word == "step"]
        flushed = max((value for word, value in said if word == "flushed"), default=0)
        while len(reference) < len(taken) + 1:
            reference.append(next(steps))
        whole = _leading_steps(recovered(target), reference, rows)
        old = sum(moment < at - 1 for moment in taken)
        found.flushed, found.lost = found.flushed + flushed, found.lost + max(flushed - whole, 0)
        found.old, found.old_lost = found.old + old, found.old_lost + max(old - whole, 0)
        found.seconds.append(at - taken[whole] if whole < len(taken) else 0.0)
        partial_of(target).unlink()
    env.close()
    return found


def _leading_steps(read: TensorDict | list, reference: list[TensorDict], rows: int) -> int:
    """How many steps of the env are in the file for every row and bit for bit, before the first one that is not."""
    whole = torch.zeros(rows, len(reference) + EPISODE_STEPS, dtype=torch.bool)
    for rollout in read:
        row, first = int(rollout[keys.ROW][0]), int(rollout[keys.EPISODE][0]) * EPISODE_STEPS
        length = min(int(rollout[keys.MASK].sum()), len(reference) - first)  # the last one may not have been said
        if length > 0:
            want = reference[first : first + length]
            same = torch.ones(length, dtype=torch.bool)
            for key in COMPARED:
                both = rollout[key][:length], torch.stack([step[key][row] for step in want])
                same &= (both[0] == both[1]).flatten(1).all(1)
            whole[row, first : first + length] = same
    return int(whole.all(0).long().cumprod(0).sum())


def kill_writers(kills: int, folder: Path, seed: int = 0) -> Kills:
    """Kills processes that write finished rollouts."""
    draw, found = random.Random(seed), Kills()
    for index in range(kills):
        target = folder / f"writer_{index}.mcap"
        said, _ = killed(write_rollouts, target, index, draw.uniform(0, 0.4))
        read, expected = recovered(target), finished_rollouts(index)
        for number in range(len(said)):
            rows, want = read[2 * number : 2 * number + 2], next(expected)
            whole = len(rows) == 2 and bool(rows[keys.MASK].all()) and torch.equal(rows["number"], want["number"])
            whole = whole and torch.equal(rows[keys.IMAGE], want[keys.IMAGE])
            found.lost += not (whole and torch.equal(rows["next", *keys.IMAGE], want["next", *keys.IMAGE]))
        found.flushed += len(said)
        partial_of(target).unlink()
    return found


def main(settings: Benchmark) -> None:
    with refusals():
        use_threads(settings.num_threads)
    with tempfile.TemporaryDirectory() as name:
        found = kill_recorders(settings.kills, Path(name), settings.rows, settings.within)
        print(f"recorded envs of {settings.rows} rows, killed {settings.kills} times:")
        print(f"  of {found.flushed} flushed steps {found.lost} lost")
        print(f"  of {found.old} steps that were a second old {found.old_lost} lost")
        ends = statistics.median(found.seconds), max(found.seconds)
        print(f"  lost before the kill: {ends[0]:.2f} s (median), {ends[1]:.2f} s (most)", flush=True)
        found = kill_writers(settings.kills, Path(name))
        print(f"writers, killed {settings.kills} times: of {found.flushed} flushed writes {found.lost} lost")


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
