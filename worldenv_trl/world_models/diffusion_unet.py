"""Diffusers' spatio-temporal UNet with a time and a context of each frame's own."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.algorithms._checkpoint.checkpoint_wrapper import (
    apply_activation_checkpointing,
    checkpoint_wrapper,
)

__all__ = ["VideoUNet"]


class VideoUNet(nn.Module):
    """Layers and weights of ``UNetSpatioTemporalConditionModel``, called otherwise in two points, both EVAC's.

    Remembered frames are clean, so their timestep is 0 while that of the painted ones is what the sampler says. And
    every frame cross-attends to tokens of its own. Attention over time sees the first frame's, as in diffusers.

    Args:
        sizes: of diffusers' class.

    Attributes:
        net: of diffusers' class.
    """

    def __init__(self, sizes: Mapping[str, Any]) -> None:
        from diffusers import UNetSpatioTemporalConditionModel

        super().__init__()
        self.net: Any = UNetSpatioTemporalConditionModel.from_config(dict(sizes))

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights."""
        return self.net.conv_in.weight.dtype

    def checkpoint_activations(self) -> None:
        """Every residual and attention block's activations are computed twice in training instead of being kept.

        Diffusers' own switch leaves out what attends over time, nearly half of them.
        """
        from diffusers.models.resnet import SpatioTemporalResBlock
        from diffusers.models.transformers.transformer_temporal import TransformerSpatioTemporalModel

        apply_activation_checkpointing(
            self.net,
            checkpoint_wrapper_fn=partial(checkpoint_wrapper, preserve_rng_state=False),  # nothing is drawn in them
            check_fn=lambda module: isinstance(module, SpatioTemporalResBlock | TransformerSpatioTemporalModel),
        )

    def forward(self, sample: Tensor, timesteps: Tensor, context: Tensor, added_ids: Tensor) -> Tensor:
        """What the latents' frames are predicted to be.

        Args:
            sample: [B, F, channels, h, w].
            timesteps: [B, F].
            context: [B, F, L, D].
            added_ids: [B, K], further numbers the video is told by, K times 256 of the time embedding's width.

        Returns:
            [B, F, latent channels, h, w].
        """
        batch, frames = sample.shape[:2]
        net, dtype = self.net, sample.dtype
        added = net.add_time_proj(added_ids.flatten()).reshape(batch, -1).to(dtype)
        times = net.time_embedding(net.time_proj(timesteps.flatten()).to(dtype))
        emb = times + net.add_embedding(added).repeat_interleave(frames, 0)
        known: dict[str, Any] = {"temb": emb, "image_only_indicator": sample.new_zeros(batch, frames)}
        told = known | {"encoder_hidden_states": context.flatten(0, 1).to(dtype)}

        hidden = net.conv_in(sample.flatten(0, 1))
        skips = [hidden]
        for block in net.down_blocks:
            hidden, outputs = block(hidden, **(told if _attends(block) else known))
            skips.extend(outputs)
        hidden = net.mid_block(hidden, **told)
        for block in net.up_blocks:
            count = len(block.resnets)
            taken, skips = tuple(skips[-count:]), skips[:-count]
            hidden = block(hidden, res_hidden_states_tuple=taken, **(told if _attends(block) else known))
        hidden = net.conv_out(net.conv_act(net.conv_norm_out(hidden)))
        return hidden.unflatten(0, (batch, frames))


def _attends(block: torch.nn.Module) -> bool:
    return bool(getattr(block, "has_cross_attention", False))
