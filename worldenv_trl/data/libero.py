"""LIBERO's demonstrations as rollouts that every stage here can learn from."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import NonTensorData, TensorDict
from torch import Tensor

from worldenv_trl.context_ids import UNKNOWN_CONTEXT
from worldenv_trl.data.hdf5 import bottom_up, images_of, opening_of
from worldenv_trl.devices import device_of
from worldenv_trl.hdf5_file import demonstration_names, demonstrations_of, open_hdf5
from worldenv_trl.keys import (
    ACTION,
    ACTION_DIM,
    CONTEXT_ID,
    INSTRUCTION,
    KINEMATIC_STATE,
    MASK,
    STATE,
    SUCCESS,
    TASK_ID,
    image_key,
)
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.robot import panda

__all__ = ["ACTIONS", "LiberoFile", "inspect_libero", "read_libero"]

ACTIONS = ("path", "stored")
_STILL = 1e-4  # OpenVLA-OFT's: an action shorter than that moves nothing
_NEEDED = ("actions", "rewards", "obs", "obs/joint_states", "obs/gripper_states")


@dataclass(frozen=True)
class LiberoFile:
    """What of a file can be learned from."""

    demonstrations: tuple[str, ...]
    """Those that reach the goal, by number."""
    steps: tuple[int, ...]
    """Of each, after no-ops are left out."""
    failed: int
    """Demonstrations that do not reach it."""
    no_ops: int
    """Steps left out."""
    cameras: tuple[str, ...]
    size_px: int


def inspect_libero(path: str | os.PathLike, *, actions: str = "path") -> LiberoFile:
    """What :func:`read_libero` would give; images stay on the disk.

    Raises:
        FileNotFoundError, ImportError, ValueError: as :func:`read_libero`.
    """
    _check_actions(actions)
    names, steps, failed, no_ops, seen = [], [], 0, 0, set()
    with open_hdf5(path) as file:
        data = demonstrations_of(file, path)
        for name in demonstration_names(data):
            demo, where = data[name], f"{path}:{name}"
            commands, kept = _commands(demo, where, actions, _noted_after(data))
            seen.add(_shown(demo["obs"], where))
            if not np.asarray(demo["rewards"]).any():
                failed += 1
                continue
            names.append(name)
            steps.append(len(kept))
            no_ops += len(commands) - len(kept)
    if len(seen) > 1:
        raise ValueError(f"{path} holds images of several kinds: {'; '.join(sorted(map(_kind, seen)))}")
    if not names:
        raise ValueError(f"{path} holds {failed} demonstrations, none of which reaches the goal (rewards)")
    (cameras, size_px), *_ = seen
    return LiberoFile(tuple(names), tuple(steps), failed, no_ops, cameras, size_px)


def read_libero(
    path: str | os.PathLike,
    kinematics: ForwardKinematics,
    *,
    instruction: str,
    task_id: int = 0,
    actions: str = "path",
    cameras: Sequence[str] = ("agentview", "wrist"),
    demonstrations: Sequence[str] | None = None,
) -> Iterator[TensorDict]:
    """Successful demonstrations of a file of LIBERO's, one after another, as rollouts [1, T] of this package's robot.

    Entries as of ``TabletopEnv.rollout``, the simulator's state excepted: images of ``cameras`` uint8
    [1, T, 3, H, W], upright; ``("observation", "state")`` [1, T, 7] and ``kinematic_state`` [1, T, 20], the target
    being where the joints hold the hand (LIBERO's controller starts from there each step) and the opening the
    commanded one; ``action`` [1, T, 7]. As in OpenVLA-OFT's data, steps whose action neither moves nor turns the hand
    nor changes the gripper's command are left out.

    Args:
        path: ``<task>_demo.hdf5``, as published or as OpenVLA-OFT's script makes them anew.
        kinematics: of the Panda, which is LIBERO's robot, too.

    Keyword Args:
        instruction: of all rollouts.
        task_id: of all rollouts.
        actions: ``path``, what moves the hand along the demonstrated path here, where +1 is 0.05 m or 0.5 rad of way:
            forward kinematics follows it. ``stored``, LIBERO's commands, of which its controller reaches a fifth
            before the next one: for a policy that acts in LIBERO, and forward kinematics does not follow.
        cameras: of ``agentview`` and ``wrist``.
        demonstrations: which, by name; all that succeed by default.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: without h5py.
        ValueError: for a file that is no HDF5, or lacks what a demonstration needs, naming it.
    """
    _check_actions(actions)
    with open_hdf5(path) as file:
        data = demonstrations_of(file, path)
        for name in demonstration_names(data) if demonstrations is None else demonstrations:
            demo, where = data[name], f"{path}:{name}"
            commands, kept = _commands(demo, where, actions, _noted_after(data))
            if demonstrations is None and not np.asarray(demo["rewards"]).any():
                continue
            rollout = _rollout(demo, where, kinematics, commands, kept, actions, cameras, bottom_up(data))
            shape = rollout.batch_size
            rollout[TASK_ID] = torch.full((*shape, 1), task_id)
            rollout[CONTEXT_ID] = torch.full((*shape, 1), UNKNOWN_CONTEXT)
            rollout.set(INSTRUCTION, NonTensorData(instruction, batch_size=shape))
            yield rollout


def _check_actions(actions: str) -> None:
    if actions not in ACTIONS:
        raise ValueError(f"actions must be one of {', '.join(ACTIONS)}, got {actions!r}")


def _noted_after(data: Any) -> bool:
    """Whether observations are those after the action of their index, as LIBERO's script notes them.

    OpenVLA-OFT's notes the ones before it, and does not name the images' convention.
    """
    return "macros_image_convention" in data.attrs


def _commands(demo: Any, where: str, actions: str, noted_after: bool) -> tuple[np.ndarray, np.ndarray]:
    """The commands [T, 7], each of which belongs to the observation of its index, and the indices [K] of those that
    do something. On a path the last observation only ends it."""
    missing = [name for name in _NEEDED if name not in demo]
    if missing:
        raise ValueError(f"{where} lacks {missing[0]!r}: it is no demonstration as LIBERO publishes them")
    commands = np.asarray(demo["actions"], np.float32)
    if commands.ndim != 2 or commands.shape[1] != ACTION_DIM:
        raise ValueError(f"{where}: actions must be [T, {ACTION_DIM}], got {commands.shape}")
    counted = {name: len(demo[name]) for name in (*_NEEDED[3:], "rewards")}
    wrong = {name: length for name, length in counted.items() if length != len(commands)}
    if wrong:
        name, length = next(iter(wrong.items()))
        raise ValueError(f"{where} has {len(commands)} actions and {length} {name}")
    if actions == "path":
        commands = commands[1:] if noted_after else commands[:-1]
    still = np.linalg.norm(commands[:, :6], axis=-1) < _STILL
    held = np.concatenate([[True], commands[1:, 6] == commands[:-1, 6]]) if len(commands) else still
    kept = np.flatnonzero(~(still & held))
    if not len(kept):
        raise ValueError(f"{where} holds no action that does anything")
    return commands, kept


def _shown(obs: Any, where: str) -> tuple[tuple[str, ...], int]:
    """Cameras, and the side of their images (px)."""
    shapes = {camera: obs[name].shape for camera, name in images_of(obs).items()}
    if "agentview" not in shapes:
        raise ValueError(f"{where} holds no images of the agent's view: it has {', '.join(obs)}")
    sides = {side for shape in shapes.values() for side in shape[1:3]}
    if len(sides) > 1:
        raise ValueError(f"{where}: images must be square and of one size, got {', '.join(map(str, shapes.values()))}")
    return tuple(shapes), sides.pop()


def _kind(shown: tuple[tuple[str, ...], int]) -> str:
    return f"{', '.join(shown[0])} at {shown[1]} px"


def _rollout(
    demo: Any,
    where: str,
    kinematics: ForwardKinematics,
    commands: np.ndarray,
    kept: np.ndarray,
    actions: str,
    cameras: Sequence[str],
    flip: bool,
) -> TensorDict:
    obs, last = demo["obs"], len(demo["actions"]) - 1
    root = torch.from_numpy(kept)
    final = (root[-1:] + 1).clamp(max=last)  # on a path there is one; of stored pairs the last observation repeats
    shown = torch.cat([root, final])  # [K + 1]
    grip = torch.from_numpy(commands[kept, 6:])
    opening = _commanded(opening_of(obs["gripper_states"])[shown[0]], grip)
    joints = torch.from_numpy(np.asarray(obs["joint_states"], np.float32))[shown]
    states = kinematics.initial_state(joints.to(device_of(kinematics)))
    states = torch.cat([states[:, :-1].cpu(), opening], -1)  # [K + 1, 20]
    moves = kinematics.path_actions(states) if actions == "path" else torch.from_numpy(commands[kept, :6])
    seen = {KINEMATIC_STATE: states, STATE: kinematics.state(states, "commanded")}
    names = images_of(obs)
    for camera in cameras:
        if camera not in names:
            raise ValueError(f"{where} holds no images of {camera}: it has {', '.join(names)}")
        seen[image_key(camera)] = _frames(obs[names[camera]], f"{where}: obs/{names[camera]}", shown, flip)
    rows = len(root)
    out = TensorDict(batch_size=[1, rows])
    for key, value in seen.items():
        path = (key,) if isinstance(key, str) else key
        out[path], out["next", *path] = value[:-1].unsqueeze(0), value[1:].unsqueeze(0)
    out[ACTION] = torch.cat([moves.clamp(-1, 1), grip], -1).unsqueeze(0)
    end = torch.zeros(1, rows, 1, dtype=torch.bool)
    end[:, -1] = True
    reached = end & bool(np.asarray(demo["rewards"]).any())
    out["next", SUCCESS], out["next", "reward"] = reached, reached.float()
    out["next", "done"], out["next", "terminated"], out["next", "truncated"] = end, reached, end & ~reached
    out[MASK] = torch.ones(1, rows, dtype=torch.bool)
    return out


def _commanded(first: Tensor, grip: Tensor) -> Tensor:
    """The opening [K + 1, 1] that commands [K, 1] lead to from the measured one [1]."""
    openings = [first.clamp(0, 1)]
    for command in grip:
        openings.append((openings[-1] - panda.GRIPPER_RATE * command.sign()).clamp(0, 1))
    return torch.stack(openings)


def _frames(images: Any, where: str, shown: Tensor, flip: bool) -> Tensor:
    """Upright frames uint8 [K + 1, 3, H, W]."""
    if images.ndim != 4 or images.shape[-1] != 3 or images.dtype != np.uint8:
        raise ValueError(f"{where} must be uint8 [T, H, W, 3], got {images.dtype} {images.shape}")
    frames = torch.from_numpy(np.asarray(images))[shown]
    frames = frames.flip(1) if flip else frames
    return frames.permute(0, 3, 1, 2).contiguous()
