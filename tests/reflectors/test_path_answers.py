"""A path reflector does not take how a hand answers for what it did: where it cannot answer, R is as right."""

from __future__ import annotations

import pytest
import torch
from test_path import FRONT, SIZE, TEXTS, begun, further, make, paths, scenes, showing
from videos import Videos, work_through

from worldenv_trl.data import score_episodes
from worldenv_trl.reflectors import PathLessons

DOWN, STEPS = 5, 14  # frame at which hands have come down, and of an episode


def grasps(count, seed, *, answers):
    """Hands that come down on a block or beside it. Those that miss go back up if they can answer to it, and on as the
    others do if not."""
    generator = torch.Generator().manual_seed(seed)
    block = torch.cat([0.16 * torch.rand(count, 2, generator=generator) - 0.08, torch.full((count, 1), 0.05)], -1)
    hand = block + torch.cat([0.12 * torch.rand(count, 2, generator=generator) - 0.06, torch.zeros(count, 1)], -1)
    pixels = [torch.from_numpy(FRONT.project(each.numpy(), SIZE)) for each in (block, hand)]
    took = (pixels[0] - pixels[1]).norm(dim=-1) < 2.0
    frame = torch.arange(STEPS + 1)
    way = hand.unsqueeze(1).repeat(1, STEPS + 1, 1)
    way[..., 2] += 0.03 * (DOWN - frame).clamp(min=0)
    after = (frame - DOWN - 3).clamp(min=0)
    on = torch.stack([0.02 * after, torch.zeros(STEPS + 1), 0.01 * after], -1)
    back = torch.stack([-0.02 * after, torch.zeros(STEPS + 1), 0.03 * after], -1)
    way += torch.where((took | (not answers))[:, None, None], on, back)
    reached = took.unsqueeze(1) & (frame >= STEPS - 2)
    episodes = Videos({"front": showing(pixels[0], STEPS, generator)}, [TEXTS[0]] * count, reached, [0] * count)
    states = torch.zeros(count, STEPS + 1, 20)
    states[..., 7:10], states[..., 10:19] = way, torch.eye(3).flatten()
    episodes["kinematic_states"] = states
    return episodes


def surprise(reflector, episodes):
    """Cross-entropy of how episodes end and R at the end, nats."""
    chance, success = score_episodes(reflector, episodes)[:, -1], episodes["success"].any(1)
    assert 0.2 < success.float().mean() < 0.8
    return torch.nn.functional.binary_cross_entropy(chance, success.float()).item()


def test_it_knows_in_a_dream_what_it_learned_where_hands_answer():
    found = {}
    for frames in (0, 2):
        lessons = PathLessons(steps=150, place_steps=60, batch_size=32)
        reflector = make(lessons=lessons, members=1, stride=1, window=0.4, crop_size=13, open_loop_frames=frames)
        for lesson in reflector.train().train_on(grasps(256, 0, answers=True)):
            work_through(reflector)(lesson)
        for answers in (True, False):
            found[frames, answers] = surprise(reflector.eval(), grasps(200, 1, answers=answers))
    assert found[0, True] < 0.2 and found[2, True] < 0.4
    assert found[2, False] < min(0.4, 0.6 * found[0, False]), found


@pytest.mark.parametrize(("stride", "open_loop"), [(1, 2), (2, 3), (3, 4), (1, 0)])
def test_the_score_is_the_mean_of_the_whole_path_and_of_promise_times_when(stride, open_loop):
    reflector, states, first = make(stride=stride, open_loop_frames=open_loop), paths(4, 15), scenes(4)
    heights = [[0.2] * 16, [0.2, 0.15, 0.1, 0.05] + [0.05] * 12, [0.2] * 9 + [0.1] * 7, [0.2] * 13 + [0.1] * 3]
    states[..., 9] = torch.tensor(heights)
    looks = -(-open_loop // stride)
    asked = []  # by hand: the first look 3 cm below the beginning from which the next falls by less than 1 cm
    for height in heights:
        seen = height[::stride]
        down = [k for k in range(len(seen) - 1) if seen[0] - seen[k] > 0.03 and seen[k] - seen[k + 1] < 0.01]
        asked.append(down[0] + looks if down else 99)
    texts = [TEXTS[0]] * 4
    state = begun(reflector, first, states, texts)
    streamed = [state["score"].unsqueeze(1)]
    for start, stop in ((1, 6), (6, 7), (7, 16)):
        state, scores = further(reflector, state, states, start, stop)
        streamed.append(scores)
    view, words, levels = reflector.views_of(texts), reflector.vocabulary.ids(texts), reflector.places.levels(texts)
    poses = states[:, ::stride, 7:20]
    crops = reflector.crops(first["front"].unsqueeze(1), view, poses)
    _, places = reflector.places(first["front"].unsqueeze(1), view, words, levels)
    chances = reflector.logits(reflector.look(crops), reflector.path(poses, places), words).sigmoid().mean(2)
    assert chances.shape[-1] == (3 if open_loop else 1)
    for row in range(4):
        for frame, score in enumerate(torch.cat(streamed, 1)[row].tolist()):
            look = frame // stride
            expected = whole = chances[row, look, 0].item()
            if open_loop:
                when, promised = chances[row, look, 1].item(), chances[row, min(look, asked[row]), 2].item()
                expected = (whole + when * promised) / 2
            assert score == pytest.approx(expected, abs=1e-5)


def learning():
    """A reflector that asks open loop, and paths of hands that answer."""
    reflector = make(lessons=PathLessons(steps=1, batch_size=8), open_loop_frames=2)
    for lesson in reflector.train_on(grasps(8, 0, answers=True)):
        batch = lesson.sample()
    succeeds = batch["label"].any(1)
    assert 0 < succeeds.sum() < len(succeeds)
    return reflector, batch, succeeds


def slopes(reflector, batch):
    """Of each member's last layer: one row of each answer, whole path, when and promise."""
    reflector.zero_grad()
    reflector.training_loss(batch)["loss_reflector"].backward()
    return [member.head[-1].weight.grad.clone() for member in reflector.members]


def test_when_is_learned_from_episodes_that_succeed_and_the_others_from_all():
    reflector, batch, succeeds = learning()
    for slope in slopes(reflector, batch[succeeds]):
        assert slope.abs().amax(1).min() > 0
    for whole, when, promise in slopes(reflector, batch[~succeeds]):
        assert whole.any() and promise.any() and not when.any()


@pytest.mark.parametrize("of_all", [True, False])
def test_the_promise_does_not_read_what_comes_later_and_when_not_what_failures_do(of_all):
    reflector, batch, succeeds = learning()
    later, moved = batch.clone(), torch.ones_like(succeeds) if of_all else ~succeeds
    later["path"][moved, int(batch["asked"].max()) + 1 :] += 1
    for before, after in zip(slopes(reflector, batch), slopes(reflector, later), strict=True):
        torch.testing.assert_close(after[2], before[2])
        assert not torch.allclose(after[0], before[0])
        assert torch.allclose(after[1], before[1]) != of_all


def test_it_is_asked_once_whatever_comes_later():
    reflector = make(stride=2, open_loop_frames=3)
    hands = torch.zeros(3, 8, 3)
    hands[0, :, 2] = torch.tensor([0.3, 0.2, 0.1, 0.1, 0.3, 0.3, 0.1, 0.1])
    hands[1, :, 2] = 0.3
    hands[2, :, 2] = torch.linspace(0.3, 0.0, 8)
    asked = reflector.asked(hands)
    assert asked[0] == 2 + 2 and (asked[1:] >= 8).all()


def test_time_does_not_run_backwards():
    with pytest.raises(ValueError, match="open_loop_frames must be at least 0, got -1"):
        make(open_loop_frames=-1)
