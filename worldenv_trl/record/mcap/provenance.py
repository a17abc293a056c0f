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

from worldenv_trl.keys import IMAGE

if TYPE_CHECKING:
    from worldenv_trl.scenes import Task

__all__ = ["model_hash", "package_versions", "provenance"]

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
        tasks: of the rollouts, for an env that does not know its tasks (imagination).
        more: further plain values of the metadata, for instance ``seed=0``.

    Returns:
        ``metadata``: ``versions`` of packages; ``threads`` of torch; ``models``, name -> :func:`model_hash`;
        ``config``; ``tasks``, their names, and ``task_ids``; ``env``, its class and settings; ``calibration``, by task
        and camera. ``attachments``:
        for each task ``<k>.mjcf`` (the scene as text), ``<k>.mjb`` (the compiled scene, which the same version of
        MuJoCo loads) and, for tasks of files, ``<k>.bddl``; k counts the tasks.
    """
    metadata: dict[str, Any] = {"versions": package_versions(), "threads": torch.get_num_threads()}
    attachments: dict[str, bytes] = {}
    if models:
        metadata["models"] = {name: model_hash(model) for name, model in models.items()}
    if config is not None:
        metadata["config"] = _plain(config)
    if env is not None:
        base = env
        transforms: list[str] = []
        while isinstance(base, TransformedEnv):
            transforms += [_described(part) for part in getattr(base.transform, "transforms", [base.transform])]
            base = base.base_env
        metadata["env"] = {"class": type(base).__name__, "transforms": transforms} | _settings(base)
        tasks = tasks or getattr(base, "tasks", ())
    known = [_loaded(task) for task in tasks]
    if known:
        size = getattr(base, "image_size", None) if env is not None else None
        if size is None and env is not None:
            size = base.observation_spec[IMAGE].shape[-1]
        metadata["tasks"] = [task.name for task in known]
        metadata["task_ids"] = [task.task_id for task in known]
        metadata["calibration"] = {task.name: _calibration(task, size or 64) for task in known}
    for index, task in enumerate(known):
        attachments |= {f"{index}.{kind}": data for kind, data in _scene_files(task).items()}
    return {"metadata": metadata | _plain(more), "attachments": attachments}


def _loaded(task: str | Task) -> Task:
    if not isinstance(task, str):
        return task
    from worldenv_trl.scenes import load_task  # builds on MuJoCo; reading alone does not need it

    return load_task(task)


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
    names = ("chunk_length", "threshold", "consecutive", "num_frames")
    settings = [f"{name}={getattr(transform, name)}" for name in names if getattr(transform, name, None) is not None]
    return f"{type(transform).__name__}({', '.join(settings)})"


def _calibration(task: Task, size_px: int) -> dict[str, Any]:
    """Pinhole cameras: position (m), rotation (world from camera, looking along -z), vertical field of view (degrees)
    and the intrinsic matrix in pixels."""
    return {
        camera.name: {
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
        mujoco.mj_saveLastXML(str(path), compile_scene(task.problem)[1])
        files["mjcf"] = path.read_bytes()
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
