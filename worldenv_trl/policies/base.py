"""What every policy is: the parameters of a Laplace distribution over action chunks, from images, state and a goal."""

from __future__ import annotations

import abc
from collections.abc import Iterable, Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM, INSTRUCTION, LOC, LOG_SCALE, STATE, STATE_DIM, image_key
from worldenv_trl.language import SeenInstructions, instructions_of

__all__ = ["Policy"]


class Policy(TensorDictModuleBase, abc.ABC):
    """A policy as the actor, exploration, LOOP and the evaluation see it; nothing else of it is known to them.

    Reads what :class:`torchrl.modules.vla.VLAWrapperBase` reads: ``("observation", ...)`` uint8 [*B, 3, H, W] of each
    camera, ``("observation", "state")`` float32 [*B, 7] and ``language_instruction``. Writes ``("vla_action", "loc")``
    and ``("vla_action", "log_scale")``, float32 [*B, C, 7] in the env's normalised action units.

    A subclass calls ``super().__init__`` with what it is trained for, and implements :meth:`predict`,
    :meth:`fit_statistics`, :attr:`action_range`, :meth:`scale_parameters` and :meth:`post_training_parameters`. With
    :class:`~worldenv_trl.pretrained.Pretrained` beside it, all of that is saved with its weights.

    Keyword Args:
        cameras: scene cameras whose images it reads, in order.
        image_size: height and width of the images (px).
        chunk_length: C.
        proprio: what the state tells, ``commanded`` (the controller's targets) or ``measured``.
        instructions: those it is trained on; others are answered with a warning.

    Raises:
        ValueError: for no camera, one that is named twice, or another kind of proprioception; when called, for images
            or states of another size.
    """

    def __init__(
        self,
        *,
        cameras: Sequence[str] = ("agentview",),
        image_size: int,
        chunk_length: int,
        proprio: str = "commanded",
        instructions: Sequence[str] = (),
    ) -> None:
        super().__init__()
        if not cameras or len(set(cameras)) < len(cameras):
            raise ValueError(f"cameras must name at least one camera, each once, got {tuple(cameras)}")
        if proprio not in ("commanded", "measured"):
            raise ValueError(f"proprio must be 'commanded' or 'measured', got {proprio!r}")
        self.cameras, self.image_size = tuple(cameras), int(image_size)
        self.chunk_length, self.proprio = int(chunk_length), proprio
        self._seen = SeenInstructions(f"the policy {type(self).__name__}", instructions)
        self.in_keys = [*(image_key(camera) for camera in self.cameras), STATE, INSTRUCTION]
        self.out_keys = [LOC, LOG_SCALE]

    @property
    def instructions(self) -> tuple[str, ...]:
        """What it was trained on."""
        return self._seen.instructions

    @abc.abstractmethod
    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        """``loc`` and ``log_scale``, float32 [n, C, 7].

        Args:
            images: uint8 [n, 3, H, W] by camera.
            state: float32 [n, 7]: position (m), axis-angle (rad), gripper opening.
            instructions: n texts.
        """

    @property
    @abc.abstractmethod
    def action_range(self) -> Tensor:
        """Half the range that the training uses of each action dimension, [7], in normalised units."""

    @abc.abstractmethod
    def fit_statistics(self, states: Tensor, actions: Tensor) -> None:
        """Takes what normalisation needs from training data, [..., 7] each."""

    @abc.abstractmethod
    def scale_parameters(self) -> Iterable[nn.Parameter]:
        """Parameters of the scale alone, for the stage that trains nothing else (World-Env Eq. 8)."""

    @abc.abstractmethod
    def post_training_parameters(self, rank: int) -> dict[str, list[nn.Parameter]]:
        """Prepares for LOOP and returns the groups that it updates, ``adapters`` and ``heads``; the rest is frozen.

        Adapters of that rank are added where there are none yet, without changing what the policy does. Build losses
        and optimisers after this call.
        """

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = tensordict.batch_size
        images = {camera: self._image(tensordict, camera) for camera in self.cameras}
        state = tensordict[STATE]
        if state.shape != (*batch, STATE_DIM):
            raise ValueError(f"{STATE} must be {[*batch, STATE_DIM]}, got {list(state.shape)}")
        instructions = instructions_of(tensordict)
        self._seen.check(instructions)
        loc, log_scale = self.predict(images, state.reshape(-1, STATE_DIM), instructions)
        shape = (*batch, self.chunk_length, ACTION_DIM)
        tensordict.set(LOC, loc.float().reshape(shape))
        return tensordict.set(LOG_SCALE, log_scale.float().reshape(shape))

    def _image(self, tensordict: TensorDictBase, camera: str) -> Tensor:
        image, size = tensordict.get(image_key(camera), None), (3, self.image_size, self.image_size)
        if image is None:
            raise ValueError(
                f"this policy was trained for the cameras {', '.join(self.cameras)}; the tensordict has no "
                f"{image_key(camera)} of {camera!r}: pass cameras={self.cameras} to the env"
            )
        if image.dtype != torch.uint8 or tuple(image.shape[-3:]) != size:
            raise ValueError(
                f"{image_key(camera)} must be uint8 [*B, 3, {size[1]}, {size[2]}], "
                f"got {image.dtype} {list(image.shape)}"
            )
        return image.reshape(-1, *size)
