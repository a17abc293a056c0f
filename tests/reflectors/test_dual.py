"""Who judges in which world."""

from __future__ import annotations

import pytest
import torch
from test_path import FRONT, SIZE, TEXTS, touching
from videos import work_through

from worldenv_trl.data import score_episodes
from worldenv_trl.reflectors import (
    CompactLessons,
    CompactReflectorConfig,
    DualReflector,
    DualReflectorConfig,
    PathLessons,
    PathReflectorConfig,
)


def make(texts=TEXTS):
    torch.manual_seed(0)
    return DualReflector(
        DualReflectorConfig(
            CompactReflectorConfig(TEXTS, ("front",), image_size=SIZE, widths=(8, 12, 16)),
            PathReflectorConfig.for_cameras({"front": {text: FRONT for text in texts}}, image_size=SIZE),
        ),
        CompactLessons(encoder_steps=2, steps=2, batch_size=4),
        PathLessons(epochs=1, place_epochs=1, batch_size=4),
    )


def test_imagined_rollouts_are_judged_by_their_path_and_real_ones_by_what_they_show():
    reflector, episodes = make().eval(), touching(6, 0)
    assert reflector.for_world("imagined") is reflector.path and reflector.for_world("real") is reflector.video
    real, imagined = (score_episodes(reflector.for_world(world), episodes) for world in ("real", "imagined"))
    assert torch.equal(score_episodes(reflector, episodes), real) and (real != imagined).any()
    assert not reflector.for_world("imagined").reads_video and reflector.reads_video


def test_each_lesson_teaches_the_judge_that_it_is_for_and_no_other():
    reflector, changed = make(), []
    before = {name: value.clone() for name, value in reflector.state_dict().items()}
    for lesson in reflector.train_on(touching(8, 0)):
        work_through(reflector)(lesson)
        now = reflector.state_dict()
        changed.append(
            (lesson.name, {n.split(".")[0] for n, value in before.items() if not torch.equal(value, now[n])})
        )
        before = {name: value.clone() for name, value in now.items()}
    # The statistics of the path are fitted when its first lesson begins.
    assert changed == [("encoder", {"video"}), ("head", {"video"}), ("places", {"path"}), ("paths", {"path"})]


def test_both_are_saved_and_loaded_together(tmp_path):
    reflector, episodes = make().eval(), touching(4, 0)
    reflector.save_pretrained(tmp_path)
    again = DualReflector.from_pretrained(tmp_path).eval()
    for world in ("real", "imagined"):
        scores = (score_episodes(each.for_world(world), episodes) for each in (reflector, again))
        assert torch.equal(*scores)


def test_judges_of_other_instructions_are_refused():
    with pytest.raises(ValueError, match="video and path must be for the same instructions"):
        make(texts=TEXTS[:1])
