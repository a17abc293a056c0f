"""Workers of a Ray cluster."""

from __future__ import annotations

import importlib.util
import itertools
import os
import socket
import sys
from collections.abc import Callable, Sequence
from typing import Any
from urllib.parse import urlsplit

import cloudpickle

from worldenv_trl.collectors.workers import ATTEMPTS, Stored

__all__ = ["RayWorkers", "check_ray"]

_ANSWER_SECONDS = 5.0
_START_SECONDS = 300.0
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def check_ray(address: str | None = None) -> None:
    """Whether Ray can be used: in one line, before long work.

    Args:
        address: of a cluster; the environment's ``RAY_ADDRESS`` when None, and without that nothing has to answer.

    Raises:
        ValueError: if Ray is not installed, or the address is none.
        RuntimeError: if nothing answers there.
    """
    if importlib.util.find_spec("ray") is None:
        raise ValueError("Ray is not installed: pip install 'worldenv_trl[ray]', or use process workers")
    address = os.environ.get("RAY_ADDRESS") if address is None else address
    if not address or address in ("auto", "local"):
        return
    parts = urlsplit(address if "://" in address else f"ray://{address}")
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None:
        raise ValueError(f"a Ray address must be HOST:PORT, ray://HOST:PORT, auto or local, got {address!r}")
    try:
        socket.create_connection((host, port), timeout=_ANSWER_SECONDS).close()
    except OSError as error:
        raise RuntimeError(
            f"no Ray cluster answers at {address} ({error}): start one there (ray start --head), or unset RAY_ADDRESS "
            "for one of this machine"
        ) from error


class RayWorkers:
    """Actors of a Ray cluster, one CPU each.

    Ray restarts an actor that dies, anywhere in the cluster, and makes its call again; nothing here does. Every node
    needs the packages of this process at the same paths.

    Args:
        count: of actors.
        address: of the cluster; the environment's ``RAY_ADDRESS`` when None, and without that one of this machine is
            started, which ends with the program.

    Keyword Args:
        gpu: whether each actor has its share of the cluster's GPUs, one at most.

    Raises:
        ValueError: if ``count`` is below 1, Ray is not installed, or the address is none.
        RuntimeError: if no cluster answers, or it has no room for so many.
    """

    def __init__(self, count: int, address: str | None = None, *, gpu: bool = False) -> None:
        if count < 1:
            raise ValueError(f"workers must be at least 1, got {count}")
        check_ray(address)
        import ray

        self.count, self._ray, self._connected = count, ray, not ray.is_initialized()
        if self._connected:
            _connect(address or os.environ.get("RAY_ADDRESS") or "local", count)
        room = int(ray.cluster_resources().get("CPU", 0))
        self._actors: list[Any] = []
        if room < count:
            self.shutdown()
            raise RuntimeError(f"{count} Ray workers need as many CPUs, the cluster has {room}: use at most {room}")
        num_gpus = min(1.0, ray.cluster_resources().get("GPU", 0.0) / count) if gpu else 0.0
        actor = ray.remote(num_cpus=1, num_gpus=num_gpus, max_restarts=-1, max_task_retries=ATTEMPTS - 1)(_Actor)
        self._actors = [actor.remote() for _ in range(count)]
        ready, missing = ray.wait(
            [each.pid.remote() for each in self._actors], num_returns=count, timeout=_START_SECONDS
        )
        if missing:
            self.shutdown()
            raise RuntimeError(
                f"{len(ready)} of {count} Ray workers have started after {_START_SECONDS:.0f} s: the cluster is busy, "
                "wait or use fewer"
            )

    def put(self, value: Any) -> Stored:
        return _Object(self._ray.put(cloudpickle.dumps(value)))

    def map(self, function: Callable[..., Any], arguments: Sequence[tuple]) -> list[Any]:
        pool = self._ray.util.ActorPool(self._actors)
        try:
            return list(pool.map(lambda actor, each: actor.call.remote(function, each), list(arguments)))
        except self._ray.exceptions.RayActorError as error:
            raise RuntimeError(
                f"a Ray worker died {ATTEMPTS} times at the same work and was replaced each time: it may be out of "
                f"memory; use fewer workers than {self.count}, or smaller batches"
            ) from error

    @property
    def pids(self) -> list[int]:
        """Of the actors' processes, each on its own machine."""
        return self._ray.get([each.pid.remote() for each in self._actors])

    def shutdown(self) -> None:
        for each in self._actors:
            self._ray.kill(each)
        self._actors = []
        if self._connected:
            self._ray.shutdown()
            self._connected = False


class _Actor:
    def pid(self) -> int:
        return os.getpid()

    def call(self, function: Callable[..., Any], arguments: tuple) -> Any:
        import torch

        torch.set_num_threads(1)
        return function(*arguments)


class _Object:
    """A value in the cluster's object store, which drops it when nobody holds it any more."""

    _names = itertools.count()

    def __init__(self, reference: Any) -> None:
        self.name, self._reference = f"{os.getpid()}/{next(self._names)}", reference

    def get(self) -> Any:
        import ray

        return cloudpickle.loads(ray.get(self._reference))


def _connect(address: str, count: int) -> None:
    import ray

    installed = (sys.prefix, sys.base_prefix)  # every node has its own
    paths = [path for path in map(os.path.abspath, sys.path) if not path.startswith(installed)]
    gl = {"MUJOCO_GL": os.environ["MUJOCO_GL"]} if "MUJOCO_GL" in os.environ else {}
    environment = {"env_vars": _ENVIRONMENT | gl | {"PYTHONPATH": os.pathsep.join(paths)}}
    # On a cluster of its own every worker has a CPU, whether the machine does or not: as with processes.
    own: dict[str, Any] = {"num_cpus": count, "include_dashboard": False} if address == "local" else {}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would call home
    try:
        ray.init(address=address, runtime_env=environment, logging_level="warning", **own)
    except (ConnectionError, RuntimeError, ValueError) as error:
        said = " ".join(str(error).split())
        raise RuntimeError(
            f"Ray cannot be reached at {address} ({said}): start it there, or unset RAY_ADDRESS"
        ) from error
