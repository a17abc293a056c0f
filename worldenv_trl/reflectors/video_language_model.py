"""A frozen video language model: frames to tokens, once each, and one language pass for each prefix of a video."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worldenv_trl import hub

__all__ = ["VideoLanguageModel"]

_FILES = ["*.json", "*.safetensors", "*.txt", "*.jinja", "*.model"]  # never a pickle
_FRAMES_PER_CALL = {"cpu": 16, "cuda": 64}
_TYPES = ("llava_onevision",)  # LLaVA-OneVision and LLaVA-Video: the class that transformers reads both into


class VideoLanguageModel(nn.Module):
    """LLaVA-OneVision (``LlavaOnevisionForConditionalGeneration``), frozen, its two halves called one by one.

    A frame's tokens depend on that frame alone: :meth:`encode` makes them once, and :meth:`hidden` reads those of any
    frames behind a prompt. Together they give what the model's own forward gives.

    Args:
        model: of transformers; gets no gradients, and stays in evaluation mode.
        tokenizer: a text to token ids: ``tokenizer(text).input_ids``.

    Keyword Args:
        mean, std: of the red, green and blue that the vision tower was trained with, in [0, 1].

    Raises:
        ValueError: for a model of another class.
    """

    def __init__(
        self,
        model: nn.Module,
        tokenizer: Any,
        *,
        mean: Sequence[float] = (0.5, 0.5, 0.5),
        std: Sequence[float] = (0.5, 0.5, 0.5),
    ) -> None:
        super().__init__()
        config: Any = model.config
        if config.model_type not in _TYPES:
            raise ValueError(
                f"a VLM reflector reads videos through {', '.join(_TYPES)}, got a {config.model_type}: "
                "name a LLaVA-OneVision or LLaVA-Video checkpoint in the layout of transformers"
            )
        self.net: Any = model.eval().requires_grad_(False)
        self.tokenizer = tokenizer
        self.image_size = int(config.vision_config.image_size)
        side = math.ceil(self.image_size // config.vision_config.patch_size / 2)
        self.tokens_per_frame, self.width = side * side, int(config.text_config.hidden_size)
        self.video_token = int(config.video_token_id)
        self._colours = (tuple(mean), tuple(std))
        # Causal attention does not look at what is padded behind: no mask, and the fastest kernel serves. Qwen2, told
        # so for its layers, does not look for packed sequences either, for which a GPU would have to be waited for.
        text: Any = model.get_submodule("model.language_model").config
        plain = text.model_type == "qwen2" and set(text.layer_types) == {"full_attention"}
        fused = text._attn_implementation in ("sdpa", "flash_attention_2")
        self._mask = {"full_attention": None} if plain and fused else None
        self._prompts: dict[str, tuple[list[int], list[int]]] = {}

    @classmethod
    def load(cls, name: str, dtype: str = "auto", device: str = "cpu") -> VideoLanguageModel:
        """From a local folder of transformers' layout, or ``owner/name`` of a repository on the Hub.

        Args:
            name: the folder or repository.
            dtype: of the weights: ``auto`` as they were saved, ``float32``, ``bfloat16``, ``float16``.
            device: ``cpu``, or ``meta``: no weights are read, only that their files are there is checked.

        Raises:
            FileNotFoundError: if there is no such folder, or a file in it is missing.
            ValueError: for a model of another class, or weights that are only there as pickles.
        """
        from transformers import AutoConfig, AutoModelForImageTextToText, AutoTokenizer

        folder = hub.download(name, _FILES) if hub.is_repo_id(name) else Path(name)
        for path in (folder, folder / "config.json"):
            if not path.exists():
                raise FileNotFoundError(
                    f"no video language model at {name}: {path} is missing. Name a folder of LLaVA-OneVision in the "
                    "layout of transformers, or owner/name of a repository on the Hugging Face Hub"
                )
        if not any(folder.glob("*.safetensors")):
            pickled = sorted(path.name for path in folder.glob("*.bin"))
            if pickled:
                raise ValueError(
                    f"{folder} holds its weights as a pickle, {pickled[0]}, which may run code when read: convert "
                    "it where you trust it, AutoModelForImageTextToText.from_pretrained(folder).save_pretrained(new)"
                )
            raise FileNotFoundError(f"no *.safetensors in {folder}: copy the weights there")
        model_type = json.loads((folder / "config.json").read_text()).get("model_type")
        if model_type not in _TYPES:
            raise ValueError(
                f"{folder} holds a {model_type}, a VLM reflector reads {', '.join(_TYPES)}: name a LLaVA-OneVision or "
                "LLaVA-Video checkpoint in the layout of transformers"
            )
        tokenizer = AutoTokenizer.from_pretrained(folder)
        if device == "meta":
            config = AutoConfig.from_pretrained(folder)
            saved = config.dtype or torch.float32
            with torch.device("meta"):
                model = AutoModelForImageTextToText.from_config(
                    config, dtype=saved if dtype == "auto" else getattr(torch, dtype)
                )
            return cls(model, tokenizer, **_colours(folder))
        model = AutoModelForImageTextToText.from_pretrained(
            folder, dtype=dtype if dtype == "auto" else getattr(torch, dtype), use_safetensors=True
        )
        return cls(model, tokenizer, **_colours(folder))

    def train(self, mode: bool = True) -> VideoLanguageModel:
        """Frozen: it stays in evaluation mode."""
        return super().train(False)

    # ------------------------------------------------------------------------------------------------- vision

    def prepare(self, frames: Tensor) -> Tensor:
        """uint8 [n, 3, H, W] as the vision tower wants them, [n, 3, S, S]: the shorter side resized to S, the centre
        cropped, colours standardised."""
        size, (height, width) = self.image_size, frames.shape[-2:]
        scale = size / min(height, width)
        shape = [max(size, round(height * scale)), max(size, round(width * scale))]
        images = frames.float()
        if shape != [height, width]:
            images = F.interpolate(images, shape, mode="bicubic", antialias=True, align_corners=False).clamp(0, 255)
        top, left = (shape[0] - size) // 2, (shape[1] - size) // 2
        images = images[..., top : top + size, left : left + size] / 255
        mean, std = (images.new_tensor(values).view(3, 1, 1) for values in self._colours)
        return ((images - mean) / std).to(self.net.dtype)

    @torch.no_grad()
    def encode(self, frames: Tensor) -> Tensor:
        """Tokens [n, T, D] of frames uint8 [n, 3, H, W], T = :attr:`tokens_per_frame`."""
        count, parts = _FRAMES_PER_CALL.get(frames.device.type, 16), []
        for part in frames.split(count):
            # One frame is a video of its own: frames do not see each other before the language model.
            video = self.net.model.get_video_features(self.prepare(part).unsqueeze(1)).pooler_output
            parts.append(video[:, : self.tokens_per_frame])  # some versions append the newline here, some later
        return torch.cat(parts)

    # ------------------------------------------------------------------------------------------------- language

    def prompt_ids(self, prompt: str) -> tuple[list[int], list[int]]:
        """Token ids before and behind the video.

        Raises:
            ValueError: unless the model's video token is in it exactly once.
        """
        if prompt not in self._prompts:
            ids = [int(token) for token in self.tokenizer(prompt).input_ids]
            if ids.count(self.video_token) != 1:
                raise ValueError(
                    f"the prompt {prompt!r} must hold the video token (id {self.video_token}) once, the tokenizer "
                    f"finds it {ids.count(self.video_token)} times: write <video> once, and use the checkpoint's own "
                    "tokenizer"
                )
            place = ids.index(self.video_token)
            self._prompts[prompt] = ids[:place], ids[place + 1 :]
        return self._prompts[prompt]

    def word(self, text: str) -> int:
        """The id of a word that is one token.

        Raises:
            ValueError: for a text of none or several tokens, or one that the tokenizer does not know.
        """
        ids = list(self.tokenizer(text, add_special_tokens=False).input_ids)
        if len(ids) != 1 or ids[0] == getattr(self.tokenizer, "unk_token_id", None):
            raise ValueError(f"{text!r} must be one token of the model's tokenizer, got {ids}: choose another word")
        return int(ids[0])

    @torch.no_grad()
    def hidden(self, videos: Sequence[Tensor], prompts: Sequence[tuple[list[int], list[int]]]) -> list[Tensor]:
        """The last layer's states [S_i, D] of each prompt with its video, in one pass.

        Args:
            videos: tokens of the frames of each, [L_i, T, D].
            prompts: ids before and behind the video, see :meth:`prompt_ids`.
        """
        device, embed = videos[0].device, self.net.get_input_embeddings()
        newline = self.net.model.image_newline.unsqueeze(0)
        rows = []
        for video, (before, after) in zip(videos, prompts, strict=True):
            first, last = (embed(torch.tensor(ids, dtype=torch.int64, device=device)) for ids in (before, after))
            rows.append(torch.cat([first, video.flatten(0, 1).to(first.dtype), newline.to(first.dtype), last]))
        padded = nn.utils.rnn.pad_sequence(rows, batch_first=True)
        states = self.net.model.language_model(
            inputs_embeds=padded, attention_mask=self._mask, use_cache=False
        ).last_hidden_state
        return [states[index, : len(row)] for index, row in enumerate(rows)]

    def logits(self, states: Tensor, words: Sequence[int]) -> Tensor:
        """What the language model would say next, of these words: [n, D] -> [n, len(words)]."""
        return F.linear(states, self.net.lm_head.weight[list(words)]).float()


def _colours(folder: Path) -> dict[str, Any]:
    """Mean and standard deviation of the checkpoint's own image preparation, where it says so."""
    for name in ("video_preprocessor_config.json", "preprocessor_config.json"):
        if (folder / name).exists():
            known = json.loads((folder / name).read_text())
            if "image_mean" in known and "image_std" in known:
                return {"mean": known["image_mean"], "std": known["image_std"]}
    return {}
