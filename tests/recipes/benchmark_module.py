"""A benchmark as a module; its name may be that of a recipe."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import show_scenes

FOLDER = Path(show_scenes.__file__).parent / "benchmarks"


def benchmark(name: str):
    spec = importlib.util.spec_from_file_location(f"benchmark_of_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
