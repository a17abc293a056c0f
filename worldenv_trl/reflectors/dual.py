"""One reflector for real frames, another for imagination."""

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

_DEFAULT_VIDEO_LESSONS, _DEFAULT_PATH_LESSONS = CompactLessons(), PathLessons()


@dataclass(frozen=True)
class DualReflectorConfig:
    """Of the two judges of a :class:`DualReflector`.

    Raises:
        ValueError: if they are not for the same instructions.
    """

    video: CompactReflectorConfig
    path: PathReflectorConfig

    def __post_init__(self) -> None:
        if set(self.video.instructions) != set(self.path.instructions):
            raise ValueError(
                "video and path must be for the same instructions, got "
                f"{self.video.instructions} and {self.path.instructions}"
            )

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> DualReflectorConfig:
        return cls(CompactReflectorConfig(**fields["video"]), PathReflectorConfig.from_dict(fields["path"]))


class DualReflector(Reflector, Pretrained):
    """A :class:`CompactReflector` that judges real frames and a :class:`PathReflector` that judges imagined rollouts.

    Real frames show what happened, and whoever looks at them is right more often than any prediction. Imagined frames
    show what the world model believes would have happened: inside a LOOP group that says less of the truth than the
    commanded path over the real first frame. :meth:`for_world` gives the one or the other; where nobody asks, the
    video is judged.

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
            cameras=config.video.cameras, image_size=config.video.image_size, instructions=config.video.instructions
        )
        self.config = config
        self.video = CompactReflector(config.video, video_lessons)
        self.path = PathReflector(config.path, path_lessons)

    def for_world(self, world: str) -> Reflector:
        return self.path if world == "imagined" else self.video

    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        return self.video.begin(frames, instructions)

    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        return self.video.extend(state, frames)

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
