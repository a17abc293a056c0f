"""The full-size world model learns: its loss against closed forms, and one clip by heart."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")
from small_diffusion import VAE, ask, make_diffusion
from small_models import PULL, TWO
from small_windows import make_windows

from worldenv_trl.keys import frames_key
from worldenv_trl.objectives import WorldModelLoss
from worldenv_trl.world_models import Window, request
from worldenv_trl.world_models.cells import to_float


def loss_of(model, windows, seed=0):
    torch.manual_seed(seed)
    return WorldModelLoss(model)(windows)["loss_world_model"]


@pytest.mark.parametrize("answer", ["the truth", "nothing"])
def test_the_loss_is_the_error_of_v(monkeypatch, answer):
    model, velocities = make_diffusion(TWO), []
    velocity = model.scheduler.get_velocity

    def told(*given):
        velocities.append(velocity(*given))
        return velocities[-1]

    def predict(noisy, timesteps, conditions, memory_noise):
        alpha = model.scheduler.alphas_cumprod[timesteps].view(-1, 1, 1, 1, 1)
        clean = torch.cat([model.encode(to_float(windows[frames_key(c)][:, 1:5])) for c in model.cameras], -2)
        return (alpha.sqrt() * noisy - clean) / (1 - alpha).sqrt() * (answer == "the truth")

    monkeypatch.setattr(model.scheduler, "get_velocity", told)
    monkeypatch.setattr(model, "predict_v", predict)
    windows = make_windows(model, (0, 0), 1)
    out = model.training_loss(windows)
    expected = 0.0 if answer == "the truth" else velocities[0].square().mean().item()
    assert out["loss_world_model"].item() == pytest.approx(expected, abs=1e-3)
    assert (out["latent_mse"] < 1e-3) == (answer == "the truth")


def test_steps_past_the_end_of_an_episode_do_not_count():
    model = make_diffusion()
    windows = make_windows(model, (0, 0), 1)
    windows["step_mask"][:, 2:] = False
    first = loss_of(model, windows)
    model_sees = model.predict_v
    # The network's own view of the frames stays; only what the masked frames should have been changes.
    model.predict_v = lambda *given, **known: (
        model_sees(*given, **known) + 100 * torch.tensor([0.0, 0, 1, 1]).view(1, 4, 1, 1, 1)
    )
    assert loss_of(model, windows).item() == pytest.approx(first.item())
    windows["step_mask"][:, 2] = True
    assert loss_of(model, windows) > 100 * first


def test_the_network_learns_and_the_pretrained_parts_do_not():
    model = make_diffusion(TWO).train()
    assert not model.vae.training and not model.context.encoder.training and model.unet.training
    loss_of(model, make_windows(model)).backward()
    frozen = [name for name, parameter in model.named_parameters() if not parameter.requires_grad]
    assert all(name.startswith(("vae.", "context.encoder.")) for name in frozen)
    idle = [name for name, parameter in model.named_parameters() if parameter.requires_grad and parameter.grad is None]
    assert idle == []


def test_checkpointed_activations_change_no_gradient():
    models = [make_diffusion(gradient_checkpointing=wanted).train() for wanted in (False, True)]
    assert list(models[0].state_dict()) == list(models[1].state_dict())
    models[1].load_state_dict(models[0].state_dict())
    for model in models:
        loss_of(model, make_windows(model)).backward()
    for plain, twice in zip(*(model.unet.parameters() for model in models), strict=True):
        torch.testing.assert_close(plain.grad, twice.grad)


def test_disturbed_memory_is_drawn_up_to_its_level_and_told(monkeypatch):
    model, told = make_diffusion(memory_noise=0.5), []
    predict = model.predict_v
    monkeypatch.setattr(
        model, "predict_v", lambda *given, **known: (told.append(tuple(known.values())), predict(*given, **known))[1]
    )
    windows = make_windows(model, (0,) * 6, 1)
    clean = model.conditions(asked_of(model, windows), [PULL] * 6).memory
    loss_of(model, windows)
    ((known, level),) = told
    measured = (known.memory - clean).flatten(1).std(1)
    torch.testing.assert_close(measured, level, atol=0.05, rtol=0.1)
    assert level.min() >= 0 and 0.25 < level.max() <= 0.5


def asked_of(model, windows):
    window = Window(windows)
    length = model.chunk_length
    poses = window.recall(window.start.unsqueeze(-1) + torch.arange(1, length + 1))["poses"]
    texts = [PULL] * len(windows)
    return request(model, window.recall, window.start, poses, window.actions[:, :length], texts)


def test_one_clip_is_learned_by_heart():
    vae = VAE | {"scaling_factor": 1.5}  # latents of about the noise's size, as pretrained ones are
    model = make_diffusion(memory_noise=0.0, eta=0.0, num_denoise_steps=4, vae=vae)
    windows = make_windows(model, (0,), 1)
    asked = asked_of(model, windows)
    asked["noise_seed"] = torch.tensor([[3]])
    clean = model.encode(to_float(windows[frames_key("agentview")][:, 1:5]))
    before = (model.sample(asked, [PULL]) - clean).square().mean()
    optimizer = torch.optim.Adam([p for p in model.train().parameters() if p.requires_grad], lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 100)
    torch.manual_seed(0)
    for _ in range(100):
        loss = model.training_loss(windows)["loss_world_model"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    after = (model.eval().sample(asked, [PULL]) - clean).square().mean()
    assert after < 0.1 * before and after < 0.4 * clean.square().mean(), (before, after)


def test_a_window_of_half_a_chunk_is_refused():
    model = make_diffusion()
    windows = make_windows(model)
    windows["actions"] = windows["actions"][:, :6]
    with pytest.raises(ValueError, match="whole chunks of 4 frames, got 6 steps"):
        model.training_loss(windows)


def test_lower_precision_paints_nearly_the_same():
    exact, low = make_diffusion(precision="float32"), make_diffusion(precision="bfloat16")
    low.load_state_dict(exact.state_dict())
    asked, x, times = ask(exact, 1), torch.randn(1, 4, 4, 8, 12), torch.tensor([500])
    v, nearly = (model.predict_v(x, times, model.conditions(asked, [PULL])) for model in (exact, low))
    assert 0 < (v - nearly).abs().max() < 0.1 * v.abs().max()
    known = low.weights_to(torch.bfloat16).conditions(asked, [PULL])
    assert low.unet.dtype == torch.bfloat16 and known.fixed.dtype == torch.float32
    moved = replace(known, context=known.context.float())
    assert (v - low.predict_v(x, times, moved)).abs().max() < 0.1 * v.abs().max()
