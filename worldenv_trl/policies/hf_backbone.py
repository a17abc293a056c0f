"""A Hugging Face vision-language model as a policy's backbone: images, proprioception, text and action placeholders."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from worldenv_trl.policies.prismatic import PrismaticConfig, PrismaticModel

if TYPE_CHECKING:
    from transformers import PreTrainedConfig, PreTrainedModel

__all__ = ["FAMILIES", "Family", "VisionLanguageBackbone", "backbone_config", "make_model"]


@dataclass(frozen=True)
class Family:
    """How the models of one ``model_type`` were pretrained to see images.

    Args:
        before, after: tokens around the features of each image, by text.
        images_first: images stand before the text's first special token, not after it.
        first_position: position of the first token.
        prefix_sees_itself: every token of images and text sees all of them, not only those before it.
        grid_positions: an image's tokens have a row and a column as positions (multimodal RoPE).
    """

    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    images_first: bool = False
    first_position: int = 0
    prefix_sees_itself: bool = False
    grid_positions: bool = False


_IDEFICS = Family(("<fake_token_around_image>", "<global-img>"), ("<fake_token_around_image>",))
_QWEN = Family(("<|vision_start|>",), ("<|vision_end|>",), grid_positions=True)
FAMILIES: Mapping[str, Family] = {
    "llava": Family(),
    "paligemma": Family(images_first=True, first_position=1, prefix_sees_itself=True),
    "idefics3": _IDEFICS,
    "smolvlm": _IDEFICS,
    "qwen2_vl": _QWEN,
    "qwen2_5_vl": _QWEN,
    "prismatic": Family(),
}
"""By the ``model_type`` of their config."""


def backbone_config(fields: Mapping[str, Any]) -> PreTrainedConfig | PrismaticConfig:
    """The config of what its ``to_dict()`` gave: transformers', or this package's own of OpenVLA's backbone.

    Raises:
        ValueError: for a family that is not in :data:`FAMILIES`.
    """
    from transformers import AutoConfig  # imported where used: it takes seconds

    fields = dict(fields)
    kind = fields.pop("model_type", None)
    if kind not in FAMILIES:
        raise ValueError(f"the backbone's model_type must be one of {', '.join(FAMILIES)}, got {kind!r}")
    if kind == PrismaticConfig.model_type:
        return PrismaticConfig(fields["text_config"], fields["vision_config"])
    return AutoConfig.for_model(kind, **fields)


def make_model(config: PreTrainedConfig | PrismaticConfig, dtype: torch.dtype) -> PreTrainedModel | PrismaticModel:
    """The model of a config without its language-modelling head, with random weights, on torch's default device."""
    from transformers import AutoModelForImageTextToText

    if isinstance(config, PrismaticConfig):
        return PrismaticModel(config, dtype)
    return AutoModelForImageTextToText.from_config(config, dtype=dtype).model


class VisionLanguageBackbone(nn.Module):
    """Hidden states of action placeholders that see images, proprioception and a text, in one pass.

    The sequence is the text's first special token, each camera's image between its family's tokens, one token of
    proprioception, the text, the placeholders (zeros: position alone tells them apart, as in OpenVLA-OFT) and, if
    asked for, a stop token. Placeholders see all of it and each other.

    Args:
        model: what :func:`make_model` makes, or a pretrained one's ``.model``.
        token_ids: the ids of the family's tokens before and after an image.
        first_id: of the text's first special token, which stands before the images; None if there is none.
        attention: ``prefix``, images and text see each other as they were pretrained to, and no placeholder, or
            ``full``, every token sees all.
        stop_id: of a token behind the placeholders, or None.
        readout_shift: how many tokens before the placeholders the first hidden state is read (OpenVLA-OFT: 1).
    """

    model: Any  # transformers has no types

    def __init__(
        self,
        model: PreTrainedModel | PrismaticModel,
        *,
        token_ids: tuple[Sequence[int], Sequence[int]] = ((), ()),
        first_id: int | None = None,
        attention: str = "prefix",
        stop_id: int | None = None,
        readout_shift: int = 0,
    ) -> None:
        super().__init__()
        self.model = model
        self.family = FAMILIES[model.config.model_type]
        self.first_id, self.stop_id = first_id, stop_id
        self.attention, self.readout_shift = attention, readout_shift
        self._around = tuple(tuple(ids) for ids in token_ids)
        text = model.config.get_text_config()
        self.dim = int(text.hidden_size)
        self._kinds = set(getattr(text, "layer_types", None) or ())

    @property
    def language_model(self) -> Any:
        return getattr(self.model, "language_model", None) or self.model.text_model

    def forward(self, pixels: Tensor, proprio: Tensor, ids: Tensor, valid: Tensor, placeholders: int) -> Tensor:
        """Hidden states of the placeholders, [n, placeholders, dim].

        Args:
            pixels: prepared images of every camera, [n, cameras, 3, H, W].
            proprio: its token, [n, dim].
            ids: of the text behind its first special token, int64 [n, L], padded in front.
            valid: which of them are no padding, bool [n, L].
            placeholders: how many.
        """
        embed = self.language_model.get_input_embeddings()
        front, sides = self._front(pixels, ids.device, proprio)
        rows, dtype = pixels.shape[0], front[sides[0]].dtype
        back = [torch.zeros(rows, placeholders, self.dim, dtype=dtype, device=ids.device)]
        if self.stop_id is not None:
            back.append(self._tokens([self.stop_id], rows, ids.device))
        sequence = torch.cat([*front, embed(ids), *back], 1).to(dtype)  # [n, S, dim]

        behind = sum(part.shape[1] for part in back)
        seen = self._seen(valid, front, behind)
        mask = self._additive(self._allowed(seen, behind), dtype)
        hidden = self.language_model(
            inputs_embeds=sequence,
            attention_mask=mask,
            position_ids=self._positions(seen, front, sides),
            use_cache=False,
        ).last_hidden_state
        begin = sequence.shape[1] - behind - self.readout_shift
        return hidden[:, begin : begin + placeholders]

    def _front(
        self, pixels: Tensor, device: torch.device, proprio: Tensor | None = None
    ) -> tuple[list[Tensor], list[int]]:
        """What stands before the text, [n, length, dim] each, and which of it are images."""
        rows, cameras = pixels.shape[:2]
        features = self.image_features(pixels.flatten(0, 1)).unflatten(0, (rows, cameras))  # [n, cameras, T, dim]
        first = [] if self.first_id is None else [self._tokens([self.first_id], rows, device)]
        front: list[Tensor] = []
        sides: list[int] = []
        for camera in range(cameras):
            front += [self._tokens(self._around[0], rows, device)] if self._around[0] else []
            sides.append(len(front))
            front.append(features[:, camera])
            front += [self._tokens(self._around[1], rows, device)] if self._around[1] else []
        front += [] if proprio is None else [proprio[:, None].to(features.dtype)]
        if self.family.images_first:
            return [*front, *first], sides
        return [*first, *front], [side + len(first) for side in sides]

    def _tokens(self, values: Sequence[int], rows: int, device: torch.device) -> Tensor:
        embed = self.language_model.get_input_embeddings()
        return embed(torch.tensor([values], device=device)).expand(rows, -1, -1)

    @staticmethod
    def _seen(valid: Tensor, front: Sequence[Tensor], behind: int) -> Tensor:
        """Which tokens of the sequence are no padding, bool [n, S]."""
        ahead = sum(part.shape[1] for part in front)
        return torch.nn.functional.pad(valid, (ahead, behind), value=True)

    def _positions(self, seen: Tensor, front: Sequence[Tensor], sides: Sequence[int]) -> Tensor:
        """[n, S], or [3, n, S] where images have rows and columns."""
        if self.family.grid_positions:
            return self._grid_positions(seen, [part.shape[1] for part in front], sides, front[sides[0]].shape[1])
        return (seen.cumsum(1) - 1).clamp(min=0) + self.family.first_position

    def image_features(self, pixels: Tensor) -> Tensor:
        """What the language model sees of prepared images [n, 3, H, W]: [n, T, dim]."""
        model, kind = self.model, self.model.config.model_type
        pixels = pixels if kind == "prismatic" else pixels.to(model.dtype)  # that one normalises first
        if kind in ("idefics3", "smolvlm"):
            return model.connector(self._idefics_vision(pixels))
        if self.family.grid_positions:
            patches, grid = _qwen_patches(pixels, model.config.vision_config)
            features = model.get_image_features(patches, grid)
        else:
            features = model.get_image_features(pixels)
        features = getattr(features, "pooler_output", features)
        return features if isinstance(features, Tensor) else torch.stack(tuple(features))

    def _idefics_vision(self, pixels: Tensor) -> Tensor:
        """Of whole images alone: the model's own way asks tensors for their values, which blocks the device, and drops
        images that are blank."""
        vision = self.model.vision_model
        known, side = vision.embeddings.num_patches_per_side, pixels.shape[-1] // vision.patch_size
        line = torch.arange(side, device=pixels.device) * known // side
        where = (line[:, None] * known + line).flatten()
        patches = vision.embeddings.patch_embedding(pixels).flatten(2).mT  # [n, P, width]
        embedded = patches + vision.embeddings.position_embedding(where)
        return vision.post_layernorm(vision.encoder(inputs_embeds=embedded, attention_mask=None).last_hidden_state)

    def _allowed(self, seen: Tensor, behind: int) -> Tensor:
        """Bool [n, S, S]: padding is never seen, placeholders by the text only where attention is ``full``."""
        length = seen.shape[1]
        allowed = seen[:, None, :].expand(-1, length, -1)
        if self.attention == "prefix":
            index = torch.arange(length, device=seen.device)
            block = index >= length - behind - self.readout_shift
            within = ~block[None, :] if self.family.prefix_sees_itself else index[None, :] <= index[:, None]
            allowed = allowed & (block[:, None] | within)
        # A row of padding must see something, or its softmax is not a number.
        return allowed | torch.eye(length, dtype=torch.bool, device=seen.device)

    def _additive(self, allowed: Tensor, dtype: torch.dtype) -> Any:
        """What the language model adds, [n, 1, queries, keys]; by kind of its layers, where there are kinds."""
        mask = torch.zeros((), dtype=dtype, device=allowed.device)
        mask = torch.where(allowed, mask, torch.finfo(dtype).min)[:, None]
        return {kind: mask for kind in self._kinds} if "sliding_attention" in self._kinds else mask

    def _grid_positions(self, seen: Tensor, lengths: Sequence[int], images: Sequence[int], tokens: int) -> Tensor:
        """Multimodal RoPE's positions [3, n, S]: time, row, column; a text's are the same in all three."""
        side = int(tokens**0.5)
        where = torch.arange(tokens, device=seen.device)
        grid = torch.stack([torch.zeros_like(where), where // side, where % side])  # [3, T]
        parts, start = [], 0
        for index, length in enumerate(lengths):
            if index in images and length == tokens:
                parts.append(grid + start)
                start += side
            else:
                parts.append(torch.arange(start, start + length, device=seen.device).expand(3, -1))
                start += length
        ahead = torch.cat(parts, 1)[:, None].expand(-1, seen.shape[0], -1)  # [3, n, ahead]
        after = (seen[:, ahead.shape[2] :].cumsum(1) - 1).clamp(min=0) + start
        return torch.cat([ahead, after.expand(3, -1, -1)], 2)


def _qwen_patches(pixels: Tensor, vision: PreTrainedConfig) -> tuple[Tensor, Tensor]:
    """Images [n, 3, S, S] as Qwen's encoder takes them: rows of patches, those that it merges beside each other."""
    patch, merge, frames = vision.patch_size, vision.spatial_merge_size, vision.temporal_patch_size
    count, channels, side = pixels.shape[0], pixels.shape[1], pixels.shape[-1] // patch
    split = pixels.reshape(count, channels, side // merge, merge, patch, side // merge, merge, patch)
    split = split.permute(0, 2, 5, 3, 6, 1, 4, 7)  # [n, row, column, merge, merge, C, patch, patch]
    rows = split.reshape(count * side * side, channels, 1, patch, patch).expand(-1, -1, frames, -1, -1)
    grid = torch.tensor([[1, side, side]], device=pixels.device).repeat(count, 1)
    return rows.reshape(rows.shape[0], -1), grid


def autocast(device: torch.device, dtype: torch.dtype) -> contextlib.AbstractContextManager:
    """Products in ``dtype`` where weights that learn are float32 and the frozen ones are not."""
    if dtype == torch.float32 or not torch.amp.is_autocast_available(device.type):
        return contextlib.nullcontext()
    return torch.autocast(device.type, dtype=dtype)


def full_precision(device: torch.device) -> contextlib.AbstractContextManager:
    """Products as precise as what they are of, inside :func:`autocast`."""
    if not torch.amp.is_autocast_available(device.type):
        return contextlib.nullcontext()
    return torch.autocast(device.type, enabled=False)
