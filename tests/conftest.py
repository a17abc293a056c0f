"""What must hold before any test module is imported."""

from __future__ import annotations

import dataclasses
import os
import signal
import sys

import pytest
import torch

# MuJoCo chooses its GL backend when it is first imported, and test modules import it in any order.
os.environ.setdefault("LP_NUM_THREADS", "0")
if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

torch.set_num_threads(1)  # test processes share the cores

# Ignored in the background of a script; what the tests start, and interrupt, would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def tiny(tmp_path):
    """Settings of the whole loop at the smallest scale."""
    from small_run import SMALL

    return dataclasses.replace(SMALL, run_dir=tmp_path / "run")
