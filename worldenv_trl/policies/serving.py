"""Our own policies behind the bridge's server: a second process or machine, or a stand-in for somebody else's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from worldenv_trl.devices import device_of
from worldenv_trl.policies.base import Policy
from worldenv_trl.policies.bridge import Description

__all__ = ["ServedPolicy"]


class ServedPolicy:
    """A policy as :func:`~worldenv_trl.policies.bridge.serve` takes it: ``serve(served, served.description)``.

    Args:
        policy: on its device; it is put into evaluation mode.

    Keyword Args:
        name: for people and recordings; the class's name by default.
        digest: what tells it from others of that name: that of its weights (``worldenv_trl.record.model_hash``).

    Examples:
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy
        >>> served = ServedPolicy(OFTPolicy(OFTConfig(instructions=("open the drawer",))))
        >>> images = {"agentview": np.zeros((2, 3, 64, 64), np.uint8)}
        >>> actions, log_scale = served(images, np.zeros((2, 7), np.float32), 2 * ["open the drawer"])
        >>> actions.shape, served.description.chunk_length
        ((2, 8, 7), 8)
    """

    def __init__(self, policy: Policy, *, name: str = "", digest: str = "") -> None:
        self.policy = policy.eval()
        self.description = Description(
            name=name or type(policy).__name__,
            cameras=policy.cameras,
            image_size=policy.image_size,
            chunk_length=policy.chunk_length,
            proprio=policy.proprio,
            instructions=policy.instructions,
            action_range=tuple(policy.action_range.tolist()),
            digest=digest,
        )

    @torch.inference_mode()
    def __call__(
        self, images: Mapping[str, np.ndarray], state: np.ndarray, instructions: Sequence[str]
    ) -> tuple[np.ndarray, np.ndarray]:
        """``loc`` and ``log_scale``, float32 [n, C, 7], of uint8 [n, 3, H, W] by camera, float32 [n, 7] and n texts."""
        device = device_of(self.policy)
        seen = {camera: torch.tensor(image, device=device) for camera, image in images.items()}
        loc, log_scale = self.policy.predict(seen, torch.tensor(state, device=device), instructions)
        return loc.float().cpu().numpy(), log_scale.float().cpu().numpy()
