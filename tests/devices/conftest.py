"""The device that is not the CPU."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from stand_in import stand_in

sys.path += [
    str(Path(__file__).parents[1] / part) for part in ("policies", "world_models", "envs", "reflectors")
]  # small parts


@pytest.fixture
def gpu():
    """``cuda``: a real one where there is one, else the stand-in."""
    if torch.cuda.is_available():
        yield torch.device("cuda", torch.cuda.current_device())
        return
    with patch("torch.cuda.current_device", return_value=0), stand_in() as device:
        yield device
