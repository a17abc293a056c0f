"""Behaviour cloning of a policy that is also told where, on the image, the hand goes next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_IS_PAD, WAYPOINT
from worldenv_trl.kinematics import ActionMap
from worldenv_trl.kinematics.calibrations import Calibrations, check_instructions, plain_cameras
from worldenv_trl.kinematics.densities import log_density
from worldenv_trl.language import instructions_of
from worldenv_trl.policies.base import Aims
from worldenv_trl.robot import Camera

__all__ = ["AimedCloning"]

_SIDE = 64  # of the image that places are projected on, square like all of a policy


class AimedCloning(nn.Module):
    """A cloning loss, and beside it how far the policy's aim is from the place where its gripper next closes or opens.

    Five demonstrations of a task can be told apart by anything on the image, and L1 on their actions does not say by
    what. Where the hand will take hold is known from the demonstration itself, and where that is seen, from the camera:
    the divergence KL(target, aim) with a normal density around that point as the target. (Places on the image as what
    to learn: Transporter networks, arXiv:2010.14406; PerAct, arXiv:2209.05451, of the same keyframes.) Cameras that are
    mounted on the tool, and places outside the image, are left out.

    Args:
        loss: from samples [B] to a TensorDict with ``loss_bc``; calls ``policy`` once.
        policy: whose aim is taught.
        cameras: ``{camera name: {instruction: camera}}``, what each instruction's scene is seen through.
        weight: of the divergence (nats) in ``loss_aim``.
        width: standard deviation of the target, in cells of the policy's maps.

    Raises:
        ValueError: for a negative weight, a width that is not positive, no camera that stands still, or cameras of
            different instructions.
        TypeError: for a policy that does not aim.

    Examples:
        >>> from tensordict import NonTensorStack, TensorDict
        >>> from torchrl.objectives import BCLoss
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor
        >>> from worldenv_trl.robot import look_at
        >>> front = look_at("agentview", (0.8, 0.0, 0.6), (0.0, 0.0, 0.1), 40.0)
        >>> policy = OFTPolicy(OFTConfig(instructions=("do it",)))
        >>> cloning = BCLoss(laplace_actor(policy), loss_function="l1")
        >>> cloning.set_keys(action=("vla_action", "chunk"), pad_mask="action_is_pad")
        >>> loss = AimedCloning(cloning, policy, {"agentview": {"do it": front}}, weight=0.5)
        >>> samples = TensorDict(
        ...     {
        ...         "observation": {"image": torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(2, 7)},
        ...         "vla_action": {"chunk": torch.zeros(2, 8, 7), "waypoint": torch.zeros(2, 3)},
        ...         "action_is_pad": torch.zeros(2, 8, dtype=torch.bool),
        ...     },
        ...     [2],
        ... )
        >>> out = loss(samples.set("language_instruction", NonTensorStack("do it", "do it")))
        >>> sorted(out.keys())
        ['loss_aim', 'loss_bc']
    """

    def __init__(
        self,
        loss: nn.Module,
        policy: Aims,
        cameras: Mapping[str, Mapping[str, Camera]],
        weight: float,
        width: float = 0.5,
    ) -> None:
        super().__init__()
        if not isinstance(policy, Aims):
            raise TypeError(f"the policy must have aiming(), as OFTPolicy has, {type(policy).__name__} has not")
        if weight < 0 or width <= 0:
            raise ValueError(f"weight must be at least 0 and width positive, got {weight} and {width}")
        plain = plain_cameras(cameras)
        check_instructions(plain, "AimedCloning")
        self.loss, self.weight, self.width = loss, weight, width
        views = {name: Calibrations(each) for name, each in plain.items()}
        fixed = {name: each for name, each in views.items() if not each.any_mounted}
        if not fixed:
            raise ValueError(f"one camera at least must stand still to be aimed with, got {', '.join(views)}")
        self._views = {name: (each, ActionMap(each.distinct, _SIDE)) for name, each in fixed.items()}
        self._aiming = policy.aiming  # not the module: it is the loss's

    def forward(self, samples: TensorDictBase) -> Any:
        """``loss_bc`` and ``loss_aim``, to be summed, for samples [B] of :func:`~worldenv_trl.data.policy_samples`."""
        with self._aiming() as aims:
            out = self.loss(samples)
        texts, where = instructions_of(samples), samples[WAYPOINT]
        # Of actions, like the cloning loss: so that processes that share a batch add up to one.
        rows = (~samples[ACTION_IS_PAD]).sum(-1)
        far = torch.stack([self._divergence(name, aims[name], texts, where) for name in self._views])
        out["loss_aim"] = self.weight * (far.mean(0) * rows).sum() / rows.sum().clamp_min(1)
        return out

    def _divergence(self, name: str, log_probs: Tensor, texts: Sequence[str], where: Tensor) -> Tensor:
        """[n] nats of one camera's log-probabilities [n, h, w] against points [n, 3]; 0 where there is no place."""
        (views, maps), side, device = self._views[name], log_probs.shape[-1], where.device
        seen = maps.to(device).project(where, views.indices(texts)) * (side / _SIDE)  # [n, 2], in cells
        target = log_density(seen, side, self.width)
        far = (target.exp() * (target - log_probs.flatten(1))).sum(-1)
        inside = ((seen > 0) & (seen < side)).all(-1)
        return torch.where(inside, far, torch.zeros_like(far))
