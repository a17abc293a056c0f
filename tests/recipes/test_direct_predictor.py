"""Success told from the hand's path."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from direct_predictor import DirectPredictor, fit_direct, predict_direct
from worldenv_trl import keys
from worldenv_trl.data import Episodes
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.metrics import classification
from worldenv_trl.robot import panda

FK, STEPS = ForwardKinematics(), 12


def moved(rows: int, seed: int) -> Episodes:
    """Grey episodes of two tasks: the first is done by moving along x, the second by moving against it."""
    generator = torch.Generator().manual_seed(seed)
    task = torch.arange(rows).unsqueeze(-1) % 2
    along = torch.rand(rows, 1, 1, generator=generator) * 2 - 1
    actions = torch.cat([along, torch.zeros(rows, 1, 6)], -1).expand(rows, STEPS, 7).clone()
    home = FK.initial_state(torch.as_tensor(panda.HOME_Q, dtype=torch.float32).expand(rows, 7))
    reached = (along[:, 0] > 0) == (task == 0)
    entries = {
        "states": torch.zeros(rows, STEPS + 1, 7),
        "kinematic_states": home.unsqueeze(1).repeat(1, STEPS + 1, 1),
        "actions": actions,
        "success": reached & (torch.arange(STEPS + 1) > 6),
        "length": torch.full((rows, 1), STEPS),
        keys.TASK_ID: task,
        keys.CONTEXT_ID: torch.arange(rows).unsqueeze(-1),
    }
    frames = torch.full((rows * (STEPS + 1), 3, 16, 16), 128, dtype=torch.uint8)
    video = TensorDict({keys.frames_key("agentview"): frames}, batch_size=[len(frames)])
    return Episodes(TensorDict(entries, batch_size=[rows]), [f"task {row % 2}" for row in range(rows)], video)


def test_it_learns_what_the_path_tells_of_each_task():
    torch.manual_seed(0)
    model = fit_direct(moved(64, 0), FK, 2, steps=60, batch_size=32)
    unseen = moved(64, 1)
    prob = predict_direct(model, unseen, FK)
    assert classification(prob, unseen["success"][:, -1]).auc > 0.95


def test_a_keypoint_is_where_its_map_is_bright():
    model = DirectPredictor(1, 1, keypoints=1)
    seen = []
    model.scene.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    bright = torch.full((1, 1, 4, 4), -50.0)
    bright[0, 0, 0, 3] = 50.0  # above and right
    model.maps = torch.nn.Sequential(
        torch.nn.Flatten(), torch.nn.Linear(3 * 16 * 16, 16), torch.nn.Unflatten(1, (1, 4, 4))
    )
    torch.nn.init.zeros_(model.maps[1].weight)
    model.maps[1].bias.data = bright.flatten()
    model(torch.zeros(1, 3, 16, 16, dtype=torch.uint8), torch.zeros(1, STEPS, 20), torch.tensor([0]))
    assert seen[0][0].tolist() == pytest.approx([-1.0, 1.0])


def test_episodes_without_labels_are_refused():
    episodes = moved(4, 0)
    del episodes.entries["success"]
    with pytest.raises(ValueError, match="no success labels"):
        fit_direct(episodes, FK, 2)
