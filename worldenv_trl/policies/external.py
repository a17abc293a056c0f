"""Policies that live in another environment, behind a server: pi0, OpenVLA, UniVLA, LeRobot's, or one of ours."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, Self

import numpy as np
import torch
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM, CONTROL_HZ, POSITION_STEP, ROTATION_STEP
from worldenv_trl.policies.base import Policy
from worldenv_trl.policies.bridge import ActionUnits, Description
from worldenv_trl.policies.external_connection import ExternalConnection
from worldenv_trl.pretrained import Pretrained

__all__ = ["ExternalConfig", "ExternalPolicy"]

_NARROW = -6.0  # the lowest log-scale of laplace_actor's own bounds


@dataclass(frozen=True)
class ExternalConfig:
    """Where a policy is served, and what it said of itself.

    Args:
        address: ``host:port`` or ``unix:/path``.
        description: the server's.
        timeout: seconds within which it has to answer.
    """

    address: str
    description: Description
    timeout: float = 60.0

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> ExternalConfig:
        return cls(fields["address"], Description.from_dict(fields["description"]), float(fields["timeout"]))


class ExternalPolicy(Policy, Pretrained):
    """A policy whose network runs in a server process; see :mod:`worldenv_trl.policies.bridge`.

    It acts as every policy does, in the scenes and in imagination, greedily or with exploration's noise around its
    actions. It cannot learn: no weights are here, and no gradient comes through a socket. A server that sends
    ``log_scale`` keeps its own noise; around any other's actions it is the floor of
    :func:`~worldenv_trl.policies.scale_bounds`.

    Cameras, image size, chunk length and proprioception are what the server says; actions in other units
    (:class:`~worldenv_trl.policies.bridge.ActionUnits`) are converted to ours. Copies and other processes make
    connections of their own. :meth:`save_pretrained` writes the address and what was said, :meth:`from_pretrained`
    holds the server at that address against it.

    Raises:
        ValueError: if the server's actions come at another rate than the 20 Hz of the envs.

    Examples:
        >>> import threading
        >>> from tensordict import TensorDict
        >>> from worldenv_trl.policies.bridge import PolicyServer
        >>> def still(images, state, instructions):  # in the other environment
        ...     return np.zeros((len(instructions), 8, 7), np.float32)
        >>> told = Description("still", ("agentview",), image_size=64, chunk_length=8, proprio="commanded")
        >>> server = PolicyServer(still, told)
        >>> threading.Thread(target=server.serve_forever).start()
        >>> policy = ExternalPolicy.connect(server.address)
        >>> observation = {"image": torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(2, 7)}
        >>> out = policy(TensorDict({"observation": observation, "language_instruction": "open the drawer"}, [2]))
        >>> out["vla_action", "loc"].shape
        torch.Size([2, 8, 7])
        >>> server.close()
    """

    config_class = ExternalConfig
    config: ExternalConfig
    gain: Tensor
    offset: Tensor

    def __init__(self, config: ExternalConfig) -> None:
        told = config.description
        super().__init__(
            cameras=told.cameras,
            image_size=told.image_size,
            chunk_length=told.chunk_length,
            proprio=told.proprio,
            instructions=told.instructions,
        )
        if told.units.control_hz != CONTROL_HZ:
            raise ValueError(
                f"the policy {told.name!r} acts at {told.units.control_hz:g} Hz, the envs at {CONTROL_HZ}: let its "
                "server resample its chunks"
            )
        self.config = config
        self.connection = ExternalConnection(config.address, config.timeout, told)
        gain, offset = _conversion(told.units)
        self.register_buffer("gain", gain, persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.action_range.copy_(torch.tensor(told.action_range) * gain.abs())

    @classmethod
    def connect(cls, address: str, *, timeout: float = 60.0) -> Self:
        """The policy that is served at an address.

        Args:
            address: ``host:port`` or ``unix:/path``.

        Keyword Args:
            timeout: seconds within which it has to answer, now and whenever it acts.

        Raises:
            ConnectionError: if nobody answers there.
            TimeoutError: if the server is too slow.
            RuntimeError: if it is no policy server, or one of another version.
            ValueError: for what is no address.
        """
        connection = ExternalConnection(address, timeout)
        description = connection.describe()
        connection.close()
        return cls(ExternalConfig(address, description, timeout))

    @classmethod
    def from_pretrained(
        cls, name: str | os.PathLike, *, device: str | torch.device = "cpu", revision: str | None = None
    ) -> Self:
        """See :meth:`Pretrained.from_pretrained`; the server has to be there and to serve what it served then.

        Raises:
            ConnectionError, TimeoutError, RuntimeError: see :meth:`connect`.
        """
        policy = super().from_pretrained(name, device=device, revision=revision)
        policy.connection.describe()
        return policy

    @torch.no_grad()
    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        arrays = {f"image.{camera}": images[camera].cpu().numpy() for camera in self.cameras}
        arrays["state"] = state.float().cpu().numpy()
        answer = self.connection.act(arrays, list(instructions))
        shape = (len(state), self.chunk_length, ACTION_DIM)
        loc = self._checked(answer, "actions", shape)
        log_scale = self._checked(answer, "log_scale", shape) if "log_scale" in answer else None
        if self.config.description.units != ActionUnits():
            loc = loc * self.gain + self.offset
            log_scale = None if log_scale is None else log_scale + self.gain.abs().log()
        return loc, torch.full_like(loc, _NARROW) if log_scale is None else log_scale

    def _checked(self, answer: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> Tensor:
        array = answer.get(name)
        if array is None or array.dtype != np.float32 or array.shape != shape or not np.isfinite(array).all():
            got = "nothing" if array is None else f"{array.dtype} {list(array.shape)}"
            finite = array is None or array.dtype != np.float32 or np.isfinite(array).all()
            raise RuntimeError(
                f"the policy server at {self.config.address} must answer with {name} float32 {list(shape)}, all "
                f"finite, got {got}{'' if finite else ', not all finite'}: mend its adapter"
            )
        return torch.from_numpy(array.copy()).to(self.gain.device)

    def require_gradients(self) -> NoReturn:
        raise RuntimeError(
            f"the policy served at {self.config.address} can be evaluated and explored with, but not trained: its "
            "weights are in another process and no gradient or density of its own comes from there. Post-train an "
            "OFTPolicy, an HFPolicy or a FlowPolicy"
        )

    def fit_statistics(self, states: Tensor, actions: Tensor) -> None:
        self.require_gradients()

    def scale_parameters(self) -> Iterable[nn.Parameter]:
        self.require_gradients()

    def post_training_parameters(self, rank: int) -> dict[str, list[nn.Parameter]]:
        self.require_gradients()


def _conversion(units: ActionUnits) -> tuple[Tensor, Tensor]:
    """What takes actions in these units to ours: ``action * gain + offset``, [7] each."""
    gripper = 2 / (units.gripper_closed - units.gripper_open)
    gain = [*3 * [units.position / POSITION_STEP], *3 * [units.rotation / ROTATION_STEP], gripper]
    return torch.tensor(gain), torch.tensor([*6 * [0.0], -1 - gripper * units.gripper_open])
