"""How faithful a run's world model is: held-out exploration, imagined open loop, against what the cameras saw.

``python recipes/fidelity.py runs/improve`` prints PSNR (all and moving pixels) and SSIM by horizon, beside copying the
first frame. ``--lpips FOLDER`` adds LPIPS and ``--fvd FILE`` the Frechet video distance, with weights that you have:
recipes/README.md, Fidelity, says which and where to get them.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from command_line import at_least, refusals, writable
from episodes import demonstrations_and_exploration, split_by_context
from gather_evidence import read_config
from real_parts import parts_of
from run import Run
from run_folder import RunFolder
from threads import use_threads
from worldenv_trl.data import Episodes, imagine_episodes
from worldenv_trl.metrics import (
    LPIPS,
    frechet_distance,
    load_video_features,
    moving_pixel_psnr,
    psnr,
    ssim,
    video_features,
)
from worldenv_trl.report import RunRecord
from worldenv_trl.world_models import WorldModel

HORIZONS = (1, 20, 40, 56, 60)
Measure = Callable[[Tensor, Tensor], Tensor]
"""From generated and real frames [n, 3, H, W] to a number for each."""


@dataclass(frozen=True)
class Settings:
    run: tyro.conf.Positional[Path]
    """Run folder of recipes/world_env.py."""
    world_model: str = "world_model"
    """Checkpoint of the run, of any round."""
    lpips: Path | None = None
    """Folder of LPIPS's weights: a classifier's and the heads', as safetensors."""
    fvd: Path | None = None
    """Extractor of video features, a TorchScript file: commonly ``i3d_torchscript.pt``."""
    clip_frames: int = 16
    """Of a video whose features are compared, at least 10."""
    out: Path | None = None
    """JSON of all figures; fidelity_WORLD_MODEL.json in the run folder if not given."""
    num_threads: int = 1
    device: str = "auto"
    """Of the models: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one."""


def main(settings: Settings) -> Path:
    with refusals():
        at_least(10, clip_frames=settings.clip_frames)
        use_threads(settings.num_threads)
        config = read_config(RunRecord.read(settings.run), settings.num_threads, settings.device)
        run = Run(config, RunFolder(settings.run), parts_of(config))
        out = writable(settings.out or settings.run / f"fidelity_{settings.world_model}.json")
        measures: dict[str, Measure] = {"ssim": ssim}
        if settings.lpips is not None:
            measures["lpips"] = LPIPS.from_folder(settings.lpips).to(run.device)
        features = None if settings.fvd is None else load_video_features(settings.fvd, run.device)
        suffix = settings.world_model.removeprefix("world_model")
        model = run.world_model(suffix)
        rounds = int(suffix.removeprefix("_") or 1)
        _, explored = demonstrations_and_exploration(run, rounds)
        _, held_out = split_by_context(explored, config.world_model.holdout, run.seed("held-out contexts"))
        seed = run.seed(settings.world_model, "fidelity")
        figures = fidelity(run, model, held_out, seed, measures, features, settings.clip_frames)
    figures = {"episodes": len(held_out)} | figures
    _show(figures, model.cameras, tuple(measures))
    for name, option, what in (("lpips", settings.lpips, "a folder of weights"), ("fvd", settings.fvd, "a file")):
        if option is None:
            print(f"{name.upper()} is left out: --{name} names {what} (recipes/README.md, Fidelity, where to get it)")
    out.write_text(json.dumps(figures, indent=1) + "\n")
    print(f"{out}: all figures")
    return out


def fidelity(
    run: Run,
    model: WorldModel,
    episodes: Episodes,
    seed: int,
    measures: Mapping[str, Measure] | None = None,
    features: Callable[[Tensor], Tensor] | None = None,
    clip_frames: int = 16,
) -> dict[str, float]:
    """PSNR of open-loop imagination at some horizons, on all and on moving pixels, beside copying the first frame, and
    what ``measures`` say of the same frames. Figures of further cameras end in their names.

    With ``features`` of videos also ``fvd_model``, the distance of imagined clips of ``clip_frames`` frames from the
    real ones, and ``fvd_copy``, of clips that stand still.

    Raises:
        ValueError: for features, and episodes too short or few for clips.
    """
    figures: dict[str, float] = {}
    clips = None if features is None else _clips(episodes, clip_frames)
    with tempfile.TemporaryDirectory(dir=run.folder.scratch) as scratch:
        imagined = imagine_episodes(model, episodes, run.kinematics, seed=seed, folder=scratch)
        for horizon in (horizon for horizon in HORIZONS if horizon <= episodes["actions"].shape[1]):
            alive = (episodes["length"].squeeze(-1) >= horizon).nonzero().squeeze(-1)
            for place, camera in enumerate(model.cameras if len(alive) else ()):
                suffix = f"_{camera}" if place else ""
                at = torch.full_like(alive, horizon)
                real, first = episodes.frames(camera, alive, at), episodes.frames(camera, alive, torch.zeros_like(at))
                for name, guess in (("model", imagined.frames(camera, alive, at)), ("copy", first)):
                    figures[f"psnr_{name}_{horizon}{suffix}"] = psnr(guess, real).clamp(max=60).mean().item()
                    moving = moving_pixel_psnr(guess, real, first).nanmean().item()
                    figures[f"moving_psnr_{name}_{horizon}{suffix}"] = moving
                    for measure, of in (measures or {}).items():
                        said = of(guess.to(run.device), real.to(run.device))
                        figures[f"{measure}_{name}_{horizon}{suffix}"] = said.mean().item()
        if features is not None and clips is not None:
            for place, camera in enumerate(model.cameras):
                apart = _distances(features, imagined, episodes, camera, *clips)
                figures |= {f"{name}_{camera}" if place else name: value for name, value in apart.items()}
    return figures


def _clips(episodes: Episodes, clip_frames: int) -> tuple[Tensor, Tensor]:
    """Episode [n, 1] and frames [n, clip_frames] of clips that follow each other, from the first painted frame on."""
    clips = [
        (row, start)
        for row, length in enumerate(episodes["length"].flatten().tolist())
        for start in range(1, length - clip_frames + 2, clip_frames)
    ]
    if len(clips) < 2:
        raise ValueError(
            f"the {len(episodes)} held-out episodes hold {len(clips)} clips of {clip_frames} frames, FVD needs 2 at "
            "least: --clip-frames fewer, or a run with a larger --world-model.holdout"
        )
    row, start = torch.tensor(clips).T.unsqueeze(-1)
    return row, start + torch.arange(clip_frames)


def _distances(
    features: Callable[[Tensor], Tensor], imagined: Episodes, real: Episodes, camera: str, row: Tensor, frame: Tensor
) -> dict[str, float]:
    found = {
        name: video_features(features, episodes.frames(camera, row, at))
        for name, episodes, at in (
            ("real", real, frame),
            ("model", imagined, frame),
            ("copy", real, torch.zeros_like(frame)),
        )
    }
    distances = {f"fvd_{name}": frechet_distance(found[name], found["real"]) for name in ("model", "copy")}
    return distances | {"fvd_clips": float(len(row))}


def _show(figures: Mapping[str, float], cameras: tuple[str, ...], measures: tuple[str, ...]) -> None:
    print(
        f"{figures['episodes']:.0f} held-out episodes of exploration, imagined open loop; copy: the first frame stays"
    )
    names = ("psnr", "moving_psnr", *measures)
    print(
        f"{'camera':<12}{'frame':>6}" + "".join(f"{f'{name} {of}':>20}" for name in names for of in ("model", "copy"))
    )
    for place, camera in enumerate(cameras):
        suffix = f"_{camera}" if place else ""
        for horizon in HORIZONS:
            if f"psnr_model_{horizon}{suffix}" not in figures:
                continue
            row = [figures[f"{name}_{of}_{horizon}{suffix}"] for name in names for of in ("model", "copy")]
            print(f"{camera:<12}{horizon:>6}" + "".join(f"{value:>20.3f}" for value in row))
        if f"fvd_model{suffix}" in figures:
            print(
                f"{camera:<12} FVD of {figures[f'fvd_clips{suffix}']:.0f} clips: model "
                f"{figures[f'fvd_model{suffix}']:.2f}, copy {figures[f'fvd_copy{suffix}']:.2f}"
            )


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
