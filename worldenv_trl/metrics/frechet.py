"""Fréchet video distance (Unterthiner et al., arXiv 1812.01717): how far two sets of videos are apart."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from worldenv_trl.devices import device_of

__all__ = ["frechet_distance", "load_video_features", "video_features"]

SIZE_PX, MIN_FRAMES = 224, 10  # of I3D
_SCRIPTED = {"rescale": False, "resize": False, "return_features": True}


def frechet_distance(generated: Tensor, real: Tensor) -> float:
    """Squared Wasserstein-2 distance of the Gaussians with the features' means and covariances.

    Args:
        generated: [n, D], n at least 2.
        real: [m, D], m at least 2.

    Raises:
        ValueError: for fewer rows, other widths, or numbers that are not finite.
    """
    for name, values in (("generated", generated), ("real", real)):
        if values.ndim != 2 or len(values) < 2:
            raise ValueError(f"{name} features must be [n, D] of at least 2 rows, got {list(values.shape)}")
        if not bool(values.isfinite().all()):
            raise ValueError(f"{name} features are not finite")
    if generated.shape[1] != real.shape[1]:
        raise ValueError(f"features must be equally wide, got {generated.shape[1]} and {real.shape[1]}")
    ours, theirs = generated.double(), real.double()
    between = (ours.mean(0) - theirs.mean(0)).square().sum()
    width = ours.shape[1]
    first, second = (torch.cov(each.T).reshape(width, width) for each in (ours, theirs))
    # The trace of (S1 S2)^1/2 is that of (S1^1/2 S2 S1^1/2)^1/2, which is symmetric: no complex root is ever taken.
    values, vectors = torch.linalg.eigh(first)
    root = vectors * values.clamp_min(0).sqrt() @ vectors.T
    cross = torch.linalg.eigvalsh(root @ second @ root).clamp_min(0).sqrt().sum()
    return float((between + first.trace() + second.trace() - 2 * cross).clamp_min(0))


@torch.no_grad()
def video_features(extractor: Callable[..., Tensor], videos: Tensor, *, rows_at_once: int = 8) -> Tensor:
    """Features float32 [n, D] of videos, on the CPU.

    Args:
        extractor: from float32 [b, 3, T, 224, 224] in [-1, 1] to [b, D].
        videos: uint8 [n, T, 3, H, W], T at least 10.

    Keyword Args:
        rows_at_once: videos in a call.

    Raises:
        ValueError: for other videos, or an extractor that gives something else.
    """
    if videos.ndim != 5 or videos.shape[2] != 3 or videos.dtype != torch.uint8 or videos.shape[1] < MIN_FRAMES:
        raise ValueError(
            f"videos must be uint8 [n, T, 3, H, W] of at least {MIN_FRAMES} frames, got {videos.dtype} "
            f"{list(videos.shape)}"
        )
    device = device_of(extractor) if isinstance(extractor, torch.nn.Module) else videos.device
    found = []
    for part in videos.split(rows_at_once):
        frames = part.to(device).flatten(0, 1).float()
        frames = F.interpolate(frames, (SIZE_PX, SIZE_PX), mode="bilinear", antialias=True) / 127.5 - 1
        out = extractor(frames.unflatten(0, part.shape[:2]).transpose(1, 2))
        if not isinstance(out, Tensor) or out.ndim != 2 or len(out) != len(part):
            shape = list(out.shape) if isinstance(out, Tensor) else type(out).__name__
            raise ValueError(f"the feature extractor must give [{len(part)}, D], got {shape}")
        found.append(out.float().cpu())
    return torch.cat(found)


def load_video_features(path: str | os.PathLike, device: str | torch.device = "cpu") -> Callable[[Tensor], Tensor]:
    """A TorchScript feature extractor from a file; the common ``i3d_torchscript.pt`` is asked for its features.

    A TorchScript file is a program: load only what you trust.

    Raises:
        FileNotFoundError: if there is no such file, saying what to get.
        ValueError: if it is no TorchScript.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(
            f"there is no file {path}: FVD needs a feature extractor as TorchScript, commonly i3d_torchscript.pt of "
            "https://github.com/universome/fvd-comparison"
        )
    try:
        with warnings.catch_warnings():  # torch no longer writes such files; those there are stay what they are
            warnings.simplefilter("ignore", DeprecationWarning)
            module = torch.jit.load(str(path), map_location=device).eval()
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"{path} is no TorchScript file ({str(error).splitlines()[0]}): fetch it again") from error
    taken = {argument.name for argument in module.forward.schema.arguments}
    options = _SCRIPTED if set(_SCRIPTED) <= taken else {}

    def extract(videos: Tensor) -> Tensor:
        return module(videos.to(device), **options)

    return extract
