"""An actor on one device, an env on another."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from worldenv_trl.devices import device_of, to_device

__all__ = ["DeviceBridge"]


class DeviceBridge(TensorDictModuleBase):
    """Lets an actor on a GPU act in an env on the CPU: what it reads goes over, what it writes comes back.

    Nothing else is copied: no frame that the actor does not look at, and nothing back but what it writes. Where actor
    and env share a device it is the actor alone.

    Args:
        actor: on one device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor
        >>> actor = DeviceBridge(laplace_actor(OFTPolicy(OFTConfig(instructions=("open the drawer",)))))
        >>> observation = {"image": torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(2, 7)}
        >>> out = actor(TensorDict({"observation": observation, "language_instruction": "open the drawer"}, [2]))
        >>> out["vla_action", "chunk"].device
        device(type='cpu')
    """

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor = actor
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.select(*self.in_keys, strict=False)
        carried = to_device(seen, device_of(self.actor))
        if carried is seen:
            return self.actor(tensordict)
        here = next(value.device for value in seen.values(True, True) if isinstance(value, torch.Tensor))
        acted = self.actor(carried)
        for key in self.out_keys:
            tensordict.set(key, acted.get(key).to(here))
        return tensordict
