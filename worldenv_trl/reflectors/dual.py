"""A reflector of imagination that is asked in the world, too, beside one that looks at what happens there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.pretrained import Pretrained
from worldenv_trl.reflectors.base import Lesson, Reflector
from worldenv_trl.reflectors.compact import CompactReflector, CompactReflectorConfig
from worldenv_trl.reflectors.compact_lessons import CompactLessons
from worldenv_trl.reflectors.path import PathReflector, PathReflectorConfig
from worldenv_trl.reflectors.path_lessons import PathLessons

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes

__all__ = ["DualReflector", "DualReflectorConfig"]

_NEVER_SURE = 1e-5  # a score of 1 would outvote any other
_DEFAULT_VIDEO_LESSONS, _DEFAULT_PATH_LESSONS = CompactLessons(), PathLessons()


@dataclass(frozen=True)
class DualReflectorConfig:
    """Of the two judges of a :class:`DualReflector`.

    Raises:
        ValueError: if they are not for the same instructions, or the path's looks through a camera that the video's
            does not.
    """

    video: CompactReflectorConfig
    path: PathReflectorConfig

    def __post_init__(self) -> None:
        if set(self.video.instructions) != set(self.path.instructions):
            raise ValueError(
                "video and path must be for the same instructions, got "
                f"{self.video.instructions} and {self.path.instructions}"
            )
        others = [camera for camera in self.path.cameras if camera not in self.video.cameras]
        if others:
            raise ValueError(f"path must look through cameras of video, {self.video.cameras}, got {tuple(others)} too")

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> DualReflectorConfig:
        return cls(CompactReflectorConfig(**fields["video"]), PathReflectorConfig.from_dict(fields["path"]))


class DualReflector(Reflector, Pretrained):
    """A :class:`PathReflector` judges imagined rollouts, it and a :class:`CompactReflector` those of the world.

    Imagined frames show what the world model believes would have happened: inside a LOOP group that says less of the
    truth than the commanded path over the real first frame. Real frames show what happened; the path says where the
    hand was when it did. They err in different places, and in the world R is the mean of both log-odds.
    :meth:`for_world` gives the one or the other; where nobody asks, it is the world's.

    Args:
        config: of both.
        video_lessons, path_lessons: how long either learns in :meth:`train_on`; not saved.
    """

    config_class = DualReflectorConfig

    def __init__(
        self,
        config: DualReflectorConfig,
        video_lessons: CompactLessons = _DEFAULT_VIDEO_LESSONS,
        path_lessons: PathLessons = _DEFAULT_PATH_LESSONS,
    ) -> None:
        super().__init__(
            cameras=config.video.cameras,
            image_size=config.video.image_size,
            instructions=config.video.instructions,
            reads_path=True,
        )
        self.config = config
        self.video = CompactReflector(config.video, video_lessons)
        self.path = PathReflector(config.path, path_lessons)
        self.video.seen = self.path.seen = self.seen  # of what neither was trained on there is one warning

    def for_world(self, world: str) -> Reflector:
        return self.path if world == "imagined" else self

    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        states = {"video": self.video.begin(frames, instructions), "path": self.path.begin(frames, instructions)}
        state = TensorDict(states, batch_size=[len(instructions)])
        return state.set("score", _together(*(each["score"] for each in states.values())))

    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        video, seen = self.video.extend(state["video"], frames)
        path, gone = self.path.extend(state["path"], frames)
        scores = _together(seen, gone)
        return TensorDict({"video": video, "path": path, "score": scores[:, -1]}, batch_size=[len(scores)]), scores

    def train_on(self, episodes: Episodes) -> Iterator[Lesson]:
        """The lessons of the video's judge, then those of the path's.

        Raises:
            ValueError: as :meth:`CompactReflector.train_on` and :meth:`PathReflector.train_on`, at once.
        """
        lessons = [self.video.train_on(episodes), self.path.train_on(episodes)]
        return (lesson for part in lessons for lesson in part)

    def training_loss(self, batch: TensorDictBase) -> TensorDict:
        """That of the judge whose lesson drew the batch."""
        of_path = not {"path", "place"}.isdisjoint(batch.keys())
        return (self.path if of_path else self.video).training_loss(batch)


def _together(seen: Tensor, gone: Tensor) -> Tensor:
    """The probability whose log-odds are the mean of those of two."""
    return ((seen.logit(_NEVER_SURE) + gone.logit(_NEVER_SURE)) / 2).sigmoid()
