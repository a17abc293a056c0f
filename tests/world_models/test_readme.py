"""The world model that README.md shows runs, learns and is saved."""

from __future__ import annotations

import re
from pathlib import Path

import torch
from small_windows import make_windows
from swaps.copying_world_model import CopyingConfig as FadingConfig
from tensordict import TensorDict

import worldenv_trl.world_models
from worldenv_trl.keys import frames_key
from worldenv_trl.language import instructions_of
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.world_models import Window, WorldModel, memory_key, request

NAMES = {
    "FadingConfig": FadingConfig,
    "Pretrained": Pretrained,
    "TensorDict": TensorDict,
    "Window": Window,
    "WorldModel": WorldModel,
    "frames_key": frames_key,
    "instructions_of": instructions_of,
    "memory_key": memory_key,
    "request": request,
    "torch": torch,
}


def shown() -> type[WorldModel]:
    """The class in the README."""
    text = (Path(worldenv_trl.world_models.__file__).parent / "README.md").read_text()
    names = dict(NAMES)
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], names)
    return names["Fading"]


def make_fading() -> WorldModel:
    torch.manual_seed(0)
    return shown()(FadingConfig(cameras=("agentview", "wrist"), image_size=32, chunk_length=8))


def make_dimming(model: WorldModel) -> TensorDict:
    """Windows in which every frame is the first one, dimmer by the first action of each step."""
    windows = make_windows(model, starts=(0, 0), chunks=1)
    change = windows["actions"][..., 0].mul_(0.3)
    for camera in model.cameras:
        frames = windows[frames_key(camera)]
        after = frames[:, :1].float() * 0 + 128 + 255 * change[..., None, None, None]
        frames[:, :1] = 128
        frames[:, 1:9] = after.clamp(0, 255).to(torch.uint8)
    return windows


def test_it_learns_from_windows():
    model = make_fading()
    windows = make_dimming(model)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.05)
    before = model.training_loss(windows)["loss_world_model"].item()
    for _ in range(100):
        optimizer.zero_grad()
        model.training_loss(windows)["loss_world_model"].backward()
        optimizer.step()
    assert model.training_loss(windows)["loss_world_model"].item() < 0.1 * before


def test_it_is_saved_and_paints_the_same(tmp_path):
    model = make_fading()
    model.save_pretrained(tmp_path)
    again = shown().from_pretrained(tmp_path)
    windows = make_dimming(model)
    window = Window(windows)
    asked = request(
        model, window.recall, window.start, windows["poses"][:, 1:9], window.actions, instructions_of(windows)
    )
    first, second = model(asked.clone()), again(asked)
    for camera in model.cameras:
        assert first[frames_key(camera)].shape == (2, 8, 3, 32, 32)
        assert torch.equal(first[frames_key(camera)], second[frames_key(camera)])
