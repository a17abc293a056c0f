"""Tiny files as LIBERO publishes its demonstrations, and as OpenVLA-OFT's script makes them anew."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

BDDL = """
(define (problem LIBERO_Tabletop_Manipulation)
  (:domain robosuite)
  (:language put the bowl on a plate)
  (:regions
    (plate_region (:target main_table) (:ranges ((0.04 -0.03 0.06 -0.01))))
    (bowl_region (:target main_table) (:ranges ((-0.10 -0.01 -0.08 0.01)))))
  (:fixtures main_table - table)
  (:objects akita_black_bowl_1 - akita_black_bowl plate_1 - plate)
  (:obj_of_interest akita_black_bowl_1 plate_1)
  (:init (On akita_black_bowl_1 main_table_bowl_region) (On plate_1 main_table_plate_region))
  (:goal (And (On akita_black_bowl_1 plate_1))))
"""
HOME = np.array([0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.2267522, np.pi / 4])  # LIBERO's


def write_libero(
    path: Path,
    lengths=(12, 9),
    *,
    size=32,
    failed=(),
    still=(),
    regenerated=False,
    seed=0,
    bddl=BDDL,
) -> list[dict[str, np.ndarray]]:
    """Writes demonstrations of so many steps and returns their arrays as they stand in the file.

    ``failed`` are numbers of demonstrations without a reward, ``still`` steps of each whose action is a no-op. A file
    that was made anew (``regenerated``) says nothing of itself and notes each observation before its action.
    """
    rng, made = np.random.default_rng(seed), []
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if not regenerated:
            data.attrs["problem_info"] = json.dumps({"language_instruction": "words of the BDDL"})
            data.attrs["macros_image_convention"] = "opengl"
            data.attrs["bddl_file_name"] = f"bddl_files/libero_goal/{path.stem.removesuffix('_demo')}.bddl"
            data.attrs["bddl_file_content"] = bddl
        for number, length in enumerate(lengths):
            joints = HOME + 0.02 * rng.normal(size=(length, 7)).cumsum(0)
            actions = rng.uniform(-1, 1, (length, 7)).astype(np.float64)
            actions[:, 6] = np.where(np.arange(length) < length // 2, -1, 1)
            actions[list(still), :6] = 0
            arrays = {
                "actions": actions,
                "states": rng.normal(size=(length, 79)),
                "robot_states": rng.normal(size=(length, 9)),
                "rewards": np.zeros(length, np.uint8),
                "dones": np.eye(1, length, length - 1, dtype=np.uint8)[0],
                "obs/agentview_rgb": rng.integers(0, 256, (length, size, size, 3), np.uint8),
                "obs/eye_in_hand_rgb": rng.integers(0, 256, (length, size, size, 3), np.uint8),
                "obs/joint_states": joints,
                "obs/gripper_states": np.tile([[0.03, -0.03]], (length, 1)),
                "obs/ee_pos": rng.normal(size=(length, 3)),
                "obs/ee_ori": rng.normal(size=(length, 3)),
            }
            arrays["obs/ee_states"] = np.concatenate([arrays["obs/ee_pos"], arrays["obs/ee_ori"]], -1)
            arrays["rewards"][-1] = number not in failed
            for name, value in arrays.items():
                data.create_dataset(f"demo_{number}/{name}", data=value)
            made.append(arrays)
    return made
