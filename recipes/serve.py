"""Serves a policy of ours to other processes and machines, until Ctrl-C.

``python recipes/serve.py runs/improve/checkpoints/post_train --address 127.0.0.1:8765``; the other side is
``worldenv_trl.policies.ExternalPolicy.connect("127.0.0.1:8765")``, or ``python recipes/evaluate_external.py``. What a
server of somebody else's policy must do is in ``worldenv_trl/policies/README.md``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from command_line import one_line_errors
from threads import use_threads
from worldenv_trl.devices import choose_device
from worldenv_trl.policies import (
    FASTPolicy,
    FlowPolicy,
    HFPolicy,
    HFTokenPolicy,
    OFTPolicy,
    Policy,
    ServedPolicy,
    load_lerobot,
    load_openvla,
    load_openvla_oft,
)
from worldenv_trl.policies.bridge import serve
from worldenv_trl.policies.hf_files import read_json
from worldenv_trl.pretrained import OtherClassError
from worldenv_trl.record import model_hash


@dataclass(frozen=True)
class Settings:
    checkpoint: tyro.conf.Positional[str]
    """Folder or Hub id of an OFTPolicy, HFPolicy, HFTokenPolicy, FASTPolicy or FlowPolicy, or folder of a release of
    OpenVLA, of OpenVLA-OFT or of LeRobot."""
    address: str = "127.0.0.1:8765"
    """``host:port``, port 0 for any free one, or ``unix:/path``. It answers whoever reaches it."""
    backbone: str = ""
    """Folder or Hub id of which LeRobot's policy has its tokenizer, and SmolVLA its backbone's config; when empty its
    own folder, and what its config names."""
    mirror: bool = False
    """LeRobot's policy sees images with left and right swapped: those of LIBERO's data sets are mirrored."""
    device: str = "auto"
    """``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one."""
    num_threads: int = 1


@one_line_errors
def main(settings: Settings) -> None:
    use_threads(settings.num_threads)
    released = {"backbone": settings.backbone or None, "mirror": settings.mirror}
    policy = load_policy(settings.checkpoint, choose_device(settings.device), **released)
    name = Path(settings.checkpoint).name
    served = ServedPolicy(policy, name=f"{type(policy).__name__} {name}", digest=model_hash(policy))
    serve(served, served.description, settings.address)


def load_policy(checkpoint: str, device: torch.device, **released: Any) -> Policy:
    """A checkpoint of any of our policies; ``released`` are settings of LeRobot's alone.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is one of another kind.
    """
    folder = Path(checkpoint)
    described = read_json(folder, "config.json") if (folder / "config.json").is_file() else {}
    if described.get("model_type") == "openvla":
        release = load_openvla_oft if any(folder.glob("action_head--*")) else load_openvla
        return release(folder, device=device, mirror=True)  # it is asked with upright images
    if "input_features" in described:
        return load_lerobot(checkpoint, device=device, **released)
    for kind in (OFTPolicy, HFPolicy, HFTokenPolicy, FASTPolicy):
        try:
            return kind.from_pretrained(checkpoint, device=device)
        except OtherClassError:
            continue
    return FlowPolicy.from_pretrained(checkpoint, device=device)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
