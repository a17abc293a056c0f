"""What a process of torchrun does in the tests: stages, one after the other, each on a folder of its own.

    torchrun --nproc-per-node 2 tests/recipes/stages_together.py JOBS

JOBS is a JSON list of ``{"run": folder, "kind": of the stage, "settings": {...}, "kill": [rank, update]}``. What each
process learned from goes to ``rows_<rank>.json`` in the folder, the bytes it held of what it trained first to
``held_<rank>.json``.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import signal
import sys
from pathlib import Path

import pytest
import torch
from small_run import SMALL

import config
import updates
from data_parallel import DataParallel
from holding import Hold
from post_train import post_train
from stages import open_run, rerun
from world_env import WORKS
from worldenv_trl import keys

SETTINGS = dataclasses.replace(
    SMALL,
    device="cpu",
    checkpoint_minutes=1000.0,
    sft=config.SFT(steps=20, scale_steps=5, batch_size=8),
    explore=dataclasses.replace(SMALL.explore, scale_factors=(1.0, 0.0)),
    world_model=config.WorldModel(steps=20, batch_size=2, lr=5e-4),
    reflector=config.Reflector(encoder_frames=160, prefixes=160, batch_size=4),
    adapt=config.Adapt(steps=20, episodes_per_task=4, batch_size=8),
    post_train=config.PostTrain(
        iterations=5, groups=4, group_size=9, epochs=2, minibatch_size=36, probe_every=4, probe_contexts=2,
    ),
)  # fmt: skip


def learn(run, **options) -> None:
    """LOOP on returns that differ by more than rounding, which an untrained reflector's do not; holding, if anything,
    every other context: there is one task alone."""
    refer = Hold.refer

    def every_other(hold, wave):
        return wave[keys.CONTEXT_ID][:, 0, 0, 0] % 2 == 0

    def elsewhere(hold, decisions):
        """Where a mean is where it is held, the gradient of its distance has the sign of rounding."""
        refer(hold, decisions)
        decisions[keys.REFERENCE_LOC] += decisions[keys.REFERENCE_SCALE]

    def returns_of(wave):
        return wave[keys.CHUNK][..., :3].mean((-1, -2, -3)) + wave["next", keys.STEP_MASK].float().mean((-1, -2))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hold, "groups", every_other)
        patch.setattr(Hold, "refer", elsewhere)
        patch.setattr(updates, "_PIXELS", 1)  # sixteen decisions at once: a share takes one turn or two
        # Advantages of a group sum to zero, so a gradient of what all its rows share is rounding, which differs from
        # CPU to CPU, and Adam would divide it by its own size.
        patch.setattr(torch.optim, "AdamW", functools.partial(torch.optim.AdamW, eps=1e-6))
        post_train(run, **options, returns_of=returns_of)


def _bytes(*modules: torch.nn.Module) -> int:
    """That the parameters and buffers of modules take in this process, each storage once."""
    tensors = [tensor for module in modules for tensor in (*module.parameters(), *module.buffers())]
    storages = [getattr(tensor, "_local_tensor", tensor).untyped_storage() for tensor in tensors]
    return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())


def work(run: str, kind: str, settings: dict, kill: list[int] | None = None) -> None:
    rows, held, call, step = [], {}, DataParallel.__call__, torch.optim.AdamW.step

    def counted(self, batch):
        if not held:
            learns = [parameter for parameter in self.part.parameters() if parameter.requires_grad]
            held.update(part=_bytes(self.part), both=_bytes(self.part, self._trained))
            held["learns"] = sum(parameter.nbytes for parameter in learns)
        rows.append(len(batch))
        return call(self, batch)

    def killed(self, *arguments):
        if len(rows) == kill[1] and int(os.environ["RANK"]) == kill[0]:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(self, *arguments)

    DataParallel.__call__ = counted
    if kill is not None:
        torch.optim.AdamW.step = killed
    try:
        changed = {name: dataclasses.replace(getattr(SETTINGS, name), **value) if isinstance(value, dict) else value
                   for name, value in settings.items()}  # fmt: skip
        opened = open_run(dataclasses.replace(SETTINGS, run_dir=Path(run), **changed))
        rerun(kind, (WORKS | {"post_train": learn})[kind], opened)
        for name, found in (("rows", rows), ("held", held)):
            (Path(run) / f"{name}_{os.environ.get('RANK', 0)}.json").write_text(json.dumps(found))
    finally:
        DataParallel.__call__, torch.optim.AdamW.step = call, step


if __name__ == "__main__":
    for job in json.loads(sys.argv[1]):
        work(**job)
