"""What a world model is asked, and that nobody but ``request`` says it."""

from __future__ import annotations

import re

import pytest
import torch
from swaps.copying_world_model import CopyingConfig, CopyingWorldModel
from tensordict import TensorDict

from worldenv_trl.keys import INSTRUCTION, NOISE_SEED, frames_key
from worldenv_trl.language import SeenInstructions, instructions_of
from worldenv_trl.world_models import WorldModel, request

CAMERAS = ("agentview", "wrist", "left of the table")


def world_model(cameras=CAMERAS, stride: int = 2) -> CopyingWorldModel:
    return CopyingWorldModel(CopyingConfig(cameras=cameras, image_size=8, chunk_length=4, stride=stride))


def make_video(rows: int = 2, length: int = 30) -> TensorDict:
    """Videos [n, T] of three cameras, each frame of which says which it is."""
    number = torch.arange(rows).view(-1, 1) * 50 + torch.arange(length)
    frames = {
        frames_key(camera): (number + 3 * index).to(torch.uint8)[..., None, None, None].expand(-1, -1, 3, 8, 8)
        for index, camera in enumerate(CAMERAS)
    }
    return TensorDict({**frames, "poses": number.float().unsqueeze(-1).expand(-1, -1, 13)}, batch_size=[rows, length])


def asked(model: WorldModel, now: list[int], **changes) -> TensorDict:
    video, rows = make_video(), torch.arange(2).unsqueeze(-1)
    told = {
        "recall": lambda numbers: video[rows, numbers],
        "now": torch.tensor(now),
        "poses": torch.rand(2, 4, 13),
        "actions": torch.rand(2, 4, 7),
        "instructions": ["pull", "push"],
    }
    return request(model, **(told | changes))


def test_a_request_shows_the_frames_that_the_model_remembers_of_every_camera_it_paints():
    td = asked(world_model(CAMERAS[:2]), [3, 20])
    for index, entry in enumerate(("image", "wrist_image")):
        frames = td["memory", "frames", entry]
        assert frames.dtype == torch.uint8 and frames.shape == (2, 2, 3, 8, 8)
        assert frames[..., 0, 0, 0].tolist() == [[1 + 3 * index, 3 + 3 * index], [68 + 3 * index, 70 + 3 * index]]
    assert set(td["memory", "frames"].keys()) == {"image", "wrist_image"}


def test_a_camera_without_a_name_of_torchrls_keeps_its_own():
    td = asked(world_model(), [3, 20])
    assert td["memory", "frames", "left of the table"][0, :, 0, 0, 0].tolist() == [7, 9]


def test_the_reference_is_the_first_frame_even_when_it_is_not_remembered():
    td = asked(world_model(), [7, 20])
    for index, entry in enumerate(("image", "wrist_image", "left of the table")):
        assert td["memory", "reference", entry][:, 0, 0, 0].tolist() == [3 * index, 50 + 3 * index]


def test_memory_poses_are_those_of_the_remembered_frames():
    assert asked(world_model(), [3, 20])["memory", "poses"][..., 5].tolist() == [[1.0, 3.0], [68.0, 70.0]]


def test_actions_fill_the_first_arm_and_leave_the_second_at_rest():
    actions = torch.rand(2, 4, 7)
    padded = asked(world_model(), [3, 20], actions=actions)["padded_actions"]
    assert padded.shape == (2, 4, 14)
    assert torch.equal(padded[..., :7], actions) and not padded[..., 7:].any()


def test_every_row_is_told_its_own_goal():
    td = asked(world_model(), [3, 20])
    assert instructions_of(td) == ["pull", "push"] and td[1][INSTRUCTION] == "push"


def test_noise_seeds_are_passed_on_and_otherwise_absent():
    seeds = torch.tensor([[5], [6]])
    assert torch.equal(asked(world_model(), [3, 20], noise_seed=seeds)[NOISE_SEED], seeds)
    assert NOISE_SEED not in asked(world_model(), [3, 20]).keys()  # noqa: SIM118


def test_a_request_holds_what_the_model_says_it_reads():
    model = world_model()
    td = asked(model, [3, 20])
    present = set(td.keys(True))
    assert set(model.in_keys) <= present
    model(td)
    assert set(model.out_keys) <= set(td.keys(True))


@pytest.mark.parametrize("cameras", [(), ("wrist", "wrist")])
def test_a_world_model_names_its_cameras_once_each(cameras):
    with pytest.raises(ValueError, match=re.escape(f"at least one camera, each once, got {cameras}")):
        world_model(cameras)


def test_a_model_that_does_not_learn_says_so():
    with pytest.raises(TypeError, match="CopyingWorldModel is not trained"):
        world_model().training_loss(TensorDict())


def test_a_copying_world_model_repeats_the_last_frame():
    td = world_model()(asked(world_model(), [3, 20]))
    for index, camera in enumerate(CAMERAS):
        painted = td[frames_key(camera)]
        assert painted.shape == (2, 4, 3, 8, 8) and painted.dtype == torch.uint8
        assert painted[:, :, 1, 2, 3].tolist() == [[3 + 3 * index] * 4, [70 + 3 * index] * 4]


def test_a_copying_world_model_is_saved_and_loaded_like_any_other(tmp_path):
    model = world_model()
    model.save_pretrained(tmp_path)
    again = CopyingWorldModel.from_pretrained(tmp_path)
    assert again.config == model.config and again.cameras == CAMERAS


def test_an_instruction_that_was_not_trained_on_is_warned_of_whatever_the_model():
    model = world_model()
    model.seen = SeenInstructions("the world model of this test", ["pull"])
    with pytest.warns(UserWarning, match="the world model of this test was never trained on the instruction 'push'"):
        asked(model, [0, 0])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"image_size": 0}, "must be at least 1, got 0 and 4"), ({"chunk_length": 0}, "must be at least 1, got 8 and 0")],
)
def test_sizes_that_cannot_be_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        CopyingWorldModel(CopyingConfig(**{"image_size": 8, "chunk_length": 4} | wrong))
