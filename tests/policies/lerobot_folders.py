"""Folders as LeRobot writes them, with weights that are a function of their names, and what its own files made of them.

``lerobot_reference/actions.json`` holds, for each kind, LeRobot's config, statistics, names and shapes of tensors, and
the actions of its ``predict_action_chunk`` (huggingface/lerobot 7427f31 with transformers 5.5.4, at tiny sizes; of
``lerobot`` only the modelling files were loaded). Weights, images, states and noise are made here again.
"""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tensordict import NonTensorStack, TensorDict

pytest.importorskip("transformers")

from tokenizers import Regex, Tokenizer, models, pre_tokenizers, processors

from worldenv_trl import keys

REFERENCE = json.loads((Path(__file__).parent / "lerobot_reference" / "actions.json").read_text())
KINDS = ("smolvla", "smolvla_tokens", "pi0", "pi05")
CAMERAS = ("agentview", "wrist")
SIDE = 56


def noise(shape: tuple[int, ...], name: str) -> np.ndarray:
    """Numbers in [-1, 1) that depend on a name alone."""
    index = np.arange(1, int(np.prod(shape)) + 1, dtype=np.float64)
    x = np.sin(index * 12.9898 + zlib.crc32(name.encode()) % 9973) * 43758.5453
    return (2 * (x - np.floor(x)) - 1).reshape(shape)


def weight(kind: str, name: str, shape: tuple[int, ...]) -> torch.Tensor:
    x = noise(shape, f"{kind}.{name}")
    if len(shape) >= 2 and not name.endswith(("position_embedding.weight", "embed_tokens.weight", "lm_head.weight")):
        x = x * np.sqrt(3 / np.prod(shape[1:]))
    elif len(shape) >= 2 or (kind != "smolvla" and "norm" in name and "vision" not in name):
        x = 0.2 * x if name.endswith("bias") else 0.3 * x
    else:
        x = 0.2 * x if name.endswith("bias") else 1 + 0.3 * x
    return torch.tensor(x, dtype=torch.float32)


def tokenizer(begins: bool) -> Tokenizer:
    """A token a character; ``begins``: every text begins with ``<bos>``."""
    special = ["<unk>", "<bos>", "<fake_token_around_image>", "<global-img>"]
    made = Tokenizer(
        models.WordLevel({w: i for i, w in enumerate([*special, *REFERENCE["characters"]])}, unk_token="<unk>")
    )
    made.pre_tokenizer = pre_tokenizers.Split(Regex(r"[\s\S]"), "isolated")
    made.add_special_tokens(special)
    if begins:
        made.post_processor = processors.TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", 1)])
    return made


def save_folder(folder: Path, kind: str, buffers: bool = False) -> Path:
    """A policy's folder; with ``buffers`` as LeRobot wrote it before 0.4, statistics between the weights."""
    folder.mkdir(parents=True, exist_ok=True)
    described = REFERENCE[kind]
    type_ = described["config"]["type"]
    config = described["config"] | ({"vlm_model_name": str(folder / "vlm")} if type_ == "smolvla" else {})
    (folder / "config.json").write_text(json.dumps(config))
    state = {name: weight(type_, name, tuple(shape)) for name, shape in described["layout"].items()}
    statistics = REFERENCE[type_]["statistics"]
    flat = {
        (name, which): torch.tensor(values) for name, known in statistics.items() for which, values in known.items()
    }
    if buffers:
        for (name, which), values in flat.items():
            for prefix in ("unnormalize_outputs", "normalize_targets") if name == "action" else ("normalize_inputs",):
                state[f"{prefix}.buffer_{name.replace('.', '_')}.{which}"] = values.clone()
    else:
        for which, step in (("pre", "normalizer_processor"), ("post", "unnormalizer_processor")):
            file = f"policy_{which}processor_step_5_{step}.safetensors"
            save_file({f"{name}.{each}": values for (name, each), values in flat.items()}, folder / file)
            norm_map = config["normalization_mapping"]
            steps = [
                {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
                {"registry_name": step, "config": {"eps": 1e-8, "norm_map": norm_map}, "state_file": file},
            ]
            (folder / f"policy_{which}processor.json").write_text(json.dumps({"name": which, "steps": steps}))
    save_file(state, folder / "model.safetensors")
    if type_ == "smolvla":
        (folder / "vlm").mkdir(exist_ok=True)
        (folder / "vlm" / "config.json").write_text(json.dumps(REFERENCE["smolvla"]["vlm"]))
        tokenizer(False).save(str(folder / "vlm" / "tokenizer.json"))
    else:
        tokenizer(True).save(str(folder / "tokenizer.json"))
    return folder


def observations() -> TensorDict:
    td = TensorDict(batch_size=[2])
    for camera in CAMERAS:
        levels = [np.floor((noise((3, SIDE, SIDE), f"image.{k}.{camera}") + 1) * 128).clip(0, 255) for k in range(2)]
        td[keys.image_key(camera)] = torch.tensor(np.stack(levels).astype(np.uint8))
    states = np.stack([noise((7,), f"state.{k}") for k in range(2)])
    states[:, 6] = (states[:, 6] + 1) / 2
    td[keys.STATE] = torch.tensor(states, dtype=torch.float32)
    td[keys.INSTRUCTION] = NonTensorStack(*REFERENCE["goals"])
    return td


def start(policy):
    """The policy, its flow beginning with the noise that the reference began with."""
    policy.noise.copy_(torch.tensor(noise(tuple(policy.noise.shape), "noise")))
    return policy


def expected(kind: str) -> torch.Tensor:
    """The reference's actions, [2, 6, 7]."""
    return torch.tensor(REFERENCE[kind]["actions"])
