"""What importing the package costs, needs and says."""

from __future__ import annotations

import subprocess
import sys

# Every package and module of worldenv_trl, and every name that a package offers (some are loaded when asked for).
EVERYTHING = """
import importlib, pkgutil, worldenv_trl
for module in pkgutil.walk_packages(worldenv_trl.__path__, "worldenv_trl."):
    loaded = importlib.import_module(module.name)
    for name in getattr(loaded, "__all__", ()):
        getattr(loaded, name)
"""
# As where only the dependencies are installed: importing these fails.
WITHOUT_EXTRAS = """
import sys
extras = "accelerate diffusers h5py huggingface_hub pyarrow pytest ray rerun transformers websockets"
sys.modules.update(dict.fromkeys(extras.split()))
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)


def test_importing_any_public_name_says_and_warns_of_nothing():
    result = run(EVERYTHING)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_importing_any_module_needs_no_extra():
    result = run(WITHOUT_EXTRAS + EVERYTHING)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_the_package_alone_loads_nothing_heavy_and_takes_no_time():
    result = run("""
import sys, time
started = time.perf_counter()
import worldenv_trl, worldenv_trl.envs, worldenv_trl.keys, worldenv_trl.context_ids
assert time.perf_counter() - started < 1
heavy = {"torch", "torchrl", "tensordict", "mujoco", "dm_control", "numpy", "matplotlib"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
""")
    assert result.returncode == 0, result.stderr


def test_the_robot_needs_numpy_alone_and_the_scenes_no_torch():
    result = run("""
import sys
import worldenv_trl.robot
assert not {"torch", "mujoco"} & set(sys.modules)
import worldenv_trl.scenes
assert not {"torch", "torchrl", "tensordict"} & set(sys.modules)
""")
    assert result.returncode == 0, result.stderr
