"""Waves collected by Ray actors, on a cluster of this machine."""

from __future__ import annotations

import os
import signal
import socket
import sys

import pytest
from shared_waves import Here, assert_equal, make_policy, spread, waves_of

from worldenv_trl.collectors import RayWorkers, check_ray

if sys.platform == "win32":
    pytest.skip("Ray's workers are killed by a POSIX signal", allow_module_level=True)

WITHOUT_RAY = "Ray is not installed: pip install 'worldenv_trl[ray]'"


@pytest.fixture(scope="module")
def cluster():
    """Two workers, and room for TorchRL's."""
    ray = pytest.importorskip("ray", reason=WITHOUT_RAY)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RAY_ADDRESS", raising=False)
        workers = RayWorkers(2)
        yield workers
        workers.shutdown()
    assert not ray.is_initialized()


def test_ray_gives_what_this_process_gives(cluster):
    assert_equal(waves_of(spread(cluster)), waves_of(spread(Here(2))))
    assert os.getpid() not in cluster.pids


def test_an_actor_killed_inside_a_rollout_is_replaced_and_its_groups_are_collected_again(cluster, tmp_path):
    before = set(cluster.pids)
    killed = waves_of(spread(cluster, make_policy(marker=tmp_path / "died")))
    assert (tmp_path / "died").exists() and len(before & set(cluster.pids)) == 1
    assert_equal(killed, waves_of(spread(Here(2))))


def test_an_actor_killed_between_waves_is_replaced(cluster):
    collector = spread(cluster)
    waves = [collector.next()]
    os.kill(cluster.pids[0], signal.SIGKILL)
    waves += waves_of(collector)
    assert_equal(waves, waves_of(spread(Here(2))))


def test_work_that_kills_every_actor_ends_in_one_line(cluster, tmp_path):
    with pytest.raises(RuntimeError, match="died 3 times at the same work") as error:
        waves_of(spread(cluster, make_policy(marker=tmp_path / "died", always=True), shares=1))
    assert "\n" not in str(error.value)


def test_more_actors_than_the_cluster_has_processors_are_refused(cluster):
    with pytest.raises(RuntimeError, match=r"^3 Ray workers need as many CPUs, the cluster has 2: use at most 2$"):
        RayWorkers(3)
    assert cluster.map(divmod, [(7, 2)]) == [(3, 1)]  # those that are there stay


# ----------------------------------------------------------------------------------------------------- bad input


def test_there_must_be_an_actor():
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        RayWorkers(0)


def test_an_address_that_does_not_answer_is_refused_in_one_line(monkeypatch):
    pytest.importorskip("ray", reason=WITHOUT_RAY)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{port}")
    for ask in (check_ray, lambda: RayWorkers(1)):
        with pytest.raises(
            RuntimeError, match=f"^no Ray cluster answers at 127.0.0.1:{port} .*unset RAY_ADDRESS"
        ) as error:
            ask()
        assert "\n" not in str(error.value)


def test_an_address_that_is_none_is_refused():
    pytest.importorskip("ray", reason=WITHOUT_RAY)
    with pytest.raises(ValueError, match=r"must be HOST:PORT.*got 'nowhere'"):
        check_ray("nowhere")


def test_without_ray_the_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"Ray is not installed: pip install 'worldenv_trl\[ray\]'"):
        RayWorkers(1)
