"""A flow-matching action expert beside a vision-language model: the velocities of SmolVLA, pi0 and pi0.5."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from worldenv_trl.policies.hf_backbone import VisionLanguageBackbone
from worldenv_trl.policies.joint_layers import AdaptiveNorm, JointLayer, sinusoids

if TYPE_CHECKING:
    from transformers import PreTrainedModel

__all__ = ["FLOW_FAMILIES", "Expert", "FlowFamily", "FlowNetwork", "Prefix"]


@dataclass(frozen=True)
class FlowFamily:
    """How one kind of policy puts its expert beside its vision-language model.

    Args:
        backbone: ``model_type`` of the vision-language model.
        layer: ``model_type`` whose decoder layers the expert is made of.
        state: where proprioception is: a token of the ``prefix`` (images and text), which they do not see, one of the
            ``suffix`` (the actions), or digits of the ``prompt``.
        causal: an action sees those before it alone; otherwise all of them.
        adaptive: the flow's time conditions the expert's norms; otherwise it is joined to each action.
        scaled: embeddings of images and text are multiplied by the square root of their width.
    """

    backbone: str
    layer: str
    state: str
    causal: bool = False
    adaptive: bool = False
    scaled: bool = False


FLOW_FAMILIES: Mapping[str, FlowFamily] = {
    "smolvla": FlowFamily("smolvlm", "llama", "prefix", causal=True, scaled=True),  # arXiv:2506.01844
    "pi0": FlowFamily("paligemma", "gemma", "suffix"),  # arXiv:2410.24164
    "pi05": FlowFamily("paligemma", "gemma", "prompt", adaptive=True),  # arXiv:2504.16054
}
"""By LeRobot's ``type``."""


class Prefix(NamedTuple):
    """What the expert sees of an observation: keys and values of each layer, [n, heads, P, head_dim], and which
    tokens are no padding, bool [n, P]."""

    layers: list[tuple[Tensor, Tensor]]
    seen: Tensor


class Expert(nn.Module):
    """The action expert: layers like those of the language model, of another width.

    Args:
        family: which kind.
        text: config of the language model, of which heads and norms are taken.
        sizes: ``hidden_size``, ``intermediate_size`` and ``num_hidden_layers``.
        depth: layers of the language model, a multiple of the expert's.
        self_every: one layer in so many sees the actions, too, the others only the prefix, through projections of
            their own (SmolVLA: 2); 0: all do.

    Raises:
        ValueError: for numbers of layers that do not fit each other.
    """

    def __init__(
        self, family: FlowFamily, text: Any, sizes: Mapping[str, int], depth: int, self_every: int = 0
    ) -> None:
        super().__init__()
        from transformers import AutoConfig
        from transformers.models.gemma.modeling_gemma import GemmaDecoderLayer, GemmaRMSNorm
        from transformers.models.llama.modeling_llama import LlamaDecoderLayer, LlamaRMSNorm

        count = sizes["num_hidden_layers"]
        stride = depth // count
        cross = [bool(self_every) and index % self_every != 0 for index in range(count)]
        beside = [bool(self_every) and index * stride % self_every != 0 for index in range(count)]
        if depth % count or cross != beside:
            raise ValueError(
                f"{count} layers of an expert cannot stand beside {depth} of a language model, with self-attention in "
                f"one of {self_every}"
            )
        self.stride, self.width = stride, int(sizes["hidden_size"])
        fields = {name: value for name, value in text.to_dict().items() if name != "model_type"}
        config = AutoConfig.for_model(family.layer, **(fields | dict(sizes)))
        make = {"llama": LlamaDecoderLayer, "gemma": GemmaDecoderLayer}[family.layer]
        layers = [make(config, index) for index in range(count)]
        heads = config.num_key_value_heads * config.head_dim
        for layer, crossing in zip(layers, cross, strict=True):
            if crossing:
                layer.self_attn.k_proj, layer.self_attn.v_proj = (nn.Linear(heads, heads, bias=False) for _ in "kv")
            if family.adaptive:
                layer.input_layernorm, layer.post_attention_layernorm = (
                    AdaptiveNorm(self.width, config.rms_norm_eps) for _ in range(2)
                )
        self.layers = nn.ModuleList(
            JointLayer(layer, "cross" if crossing else "self") for layer, crossing in zip(layers, cross, strict=True)
        )
        norm = {"llama": LlamaRMSNorm, "gemma": GemmaRMSNorm}[family.layer]
        self.norm = (
            AdaptiveNorm(self.width, config.rms_norm_eps)
            if family.adaptive
            else norm(self.width, eps=config.rms_norm_eps)
        )


class FlowNetwork(nn.Module):
    """The velocity of noised action chunks, given images, a text and proprioception.

    Images and text go through the vision-language model once; the expert then looks at its keys and values, layer by
    layer, at every step of the integration.

    Args:
        family: which kind.
        model: the vision-language model without its head; the parts of it that no expert looks at are taken out.
        expert: sizes of the expert's layers, see :class:`Expert`.

    Keyword Args:
        token_ids: ids of tokens before and after each image.
        max_state_dim, max_action_dim: to which proprioception and actions are padded.
        self_every: see :class:`Expert`.
        periods: shortest and longest of the sinusoids of time.
        checkpointing: keep no activations inside layers, compute them again.
    """

    def __init__(
        self,
        family: FlowFamily,
        model: PreTrainedModel,
        expert: Mapping[str, int],
        *,
        token_ids: tuple[Sequence[int], Sequence[int]] = ((), ()),
        max_state_dim: int,
        max_action_dim: int,
        self_every: int = 0,
        periods: tuple[float, float] = (4e-3, 4.0),
        checkpointing: bool = False,
    ) -> None:
        super().__init__()
        self.family, self.periods, self.checkpointing = family, periods, checkpointing
        self.backbone = VisionLanguageBackbone(model)
        self._around = token_ids
        language = self.backbone.language_model
        layers = list(language.layers)
        self.expert = Expert(family, language.config, expert, len(layers), self_every)
        # Of the last layer the expert sees keys and values alone: what is behind them is never computed.
        language.layers = nn.ModuleList([*map(JointLayer, layers[:-1]), JointLayer(layers[-1], "keys")])
        language.norm = None
        width, prefix_width = self.expert.width, self.backbone.dim
        self.action_in_proj = nn.Linear(max_action_dim, width)
        self.action_out_proj = nn.Linear(width, max_action_dim)
        if family.state != "prompt":
            self.state_proj = nn.Linear(max_state_dim, prefix_width if family.state == "prefix" else width)
        self.time_mlp_in = nn.Linear(width if family.adaptive else 2 * width, width)
        self.time_mlp_out = nn.Linear(width, width)

    def towers(self) -> tuple[nn.Module, nn.Module]:
        """The vision-language model and the expert: what adapters adapt."""
        return self.backbone.model, self.expert

    def projections(self) -> list[nn.Parameter]:
        """Of proprioception, actions and time into the towers and out of them."""
        towers = {id(parameter) for tower in self.towers() for parameter in tower.parameters()}
        return [parameter for parameter in self.parameters() if id(parameter) not in towers]

    def prefix(self, pixels: Tensor, ids: Tensor, valid: Tensor, state: Tensor) -> Prefix:
        """What the expert sees of observations.

        Args:
            pixels: in [-1, 1], [n, cameras, 3, S, S].
            ids: of the text, int64 [n, L], padded behind.
            valid: which of them are no padding, bool [n, L].
            state: normalised and padded, [n, max_state_dim].
        """
        rows, cameras = pixels.shape[:2]
        embed = self.backbone.language_model.get_input_embeddings()
        features = self.backbone.image_features(pixels.flatten(0, 1)).unflatten(0, (rows, cameras))
        scale = math.sqrt(self.backbone.dim) if self.family.scaled else 1.0

        def tokens(values: Sequence[int]) -> list[Tensor]:
            return [embed(torch.tensor([values], device=ids.device)).expand(rows, -1, -1)] if values else []

        parts: list[Tensor] = []
        for camera in range(cameras):
            parts += [*tokens(self._around[0]), features[:, camera] * scale, *tokens(self._around[1])]
        sequence = torch.cat([*parts, (embed(ids) * scale).to(features.dtype)], 1)  # [n, P, dim]
        seen = F.pad(valid, (sequence.shape[1] - ids.shape[1], 0), value=True)
        allowed = seen[:, None].expand(-1, seen.shape[1], -1)
        if self.family.state == "prefix":
            token = self.state_proj(state)[:, None].to(sequence.dtype)
            sequence, seen = torch.cat([sequence, token], 1), F.pad(seen, (0, 1), value=True)
            allowed = F.pad(F.pad(allowed, (0, 1), value=False), (0, 0, 0, 1), value=True) & seen[:, None]
        # A row of padding must see something, or its softmax is not a number.
        allowed = allowed | torch.eye(seen.shape[1], dtype=torch.bool, device=seen.device)
        positions = (seen.cumsum(1) - 1).clamp(min=0)
        found, hidden = [], sequence
        for layer in self.backbone.language_model.layers:
            hidden, keys, values = self._run(layer, hidden, positions, allowed)
            found.append((keys, values))
        return Prefix(found, seen)

    def hidden(self, prefix: Prefix, state: Tensor, actions: Tensor, time: float) -> Tensor:
        """The expert's hidden states of noised actions, [n, H, width].

        Args:
            prefix: of :meth:`prefix`.
            state: normalised and padded, [n, max_state_dim].
            actions: noised, [n, H, max_action_dim].
            time: 1 for noise, 0 for actions.
        """
        return self._run(self._hidden, prefix, state, actions, time)

    def velocity(self, hidden: Tensor) -> Tensor:
        """What hidden states [n, H, width] say of the way from actions to noise, float32 [n, H, max_action_dim]."""
        return self.action_out_proj(hidden.float())

    def _hidden(self, prefix: Prefix, state: Tensor, actions: Tensor, time: float) -> Tensor:
        rows, steps = actions.shape[:2]
        when = sinusoids(time, self.expert.width, *self.periods, actions.device)
        tokens, condition = self.action_in_proj(actions), None
        if self.family.adaptive:
            condition = F.silu(self.time_mlp_out(F.silu(self.time_mlp_in(when))))  # [1, width]
        else:
            joined = torch.cat([tokens, when[:, None].to(tokens.dtype).expand(rows, steps, -1)], -1)
            tokens = self.time_mlp_out(F.silu(self.time_mlp_in(joined)))
        if self.family.state == "suffix":
            tokens = torch.cat([self.state_proj(state)[:, None], tokens], 1)
        count = tokens.shape[1]
        block = torch.ones(count, count, dtype=torch.bool, device=actions.device)
        if self.family.causal:
            block = block.tril()
        elif self.family.state == "suffix":
            block[0, 1:] = False  # proprioception does not see the actions
        outside = prefix.seen[:, None].expand(-1, count, -1)  # [n, S, P]
        allowed = torch.cat([outside, block.expand(rows, -1, -1)], 2)
        order = torch.arange(count, device=actions.device).expand(rows, -1)
        positions = prefix.seen.sum(1, keepdim=True) + order
        dtype = prefix.layers[0][0].dtype
        hidden, condition = tokens.to(dtype), None if condition is None else condition.to(dtype)
        for layer, past in zip(self.expert.layers, prefix.layers[:: self.expert.stride], strict=True):
            crossing = layer.mode == "cross"
            hidden, _, _ = layer(
                hidden, order if crossing else positions, outside if crossing else allowed, past, condition
            )
        norm = self.expert.norm
        hidden = norm(hidden, condition)[0] if isinstance(norm, AdaptiveNorm) else norm(hidden)
        return hidden[:, -steps:]

    def _run(self, function: Any, *arguments: Any) -> Any:
        if self.checkpointing and torch.is_grad_enabled():
            return checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)
        return function(*arguments)
