from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from worldenv_trl import keys
from worldenv_trl.data import hdf5_to_mcap, read_hdf5
from worldenv_trl.record import read_attachments, read_metadata, read_rollouts

h5py = pytest.importorskip("h5py")


def make_libero(path, lengths=(5, 3), **attributes):
    """As LIBERO's create_dataset writes it: demonstrations in any order, rows bottom-up."""
    rng = np.random.default_rng(0)
    made = {}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["problem_info"] = json.dumps({"language_instruction": "open the drawer"})
        data.attrs["macros_image_convention"] = "opengl"
        data.attrs["bddl_file_name"] = "bddl_files/libero_goal/open_the_drawer.bddl"
        data.attrs["bddl_file_content"] = "(define (problem demo))"
        for key, value in attributes.items():
            data.attrs[key] = value
        for index, length in zip((10, 2), lengths, strict=True):
            demo = data.create_group(f"demo_{index}")
            demo.attrs["model_file"] = f"<mujoco model='{index}'/>"
            each = {
                "agentview_rgb": rng.integers(0, 256, (length, 16, 16, 3), np.uint8),
                "eye_in_hand_rgb": rng.integers(0, 256, (length, 16, 16, 3), np.uint8),
                "ee_pos": rng.normal(size=(length, 3)),
                "ee_ori": rng.normal(size=(length, 3)),
                "gripper_states": np.tile([[0.02, -0.02]], (length, 1)),
            }
            for name, value in each.items():
                demo.create_dataset(f"obs/{name}", data=value)
            each["actions"], each["states"] = rng.uniform(-1, 1, (length, 7)), rng.normal(size=(length, 9))
            for name in ("actions", "states"):
                demo.create_dataset(name, data=each[name])
            for name in ("rewards", "dones"):
                demo.create_dataset(name, data=np.eye(1, length, length - 1, dtype=np.uint8)[0])
            made[index] = each
    return made


def test_liberos_demonstrations_become_recordings(tmp_path):
    made = make_libero(tmp_path / "open_the_drawer_demo.hdf5")
    assert hdf5_to_mcap(tmp_path / "open_the_drawer_demo.hdf5", tmp_path / "a.mcap") == 2
    read = read_rollouts(tmp_path / "a.mcap")
    assert read.shape == (2, 5) and read[keys.MASK].sum(-1).tolist() == [3, 5]  # demo_2 comes before demo_10
    demo, length = made[10], 5
    upright = demo["agentview_rgb"][:, ::-1].transpose(0, 3, 1, 2)
    assert np.array_equal(read[keys.IMAGE][1].numpy(), upright)
    assert np.array_equal(read["next", *keys.IMAGE][1, :-1].numpy(), upright[1:])
    assert np.array_equal(read["next", *keys.IMAGE][1, -1].numpy(), upright[-1])
    assert read[keys.WRIST_IMAGE].shape == (2, 5, 3, 16, 16)
    assert np.array_equal(read[keys.ACTION][1].numpy(), demo["actions"].astype(np.float32))
    state = np.concatenate([demo["ee_pos"], demo["ee_ori"], np.full((length, 1), 0.5)], -1)
    assert np.allclose(read[keys.STATE][1].numpy(), state, atol=1e-6)
    assert np.array_equal(read["source_state"][1].numpy(), demo["states"])
    assert read["next", keys.SUCCESS][1].flatten().tolist() == [False] * 4 + [True]
    assert read["next", "done"][0, :3].flatten().tolist() == [False, False, True]
    assert read[0, 0].get(keys.INSTRUCTION).tolist() == "open the drawer"
    metadata = read_metadata(tmp_path / "a.mcap")
    assert metadata["task"] == "open_the_drawer" and metadata["demonstrations"] == ["demo_2", "demo_10"]
    assert read_attachments(tmp_path / "a.mcap") == {
        "0.bddl": b"(define (problem demo))",
        "0.mjcf": b"<mujoco model='2'/>",
    }


def test_executed_alignment_pairs_actions_with_what_was_seen_before_them(tmp_path):
    made = make_libero(tmp_path / "a.hdf5")[2]
    first = next(read_hdf5(tmp_path / "a.hdf5", alignment="executed"))
    assert first.shape == (1, 2)
    assert np.array_equal(first[keys.ACTION][0].numpy(), made["actions"][1:].astype(np.float32))
    upright = made["agentview_rgb"][:, ::-1].transpose(0, 3, 1, 2)
    assert np.array_equal(first[keys.IMAGE][0].numpy(), upright[:-1])
    assert np.array_equal(first["next", *keys.IMAGE][0].numpy(), upright[1:])
    with pytest.raises(ValueError, match="alignment must be"):
        next(read_hdf5(tmp_path / "a.hdf5", alignment="other"))


def test_robomimics_names_and_quaternions_are_understood(tmp_path):
    angle = 0.7
    with h5py.File(tmp_path / "lift.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift"})
        demo = data.create_group("demo_0")
        demo.create_dataset("actions", data=np.zeros((2, 7)))
        for group, shade in (("obs", 1), ("next_obs", 2)):
            demo.create_dataset(f"{group}/agentview_image", data=np.full((2, 8, 8, 3), shade, np.uint8))
            demo.create_dataset(f"{group}/robot0_eef_pos", data=np.zeros((2, 3)))
            quaternion = -np.array([[0, 0, math.sin(angle / 2), math.cos(angle / 2)]] * 2)  # the same rotation
            demo.create_dataset(f"{group}/robot0_eef_quat", data=quaternion)
            demo.create_dataset(f"{group}/robot0_gripper_qpos", data=[[0.04, -0.04]] * 2)
    (rollout,) = read_hdf5(tmp_path / "lift.hdf5")
    assert torch.allclose(rollout[keys.STATE][0, 0], torch.tensor([0, 0, 0, 0, 0, angle, 1.0]), atol=1e-6)
    assert rollout[keys.IMAGE].flatten(2)[0, :, 0].tolist() == [1, 1]
    assert rollout["next", *keys.IMAGE].flatten(2)[0, :, 0].tolist() == [1, 2]
    assert rollout[0, 0].get(keys.INSTRUCTION).tolist() == "Lift"


def test_other_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        hdf5_to_mcap(tmp_path / "gone.hdf5", tmp_path / "a.mcap")
    (tmp_path / "text.hdf5").write_text("no")
    with pytest.raises(ValueError, match="not a readable HDF5 file"):
        hdf5_to_mcap(tmp_path / "text.hdf5", tmp_path / "a.mcap")
    with h5py.File(tmp_path / "empty.hdf5", "w") as file:
        file.create_group("other")
    with pytest.raises(ValueError, match="holds no demonstrations"):
        hdf5_to_mcap(tmp_path / "empty.hdf5", tmp_path / "a.mcap")
    make_libero(tmp_path / "a.hdf5")
    for name, said in (("actions", "lacks 'actions'"), ("obs/agentview_rgb", "no images"), ("obs/ee_pos", "neither")):
        make_libero(tmp_path / "a.hdf5")
        with h5py.File(tmp_path / "a.hdf5", "a") as file:
            del file[f"data/demo_2/{name}"]
        with pytest.raises(ValueError, match=said):
            hdf5_to_mcap(tmp_path / "a.hdf5", tmp_path / "a.mcap", overwrite=True)
        assert not (tmp_path / "a.mcap").exists()
