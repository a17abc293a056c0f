"""Serves a policy of ours to other processes and machines, until Ctrl-C.

``python recipes/serve.py runs/improve/checkpoints/post_train --address 127.0.0.1:8765``; the other side is
``worldenv_trl.policies.ExternalPolicy.connect("127.0.0.1:8765")``, or ``python recipes/evaluate_external.py``. What a
server of somebody else's policy must do is in ``worldenv_trl/policies/README.md``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from command_line import one_line_errors
from threads import use_threads
from worldenv_trl.devices import choose_device
from worldenv_trl.policies import HFPolicy, OFTPolicy, Policy, ServedPolicy, load_openvla_oft
from worldenv_trl.policies.bridge import serve
from worldenv_trl.pretrained import OtherClassError
from worldenv_trl.record import model_hash


@dataclass(frozen=True)
class Settings:
    checkpoint: tyro.conf.Positional[str]
    """Folder or Hub id of an OFTPolicy or HFPolicy, or folder of an OpenVLA-OFT release."""
    address: str = "127.0.0.1:8765"
    """``host:port``, port 0 for any free one, or ``unix:/path``. It answers whoever reaches it."""
    device: str = "auto"
    """``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one."""
    num_threads: int = 1


@one_line_errors
def main(settings: Settings) -> None:
    use_threads(settings.num_threads)
    policy = load_policy(settings.checkpoint, choose_device(settings.device))
    name = Path(settings.checkpoint).name
    served = ServedPolicy(policy, name=f"{type(policy).__name__} {name}", digest=model_hash(policy))
    serve(served, served.description, settings.address)


def load_policy(checkpoint: str, device: torch.device) -> Policy:
    """A checkpoint of any of our policies.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is one of another kind.
    """
    if (Path(checkpoint) / "dataset_statistics.json").exists():
        return load_openvla_oft(checkpoint, device=device, mirror=True)  # it is asked with upright images
    try:
        return OFTPolicy.from_pretrained(checkpoint, device=device)
    except OtherClassError:
        return HFPolicy.from_pretrained(checkpoint, device=device)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
