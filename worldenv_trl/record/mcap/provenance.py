"""What a recording must say about where it comes from, so that it can be understood and replayed."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.transforms import TransformedEnv

from worldenv_trl.devices import device_of

if TYPE_CHECKING:
    from worldenv_trl.scenes import Task

__all__ = ["model_hash", "package_versions", "provenance", "replayed_from"]

_PACKAGES = ("worldenv_trl", "torch", "torchrl", "tensordict", "mujoco", "dm-control", "numpy", "mcap")


def provenance(
    env: EnvBase | None = None,
    *,
    models: Mapping[str, nn.Module] | None = None,
    config: Any = None,
    tasks: Sequence[str | Task] = (),
    **more: Any,
) -> dict[str, dict[str, Any]]:
    """Metadata and attachments for a recording: ``RolloutWriter(path, **provenance(env, models={...}))``.

    Args:
        env: of the rollouts, with or without transforms.

    Keyword Args:
        models: what took part, by name (``policy``, ``world_model``, ``reflector``): their hashes are kept.
        config: settings, a dataclass or a dictionary.
        tasks: of the rollouts, for an env that does not know its tasks (imagination); ``task_id`` is their place here.
        more: further plain values of the metadata, for instance ``seed=0``.

    Raises:
        ValueError: if two tasks have one ``task_id``.

    Returns:
        ``metadata``: ``versions`` of packages; ``threads`` of torch; ``models``, name -> :func:`model_hash`, and the
        ``device`` they were on, ``cpu`` or ``cuda``;
        ``config``; ``tasks``, their names, with ``task_ids`` (what the entry ``task_id`` calls them), ``digests`` and
        ``instructions``; ``env``, its class and settings; ``calibration``, by task and camera. ``attachments``: for
        each task ``<k>.mjcf`` (the scene as text), ``<k>.mjb`` (the compiled scene, which the same version of MuJoCo
        loads) and, for tasks of files, ``<k>.bddl``; k counts the tasks.
    """
    metadata: dict[str, Any] = {"versions": package_versions(), "threads": torch.get_num_threads()}
    attachments: dict[str, bytes] = {}
    if models:
        metadata["models"] = {name: model_hash(model) for name, model in models.items()}
        metadata["device"] = next(device_of(model).type for model in models.values())
    if config is not None:
        metadata["config"] = _plain(config)
    base, own = env, {}  # task_id by name
    if env is not None:
        transforms: list[str] = []
        while isinstance(base, TransformedEnv):
            transforms += [_described(part) for part in getattr(base.transform, "transforms", [base.transform])]
            base = base.base_env
        metadata["env"] = {"class": type(base).__name__, "transforms": transforms} | _settings(base)
        shown = getattr(base, "tasks", ())
        numbers = getattr(base, "task_ids", range(len(shown)))
        own = {task.name: int(number) for task, number in zip(shown, numbers, strict=True)}
        tasks = tasks or shown
    known = [_loaded(task) for task in tasks]
    if known:
        size = getattr(base, "image_size", 64)
        metadata["tasks"] = [task.name for task in known]
        metadata["task_ids"] = _distinct([own.get(task.name, place) for place, task in enumerate(known)], known)
        metadata["digests"] = [task.digest for task in known]
        metadata["instructions"] = [task.language for task in known]
        metadata["calibration"] = {task.name: _calibration(task, size) for task in known}
    for index, task in enumerate(known):
        attachments |= {f"{index}.{kind}": data for kind, data in _scene_files(task).items()}
    return {"metadata": metadata | _plain(more), "attachments": attachments}


def _loaded(task: str | Task) -> Task:
    if not isinstance(task, str):
        return task
    from worldenv_trl.scenes import load_task  # builds on MuJoCo; reading alone does not need it

    return load_task(task)


def _distinct(numbers: list[int], tasks: Sequence[Task]) -> list[int]:
    for place, number in enumerate(numbers):
        if number in numbers[:place]:
            names = f"{tasks[numbers.index(number)].name} and {tasks[place].name}"
            raise ValueError(f"task_id {number} would be both {names}: pass the env its task_ids")
    return numbers


def package_versions() -> dict[str, str]:
    """Versions of the packages that decide what a rollout is."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found


def model_hash(model: nn.Module) -> str:
    """SHA-256 of a module's class, configuration and state, name by name: equal for equal models only."""
    digest = hashlib.sha256(type(model).__name__.encode())
    if dataclasses.is_dataclass(getattr(model, "config", None)):
        digest.update(json.dumps(_plain(model.config), sort_keys=True).encode())
    for name, value in sorted(model.state_dict().items()):
        if isinstance(value, torch.Tensor):
            value = value.detach().cpu().contiguous()
            digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
            digest.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _settings(env: EnvBase) -> dict[str, Any]:
    found: dict[str, Any] = {"batch_size": list(env.batch_size)}
    names = ("image_size", "cameras", "terminate_on_success", "proprio", "with_sim_state", "max_steps", "chunk_length")
    for name in names:
        if getattr(env, name, None) is not None:
            found[name] = _plain(getattr(env, name))
    if isinstance(getattr(env, "_seed", None), int):
        found["seed"] = env._seed
    limits = getattr(env, "_limit", None)  # of the rows: the tasks' own, or what the env was given
    if limits is not None:
        found["max_steps"] = int(limits.max()) if (limits == limits.max()).all() else limits.flatten().tolist()
    return found


def _described(transform: Any) -> str:
    rule = getattr(transform, "rule", None)  # when a reflector ends rollouts
    settings = [f"{name}={value}" for name, value in dataclasses.asdict(rule).items()] if rule is not None else []
    if getattr(transform, "chunk_length", None) is not None:
        settings.append(f"chunk_length={transform.chunk_length}")
    return f"{type(transform).__name__}({', '.join(settings)})"


def _calibration(task: Task, size_px: int) -> dict[str, Any]:
    """Pinhole cameras: ``mount``, the frame they are fixed in (``world``, or ``tool``, that of the tool centre),
    position (m) and rotation (from the camera, which looks along -z) in that frame, vertical field of view (degrees)
    and the intrinsic matrix in pixels."""
    return {
        camera.name: {
            "mount": camera.mount,
            "position": list(camera.position),
            "rotation": [list(row) for row in camera.rotation],
            "fovy": camera.fovy,
            "intrinsics": camera.intrinsics(size_px).tolist(),
        }
        for camera in task.cameras
    }


def _scene_files(task: Task) -> dict[str, bytes]:
    import mujoco

    from worldenv_trl.scenes.files import FileTask
    from worldenv_trl.scenes.settings import compile_scene

    model = task.build()
    compiled = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, compiled)
    files = {"mjb": compiled.tobytes()}
    if not isinstance(task, FileTask):
        return files
    with tempfile.TemporaryDirectory() as folder:
        # MuJoCo writes the text of the model that it compiled last, and tasks keep theirs: compile it once more.
        path = Path(folder) / "scene.xml"
        mujoco.mj_saveLastXML(str(path), compile_scene(task.problem, task.cameras)[1])
        files["mjcf"] = path.read_bytes()
    if task.suite != "libero":  # there the BDDL alone is not the task: its words and camera are the data set's
        files["bddl"] = Path(task.problem.source).read_bytes()
    return files


def _plain(value: Any) -> Any:
    """Dataclasses, paths and tuples as what JSON holds."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic | torch.Tensor):
        return value.tolist()
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def replayed_from(metadata: Mapping[str, Any]) -> str:
    """Of a replay's metadata what it is a replay of, in words; empty for any other recording."""
    about = metadata.get("replay")
    if about is None:
        return ""
    changed = f", changed from step {about['branch']['step']} on" if about["branch"] else ""
    return f"{about['source']}, rollout {about['rollout']}, in {about['mode']}{changed}"
