"""A folder of pi0-FAST as LeRobot writes it, with weights that are a function of their names, and what LeRobot's own
code made of it.

``lerobot_reference/pi0_fast.json`` holds LeRobot's config, names and shapes of tensors, FAST's vocabulary, and of two
observations the greedy tokens, the logits at each of them and the actions of ``sample_actions_fast`` and
``detokenize_actions`` (huggingface/lerobot 7427f31 with transformers 5.5.4, at a tiny size; only its modelling files
were loaded, and its language head was made to begin with "Action: " and to say nothing but action tokens and the end,
as random weights would not). Statistics, images, states and goals are those of :mod:`lerobot_folders`.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path

import torch
from policies.lerobot_folders import REFERENCE, weight
from safetensors.torch import save_file
from tokenizers import Regex, Tokenizer, models, pre_tokenizers, processors

VOCABULARY, SIZE, SKIP = 140, 60, 5
PATH = Path(__file__).parent / "lerobot_reference" / "pi0_fast.json"


@functools.cache
def fast_reference() -> dict:
    return json.loads(PATH.read_text())


def fast_tokenizer() -> Tokenizer:
    """A token a character, and ids for action tokens behind them."""
    known = ["<unk>", "<bos>", *REFERENCE["characters"], "|"]
    known += [f"<{number}>" for number in range(len(known), VOCABULARY)]
    made = Tokenizer(models.WordLevel({word: number for number, word in enumerate(known)}, unk_token="<unk>"))
    made.pre_tokenizer = pre_tokenizers.Split(Regex(r"[\s\S]"), "isolated")
    made.add_special_tokens(["<unk>", "<bos>"])
    made.post_processor = processors.TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", 1)])
    return made


def save_fast_folder(folder: Path) -> Path:
    """With FAST's tokenizer in ``action_tokenizer/``."""
    reference = fast_reference()
    (folder / "action_tokenizer").mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(reference["config"]))
    described = {"scale": reference["scale"], "min_token": reference["min_token"], "vocab_size": SIZE}
    (folder / "action_tokenizer" / "processor_config.json").write_text(json.dumps(described))
    (folder / "action_tokenizer" / "tokenizer.json").write_text(reference["bpe"])
    fast_tokenizer().save(str(folder / "tokenizer.json"))
    save_file(
        {name: weight("pi0_fast", name, tuple(shape)) for name, shape in reference["layout"].items()},
        folder / "model.safetensors",
    )
    statistics = REFERENCE["pi05"]["statistics"]
    flat = {
        f"{name}.{which}": torch.tensor(values) for name, known in statistics.items() for which, values in known.items()
    }
    for which, step in (("pre", "normalizer_processor"), ("post", "unnormalizer_processor")):
        file = f"policy_{which}processor_step_5_{step}.safetensors"
        save_file(flat, folder / file)
        norm_map = reference["config"]["normalization_mapping"]
        steps = [{"registry_name": step, "config": {"eps": 1e-8, "norm_map": norm_map}, "state_file": file}]
        (folder / f"policy_{which}processor.json").write_text(json.dumps({"name": which, "steps": steps}))
    return folder
