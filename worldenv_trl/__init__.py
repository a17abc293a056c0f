"""Post-train vision-language-action policies by reinforcement learning inside a learned world model."""

import os
import sys

# MuJoCo chooses its GL backend when it is first imported (TorchRL imports it), so this must come before.
os.environ.setdefault("LP_NUM_THREADS", "0")  # a software rasteriser with threads of its own fights with ours
if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

__version__ = "0.1.0"
