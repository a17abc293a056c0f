"""What the compact reflector's two lessons draw, and what is learned from them."""

from __future__ import annotations

import pytest
import torch
from videos import Videos, patches, work_through

from worldenv_trl.data import score_episodes
from worldenv_trl.reflectors import CompactLessons, CompactReflector, CompactReflectorConfig
from worldenv_trl.reflectors.compact_lessons import FrameSampler, blurred, encode_all

SIDES = ("put the left bowl on the right bowl", "put the right bowl on the left bowl")  # the same words


def make(texts=SIDES, cameras=("agentview",), **lessons):
    torch.manual_seed(0)
    config = CompactReflectorConfig(texts, cameras, image_size=16, num_frames=6, widths=(8, 12, 16))
    return CompactReflector(config, CompactLessons(**lessons))


def test_both_lessons_together_learn_what_each_of_two_goals_of_the_same_words_asks_for():
    reflector, training = make(encoder_frames=1600, prefixes=1280), patches(64, SIDES)
    teach = work_through(reflector)
    names = []
    for lesson in reflector.train_on(training):
        losses = teach(lesson)
        assert sum(losses[-10:]) < 0.5 * sum(losses[:10]), lesson.name
        names.append(lesson.name)
    assert names == ["encoder", "head"]
    held_out = patches(32, SIDES, seed=1)
    scores = score_episodes(reflector.eval(), held_out)
    assert ((scores > 0.5) == held_out["success"]).float().mean() > 0.95


def test_a_lesson_updates_its_own_part_only():
    reflector, training = make(encoder_frames=32, prefixes=32), patches(8, SIDES)
    before = {name: value.clone() for name, value in reflector.state_dict().items()}
    changed = []
    for lesson in reflector.train_on(training):
        work_through(reflector)(lesson)
        now = reflector.state_dict()
        changed.append({name.split(".")[0] for name, value in before.items() if not torch.equal(value, now[name])})
        before = {name: value.clone() for name, value in now.items()}
    assert changed == [{"encoder", "frame_hidden", "frame_goal"}, {"query", "key", "age", "head"}]
    assert not any(parameter.requires_grad for parameter in reflector.encoder.parameters())
    assert len(reflector.encoder_parameters() + reflector.head_parameters()) == len(list(reflector.parameters()))


def test_the_second_lesson_builds_on_the_encoder_as_it_is_when_it_is_asked_for():
    training = patches(8, SIDES)

    def head_batch(reflector):
        lessons = reflector.train_on(training)
        next(lessons)
        torch.nn.init.normal_(next(reflector.encoder.parameters()), generator=torch.Generator().manual_seed(1))
        torch.manual_seed(2)
        return next(lessons).sample()

    assert (head_batch(make()) == head_batch(make())).all()  # a run that is continued draws the same
    torch.manual_seed(2)
    lessons = make().train_on(training)
    next(lessons)
    assert (next(lessons).sample()["features"] - head_batch(make())["features"]).abs().max() > 0.1


def test_frames_are_read_as_they_are_drawn_and_in_parts():
    training = patches(40, SIDES, frames=9)
    lessons = make(batch_size=4).train_on(training)
    batch = next(lessons).sample()
    assert training.most_frames == len(batch) == 8
    next(lessons)
    assert training.most_frames <= 16 * 9


def test_a_frame_and_the_first_of_its_video_are_moved_alike():
    film = torch.zeros(4, 3, 3, 16, 16, dtype=torch.uint8)
    film[..., 5:8, 8:11] = 250
    data = Videos({"agentview": film}, [SIDES[0]] * 4, torch.tensor([[False, False, True]] * 4))
    lesson, moves = next(make(batch_size=8).train_on(data)), set()
    for _ in range(20):
        batch = lesson.sample()
        places = set()
        for name in ("frames", "first"):
            bright = (batch[name, "image"][:, 0] - 60).clamp(min=0)  # [P, 16, 16]
            weight = bright.sum((1, 2))
            row, column = ((bright.sum(dim) * torch.arange(16)).sum(1) / weight for dim in (2, 1))
            places |= set(zip(row.round().int().tolist(), column.round().int().tolist(), strict=True))
        assert len(places) == 1
        moves |= places
    assert {row for row, _ in moves} <= set(range(4, 9)) and {column for _, column in moves} <= set(range(7, 12))
    assert len(moves) > 5


def test_two_cameras_are_trained_on():
    one = patches(16, SIDES)
    both = Videos(
        {"agentview": torch.zeros_like(one.films["agentview"]), "wrist": one.films["agentview"]},
        one.instructions, one["success"], one["task_id"].flatten().tolist(),
    )  # fmt: skip
    reflector = make(cameras=("agentview", "wrist"), encoder_frames=480, prefixes=16, batch_size=16)
    lesson = next(reflector.train_on(both))
    losses = work_through(reflector)(lesson)
    assert sum(losses[-10:]) < 0.6 * sum(losses[:10])  # the wrist alone shows it


def labelled(first_success, task=None, length=None):
    time = torch.arange(12)
    success = torch.stack([(time >= first) if first >= 0 else time < 0 for first in first_success])
    film = torch.zeros(len(success), 12, 3, 16, 16, dtype=torch.uint8)
    return Videos({"agentview": film}, ["open"] * len(success), success, task, length)


def test_frames_are_drawn_evenly_over_tasks_and_outcomes_and_never_past_the_end():
    data = labelled([10, 3, 2, -1, 1], [0, 1, 1, 1, 1], [11, 5, 11, 4, 11])
    row, frame = FrameSampler(data)(4000)
    assert len(row) == 4000 and (frame <= data["length"][row].squeeze(-1)).all()
    for task in (0, 1):
        drawn = data["task_id"][row].squeeze(-1) == task
        assert int(drawn.sum()) == 2000
        assert int(data["success"][row, frame][drawn].sum()) == 1000


@pytest.mark.parametrize(("tasks", "steps"), [(1, (5, 8)), (2, (10, 15)), (16, (80, 120)), (40, (80, 120))])
def test_it_learns_as_much_of_each_of_many_tasks_as_of_a_few(tasks, steps):
    episodes = labelled([10] * tasks, list(range(tasks)))  # of each a success and a failure in the same episode
    lessons = make(["open"], encoder_frames=80, prefixes=120, batch_size=16).train_on(episodes)
    assert tuple(lesson.steps for lesson in lessons) == steps


def test_features_are_those_of_the_frames_and_zero_past_the_end():
    reflector, whole = make(), patches(20, SIDES)
    data = Videos(whole.films, whole.instructions, length=[8, 8, 8, 4] + [8] * 16)
    features = encode_all(reflector, data)
    assert not features[3, 5:].any()
    for row, frame in ((0, 0), (3, 4), (19, 8)):
        alone = reflector.encode({"agentview": data.films["agentview"][row, frame][None]})[0]
        torch.testing.assert_close(features[row, frame], alone)


def test_blurring_mixes_a_frame_with_its_mean_and_keeps_what_is_even():
    frames = torch.zeros(1, 3, 5, 5)
    frames[..., 2, 2] = 90
    assert torch.equal(blurred(frames, 0.0), frames)
    torch.testing.assert_close(blurred(frames, 1.0)[..., 1:4, 1:4], torch.full((1, 3, 3, 3), 10.0))
    torch.testing.assert_close(blurred(torch.full((1, 3, 4, 4), 7), 0.5), torch.full((1, 3, 4, 4), 7.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"success": None}, "no success labels"),
        ({"camera": "wrist"}, "looks at 'agentview', the episodes show 'wrist' only"),
        ({"size": 64}, "frames of 16 px, the episodes' are 64 px"),
        ({"texts": ["juggle"]}, "'juggle' is not among them"),
    ],
)
def test_episodes_that_do_not_fit_are_refused_before_the_first_lesson(change, message):
    fits = {"camera": "agentview", "size": 16, "texts": [SIDES[0]], "success": torch.tensor([[False, True]])}
    settings = fits | change
    film = torch.zeros(1, 2, 3, settings["size"], settings["size"], dtype=torch.uint8)
    data = Videos({settings["camera"]: film}, settings["texts"], settings["success"])
    with pytest.raises(ValueError, match=message):
        make().train_on(data)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"prefixes": 0}, "at least 1"), ({"lr": 0.0}, "lr must"), ({"label_smoothing": 1.0}, "1.0")],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        CompactLessons(**settings)
