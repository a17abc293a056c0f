from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl.keys import FRAMES, TASK_ID
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig
from worldenv_trl.world_models.denoiser import from_cells, to_cells

# Looks at the origin from 1.2 m in front of the robot and 0.8 m above the table.
CAMERA = SimpleNamespace(
    position=(1.2, 0.0, 0.8),
    rotation=((0.0, -0.5547, 0.83205), (1.0, 0.0, 0.0), (0.0, 0.83205, 0.5547)),
    fovy_deg=45.0,
)
SMALL = {"image_size": 32, "patch": 2, "width": 16, "multipliers": (1, 2), "blocks": (1, 1), "frame_channels": 8}


@pytest.fixture(scope="module")
def model() -> VideoWorldModel:
    torch.manual_seed(0)
    model = VideoWorldModel(VideoWorldModelConfig.for_cameras({3: CAMERA, 5: CAMERA}, **SMALL))
    for parameter in model.parameters():  # also the layers that start at zero
        parameter.data += 0.02 * torch.randn_like(parameter)
    return model.eval()


def request(rows: int, size: int = 32, chunk: int = 8) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    poses = torch.zeros(rows, 3 + chunk, 13)
    poses[..., :3] = 0.1 * torch.rand(rows, 3 + chunk, 3, generator=generator)
    poses[..., 3:12] = torch.eye(3).flatten()
    frames = torch.randint(0, 256, (rows, 3, 3, size, size), dtype=torch.uint8, generator=generator)
    return TensorDict(
        {
            "memory": {"frames": frames, "poses": poses[:, :3], "reference": frames[:, 0]},
            "poses": poses[:, 3:],
            "padded_actions": torch.rand(rows, chunk, 14, generator=generator) * 2 - 1,
            TASK_ID: torch.full((rows, 1), 3),
            "noise_seed": torch.arange(rows).unsqueeze(-1) + 2**60,
        },
        batch_size=[rows],
    )


def close(first: torch.Tensor, second: torch.Tensor) -> bool:
    """Equal up to the rounding of one intensity level: the order of sums may depend on the batch."""
    return int((first.int() - second.int()).abs().max()) <= 1


def test_a_call_writes_one_chunk_of_uint8_frames_and_keeps_its_inputs(model):
    td = request(5)
    before = td.clone()
    out = model(td)
    assert out[FRAMES].shape == (5, 8, 3, 32, 32) and out[FRAMES].dtype == torch.uint8
    assert (out.exclude(FRAMES) == before).all()


def test_no_rows_give_no_frames(model):
    assert model(request(2)[:0])[FRAMES].shape == (0, 8, 3, 32, 32)


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_row_does_not_depend_on_the_other_rows(model, deterministic):
    model.deterministic, model.num_denoise_steps = deterministic, 2
    together = model(request(20))[FRAMES]
    alone = torch.cat([model(request(20)[row : row + 1])[FRAMES] for row in (0, 7, 19)])
    model.deterministic = True
    assert close(together[[0, 7, 19]], alone)


def test_stochastic_frames_depend_on_the_row_seed_alone(model):
    td = request(4)
    td["noise_seed"][:] = 7
    model.deterministic = False
    first = model(td.clone())[FRAMES]
    td["noise_seed"][:2] = 8
    second = model(td)[FRAMES]
    model.deterministic = True
    assert torch.equal(first[2:], second[2:])
    assert not torch.equal(first[:2], second[:2])


def test_the_deterministic_mode_ignores_seeds_and_needs_none(model):
    td = request(3)
    first = model(td.clone())[FRAMES]
    assert torch.equal(first, model(td.exclude("noise_seed"))[FRAMES])


def test_an_untrained_model_copies_the_last_frame():
    model = VideoWorldModel(VideoWorldModelConfig.for_cameras({3: CAMERA}, **SMALL))
    td = request(2)
    td["memory", "frames"][:] = td["memory", "frames"][:, -1:]
    td["poses"][:] = td["memory", "poses"][:, -1:]
    last = td["memory", "frames"][:, -1:].float()
    painted = model(td)[FRAMES].float()
    assert (painted - last).abs().mean() < 0.4 * (last - 127.5).abs().mean()


def test_a_pixel_at_the_tool_can_follow_the_tool_exactly():
    model = VideoWorldModel(VideoWorldModelConfig.for_cameras({3: CAMERA}, **SMALL))
    image = torch.rand(1, 3, 32, 32)
    shift = torch.tensor([3.0, -2.0]).view(1, 1, 1, 1, 1, 2)
    moved = from_cells(model.denoiser._move(image, shift), 2)[0, 0]
    assert torch.allclose(moved[:, 4:26, 8:28], image[0, :, 6:28, 5:25], atol=1e-5)


def test_the_hand_texture_lies_on_the_plane_of_the_tool_y_and_z_axes(model):
    """Projected points of that plane map to their own plane coordinates: affinely, so only near the tool exactly."""
    poses = torch.zeros(1, 2, 13)
    poses[..., :3] = torch.tensor([[0.1, -0.05, 0.2], [-0.1, 0.1, 0.1]])
    turn = torch.tensor(0.4)
    down = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    yaw = torch.tensor([[turn.cos(), -turn.sin(), 0], [turn.sin(), turn.cos(), 0], [0, 0, 1]])
    poses[..., 3:12] = torch.stack([down, yaw @ down]).flatten(1)
    task = torch.full((1, 1), 3)
    affine = model._hand_plane(poses, model.action_map.project(poses[..., :3], task), task)
    axes = poses[..., 3:12].unflatten(-1, (3, 3))
    for y, z in ((0.0, 0.0), (0.03, 0.0), (0.0, -0.03), (-0.02, 0.02)):
        point = poses[..., :3] + y * axes[..., 1] + z * axes[..., 2]
        image = model.action_map.project(point, task) * 2 / model.action_map.height - 1
        plane = (affine[..., :2] @ image.unsqueeze(-1)).squeeze(-1) + affine[..., 2]
        expected = torch.tensor([y / 0.14, (z + 0.10) / 0.16])
        assert torch.allclose(plane, expected.expand_as(plane), atol=0.04)


def test_a_hand_seen_edge_on_gives_finite_frames(model):
    td = request(1)
    # The y axis along the camera's view: its projection is a point.
    axis = torch.nn.functional.normalize(torch.tensor([1.2, 0.0, 0.8]), dim=0)
    side = torch.tensor([0.0, 1.0, 0.0])
    td["poses"][..., :3] = 0.0
    td["poses"][..., 3:12] = torch.stack([side, axis, torch.linalg.cross(side, axis)], -1).flatten()
    conditions = model.conditions(td)
    assert conditions["hand"].isfinite().all()
    assert model.predict(None, torch.zeros(1), conditions).isfinite().all()


@pytest.mark.parametrize("patch", [1, 2, 4])
def test_cells_hold_the_pixels_of_a_patch_and_are_undone(patch):
    images = torch.randint(0, 256, (2, 3, 16, 16), dtype=torch.uint8)
    cells = to_cells(images, patch)
    expected = torch.nn.functional.pixel_unshuffle(images.float(), patch).unflatten(1, (3, -1))
    assert torch.equal(cells.float(), expected)
    assert torch.equal(from_cells(cells, patch), images)


def test_memory_holds_the_first_frame_one_stride_back_and_the_last(model):
    indices = model.memory_indices(torch.tensor([0, 2, 8, 40]))
    assert indices.tolist() == [[0, 0, 0], [0, 0, 2], [0, 4, 8], [0, 36, 40]]


@pytest.mark.parametrize("stride", [1, 4, 8])
def test_next_memory_is_what_memory_indices_select_one_chunk_later(stride):
    model = VideoWorldModel(VideoWorldModelConfig.for_cameras({3: CAMERA}, memory_stride=stride, **SMALL))
    video = torch.arange(100).unsqueeze(0)
    for t in (8, 11, 40):
        memory = video[:, model.memory_indices(torch.tensor([t]))[0]]
        later = model.next_memory(memory, video[:, t + 1 : t + 9])
        assert later.tolist() == [model.memory_indices(torch.tensor([t + 8]))[0].tolist()]


def test_a_saved_and_reloaded_model_paints_the_same_frames(model, tmp_path):
    model.save_pretrained(tmp_path)
    again = VideoWorldModel.from_pretrained(tmp_path).eval()
    assert again.config == model.config
    assert torch.equal(again(request(3))[FRAMES], model(request(3))[FRAMES])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": 40}, "image_size must be a multiple of 16"),
        ({"num_denoise_steps": 9}, "between 1 and 4, got 9"),
        ({"memory_stride": 9}, "memory_stride must lie between 1 and chunk_length=8, got 9"),
        ({"blocks": (1,)}, "equally long"),
        ({"precision": "float8"}, "precision must be auto, float32 or bfloat16, got 'float8'"),
    ],
)
def test_an_impossible_setting_is_named(settings, message):
    with pytest.raises(ValueError, match=message):
        VideoWorldModelConfig.for_cameras({0: CAMERA}, **settings)


def test_a_model_without_cameras_says_how_to_get_them():
    with pytest.raises(ValueError, match="for_cameras"):
        VideoWorldModel(VideoWorldModelConfig())


def test_wrong_frames_poses_and_tasks_are_named(model):
    with pytest.raises(ValueError, match=r"must be uint8 \[B, 3, 3, 32, 32\]"):
        model(request(2, size=48))
    with pytest.raises(ValueError, match=r"poses must be \[B, 8, 13\]"):
        model(request(2, chunk=4))
    td = request(2)
    td[TASK_ID][:] = 4
    with pytest.raises(ValueError, match="no camera for task id 4"):
        model(td)
