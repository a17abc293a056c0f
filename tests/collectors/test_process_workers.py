"""Waves collected by other processes, which die, fail and outlive nobody."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from shared_waves import Here, assert_equal, make_policy, spread, waves_of

from worldenv_trl.collectors import ProcessWorkers


@pytest.fixture(scope="module")
def processes():
    workers = ProcessWorkers(2)
    yield workers
    workers.shutdown()


def test_processes_give_what_this_process_gives(processes):
    assert_equal(waves_of(spread(processes)), waves_of(spread(Here(2))))
    assert len(processes.pids) == 2 and os.getpid() not in processes.pids


def test_a_worker_killed_inside_a_rollout_is_replaced_and_its_groups_are_collected_again(processes, tmp_path):
    before = set(processes.pids)
    with pytest.warns(UserWarning, match="a worker process died .*parts of the work that are done again: [12]$"):
        killed = waves_of(spread(processes, make_policy(marker=tmp_path / "died")))
    assert (tmp_path / "died").exists() and before.isdisjoint(processes.pids)
    assert_equal(killed, waves_of(spread(Here(2))))


def test_a_worker_killed_between_waves_is_replaced(processes):
    collector = spread(processes)
    waves = [collector.next()]
    os.kill(processes.pids[0], signal.SIGKILL)
    waves += waves_of(collector)
    assert_equal(waves, waves_of(spread(Here(2))))


def test_work_that_kills_every_worker_ends_in_one_line(processes, tmp_path):
    with pytest.raises(RuntimeError, match="died 3 times at the same work") as error:
        waves_of(spread(processes, make_policy(marker=tmp_path / "died", always=True), shares=1))
    assert "\n" not in str(error.value)


def test_what_fails_in_a_worker_fails_here(processes):
    def broken(state):
        raise ZeroDivisionError("of the policy")

    policy = make_policy()
    policy.module.forward = broken
    with pytest.raises(ZeroDivisionError, match="of the policy"):
        waves_of(spread(processes, policy))
    assert processes.map(divmod, [(7, 2)]) == [(3, 1)]  # and the workers are good for more


def test_workers_compute_with_one_thread(processes):
    assert processes.map(torch.get_num_threads, [()]) == [1]


def test_stored_values_go_with_who_holds_them():
    workers = ProcessWorkers(1)
    stored = workers.put([1, 2])
    assert stored.get() == [1, 2]
    path = stored.name
    assert os.path.exists(path)
    del stored
    assert not os.path.exists(path)
    workers.shutdown()


def test_there_must_be_a_worker():
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        ProcessWorkers(0)


def test_workers_do_not_outlive_a_killed_process(tmp_path):
    script = tmp_path / "killed.py"
    script.write_text(
        "import time\n"
        "from worldenv_trl.collectors import ProcessWorkers\n"
        "if __name__ == '__main__':\n"
        "    workers = ProcessWorkers(1)\n"
        "    workers.map(divmod, [(7, 2)])\n"
        "    print(workers.pids[0], flush=True)\n"
        "    workers.map(time.sleep, [(600,)])\n"
    )
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20
    while os.path.exists(f"/proc/{worker}") and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not os.path.exists(f"/proc/{worker}")
