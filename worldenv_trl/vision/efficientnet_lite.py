"""EfficientNet-Lite0 (Tan and Le, arXiv:1905.11946; the Lite variant without squeeze-and-excitation, with ReLU6)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["EfficientNetLite0"]

_EPSILON = 1e-3  # of the batch normalisations that the weights were trained with
_STEM = 32


class _Stage(NamedTuple):
    repeats: int
    kernel: int
    stride: int
    expansion: int
    width: int


_STAGES = (
    _Stage(1, 3, 1, 1, 16),
    _Stage(2, 3, 2, 6, 24),
    _Stage(2, 5, 2, 6, 40),
    _Stage(3, 3, 2, 6, 80),
    _Stage(3, 5, 1, 6, 112),
    _Stage(4, 5, 2, 6, 192),
    _Stage(1, 3, 1, 6, 320),
)
BLOCKS = sum(stage.repeats for stage in _STAGES)


class EfficientNetLite0(nn.Module):
    """The first ``depth`` of its sixteen blocks, every batch normalisation folded into the convolution before it.

    Args:
        depth: blocks, 1 to 16.

    Attributes:
        widths: channels after each block.
        strides: pixels of the image per cell after each block.

    Raises:
        ValueError: for another depth.
    """

    def __init__(self, depth: int = 16) -> None:
        super().__init__()
        if not 1 <= depth <= BLOCKS:
            raise ValueError(f"depth must lie between 1 and {BLOCKS}, got {depth}")
        self.stem = _Convolution(3, _STEM, 3, stride=2)
        self.blocks = nn.ModuleList()
        self.widths: list[int] = []
        self.strides: list[int] = []
        width, stride = _STEM, 2
        for stage in list(_repeated())[:depth]:
            self.blocks.append(_Block(width, stage))
            width, stride = stage.width, stride * stage.stride
            self.widths.append(width)
            self.strides.append(stride)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Images [n, 3, H, W] with values in [-1, 1] -> after each block, [n, width, H / stride, W / stride]."""
        features, out = F.relu6(self.stem(images), inplace=True), []
        for block in self.blocks:
            features = block(features)
            out.append(features)
        return out

    @torch.no_grad()
    def load_published(self, state: Mapping[str, Tensor]) -> None:
        """Takes the weights as they are published: convolutions without bias and their batch normalisations.

        Args:
            state: by the names of ``efficientnet-lite0-57934424.pth``; what belongs to later blocks is left.

        Raises:
            ValueError: naming the first entry that is missing or has another shape.
        """
        self.stem.fold(state, "_conv_stem", "_bn0")
        for index, block in enumerate(self.blocks):
            assert isinstance(block, _Block)
            block.load_published(state, f"_blocks.{index}.")


def _repeated() -> Iterator[_Stage]:
    for stage in _STAGES:
        yield stage
        yield from (stage._replace(stride=1),) * (stage.repeats - 1)


class _Convolution(nn.Conv2d):
    """A convolution padded as TensorFlow pads it: to ``ceil(size / stride)`` cells, the odd pixel behind."""

    def __init__(self, fan_in: int, fan_out: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__(fan_in, fan_out, kernel, stride, padding=kernel // 2 if stride == 1 else 0, groups=groups)

    def forward(self, input: Tensor) -> Tensor:
        if self.stride[0] > 1:
            rows, columns = (self._missing(length) for length in input.shape[-2:])
            input = F.pad(input, (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2))
        return super().forward(input)

    def _missing(self, length: int) -> int:
        kernel, stride = self.kernel_size[0], self.stride[0]
        return max((-(-length // stride) - 1) * stride + kernel - length, 0)

    def fold(self, state: Mapping[str, Tensor], convolution: str, normalisation: str) -> None:
        weight = _entry(state, f"{convolution}.weight", self.weight.shape)
        gain, shift, mean, variance = (
            _entry(state, f"{normalisation}.{name}", (self.out_channels,))
            for name in ("weight", "bias", "running_mean", "running_var")
        )
        gain = gain * (variance + _EPSILON).rsqrt()
        self.weight.copy_(weight * gain[:, None, None, None])
        assert self.bias is not None
        self.bias.copy_(shift - mean * gain)


class _Block(nn.Module):
    """Inverted residual: widen, filter each channel by itself, narrow."""

    def __init__(self, fan_in: int, stage: _Stage) -> None:
        super().__init__()
        wide = fan_in * stage.expansion
        self.widen = _Convolution(fan_in, wide, 1) if stage.expansion > 1 else None
        self.filter = _Convolution(wide, wide, stage.kernel, stage.stride, groups=wide)
        self.narrow = _Convolution(wide, stage.width, 1)
        self.residual = stage.stride == 1 and fan_in == stage.width

    def forward(self, features: Tensor) -> Tensor:
        # In place: on a CPU what is written, not what is computed, takes the time.
        wide = features if self.widen is None else F.relu6(self.widen(features), inplace=True)
        out = self.narrow(F.relu6(self.filter(wide), inplace=True))
        return features + out if self.residual else out

    def load_published(self, state: Mapping[str, Tensor], prefix: str) -> None:
        if self.widen is not None:
            self.widen.fold(state, f"{prefix}_expand_conv", f"{prefix}_bn0")
        self.filter.fold(state, f"{prefix}_depthwise_conv", f"{prefix}_bn1")
        self.narrow.fold(state, f"{prefix}_project_conv", f"{prefix}_bn2")


def _entry(state: Mapping[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    if name not in state:
        raise ValueError(f"these are not the weights of EfficientNet-Lite0: there is no {name}")
    if tuple(state[name].shape) != tuple(shape):
        raise ValueError(
            f"these are not the weights of EfficientNet-Lite0: {name} is {tuple(state[name].shape)}, not {tuple(shape)}"
        )
    return state[name].float()
