"""Demonstrations in the HDF5 files of robomimic and LIBERO."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NonTensorData, TensorDict

from worldenv_trl.hdf5_file import demonstration_names, demonstrations_of, open_hdf5, text_of
from worldenv_trl.keys import ACTION, IMAGE, INSTRUCTION, MASK, STATE, SUCCESS, image_key

__all__ = ["hdf5_to_mcap", "read_hdf5"]

_CAMERAS = {
    "agentview_rgb": "agentview",
    "agentview_image": "agentview",
    "eye_in_hand_rgb": "wrist",
    "robot0_eye_in_hand_image": "wrist",
}
_OPEN = 0.04  # metres that each finger of LIBERO's and robomimic's Panda travels


def read_hdf5(path: str | os.PathLike, *, alignment: str = "stored") -> Iterator[TensorDict]:
    """The demonstrations of a file, one after another, as rollouts [1, T].

    Entries: ``("observation", "image")`` and, if there, ``("observation", "wrist_image")`` uint8 [1, T, 3, H, W],
    upright (LIBERO stores rows bottom-up); ``("observation", "state")`` float32 [1, T, 7]: position, axis-angle and
    gripper opening; ``action`` float32 [1, T, 7]; ``source_state``: the state of the file's own simulator; reward,
    success and done; the instruction. Observations come as root and next.

    Args:
        path: ``*.hdf5``.

    Keyword Args:
        alignment: ``stored`` pairs each action with the observation of the same index, as everybody who trains on these
            files does; behind the last one, ``next_obs`` is used if the file has it, else the last observation repeats.
            LIBERO, however, noted each observation *after* its action: ``executed`` pairs each action with the
            observation before it, which loses the first action.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a file that is no HDF5, or lacks what a demonstration needs, naming it.
    """
    if alignment not in ("stored", "executed"):
        raise ValueError(f"alignment must be 'stored' or 'executed', got {alignment!r}")
    with open_hdf5(path) as file:
        data = demonstrations_of(file, path)
        said, flip = _instruction(data, path), bottom_up(data)
        for name in demonstration_names(data):
            yield _rollout(data[name], f"{path}:{name}", said, flip, alignment)


def hdf5_to_mcap(
    source: str | os.PathLike, target: str | os.PathLike, *, alignment: str = "stored", overwrite: bool = False
) -> int:
    """Writes the demonstrations of an HDF5 file into a recording; returns how many. Raises as :func:`read_hdf5`."""
    from worldenv_trl.record import RolloutWriter

    with open_hdf5(source) as file:
        data = demonstrations_of(file, source)
        attributes = {key: text_of(value) for key, value in data.attrs.items()}
        names = demonstration_names(data)
        model = text_of(data[names[0]].attrs["model_file"]) if "model_file" in data[names[0]].attrs else None
    task = Path(attributes.get("bddl_file_name", Path(source).stem)).stem.removesuffix("_demo")
    attachments = {"0.bddl": attributes.pop("bddl_file_content", None), "0.mjcf": model}
    metadata = {"task": task, "source": Path(source).name, "alignment": alignment, "demonstrations": names}
    count = 0
    with RolloutWriter(
        target,
        metadata=metadata | {"hdf5": attributes},
        attachments={name: text for name, text in attachments.items() if text},
        overwrite=overwrite,
    ) as writer:
        for rollout in read_hdf5(source, alignment=alignment):
            writer.write(rollout)
            count += 1
    return count


def _json(data: Any, name: str) -> dict[str, Any]:
    try:
        value = json.loads(text_of(data.attrs.get(name, "{}")))
    except (json.JSONDecodeError, TypeError):
        return {}
    return value if isinstance(value, dict) else {}


def _instruction(data: Any, path: str | os.PathLike) -> str:
    said = _json(data, "problem_info").get("language_instruction") or _json(data, "env_args").get("env_name")
    said = " ".join(said) if isinstance(said, list) else said
    return (said or Path(path).stem.removesuffix("_demo").replace("_", " ")).strip().strip('"')


def bottom_up(data: Any) -> bool:
    """Whether the rows of its images run upwards: as the file says or, where it does not, in LIBERO's alone.

    What OpenVLA-OFT's script makes of LIBERO's files says nothing and holds the renderer's rows as they came.
    """
    said = data.attrs.get("macros_image_convention")
    if said is not None:
        return bool(text_of(said) == "opengl")
    return "agentview_rgb" in data[demonstration_names(data)[0]].get("obs", ())


def _rollout(demo: Any, where: str, said: str, flip: bool, alignment: str) -> TensorDict:
    missing = [name for name in ("actions", "obs") if name not in demo]
    if missing:
        raise ValueError(f"{where} lacks {missing[0]!r}: it is no demonstration of robomimic or LIBERO")
    actions = torch.from_numpy(np.asarray(demo["actions"], np.float32))
    length = len(actions)
    before = _observed(demo["obs"], where, length, flip)
    if alignment == "executed":
        root, after = {k: v[:-1] for k, v in before.items()}, {k: v[1:] for k, v in before.items()}
    else:
        final = _observed(demo["next_obs"], where, length, flip) if "next_obs" in demo else before
        root, after = before, {k: torch.cat([v[1:], final[k][-1:]]) for k, v in before.items()}
    skip = length - len(root[STATE])
    if length <= skip:
        raise ValueError(f"{where} has {length} steps: too few for alignment {alignment!r}")
    rows = length - skip
    out = TensorDict(batch_size=[1, rows])
    for key, value in root.items():
        out[key], out["next", *key] = value.unsqueeze(0), after[key].unsqueeze(0)
    out[ACTION] = actions[skip:].unsqueeze(0)
    if "states" in demo:
        out["source_state"] = torch.from_numpy(np.asarray(demo["states"], np.float64))[skip:].unsqueeze(0)
    reward = _column(demo, "rewards", rows, skip)
    done = torch.zeros(1, rows, 1, dtype=torch.bool)
    done[:, -1] = True
    out["next", "reward"], out["next", SUCCESS] = reward, reward > 0
    out["next", "done"] = out["next", "truncated"] = done
    out["next", "terminated"] = torch.zeros_like(done)
    out[MASK] = torch.ones(1, rows, dtype=torch.bool)
    out.set(INSTRUCTION, NonTensorData(said, batch_size=[1, rows]))
    return out


def _column(demo: Any, name: str, rows: int, skip: int) -> torch.Tensor:
    if name not in demo:
        return torch.zeros(1, rows, 1)
    return torch.from_numpy(np.asarray(demo[name], np.float32))[skip:].reshape(1, rows, 1)


def images_of(obs: Any) -> dict[str, str]:
    """What the images of a scene's camera are called, by camera."""
    return {camera: name for name, camera in _CAMERAS.items() if name in obs}


def opening_of(fingers: Any) -> torch.Tensor:
    """How far the gripper is open, [T, 1] in [0, 1], from where both fingers are [T, 2] (m)."""
    opening = np.abs(np.asarray(fingers, np.float64)).mean(-1, keepdims=True) / _OPEN
    return torch.from_numpy(opening.astype(np.float32)).clamp(0, 1)


def _observed(obs: Any, where: str, length: int, flip: bool) -> dict[tuple[str, ...], torch.Tensor]:
    """Observations [T, ...] by key."""
    found: dict[tuple[str, ...], torch.Tensor] = {}
    for camera, name in images_of(obs).items():
        frames = np.asarray(obs[name])
        if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
            raise ValueError(f"{where}: obs/{name} must be uint8 [T, H, W, 3], got {frames.dtype} {frames.shape}")
        frames = frames[:, ::-1] if flip else frames
        frames = np.ascontiguousarray(frames.transpose(0, 3, 1, 2))
        found[image_key(camera)] = torch.from_numpy(frames)
    if IMAGE not in found:
        raise ValueError(f"{where} holds no images of the agent's view: it has {', '.join(obs)}")
    found[STATE] = _state(obs, where)
    wrong = {key: len(value) for key, value in found.items() if len(value) != length}
    if wrong:
        raise ValueError(f"{where} has {length} actions and {next(iter(wrong.values()))} observations")
    return found


def _state(obs: Any, where: str) -> torch.Tensor:
    """Position, axis-angle and opening [T, 7]."""
    if "ee_pos" in obs and "ee_ori" in obs:
        position, rotation, fingers = obs["ee_pos"], np.asarray(obs["ee_ori"], np.float64), obs.get("gripper_states")
    elif "robot0_eef_pos" in obs and "robot0_eef_quat" in obs:
        position, fingers = obs["robot0_eef_pos"], obs.get("robot0_gripper_qpos")
        rotation = _axis_angle(np.asarray(obs["robot0_eef_quat"], np.float64))
    else:
        raise ValueError(f"{where} holds neither ee_pos and ee_ori nor robot0_eef_pos and robot0_eef_quat")
    if fingers is None:
        raise ValueError(f"{where} holds neither gripper_states nor robot0_gripper_qpos")
    pose = np.concatenate([np.asarray(position, np.float64), rotation], -1)
    return torch.cat([torch.from_numpy(pose.astype(np.float32)), opening_of(fingers)], -1)


def _axis_angle(quaternion: np.ndarray) -> np.ndarray:
    """[T, 4] (x, y, z, w) -> [T, 3]."""
    quaternion = np.where(quaternion[:, 3:] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[:, :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternion[:, 3:])
    return quaternion[:, :3] / np.maximum(sine, 1e-12) * angle
