"""The command that says how faithful a run's world model is."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from safetensors.torch import save_file
from small_run import SMALL

import config
import fidelity
from run_folder import RunFolder
from stages import open_run, rerun
from world_env import WORKS
from worldenv_trl.metrics import LPIPS

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")


class Means(torch.nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.mean((3, 4)).flatten(1)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run as far as its world model."""
    path = tmp_path_factory.mktemp("fidelity") / "run"
    settings = dataclasses.replace(
        SMALL,
        run_dir=path,
        device="cpu",
        max_steps=24,
        world_model=config.WorldModel(steps=2, batch_size=2, holdout=0.5),
    )
    opened = open_run(settings)
    for kind in ("demonstrate", "sft", "explore", "train_world_model"):
        rerun(kind, WORKS[kind], opened)
    return path


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Random ones in the published layouts."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights")
    lpips = LPIPS("alex")
    state = {name: value for name, value in lpips.state_dict().items() if name.startswith("features.")}
    state |= {f"lin{place}.model.1.weight": head.data[None, :, None, None] for place, head in enumerate(lpips.heads)}
    save_file({name: value.contiguous().clone() for name, value in state.items()}, folder / "all.safetensors")
    torch.jit.script(Means()).save(str(folder / "features.pt"))
    return folder


def test_it_says_what_training_said_and_how_to_get_the_rest(run, capsys):
    out = fidelity.main(fidelity.Settings(run, device="cpu"))
    figures, printed = json.loads(out.read_text()), capsys.readouterr().out
    logged = next(line for line in RunFolder(run).read_metrics() if "psnr_model_20" in line)
    for name in ("psnr_model_20", "psnr_copy_20", "moving_psnr_model_1"):
        assert figures[name] == pytest.approx(logged[name], nan_ok=True)
    assert 0 < figures["ssim_model_20"] < 1 and "lpips_model_20" not in figures
    assert "LPIPS is left out: --lpips names a folder of weights (recipes/README.md, Fidelity" in printed
    assert "FVD is left out: --fvd names a file" in printed


def test_with_weights_it_also_measures_lpips_and_fvd(run, weights, capsys):
    settings = fidelity.Settings(
        run, lpips=weights, fvd=weights / "features.pt", clip_frames=10, out=run / "more.json", device="cpu"
    )
    figures = json.loads(fidelity.main(settings).read_text())
    # Two held-out episodes of 24 steps, by the run's seed: frames 1 to 10 and 11 to 20 of each.
    assert figures["episodes"] == 2 and figures["fvd_clips"] == 4
    assert figures["fvd_model"] > 0 and figures["fvd_copy"] > 0 and figures["lpips_model_20"] > 0
    assert "FVD of 4 clips" in capsys.readouterr().out


def test_the_truth_itself_is_at_no_distance(run, weights, monkeypatch):
    """Where imagination is the recording, LPIPS and FVD are 0 and SSIM is 1."""
    monkeypatch.setattr(fidelity, "imagine_episodes", lambda model, episodes, *_, **__: episodes)
    settings = fidelity.Settings(run, lpips=weights, fvd=weights / "features.pt", clip_frames=12, device="cpu")
    figures = json.loads(fidelity.main(settings).read_text())
    assert figures["lpips_model_20"] == 0 and figures["ssim_model_20"] == pytest.approx(1)
    assert figures["fvd_model"] == pytest.approx(0, abs=1e-6) and figures["fvd_copy"] > 1e-6


def test_what_cannot_be_measured_is_one_line(run, weights, tmp_path):
    for settings, said in (
        (fidelity.Settings(run, lpips=tmp_path), "holds no weights for LPIPS"),
        (fidelity.Settings(run, fvd=tmp_path / "i3d.pt"), "there is no file"),
        (fidelity.Settings(run, clip_frames=9), "clip-frames must be at least 10, got 9"),
        (fidelity.Settings(run, fvd=weights / "features.pt", clip_frames=30), "hold 0 clips of 30 frames"),
        (fidelity.Settings(run, world_model="world_model_2"), "world_model_2 does not exist"),
        (fidelity.Settings(tmp_path), "is no run folder"),
    ):
        with pytest.raises(SystemExit, match=said):
            fidelity.main(dataclasses.replace(settings, device="cpu"))
