"""``--collectors``: who collects, what is refused, and that it changes nothing but the speed."""

from __future__ import annotations

import copy
import dataclasses
import os
import signal
import socket
import sys
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import pytest
import torch
from safetensors.torch import load_file
from small_run import with_untrained_policy
from tensordict import TensorDict

import imagination
from collecting import Spread, spread_of
from explore import explore
from outcomes import physics_outcomes
from parts import COMPACT
from post_train import post_train
from run_folder import RunFolder
from stages import open_run
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector, ProcessWorkers, SpreadCollector
from worldenv_trl.envs import TabletopEnv
from worldenv_trl.policies import laplace_actor
from worldenv_trl.record import read_rollouts
from worldenv_trl.reflectors import StopRule


def test_a_setting_names_the_back_end_the_workers_and_the_shares():
    assert spread_of("local") is None
    assert spread_of("process:2") == Spread("process", 2)
    assert spread_of("ray:4/12") == Spread("ray", 4, 12)


@pytest.mark.parametrize(
    ("collectors", "message"),
    [
        ("ray", "collectors must be local, process:WORKERS or ray:WORKERS, got 'ray'"),
        ("threads:2", "must be local, process:WORKERS or ray:WORKERS, got 'threads:2'"),
        ("process:-1", "must be local, process:WORKERS or ray:WORKERS, got 'process:-1'"),
        ("ray:0", "collectors must name at least 1 worker, got 'ray:0'"),
        ("process:4/2", "must name as many shares as workers, 4, or more, got 'process:4/2'"),
        ("process:3", "3 workers are more than the groups of post_train.groups=2: use at most 2"),
    ],
)
def test_what_cannot_be_collected_is_refused_before_any_work(tiny, collectors, message):
    with pytest.raises(SystemExit, match=f"^error: .*{message}") as error:
        open_run(dataclasses.replace(tiny, collectors=collectors))
    assert "\n" not in str(error.value)
    assert not tiny.run_dir.exists()


def test_every_wave_of_the_settings_must_have_work_for_all(tiny):
    learned = dataclasses.replace(tiny.post_train, groups=9)
    enough = dataclasses.replace(tiny, collectors="process:3", post_train=learned)
    with pytest.raises(SystemExit, match=r"evaluate.num_envs=2: use at most 2"):
        open_run(enough)
    evaluated = dataclasses.replace(tiny.evaluate, episodes_per_task=9, num_envs=9)
    explored = dataclasses.replace(tiny.explore, num_envs=2)
    uneven = dataclasses.replace(tiny.evaluate, episodes_per_task=4, num_envs=3)  # two waves of two
    with pytest.raises(SystemExit, match=r"evaluate.num_envs=2: use at most 2"):
        open_run(dataclasses.replace(enough, evaluate=uneven))
    with pytest.raises(SystemExit, match=r"explore.num_envs=2: use at most 2"):
        open_run(dataclasses.replace(enough, evaluate=evaluated, explore=explored))


def test_a_ray_that_does_not_answer_or_is_not_there_is_refused_before_any_work(tiny, monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{free.getsockname()[1]}")
    config = dataclasses.replace(tiny, collectors="ray:2")
    find = sys.modules["importlib.util"].find_spec
    if find("ray") is not None:
        with pytest.raises(SystemExit, match=r"^error: no Ray cluster answers at 127.0.0.1"):
            open_run(config)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *more: None if name == "ray" else find(name, *more))
    with pytest.raises(SystemExit, match=r"^error: Ray is not installed: pip install 'worldenv_trl\[ray\]'"):
        open_run(config)
    assert not tiny.run_dir.exists()


def test_a_run_is_continued_with_other_collectors(tiny):
    open_run(tiny)
    RunFolder(tiny.run_dir).open(dataclasses.replace(tiny, collectors="process:2"))


# ----------------------------------------------------------------------------------------------------- what it changes


class Alone:
    """One worker, in this very process."""

    count = 1

    def put(self, value):
        return SimpleNamespace(name=str(uuid4()), get=lambda: copy.deepcopy(value))

    def map(self, function, arguments):
        state = torch.get_rng_state()
        results = [function(*each) for each in arguments]
        torch.set_rng_state(state)
        return results

    def shutdown(self):
        pass


class Killed(ProcessWorkers):
    """Processes, one of which is killed before their second wave."""

    waves = 0

    def map(self, function, arguments):
        self.waves += 1
        if self.waves == 2:
            os.kill(self.pids[0], signal.SIGKILL)
        return super().map(function, arguments)


@pytest.fixture
def run(tiny):
    """An untrained run; workers are put into it."""
    learned = dataclasses.replace(tiny.post_train, iterations=2, groups=3, env="tabletop", probe_every=0)
    evaluated = dataclasses.replace(tiny.evaluate, episodes_per_task=3, num_envs=3)
    settings = {"collectors": "process:1/3", "post_train": learned, "evaluate": evaluated}
    run = with_untrained_policy(dataclasses.replace(tiny, **settings))
    yield run
    run.close()


def with_workers(run, workers):
    run.close()
    run.__dict__["workers"] = workers
    return run


def test_loop_reaches_the_same_weights_with_any_workers_one_of_them_killed(run):
    found = []
    for workers in (Alone(), Killed(2)):
        with_workers(run, workers)
        post_train(run, "sft", "post_train", "", returns_of=lambda wave: wave[keys.CHUNK][:, :, 0].mean((-2, -1)))
        (file,) = Path(run.folder.checkpoint("post_train")).glob("*.safetensors")
        found.append(load_file(file))
        recorded = read_rollouts(run.folder.rollouts("post_train_000"))
        assert recorded[keys.CONTEXT_ID].shape[:2] == (3, 2)
    assert workers.waves == 2
    before = load_file(next(Path(run.folder.checkpoint("sft")).glob("*.safetensors")))
    assert any(not torch.equal(value, found[0].get(name, value)) for name, value in before.items())  # it has learned
    assert found[0].keys() == found[1].keys()
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


def test_exploration_begins_as_that_of_one_process_does(run):
    explore(with_workers(run, ProcessWorkers(2)))
    shared = read_rollouts(run.folder.rollouts("explore"))
    alone = dataclasses.replace(run, config=dataclasses.replace(run.config, collectors="local"))
    explore(alone)
    for key in (keys.CONTEXT_ID, keys.TASK_ID):
        assert torch.equal(shared[key], read_rollouts(run.folder.rollouts("explore"))[key])


def test_greedy_episodes_end_as_those_of_one_process_do(run):
    actor = laplace_actor(run.policy("sft"))
    task = run.config.tasks[0]
    shared = physics_outcomes(with_workers(run, ProcessWorkers(2)), actor, task, "test", 5)
    local = dataclasses.replace(run, config=dataclasses.replace(run.config, collectors="local"))
    assert torch.equal(shared, physics_outcomes(local, actor, task, "test", 5)) and len(shared) == 5


def test_greedy_episodes_come_in_waves_alike(run):
    evaluate = dataclasses.replace(run.config.evaluate, num_envs=4)
    local = dataclasses.replace(run, config=dataclasses.replace(run.config, collectors="local", evaluate=evaluate))
    begun: list[list[int]] = []
    writer = SimpleNamespace(write=lambda rollouts: begun.append(rollouts[keys.CONTEXT_ID][:, 0, 0].tolist()))
    actor, task = laplace_actor(run.policy("sft")), run.config.tasks[0]
    assert len(physics_outcomes(local, actor, task, "test", 6, writer=writer)) == 6
    assert [len(wave) for wave in begun] == [3, 3] and len({*begun[0], *begun[1]}) == 6


def test_imagined_frames_come_back_where_they_are_asked_for(run):
    env = TabletopEnv(run.config.tasks, 3, seed=0)
    contexts: TensorDict = env.reset()
    env.close()
    models = (part.make(run.config).eval() for part in (COMPACT.world_model, COMPACT.reflector))
    dream = imagination.Imagination(*models, StopRule(0.999), contexts)
    makes, whole = dream.makes(run, 2, seed=3), dream.env(run, [3, 2], seed=3)
    actor = laplace_actor(COMPACT.policy.make(run.config))
    collector = with_workers(run, ProcessWorkers(1)).group_collector(
        whole, actor, makes, steady=False, groups_per_batch=3
    )
    assert isinstance(collector, SpreadCollector)
    shared = collector.next()
    alone = GroupCollector(makes(3), actor, groups_per_batch=3).next()
    assert shared["next", "frames", "image"].shape == alone["next", "frames", "image"].shape
    # The noise of the world model is that of one process, rollout by rollout; of the policy's a share draws its own.
    assert torch.equal(shared["next", keys.NOISE_SEED], alone["next", keys.NOISE_SEED])
    assert torch.equal(shared[keys.CONTEXT_ID], alone[keys.CONTEXT_ID])
