"""LIBERO's demonstrations as rollouts, against plain NumPy and against what LIBERO itself recorded."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

pytest.importorskip("h5py")

import h5py
from small_libero import write_libero

from worldenv_trl import keys
from worldenv_trl.data import episodes_from_rollouts, inspect_libero, policy_samples, predicted_poses, read_libero
from worldenv_trl.kinematics import ForwardKinematics

# Of one of LIBERO's rollouts (libero_spatial, task 0; robosuite 1.4.0): joints (rad), the grip site (m) and the action
# that led from each state to the next one.
JOINTS = [
    [-0.0001305661, -0.1708362056, -0.0241062754, -2.4525674388, -0.0061213968, 2.2259022374, 0.7677453302],
    [0.0006901682, -0.1760875947, -0.0224244935, -2.4555665153, 0.0053403930, 2.2215874735, 0.7569617493],
    [0.0023324688, -0.1874238338, -0.0207875475, -2.4651352352, 0.0367909251, 2.2241264575, 0.7464909513],
    [0.0040415451, -0.2004629970, -0.0209664776, -2.4845821962, 0.0854892255, 2.2254843884, 0.7452181010],
]
GRIP_SITE = [
    [-0.2112428280, -0.0110908879, 1.1742479725],
    [-0.2129057938, -0.0087087345, 1.1750150837],
    [-0.2152366763, -0.0038040385, 1.1762968085],
    [-0.2214382746, 0.0022655353, 1.1742258431],
]
BASE, GRIP_FROM_HAND = [-0.66, 0.0, 0.912], 0.097


@pytest.fixture(scope="module")
def kinematics():
    return ForwardKinematics()


def rollouts(path, kinematics, **options):
    return list(read_libero(path, kinematics, instruction="put it there", **options))


def test_forward_kinematics_of_liberos_joints_is_where_libero_says_the_hand_is(kinematics):
    from worldenv_trl.robot import panda

    pose = kinematics.pose(kinematics.initial_state(torch.tensor(JOINTS)))
    along = pose[:, 3:12].unflatten(-1, (3, 3))[..., 2]
    site = pose[:, :3] - (panda.TCP_FROM_HAND - GRIP_FROM_HAND) * along
    expected = torch.tensor(GRIP_SITE) - torch.tensor(BASE) + torch.tensor(panda.BASE_POSITION)
    assert (site - expected).norm(dim=-1).max() < 1e-3


def test_on_a_path_actions_are_what_moves_the_hand_along_it(tmp_path, kinematics):
    (made, _) = write_libero(tmp_path / "a_demo.hdf5")
    first = rollouts(tmp_path / "a_demo.hdf5", kinematics)[0]
    assert first.shape == (1, 11)  # the last observation only ends the path
    poses = kinematics.pose(kinematics.initial_state(torch.from_numpy(made["obs/joint_states"]).float()))
    way = (poses[1:, :3] - poses[:-1, :3]) / 0.05
    assert torch.allclose(first[keys.ACTION][0, :, :3], way, atol=1e-4)
    turned = poses[1:, 3:12].unflatten(-1, (3, 3)) @ poses[:-1, 3:12].unflatten(-1, (3, 3)).mT
    angle = torch.acos(((turned.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    assert torch.allclose(first[keys.ACTION][0, :, 3:6].norm(dim=-1), angle / 0.5, atol=2e-3)
    # Observations are LIBERO's after their action: what leads from one to the next is the next one's command.
    assert np.array_equal(first[keys.ACTION][0, :, 6], made["actions"][1:, 6])
    episodes = episodes_from_rollouts(first)
    assert (predicted_poses(episodes, kinematics)[0, :, :3] - poses[:, :3]).norm(dim=-1).max() < 2e-3


def test_stored_actions_are_paired_as_in_the_file_and_lead_elsewhere(tmp_path, kinematics):
    (made, _) = write_libero(tmp_path / "a_demo.hdf5")
    first = rollouts(tmp_path / "a_demo.hdf5", kinematics, actions="stored")[0]
    assert np.allclose(first[keys.ACTION][0], made["actions"], atol=1e-6)
    upright = made["obs/agentview_rgb"][:, ::-1].transpose(0, 3, 1, 2)
    assert np.array_equal(first[keys.IMAGE][0], upright)
    assert np.array_equal(first["next", *keys.IMAGE][0, -1], upright[-1])
    with pytest.raises(ValueError, match="actions must be one of path, stored, got 'delta'"):
        rollouts(tmp_path / "a_demo.hdf5", kinematics, actions="delta")


@pytest.mark.parametrize("regenerated", [False, True])
def test_images_are_upright_and_not_mirrored(tmp_path, kinematics, regenerated):
    (made, _) = write_libero(tmp_path / "a_demo.hdf5", regenerated=regenerated)
    first = rollouts(tmp_path / "a_demo.hdf5", kinematics)[0]
    for name, key in (("agentview_rgb", keys.IMAGE), ("eye_in_hand_rgb", keys.WRIST_IMAGE)):
        raw = made[f"obs/{name}"]
        seen = torch.cat([first[key][0], first["next", *key][0, -1:]])
        for frame, column in ((0, 0), (5, 3), (11, 31)):
            assert (
                seen[frame, :, 0, column].tolist() == raw[frame, -1, column].tolist()
            )  # the renderer's last row is up
            assert seen[frame, :, -1, column].tolist() == raw[frame, 0, column].tolist()


def test_a_file_made_anew_pairs_each_command_with_the_observation_before_it(tmp_path, kinematics):
    (made, _) = write_libero(tmp_path / "a_demo.hdf5", regenerated=True)
    first = rollouts(tmp_path / "a_demo.hdf5", kinematics)[0]
    assert np.array_equal(first[keys.ACTION][0, :, 6], made["actions"][:-1, 6])
    assert first["next", keys.SUCCESS].flatten().tolist() == [False] * 10 + [True]


def test_no_ops_are_left_out_as_openvla_oft_does_and_the_path_goes_on(tmp_path, kinematics):
    still = (0, 3, 4, 6)  # the sixth closes the gripper: it stays
    (made, _) = write_libero(tmp_path / "a_demo.hdf5", still=still, regenerated=True)
    commands, kept = made["actions"][:-1], []
    for number, command in enumerate(commands):  # the rule in its own words, one by one
        before = commands[number - 1] if number else None
        moves = math.sqrt(sum(value**2 for value in command[:6])) >= 1e-4
        if moves or (before is not None and command[6] != before[6]):
            kept.append(number)
    assert kept == [1, 2, 5, 6, 7, 8, 9, 10]
    first = rollouts(tmp_path / "a_demo.hdf5", kinematics)[0]
    shown = made["obs/agentview_rgb"][:, ::-1].transpose(0, 3, 1, 2)[[*kept, 11]]
    assert np.array_equal(first[keys.IMAGE][0], shown[:-1])
    assert np.array_equal(first["next", *keys.IMAGE][0], shown[1:])
    reached = kinematics.rollout(first[keys.KINEMATIC_STATE][:, 0], first[keys.ACTION])[0, -1, 7:10]
    assert torch.allclose(reached, first["next", keys.KINEMATIC_STATE][0, -1, 7:10], atol=1e-4)
    found = inspect_libero(tmp_path / "a_demo.hdf5")
    assert (found.steps, found.no_ops, found.failed) == ((8, 5), 3 + 3, 0)


def test_proprioception_is_what_the_run_commands(tmp_path, kinematics):
    (made, _) = write_libero(tmp_path / "a_demo.hdf5")
    first = rollouts(tmp_path / "a_demo.hdf5", kinematics)[0]
    opening = [0.75]
    for command in made["actions"][1:, 6]:
        opening.append(min(1.0, max(0.0, opening[-1] - 0.2 * np.sign(command))))
    seen = torch.cat([first[keys.STATE][0], first["next", *keys.STATE][0, -1:]])
    assert np.allclose(seen[:, 6], opening, atol=1e-6)
    pose = kinematics.pose(kinematics.initial_state(torch.from_numpy(made["obs/joint_states"]).float()))
    assert torch.allclose(seen[:, :3], pose[:, :3], atol=1e-5)


def test_failures_are_left_out_and_counted(tmp_path, kinematics):
    write_libero(tmp_path / "a_demo.hdf5", lengths=(6, 7, 8), failed=(1,))
    found = inspect_libero(tmp_path / "a_demo.hdf5")
    assert found.demonstrations == ("demo_0", "demo_2") and found.failed == 1 and found.steps == (5, 7)
    assert found.cameras == ("agentview", "wrist") and found.size_px == 32
    assert [rollout.shape[1] for rollout in rollouts(tmp_path / "a_demo.hdf5", kinematics)] == [5, 7]


def test_rollouts_become_training_samples(tmp_path, kinematics):
    write_libero(tmp_path / "a_demo.hdf5")
    samples = policy_samples(episodes_from_rollouts(rollouts(tmp_path / "a_demo.hdf5", kinematics)[1]), 4)
    assert samples.shape == (8,) and samples[keys.CHUNK].shape == (8, 4, 7)
    assert samples[0].get(keys.INSTRUCTION).tolist() == "put it there"


@pytest.mark.parametrize(
    ("gone", "said"),
    [
        ("actions", "lacks 'actions'"),
        ("rewards", "lacks 'rewards'"),
        ("obs/joint_states", "lacks 'obs/joint_states'"),
        ("obs/gripper_states", "lacks 'obs/gripper_states'"),
        ("obs/agentview_rgb", "no images of the agent's view"),
    ],
)
def test_what_lacks_something_is_named(tmp_path, gone, said):
    path = tmp_path / "a_demo.hdf5"
    write_libero(path)
    with h5py.File(path, "a") as file:
        del file[f"data/demo_1/{gone}"]
    with pytest.raises(ValueError, match=f"{path}:demo_1.*{said}"):
        inspect_libero(path)


def test_files_that_do_not_suit_are_named(tmp_path):
    path = tmp_path / "a_demo.hdf5"
    write_libero(path, failed=(0, 1))
    with pytest.raises(ValueError, match="holds 2 demonstrations, none of which reaches the goal"):
        inspect_libero(path)
    write_libero(path)
    with h5py.File(path, "a") as file:
        del file["data/demo_1/obs/eye_in_hand_rgb"]
    with pytest.raises(ValueError, match="several kinds: agentview at 32 px; agentview, wrist at 32 px"):
        inspect_libero(path)
    write_libero(path)
    with h5py.File(path, "a") as file:
        del file["data/demo_0/rewards"]
        file["data/demo_0/rewards"] = np.ones(3)
    with pytest.raises(ValueError, match="demo_0 has 12 actions and 3 rewards"):
        inspect_libero(path)
    write_libero(path, lengths=(4,), still=range(4))
    with h5py.File(path, "a") as file:
        file["data/demo_0/actions"][:, 6] = -1
    with pytest.raises(ValueError, match="holds no action that does anything"):
        inspect_libero(path)
