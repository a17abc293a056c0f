from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl.keys import FRAMES, TASK_ID
from worldenv_trl.objectives.diffusion import DiffusionLoss
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig
from worldenv_trl.world_models.denoiser import from_cells

CAMERA = SimpleNamespace(
    position=(1.2, 0.0, 0.8),
    rotation=((0.0, -0.5547, 0.83205), (1.0, 0.0, 0.0), (0.0, 0.83205, 0.5547)),
    fovy_deg=45.0,
)


def make_model(**settings) -> VideoWorldModel:
    torch.manual_seed(0)
    small = {"image_size": 32, "patch": 2, "width": 16, "multipliers": (1, 2), "blocks": (1, 1), "frame_channels": 8}
    return VideoWorldModel(VideoWorldModelConfig.for_cameras({0: CAMERA}, **small, **settings))


def make_windows(rows: int = 2, chunks: int = 2) -> TensorDict:
    """A bright square that follows the tool over a dark gradient."""
    generator = torch.Generator().manual_seed(1)
    frames = 3 + 8 * chunks
    poses = torch.zeros(rows, frames, 13)
    poses[..., 1] = torch.linspace(-0.2, 0.2, frames) * (1 + torch.rand(rows, 1, generator=generator))
    poses[..., 3:12] = torch.eye(3).flatten()
    pixels = make_model().action_map.project(poses[..., :3], torch.zeros(rows, 1, dtype=torch.int64)) * 2
    axis = torch.arange(32)
    inside = (axis - pixels[..., :1]).abs().le(3).unsqueeze(-2) & (axis - pixels[..., 1:]).abs().le(3).unsqueeze(-1)
    video = torch.where(inside.unsqueeze(2), 220, axis.view(1, 1, 1, 1, 32) * 3).expand(rows, frames, 3, 32, 32)
    video = video.to(torch.uint8)
    return TensorDict(
        {
            "memory": {"frames": video[:, :3], "poses": poses[:, :3], "reference": video[:, 0]},
            "poses": poses[:, 3:],
            "padded_actions": torch.zeros(rows, 8 * chunks, 14),
            "target_frames": video[:, 3:],
            "target_mask": torch.ones(rows, 8 * chunks, dtype=torch.bool),
            TASK_ID: torch.zeros(rows, 1, dtype=torch.int64),
        },
        batch_size=[rows],
    )


def first_chunk(td: TensorDict) -> TensorDict:
    td = td.clone()
    for key in ("poses", "padded_actions", "target_frames", "target_mask"):
        td[key] = td[key][:, :8]
    return td


def predict(model: VideoWorldModel, td: TensorDict) -> torch.Tensor:
    """The deterministic prediction as images [B, C, 3, H, W] in [-1, 1]."""
    return from_cells(model.predict(None, torch.zeros(td.shape[0]), model.conditions(td)), model.config.patch)


def slow_loss(predicted, td, memory_last, l1_weight, moving_weight, threshold):
    """Numerator and denominator, pixel by pixel of one chunk, from the docstring."""
    target = td["target_frames"].double()
    numerator = denominator = 0.0
    for row in range(target.shape[0]):
        for step in range(target.shape[1]):
            if not td["target_mask"][row, step]:
                continue
            image = target[row, step]
            from_start = (image - td["memory", "reference"][row].double()).abs().amax(0)
            from_last = (image - memory_last[row].double()).abs().amax(0)
            moving = (from_start > 255 * threshold) | (from_last > 255 * threshold)
            weight = 1 + moving_weight * moving.double()
            error = predicted[row, step].double() - (image / 127.5 - 1)
            numerator += ((error**2 + l1_weight * error.abs()).mean(0) * weight).sum().item()
            denominator += weight.sum().item()
    return numerator, denominator


def test_the_loss_equals_a_plain_loop_over_pixels():
    model, td = make_model(), first_chunk(make_windows())
    td["target_mask"][0, 5:] = False
    predicted = predict(model, td)
    numerator, denominator = slow_loss(predicted, td, td["memory", "frames"][:, -1], 0.3, 2.0, 0.05)
    loss = DiffusionLoss(model, l1_weight=0.3, moving_weight=2.0)
    assert loss(td)["loss_diffusion"].item() == pytest.approx(numerator / denominator, rel=1e-4)


@pytest.mark.parametrize("unroll_prob", [0.0, 1.0])
def test_the_second_chunk_remembers_real_frames_or_what_the_model_painted(unroll_prob):
    model, td = make_model(), make_windows()
    head, tail = first_chunk(td), td.clone()
    for key in ("poses", "padded_actions", "target_frames", "target_mask"):
        tail[key] = td[key][:, 8:]
    painted = td["target_frames"][:, :8] if unroll_prob == 0 else model(head.clone())[FRAMES]
    tail["memory", "frames"] = model.next_memory(td["memory", "frames"], painted)
    tail["memory", "poses"] = model.next_memory(td["memory", "poses"], head["poses"])
    last = {id(head): td["memory", "frames"][:, -1], id(tail): td["target_frames"][:, 7]}
    parts = [slow_loss(predict(model, part), part, last[id(part)], 0.15, 4.0, 0.05) for part in (head, tail)]
    expected = sum(part[0] for part in parts) / sum(part[1] for part in parts)
    loss = DiffusionLoss(model, unroll_prob=unroll_prob)(td)["loss_diffusion"]
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_painting_some_frames_scores_exactly_those(monkeypatch):
    model, td = make_model(), make_windows()
    chosen = iter([torch.tensor([0, 3, 7]), torch.tensor([1, 2, 6])])
    loss = DiffusionLoss(model, unroll_prob=1.0, frames_per_chunk=3)
    monkeypatch.setattr(loss, "_draw_frames", lambda *_: next(chosen))
    value = loss(td)["loss_diffusion"]
    masked = td.clone()
    masked["target_mask"][:] = False
    masked["target_mask"][:, [0, 3, 7, 9, 10, 14]] = True
    expected = DiffusionLoss(model, unroll_prob=1.0)(masked)["loss_diffusion"]
    assert value.item() == pytest.approx(expected.item(), rel=1e-4)


def test_the_frames_that_the_next_chunk_remembers_are_always_painted():
    loss = DiffusionLoss(make_model(), frames_per_chunk=3)
    drawn = [loss._draw_frames(False, torch.device("cpu")) for _ in range(30)]
    assert all({3, 7} <= set(frames.tolist()) and len(frames) == 3 for frames in drawn)
    assert set(torch.cat(drawn).tolist()) == set(range(8))


def test_frames_past_the_end_of_the_episode_do_not_count():
    loss, td = DiffusionLoss(make_model(), unroll_prob=0.0), make_windows()
    td["target_mask"][:, 11:] = False
    expected = loss(td)["loss_diffusion"]
    td["target_frames"][:, 11:] = 255
    assert torch.equal(loss(td)["loss_diffusion"], expected)


def test_gradients_reach_every_parameter_with_noise():
    model, td = make_model(deterministic=False), make_windows()
    for parameter in model.parameters():
        parameter.data += 0.02 * torch.randn_like(parameter)
    DiffusionLoss(model, noise_prob=1.0)(td)["loss_diffusion"].backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in model.parameters())


def test_training_overfits_one_window():
    model, td = make_model(), make_windows(rows=1)
    loss = DiffusionLoss(model)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    before = loss(td)["loss_diffusion"].item()
    for _ in range(120):
        value = loss(td)["loss_diffusion"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    assert loss(td)["loss_diffusion"].item() < 0.1 * before
    painted = model(first_chunk(td))[FRAMES].float()
    assert (painted - td["target_frames"][:, :8].float()).abs().mean() < 4


def test_a_window_that_is_not_whole_chunks_is_named():
    td = make_windows()
    td["target_frames"] = td["target_frames"][:, :13]
    with pytest.raises(ValueError, match="whole chunks of 8 frames, got 13"):
        DiffusionLoss(make_model())(td)


def test_impossible_settings_are_named():
    with pytest.raises(ValueError, match="unroll_prob must lie between 0 and 1, got 2"):
        DiffusionLoss(make_model(), unroll_prob=2)
