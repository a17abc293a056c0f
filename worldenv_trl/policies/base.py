"""What every policy is: the parameters of a Laplace distribution over action chunks, from images, state and a goal."""

from __future__ import annotations

import abc
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM, INSTRUCTION, LOC, LOG_SCALE, STATE, STATE_DIM, image_key
from worldenv_trl.language import SeenInstructions, instructions_of

__all__ = ["Aims", "Policy"]


class Policy(TensorDictModuleBase, abc.ABC):
    """A policy as the actor, exploration, LOOP and the evaluation see it; nothing else of it is known to them.

    Reads what :class:`torchrl.modules.vla.VLAWrapperBase` reads: ``("observation", ...)`` uint8 [*B, 3, H, W] of each
    camera, ``("observation", "state")`` float32 [*B, 7] and ``language_instruction``. Writes ``("vla_action", "loc")``
    and ``("vla_action", "log_scale")``, float32 [*B, C, 7] in the env's normalised action units.

    A subclass calls ``super().__init__`` with what it is trained for, and implements :meth:`predict`,
    :meth:`fit_statistics`, :meth:`scale_parameters` and :meth:`post_training_parameters`. With
    :class:`~worldenv_trl.pretrained.Pretrained` beside it and the settings in its config, all of that is saved with its
    weights, and :func:`~worldenv_trl.policies.check_pairing` holds an env against it.

    Keyword Args:
        cameras: scene cameras whose images it reads, in order.
        image_size: height and width of the images (px).
        chunk_length: C.
        proprio: what the state tells, ``commanded`` (the controller's targets) or ``measured``.
        instructions: those it is trained on; others are answered with a warning. Empty: it never warns.

    Attributes:
        action_range: half the range that the training uses of each action dimension, [7], in normalised units; a buffer
            that is 1 until :meth:`fit_statistics` sets it.

    Raises:
        ValueError: for no camera, one that is named twice, a size below 1, or another kind of proprioception; when
            called, for an image that is missing, and images, states or predictions of another size.
    """

    action_range: Tensor

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
        if min(image_size, chunk_length) < 1:
            raise ValueError(f"image_size and chunk_length must be at least 1, got {image_size} and {chunk_length}")
        if proprio not in ("commanded", "measured"):
            raise ValueError(f"proprio must be 'commanded' or 'measured', got {proprio!r}")
        self.cameras, self.image_size = tuple(cameras), int(image_size)
        self.chunk_length, self.proprio = int(chunk_length), proprio
        self.seen = SeenInstructions(f"the policy {type(self).__name__}", instructions)
        self.register_buffer("action_range", torch.ones(ACTION_DIM))
        self.in_keys = [*(image_key(camera) for camera in self.cameras), STATE, INSTRUCTION]
        self.out_keys = [LOC, LOG_SCALE]

    @property
    def instructions(self) -> tuple[str, ...]:
        """What it was trained on."""
        return self.seen.instructions

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

    @abc.abstractmethod
    def fit_statistics(self, states: Tensor, actions: Tensor) -> None:
        """Takes :attr:`action_range`, and what normalisation needs, from training data, [..., 7] each."""

    @abc.abstractmethod
    def scale_parameters(self) -> Iterable[nn.Parameter]:
        """Parameters of the scale alone, for the stage that trains nothing else (World-Env Eq. 8).

        ``loc`` does not depend on them, so a loss on ``loc`` leaves them without a gradient.
        """

    @abc.abstractmethod
    def post_training_parameters(self, rank: int) -> dict[str, list[nn.Parameter]]:
        """Prepares for LOOP and returns the groups that it updates, ``adapters`` and ``heads``; the rest is frozen.

        Adapters of that rank are added where there are none yet, without changing what the policy does; again with the
        same rank, it returns the same groups. ``adapters`` is empty for a policy that has none. Rank 0 adds none and
        gives, as ``backbone``, what the adapters would have adapted. Build losses and optimisers after this call.

        Raises:
            ValueError: if there are adapters of another rank.
        """

    def require_gradients(self) -> None:
        """Called by what is about to score or to train it: raises for a policy whose actions have no gradient."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch, observed = self.observed(tensordict)
        loc, log_scale = self._of_shape(self.predict(*observed), batch.numel())
        shape = (*batch, self.chunk_length, ACTION_DIM)
        tensordict.set(LOC, loc.float().reshape(shape))
        return tensordict.set(LOG_SCALE, log_scale.float().reshape(shape))

    def _of_shape(self, predicted: tuple[Tensor, Tensor], rows: int) -> tuple[Tensor, Tensor]:
        shape = (rows, self.chunk_length, ACTION_DIM)
        values = predicted if isinstance(predicted, tuple) else (predicted,)
        found = [tuple(each.shape) if isinstance(each, Tensor) else type(each).__name__ for each in values]
        if found == [shape, shape]:
            return predicted
        got = ", ".join(map(str, found))
        raise ValueError(
            f"{type(self).__name__}.predict must give loc and log_scale, {shape} each for {rows} rows and its "
            f"chunk_length of {self.chunk_length}, got {got}"
        )

    def observed(self, tensordict: TensorDictBase) -> tuple[torch.Size, tuple[dict[str, Tensor], Tensor, list[str]]]:
        """The batch size of a TensorDict [*B], and what :meth:`predict` takes of it, rows flattened.

        Raises:
            ValueError: for an image or a goal that is missing, and images or states of another size.
        """
        state = tensordict[STATE]
        batch = state.shape[:-1]  # dispatched entries come without a batch size
        if state.shape[-1] != STATE_DIM:
            raise ValueError(f"{STATE} must be [*B, {STATE_DIM}], got {list(state.shape)}")
        images = {camera: self._image(tensordict, camera, batch) for camera in self.cameras}
        instructions = self._goals(tensordict, batch.numel())
        return batch, (images, state.reshape(-1, STATE_DIM), instructions)

    @torch.compiler.disable  # texts are no tensors: a compiled graph would be made anew for each mixture of them
    def _goals(self, tensordict: TensorDictBase, rows: int) -> list[str]:
        instructions = instructions_of(tensordict)
        if len(instructions) == 1:
            instructions = instructions * rows
        if len(instructions) != rows:
            raise ValueError(f"{INSTRUCTION} must be one text, or one for each of {rows} rows, got {len(instructions)}")
        self.seen.check(instructions)
        return instructions

    def _image(self, tensordict: TensorDictBase, camera: str, batch: torch.Size) -> Tensor:
        key, size = image_key(camera), (3, self.image_size, self.image_size)
        image = tensordict.get(key, None)
        if image is None:
            raise ValueError(
                f"this policy was trained for the cameras {', '.join(self.cameras)}; the tensordict has no {key} of "
                f"{camera!r}: pass cameras={self.cameras} to the env"
            )
        if image.dtype != torch.uint8 or tuple(image.shape) != (*batch, *size):
            raise ValueError(f"{key} must be uint8 {[*batch, *size]}, got {image.dtype} {list(image.shape)}")
        return image.reshape(-1, *size)


@runtime_checkable
class Aims(Protocol):
    """A policy that can say where on each camera's image it takes the hand to go."""

    def aiming(self) -> AbstractContextManager[dict[str, Tensor]]:
        """While it is open, ``predict`` leaves the log-probabilities [n, h, w] of the image's cells, by camera."""
        ...


def check_rank(rank: int, present: int) -> None:
    """Raises ``ValueError`` for adapters of a negative rank, or of another than a policy has (``present``; 0: none)."""
    if rank < 0:
        raise ValueError(f"rank must not be negative, got {rank}")
    if present not in (0, rank):
        raise ValueError(f"this policy has adapters of rank {present}: it cannot get some of {rank}")
