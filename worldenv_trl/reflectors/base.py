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
    """One stage of a reflector's training: what is updated, on what, and for how long.

    The loop is the caller's, so that it can be interrupted and continued. It draws ``steps`` batches, one a step, from
    torch's global generator alone, and updates ``parameters`` by AdamW; the learning rate rises to ``lr`` and falls
    again (:class:`torch.optim.lr_scheduler.OneCycleLR` over ``steps``).
    """

    name: str
    parameters: list[nn.Parameter]
    sample: Callable[[], TensorDict]
    """Draws a batch, as :meth:`Reflector.training_loss` reads it."""
    steps: int
    lr: float
    weight_decay: float = 0.0
    by_epochs: bool = False
    """Whether ``steps`` follow from the number of episodes: of twice as many it learns twice as long."""


class Reflector(nn.Module, abc.ABC):
    """Judges videos as they grow.

    A subclass calls ``super().__init__`` with what it is trained for, and implements :meth:`begin` and :meth:`extend`;
    one that learns also :meth:`train_on` and :meth:`training_loss`. With :class:`~worldenv_trl.pretrained.Pretrained`
    beside it, it is saved and loaded like every part. It keeps nothing between calls: what it remembers of the videos
    is in the state, so that rows can be taken out and put back in any number.

    Keyword Args:
        cameras: scene cameras whose frames it looks at.
        image_size: height and width of the frames (px), None for any.
        instructions: those it is trained on. One that has some calls ``self.seen.check(instructions)`` in
            :meth:`begin`, which warns of others.
        reads_path: whether it also reads where the hand goes. ``frames`` then have the entry ``kinematic_states``
            beside the cameras, float32 [n, 20] of the first frame and [n, C, 20] of the next ones: commanded, so the
            same in physics and imagination.
        reads_video: whether it looks at more than the first frame. One that does not says the same of a rollout and of
            what a world model imagines of its actions.

    Raises:
        ValueError: for no camera, or one that is named twice.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> class Brightness(Reflector):
        ...     def begin(self, frames, instructions):
        ...         score = frames["agentview"].float().mean((-3, -2, -1)) / 255
        ...         return TensorDict({"score": score}, batch_size=[len(score)])
        ...     def extend(self, state, frames):
        ...         scores = frames["agentview"].float().mean((-3, -2, -1)) / 255
        ...         return state.copy().set("score", scores[:, -1]), scores
        >>> reflector = Brightness()
        >>> state = reflector.begin({"agentview": torch.zeros(2, 3, 16, 16, dtype=torch.uint8)}, ["shine", "glow"])
        >>> bright = torch.full((2, 8, 3, 16, 16), 255, dtype=torch.uint8)
        >>> state, scores = reflector.extend(state, {"agentview": bright})
        >>> scores.shape, state["score"]
        (torch.Size([2, 8]), tensor([1., 1.]))
    """

    def __init__(
        self,
        *,
        cameras: Sequence[str] = ("agentview",),
        image_size: int | None = None,
        instructions: Sequence[str] = (),
        reads_path: bool = False,
        reads_video: bool = True,
    ) -> None:
        super().__init__()
        if not cameras or len(set(cameras)) < len(cameras):
            raise ValueError(f"cameras must name at least one camera, each once, got {tuple(cameras)}")
        self.cameras, self.image_size = tuple(cameras), image_size
        self.reads_path, self.reads_video = reads_path, reads_video
        self.seen = SeenInstructions(f"the reflector {type(self).__name__}", instructions)

    @property
    def instructions(self) -> tuple[str, ...]:
        """What it was trained on."""
        return self.seen.instructions

    @abc.abstractmethod
    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        """The state [n] of n videos of which only the first frame is known.

        Args:
            frames: uint8 [n, 3, H, W] by camera, and ``kinematic_states`` where it ``reads_path``.
            instructions: n texts.

        Returns:
            TensorDict [n]: ``score`` float32 [n], R of the first frame, and whatever else the reflector keeps: tensors
            (features, not frames) and texts. Tensors may grow along their second dimension from call to call; rows that
            are shorter than others are padded with zeros.
        """

    @abc.abstractmethod
    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        """The state after the next C frames, uint8 [n, C, 3, H, W] by camera (none for one that reads no video), and R
        after each of them, [n, C].

        The scores of a video are the same in whatever pieces its frames come. ``state`` itself is not changed; the new
        one has the same entries.
        """

    def for_world(self, world: str) -> Reflector:
        """Who judges rollouts of a ``world``, ``real`` or ``imagined``: itself, unless it has others for that."""
        return self

    def train_on(self, episodes: Episodes) -> Iterator[Lesson]:
        """The lessons to train on labelled ``episodes``, one after the other; none for a reflector that is not trained.

        A lesson is asked for when the one before is over, so that it may build on what was learned. A training that is
        continued loads the weights, asks for the lessons that are over and leaves them out.
        """
        return iter(())

    def training_loss(self, batch: TensorDictBase) -> TensorDict:
        """``loss_reflector`` (scalar) and the detached ``accuracy`` of a batch that a lesson drew."""
        raise TypeError(f"{type(self).__name__} is not trained: it has no lessons")


def check_scores(reflector: Reflector, call: str, scores: Tensor, shape: tuple[int, ...]) -> None:
    """Raises ``ValueError`` unless what a reflector's ``begin`` or ``extend`` gave are probabilities of that shape."""
    what = "state['score']" if call == "begin" else "scores"
    name = f"{type(reflector).__name__}.{call}: {what}"
    if tuple(scores.shape) != shape:
        raise ValueError(f"{name} must be {shape}, got {tuple(scores.shape)}")
    inside = (scores >= 0) & (scores <= 1)  # NaN is not
    if not bool(inside.all()):
        raise ValueError(f"{name} must be probabilities, in [0, 1], got {scores[~inside][0].item():g}")
