"""The loss against a loop over pixels that puts its own requests together."""

from __future__ import annotations

import itertools
import warnings

import pytest
import torch
from small_models import ONE, PULL, TWO, fresh_model, make_model
from small_windows import make_windows
from tensordict import NonTensorStack, TensorDict

from worldenv_trl.keys import frames_key, image_entry
from worldenv_trl.language import instructions_of
from worldenv_trl.row_share import row_share
from worldenv_trl.world_models import VideoWorldModel
from worldenv_trl.world_models.base import memory_key
from worldenv_trl.world_models.cells import from_cells, to_cells, to_float

C = 8


def asked(model: VideoWorldModel, windows: TensorDict, chunk: int, seen: dict | None = None) -> TensorDict:
    """The request for one chunk, by hand; ``seen`` are videos by camera to remember instead of the real ones."""
    td = TensorDict(batch_size=windows.batch_size)
    row = torch.arange(len(windows)).unsqueeze(-1)
    now = windows["start"] + chunk * C
    memory = torch.cat([torch.zeros_like(now), (now - 4).clamp(min=0), now], 1)
    for camera in model.cameras:
        video = windows[frames_key(camera)] if seen is None else seen[camera]
        td["memory", "frames", image_entry(camera)] = video[row, memory]
        td["memory", "reference", image_entry(camera)] = video[:, 0]
    td["memory", "poses"] = windows["poses"][row, memory]
    td["poses"] = windows["poses"][row, now + torch.arange(1, C + 1)]
    actions = windows["actions"][:, chunk * C : (chunk + 1) * C]
    td["padded_actions"] = torch.cat([actions, torch.zeros_like(actions)], -1)
    td.set("language_instruction", NonTensorStack(*instructions_of(windows)))
    return td


def slow_loss(model: VideoWorldModel, windows: TensorDict, own: tuple[bool, ...] = (False, False)) -> torch.Tensor:
    """Loss, mse and moving mse of two chunks, row by row and frame by frame, from the docstring.

    ``own`` says which rows remember their own frames in the second chunk.
    """
    seen = {camera: windows[frames_key(camera)].clone() for camera in model.cameras}
    config = model.config
    error_sum = weight_sum = square_sum = pixels = moving_square = moving_pixels = 0.0
    for chunk in range(windows["actions"].shape[1] // C):
        td = asked(model, windows, chunk, seen)
        with torch.no_grad():
            cells = model.predict(None, torch.zeros(len(td)), model.conditions(td, instructions_of(td)))
        predicted = from_cells(cells, config.patch)
        painted = model(td)
        for row, (index, camera) in itertools.product(range(len(td)), enumerate(model.cameras)):
            real, now = windows[frames_key(camera)][row], int(windows["start"][row]) + chunk * C
            for step in range(C):
                if not windows["step_mask"][row, chunk * C + step]:
                    continue
                image = real[now + step + 1].double()
                changed = [(image - real[other].double()).abs().amax(0) for other in (0, now)]
                moving = (changed[0] > 255 * 0.05) | (changed[1] > 255 * 0.05)
                error = predicted[row, index, step].double() - (image / 127.5 - 1)
                weight = 1 + config.moving_weight * moving.double()
                error_sum += ((error**2 + config.l1_weight * error.abs()).mean(0) * weight).sum()
                weight_sum += weight.sum()
                square = (error / 2).square().mean(0)
                square_sum, pixels = square_sum + square.sum(), pixels + square.numel()
                moving_square, moving_pixels = moving_square + square[moving].sum(), moving_pixels + moving.sum()
            if own[row]:
                seen[camera][row, now + 1 : now + C + 1] = painted[frames_key(camera)][row]
    return torch.stack([error_sum / weight_sum, square_sum / pixels, moving_square / moving_pixels])


def figures(model: VideoWorldModel, windows: TensorDict) -> torch.Tensor:
    out = model.training_loss(windows)
    return torch.stack([out[key].detach() for key in ("loss_world_model", "mse", "moving_mse")]).double()


@pytest.mark.parametrize("cameras", [ONE, TWO], ids=["one camera", "two cameras"])
def test_the_loss_equals_a_plain_loop_over_pixels(cameras):
    model = fresh_model(cameras, l1_weight=0.3, moving_weight=2.0, unroll_prob=0.0)
    windows = make_windows(model)
    windows["step_mask"][0, 13:] = False
    assert torch.allclose(figures(model, windows), slow_loss(model, windows), rtol=1e-4)


@pytest.mark.parametrize("cameras", [ONE, TWO], ids=["one camera", "two cameras"])
def test_the_second_chunk_remembers_what_the_model_painted(cameras):
    model = make_model(cameras, unroll_prob=1.0)
    windows = make_windows(model)
    own, real = slow_loss(model, windows, own=(True, True)), slow_loss(model, windows)
    assert torch.allclose(figures(model, windows), own, rtol=1e-4) and not torch.allclose(own, real, rtol=1e-3)


def test_some_rows_remember_their_own_frames_and_some_the_real_ones():
    model = make_model(unroll_prob=0.5)
    windows = make_windows(model)
    expected = {own: slow_loss(model, windows, own) for own in itertools.product((False, True), repeat=2)}
    seen = set()
    for seed in range(12):
        torch.manual_seed(seed)
        value = figures(model, windows)
        seen |= {own for own, loss in expected.items() if torch.allclose(value, loss, rtol=1e-5)}
    assert seen == set(expected)


def test_a_third_chunk_remembers_the_second_one_that_was_painted():
    model = make_model(unroll_prob=1.0)
    windows = make_windows(model, chunks=3)
    assert torch.allclose(figures(model, windows), slow_loss(model, windows, own=(True, True)), rtol=1e-4)


def test_frames_past_the_end_of_the_episode_do_not_count():
    model = fresh_model(TWO, unroll_prob=0.0)
    windows = make_windows(model, starts=(0, 0))
    windows["step_mask"][:, 11:] = False
    expected = figures(model, windows)
    for camera in model.cameras:
        windows[frames_key(camera)][:, 12:] = 255
    assert torch.equal(figures(model, windows), expected)


def test_the_first_chunk_is_asked_for_as_imagination_asks(monkeypatch):
    model = fresh_model(TWO, unroll_prob=0.0)
    windows, told = make_windows(model), []
    conditions = model.conditions
    monkeypatch.setattr(model, "conditions", lambda td, texts: (told.append(td), conditions(td, texts))[1])
    model.training_loss(windows)
    for chunk in (0, 1):
        assert (told[chunk] == asked(model, windows, chunk)).all()


# --------------------------------------------------------------------------------------------------------- noise


def spied(model: VideoWorldModel, windows: TensorDict, monkeypatch) -> tuple[list[TensorDict], list[tuple]]:
    """What the loss asks, and what it makes the network predict from."""
    told, made = [], []
    conditions, predict = model.conditions, model.predict
    monkeypatch.setattr(model, "conditions", lambda td, texts: (told.append(td), conditions(td, texts))[1])

    def predicted(noisy, level, known):
        made.append((noisy, level))
        return predict(noisy, level, known)

    monkeypatch.setattr(model, "predict", predicted)
    model.training_loss(windows)
    return told, made


def test_a_deterministic_model_is_trained_from_nothing_alone(monkeypatch):
    model = fresh_model(TWO)
    _, made = spied(model, make_windows(model), monkeypatch)
    assert all(noisy is None and not level.any() for noisy, level in made)


def test_noised_rows_are_between_noise_and_the_real_frames_by_their_level(monkeypatch):
    torch.manual_seed(3)
    model = fresh_model(TWO, noise_prob=0.5)
    windows = make_windows(model, starts=(0, 1, 2, 3, 4, 5, 6, 7))
    _, made = spied(model, windows, monkeypatch)
    row = torch.arange(8).unsqueeze(-1)
    with_noise = [(level > 0) for _, level in made]
    assert torch.equal(*with_noise) and 0 < int(with_noise[0].sum()) < 8
    for chunk, (noisy, level) in enumerate(made):
        place = windows["start"] + chunk * C + torch.arange(1, C + 1)
        real = torch.stack([windows[frames_key(camera)][row, place] for camera in model.cameras], 1)
        assert not noisy[level == 0].any()
        here = level > 0
        part = level[here].view(-1, *[1] * 6)
        noise = (noisy[here] - part * to_float(to_cells(real[here], 2))) / (1 - part)
        assert abs(float(noise.mean())) < 0.05 and abs(float(noise.std()) - 1) < 0.05


def test_a_row_that_was_almost_clean_remembers_real_frames(monkeypatch):
    """A prediction from an almost clean chunk is not what the model would imagine."""
    torch.manual_seed(0)
    model = make_model(TWO, noise_prob=1.0, unroll_prob=1.0)
    windows = make_windows(model, starts=(0, 1, 2, 3, 4, 5, 6, 7))
    told, made = spied(model, windows, monkeypatch)
    real, clean = asked(model, windows, 1), made[0][1] >= 0.5
    assert 0 < int(clean.sum()) < 8
    for row in range(8):
        for camera in model.cameras:
            same = torch.equal(told[1][memory_key(camera)][row], real[memory_key(camera)][row])
            assert same == bool(clean[row])


def test_figures_are_of_the_rows_without_noise():
    model = fresh_model(noise_prob=1.0)
    out = model.training_loss(make_windows(model))
    assert out["loss_world_model"] > 0 and out["mse"] == 0 and out["moving_mse"] == 0


@pytest.mark.parametrize("cameras", [ONE, TWO], ids=["one camera", "two cameras"])
def test_gradients_reach_every_parameter_with_noise(cameras):
    model = make_model(cameras, deterministic=False, noise_prob=1.0)
    model.training_loss(make_windows(model))["loss_world_model"].backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in model.parameters())


# ------------------------------------------------------------------------------------------------------ training


def test_training_overfits_one_window_of_two_cameras():
    model = fresh_model(TWO)
    windows = make_windows(model, starts=(5,), chunks=1)
    optimizer = torch.optim.Adam(model.parameters(), lr=6e-3)
    before = model.training_loss(windows)["loss_world_model"].item()
    for _ in range(50):
        value = model.training_loss(windows)["loss_world_model"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    assert model.training_loss(windows)["loss_world_model"].item() < 0.1 * before
    painted = model(asked(model, windows, 0))
    for camera in model.cameras:
        target = windows[frames_key(camera)][:, 6:14].float()
        assert (painted[frames_key(camera)].float() - target).abs().mean() < 4


@pytest.mark.parametrize("steps", [13, 0])
def test_a_window_that_is_not_whole_chunks_is_named(steps):
    model = fresh_model()
    windows = make_windows(model)
    for key in ("actions", "step_mask"):
        windows[key] = windows[key][:, :steps]
    with pytest.raises(ValueError, match=f"whole chunks of 8 frames, got {steps} steps"):
        model.training_loss(windows)


def test_instructions_without_a_calibration_are_warned_of_once():
    model = fresh_model()
    windows = make_windows(model)
    windows.set("language_instruction", NonTensorStack(PULL, "bow"))
    with pytest.warns(UserWarning, match="never trained on the instruction 'bow'"):
        model.training_loss(windows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.training_loss(windows)


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_weighted_mean_of_shares_is_the_loss_of_the_whole_batch(deterministic):
    model = make_model(ONE, deterministic=deterministic, unroll_prob=0.5)
    windows = make_windows(model, starts=(0, 5, 3, 1))
    losses = []
    for size in (1, 2):
        parts = []
        for rank, share in enumerate(windows.tensor_split(size)):
            torch.manual_seed(0)
            with row_share(rank, size):
                parts.append(model.training_loss(share))
        weights = torch.stack([part["weight"] for part in parts])
        values = torch.stack([part["loss_world_model"].detach() for part in parts])
        losses.append(float((weights * values).sum() / weights.sum()))
    assert losses[0] == pytest.approx(losses[1], abs=1e-6)
