"""Pickled weights: refused, with the command that converts them once."""

from __future__ import annotations

from pathlib import Path

__all__ = ["convert_command"]


def convert_command(path: Path) -> str:
    """The shell command that writes a pickled state dict as safetensors, reading nothing but tensors from it."""
    target = path.with_suffix(".safetensors")
    return (
        f'python -c "import torch; from safetensors.torch import save_file; state = torch.load({str(path)!r}, '
        f"weights_only=True, map_location='cpu'); save_file({{k: v.contiguous().clone() for k, v in state.items()}}, "
        f'{str(target)!r})"'
    )
