"""What must hold before any test module is imported."""

from __future__ import annotations

import os
import sys

import torch

# MuJoCo chooses its GL backend when it is first imported, and test modules import it in any order.
os.environ.setdefault("LP_NUM_THREADS", "0")
if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

torch.set_num_threads(1)  # test processes share the cores
