"""LPIPS (Zhang et al., CVPR 2018, version 0.1): how different two images look, from a classifier's features."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from worldenv_trl.weight_files import convert_command

__all__ = ["LPIPS"]


@dataclass(frozen=True)
class _Net:
    """A classifier of torchvision, its layers numbered as in its state dict."""

    convolutions: dict[int, tuple[int, int, int, int, int]]
    """Channels in and out, kernel, stride and padding."""
    pools: tuple[int, ...]
    pool: tuple[int, int]
    """Kernel and stride."""
    seen: tuple[int, ...]
    """The layers whose outputs are compared."""

    @property
    def widths(self) -> list[int]:
        """Channels of these outputs."""
        return [self.convolutions[max(each for each in self.convolutions if each <= place)][1] for place in self.seen]


_VGG = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256),
        17: (256, 512), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512)}  # fmt: skip
_NETS = {
    "alex": _Net(
        {
            0: (3, 64, 11, 4, 2),
            3: (64, 192, 5, 1, 2),
            6: (192, 384, 3, 1, 1),
            8: (384, 256, 3, 1, 1),
            10: (256, 256, 3, 1, 1),
        },
        pools=(2, 5),
        pool=(3, 2),
        seen=(1, 4, 7, 9, 11),
    ),
    "vgg": _Net(
        {place: (*channels, 3, 1, 1) for place, channels in _VGG.items()},
        pools=(4, 9, 16, 23),
        pool=(2, 2),
        seen=(3, 8, 15, 22, 29),
    ),
}
_WHERE = (
    "torchvision's alexnet-owt-7be5be79.pth (or vgg16-397923af.pth) and alex.pth (or vgg.pth) of "
    "https://github.com/richzhang/PerceptualSimilarity/tree/master/lpips/weights/v0.1, as safetensors in one folder"
)


class LPIPS(nn.Module):
    """The distance of images: 0 for equal ones, of the order of .1 for a slight blur and .5 for other scenes.

    Features of five layers are brought to unit length at each place; their squared differences are weighted by
    channel, averaged over the image and summed over the layers.

    Args:
        net: ``alex`` or ``vgg``.

    Raises:
        ValueError: for another one.

    Examples:
        >>> LPIPS("alex")(torch.zeros(2, 3, 64, 64), torch.full((2, 3, 64, 64), 9.0)).shape
        torch.Size([2])
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, net: str = "alex") -> None:
        super().__init__()
        if net not in _NETS:
            raise ValueError(f"net must be one of {', '.join(_NETS)}, got {net!r}")
        known = _NETS[net]
        layers: list[nn.Module] = []
        for place in range(known.seen[-1] + 1):
            if place in known.convolutions:
                layers.append(nn.Conv2d(*known.convolutions[place]))
            else:
                layers.append(nn.MaxPool2d(*known.pool) if place in known.pools else nn.ReLU())
        self.features, self._seen = nn.Sequential(*layers), known.seen
        self.heads = nn.ParameterList(nn.Parameter(torch.rand(width)) for width in known.widths)
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None], persistent=False)
        self.requires_grad_(False)

    @classmethod
    def from_folder(cls, folder: str | os.PathLike) -> Self:
        """Reads the published weights: the classifier's ``features.*`` and the heads' ``lin<k>.model.1.weight``.

        Args:
            folder: of safetensors files that hold them, in one file or several.

        Raises:
            FileNotFoundError: if there are none, saying where to get them.
            ValueError: for pickles, with the command that converts them, or tensors that are missing or of other
                shapes.
        """
        state = _read(Path(folder))
        net = next((name for name, known in _NETS.items() if _fits(state, known)), None)
        if net is None:
            raise ValueError(f"{folder} holds the features of neither AlexNet nor VGG16: LPIPS needs {_WHERE}")
        made = cls(net)
        for name, parameter in made.features.named_parameters(prefix="features"):
            _fill(parameter, state, name, folder)
        for place, head in enumerate(made.heads):
            _fill(head, state, f"lin{place}.model.1.weight", folder)
        return made.eval()

    def forward(self, generated: Tensor, real: Tensor) -> Tensor:
        """Distances [*B] of images [*B, 3, H, W], uint8 or floats in [0, 255].

        Raises:
            ValueError: if the shapes differ, or are below 32 px.
        """
        if generated.shape != real.shape:
            raise ValueError(f"images must have the same shape, got {list(generated.shape)} and {list(real.shape)}")
        if min(real.shape[-2:]) < 32:
            raise ValueError(f"LPIPS needs images of at least 32 px, got {list(real.shape[-2:])}")
        total = torch.zeros((), device=real.device)
        pairs = zip(self._maps(generated), self._maps(real), self.heads, strict=True)
        for one, other, head in pairs:
            total = total + ((one - other).square() * head[:, None, None]).sum(-3).mean((-2, -1))
        return total.reshape(real.shape[:-3])

    def _maps(self, images: Tensor) -> list[Tensor]:
        """Features of unit length [n, channels, h, w] of each layer that is compared."""
        hidden = (images.flatten(0, -4).float() / 127.5 - 1 - self.shift) / self.scale
        maps = []
        for place, layer in enumerate(self.features):
            hidden = layer(hidden)
            if place in self._seen:
                maps.append(hidden / (hidden.square().sum(-3, keepdim=True).sqrt() + 1e-10))
        return maps


def _fits(state: dict[str, Tensor], net: _Net) -> bool:
    convolutions = {int(name.split(".")[1]) for name in state if name.startswith("features.")}
    return convolutions == set(net.convolutions)


def _fill(parameter: nn.Parameter, state: dict[str, Tensor], name: str, folder: str | os.PathLike) -> None:
    if name not in state:
        raise ValueError(f"{folder} lacks {name}: LPIPS needs {_WHERE}")
    if state[name].numel() != parameter.numel() or state[name].shape[:1] not in (parameter.shape[:1], (1,)):
        raise ValueError(f"{folder}: {name} must hold {list(parameter.shape)}, got {list(state[name].shape)}")
    parameter.data.copy_(state[name].reshape(parameter.shape))


def _read(folder: Path) -> dict[str, Tensor]:
    files = sorted(folder.glob("*.safetensors"))
    pickled = sorted(path for pattern in ("*.pth", "*.pt", "*.bin") for path in folder.glob(pattern))
    if not files and pickled:
        commands = "; ".join(convert_command(path) for path in pickled)
        raise ValueError(f"{folder} holds pickles alone, which can run any code: convert what you trust: {commands}")
    if not files:
        raise FileNotFoundError(f"{folder} holds no weights for LPIPS (*.safetensors): it needs {_WHERE}")
    state: dict[str, Tensor] = {}
    for path in files:
        try:
            state |= safetensors.torch.load_file(path)
        except (safetensors.SafetensorError, OSError) as error:
            raise ValueError(f"{path} is truncated or no safetensors file ({error}): fetch it again") from error
    return state
