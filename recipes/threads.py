"""How many threads a command computes with: every recipe and benchmark asks here, and nothing else sets it."""

from __future__ import annotations

import os

import torch

OF_A_WORKER = 1
"""Whatever cores its machine has, so that what it collects does not depend on them."""
VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def check_threads(count: int) -> None:
    """Raises ``ValueError`` for less than one thread, and for many more than this machine has cores for."""
    if count < 1:
        raise ValueError(f"--num-threads must be at least 1, got {count}")
    cores = os.cpu_count() or 1
    most = max(16, 4 * cores)
    if count > most:
        raise ValueError(f"--num-threads must be at most {most} on this machine of {cores} cores, got {count}")


def use_threads(count: int) -> None:
    """Lets torch compute with ``count`` threads, and OpenMP, MKL and OpenBLAS in processes that start from now on.

    Physics and drawing follow: an env made without ``num_threads`` takes torch's number, two at most. What has started
    its threads before, NumPy's OpenBLAS for one, keeps them. A replay computes with as many as its recording did.

    Raises:
        ValueError: see :func:`check_threads`.
    """
    check_threads(count)
    torch.set_num_threads(count)
    os.environ.update(dict.fromkeys(VARIABLES, str(count)))
