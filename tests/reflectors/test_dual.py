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


def make(texts=TEXTS, camera="front"):
    torch.manual_seed(0)
    return DualReflector(
        DualReflectorConfig(
            CompactReflectorConfig(TEXTS, (camera,), image_size=SIZE, widths=(8, 12, 16)),
            PathReflectorConfig.for_cameras({"front": {text: FRONT for text in texts}}, image_size=SIZE),
        ),
        CompactLessons(encoder_frames=8, prefixes=8, batch_size=4),
        PathLessons(epochs=1, place_epochs=1, batch_size=4),
    )


def test_imagined_rollouts_are_judged_by_their_path_and_real_ones_by_what_they_show_too():
    reflector, episodes = make().eval(), touching(6, 0)
    assert reflector.for_world("imagined") is reflector.path and reflector.for_world("real") is reflector
    assert not reflector.for_world("imagined").reads_video and reflector.reads_video and reflector.reads_path
    seen, gone, real = (
        score_episodes(judge, episodes).double() for judge in (reflector.video, reflector.path, reflector)
    )
    assert (seen != gone).any()
    odds = (seen / (1 - seen) * gone / (1 - gone)).sqrt()
    torch.testing.assert_close(real, odds / (1 + odds), rtol=1e-4, atol=1e-5)


def test_who_is_sure_does_not_outvote_the_other():
    reflector, episodes = make().eval(), touching(6, 0)
    with torch.no_grad():
        reflector.video.head[-1].bias.fill_(1e4)
        for member in reflector.path.members:
            member.head[-1].bias.fill_(-20.0)
    scores = score_episodes(reflector, episodes)
    assert (scores - 0.5).abs().max() < 1e-3


def test_scores_are_the_same_in_whatever_pieces_frames_come():
    reflector, episodes = make().eval(), touching(4, 0)
    rows, last = torch.arange(4), episodes["actions"].shape[1]

    def shown(steps):
        frames = {"front": episodes.frames("front", rows.unsqueeze(-1), steps)}
        return frames | {"kinematic_states": episodes["kinematic_states"][:, steps]}

    first = {name: each[:, 0] for name, each in shown(torch.tensor([0])).items()}
    state, scores = reflector.begin(first, episodes.instructions), []
    for steps in torch.arange(1, last + 1).split(3):
        before, copy = state, state.clone()
        state, found = reflector.extend(before, shown(steps))
        assert (before == copy).all() and torch.equal(state["score"], found[:, -1])
        scores.append(found)
    torch.testing.assert_close(torch.cat(scores, 1), score_episodes(reflector, episodes)[:, 1:], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("world", ["real", "imagined"])
def test_of_an_instruction_that_neither_was_trained_on_there_is_one_warning(world):
    judge, episodes = make().eval().for_world(world), touching(2, 0)
    first = {"front": episodes.frames("front", torch.arange(2), torch.zeros(2, dtype=torch.int64))}
    with pytest.warns(UserWarning, match="DualReflector was never trained on the instruction 'juggle'") as caught:
        for _ in range(2):
            judge.begin(first | {"kinematic_states": episodes["kinematic_states"][:, 0]}, ["juggle"] * 2)
    assert len(caught) == 1


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


def test_a_path_over_what_the_video_does_not_show_is_refused():
    with pytest.raises(ValueError, match=r"path must look through cameras of video, \('side',\), got \('front',\)"):
        make(camera="side")
