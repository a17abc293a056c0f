"""What every reflector is: R(o_1:t, g), the probability that the task is done by frame t (World-Env section 3.3)."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from worldenv_trl.language import SeenInstructions

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes

__all__ = ["Lesson", "Reflector"]


@dataclass(frozen=True)
class Lesson:
    """One stage of a reflector's training: what is updated, on what, and for how long."""

    name: str
    parameters: list[nn.Parameter]
    sample: Callable[[], TensorDict]
    """Draws a batch, as :meth:`Reflector.training_loss` reads it."""
    steps: int
    lr: float
    weight_decay: float = 0.0


class Reflector(nn.Module, abc.ABC):
    """Judges videos as they grow.

    A subclass calls ``super().__init__`` with what it is trained for, and implements :meth:`begin` and :meth:`extend`;
    one that learns also :meth:`train_on` and :meth:`training_loss`.

    Keyword Args:
        cameras: scene cameras whose frames it looks at.
        image_size: height and width of the frames (px), None for any.
        instructions: those it is trained on; others are answered with a warning.
    """

    def __init__(
        self,
        *,
        cameras: Sequence[str] = ("agentview",),
        image_size: int | None = None,
        instructions: Sequence[str] = (),
    ) -> None:
        super().__init__()
        if not cameras or len(set(cameras)) < len(cameras):
            raise ValueError(f"cameras must name at least one camera, each once, got {tuple(cameras)}")
        self.cameras, self.image_size = tuple(cameras), image_size
        self.seen = SeenInstructions(f"the reflector {type(self).__name__}", instructions)

    @property
    def instructions(self) -> tuple[str, ...]:
        """What it was trained on."""
        return self.seen.instructions

    @abc.abstractmethod
    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        """The state [n] of n videos of which only the first frame is known.

        Args:
            frames: uint8 [n, 3, H, W] by camera.
            instructions: n texts.

        Returns:
            TensorDict [n]: ``score`` float32 [n], R of the first frame, and whatever else the reflector keeps (features,
            not frames). Entries may grow along their second dimension from call to call, padded with zeros.
        """

    @abc.abstractmethod
    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        """The state after the next C frames, uint8 [n, C, 3, H, W] by camera, and R after each of them, [n, C]."""

    def train_on(self, episodes: Episodes) -> Iterator[Lesson]:
        """The lessons to train on labelled ``episodes``, one after the other; none for a reflector that is not trained.

        A lesson is asked for when the one before is over, so that it may build on what was learned.
        """
        return iter(())

    def training_loss(self, batch: TensorDictBase) -> TensorDict:
        """``loss_reflector`` (scalar) and the detached ``accuracy`` of a batch that a lesson drew."""
        raise TypeError(f"{type(self).__name__} is not trained: it has no lessons")
