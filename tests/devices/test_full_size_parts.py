"""The full-size parts (of tiny networks) on a GPU compute what they compute on the CPU, and leave nothing there."""

from __future__ import annotations

import copy

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")
from small_diffusion import ask, make_diffusion
from small_models import PULL, PUSH, TWO
from small_windows import make_windows
from test_parts import near
from tiny_vlm import save_tiny_vlm
from videos import patches

from worldenv_trl.keys import NOISE_SEED, frames_key
from worldenv_trl.objectives import WorldModelLoss
from worldenv_trl.reflectors import PromptReflector, PromptReflectorConfig, VLMReflector, VLMReflectorConfig


@pytest.fixture(scope="module")
def reflectors(tmp_path_factory):
    """On the CPU, loaded before anything stands in for a GPU: transformers begins on the meta device."""
    folder = str(save_tiny_vlm(tmp_path_factory.mktemp("vlm")))
    return {
        "head": VLMReflector(VLMReflectorConfig(folder, num_frames=3)),
        "prompt": PromptReflector(PromptReflectorConfig(folder, num_frames=3)),
    }


def test_the_world_model_predicts_there_what_it_predicts_here(gpu):
    here = make_diffusion(TWO, precision="float32")
    there = copy.deepcopy(here).to(gpu)
    asked, x, times = ask(here, 2, texts=[PULL, PUSH]), torch.randn(2, 4, 4, 16, 12), torch.tensor([500, 999])
    v = here.predict_v(x, times, here.conditions(asked, [PULL, PUSH]))
    far = there.predict_v(x.to(gpu), times.to(gpu), there.conditions(asked.to(gpu), [PULL, PUSH]))
    near(far, v, 1e-3)
    painted = there(asked.to(gpu))
    assert painted[frames_key("wrist")].device.type == "cuda" and painted[NOISE_SEED].device.type == "cuda"


def test_the_world_model_learns_there(gpu):
    model = make_diffusion(TWO, precision="float32").train().to(gpu)
    loss = WorldModelLoss(model)(make_windows(model).to(gpu))["loss_world_model"]
    loss.backward()
    assert loss.device.type == "cuda" and model.unet.net.conv_in.weight.grad.device.type == "cuda"


@pytest.mark.parametrize("kind", ["head", "prompt"])
def test_the_reflector_judges_there_as_here(reflectors, gpu, kind):
    here = reflectors[kind]
    there = copy.deepcopy(here).to(gpu)
    video = torch.randint(0, 256, (2, 6, 3, 24, 24), dtype=torch.uint8)
    scores = []
    for reflector, device in ((here, torch.device("cpu")), (there, gpu)):
        film = video.to(device)
        state = reflector.begin({"agentview": film[:, 0]}, ["push left", "open drawer"])
        scores.append(reflector.extend(state, {"agentview": film[:, 1:]})[1])
    near(scores[1], scores[0], 1e-3)


def test_the_reflectors_lessons_are_drawn_there(reflectors, gpu):
    reflector = copy.deepcopy(reflectors["head"]).to(gpu)
    lessons = reflector.train_on(patches(12, ["push left before right"], frames=5))
    for lesson in lessons:
        batch = lesson.sample()
        assert batch["embedding"].device.type == "cuda"
        reflector.training_loss(batch)["loss_reflector"].backward()
        assert all(parameter.grad.device.type == "cuda" for parameter in lesson.parameters)
