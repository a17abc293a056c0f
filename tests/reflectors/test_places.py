"""Where hands that succeed come down and end, how a first frame tells, and how a hand lies relative to that."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worldenv_trl.kinematics.calibrations import Calibrations, plain_cameras
from worldenv_trl.reflectors.places import KINDS, Places, offsets, places_of
from worldenv_trl.robot.camera import look_at

SIZE = 32
FRONT = look_at("front", (0.8, 0.0, 0.6), (0.0, 0.0, 0.1), 40.0)
BESIDE = look_at("beside", (0.0, 0.9, 0.5), (0.0, 0.0, 0.1), 45.0)
TEXTS = ("touch the block", "reach for the block")


def make(*cameras, texts=TEXTS):
    torch.manual_seed(0)
    views = [
        Calibrations(plain_cameras({"any": each})["any"]) for each in cameras or ({text: FRONT for text in texts},)
    ]
    return Places(views, SIZE, texts, num_words=5)


def hands(height, reached, step=0.01):
    """One hand [1, L, 3] that goes along x, at these heights; and by when the goal is reached [1, L]."""
    path = torch.zeros(1, len(height), 3)
    path[0, :, 0], path[0, :, 2] = step * torch.arange(len(height)), torch.tensor(height)
    return path, torch.arange(len(height)).unsqueeze(0) >= reached


def test_a_hand_has_come_down_where_it_first_stops_to_fall():
    # It waits above, falls, stops at the fourth look, and goes lower still on its way to the goal.
    path, reached = hands([0.25, 0.25, 0.20, 0.12, 0.118, 0.08, 0.03, 0.03], 6)
    landed, end = places_of(path, reached)[0]
    assert torch.equal(landed, path[0, 3]) and torch.equal(end, path[0, 6])


def test_a_hand_that_stops_nowhere_before_the_goal_has_its_only_place_there():
    path, reached = hands([0.25, 0.24, 0.23, 0.21, 0.19, 0.17, 0.17], 4)
    landed, end = places_of(path, reached)[0]
    assert torch.equal(landed, path[0, 4]) and torch.equal(end, path[0, 4])
    never = places_of(path, torch.zeros_like(reached))[0]  # nobody asks, but there must be a number
    assert torch.equal(never[1], path[0, -1])


def test_a_cell_means_the_point_at_its_level_that_the_camera_sees_there():
    places = make({TEXTS[0]: FRONT, TEXTS[1]: BESIDE}, {text: BESIDE for text in TEXTS})
    view = torch.tensor([[0, 0], [1, 0]])
    cells = torch.tensor([[[9 * 16 + 5, 8 * 16 + 8], [10 * 16 + 3, 7 * 16 + 9]]] * 2)  # [n, V, K]
    maps = torch.nn.functional.one_hot(cells, 256).float()
    for index, eye in enumerate(places.eyes):
        eye.forward = lambda frames, words, index=index: maps[:, index].log()
    levels = torch.tensor([[0.02, 0.1], [0.05, 0.0]])
    frames, words = torch.zeros(2, 2, 3, SIZE, SIZE, dtype=torch.uint8), torch.ones(2, 1, dtype=torch.int64)
    log_maps, points = places(frames, view, words, levels)
    assert log_maps.shape == (2, 2, KINDS, 256) and points.shape == (2, 2 * KINDS, 2)
    cameras = [[FRONT, BESIDE], [BESIDE, BESIDE]]
    for row in range(2):
        for index in range(2):
            for kind in range(KINDS):
                point = [*points[row, index * KINDS + kind].tolist(), float(levels[row, kind])]
                seen = cameras[row][index].project(np.array(point), 16)
                down, right = divmod(int(cells[row, index, kind]), 16)
                np.testing.assert_allclose(seen, (right + 0.5, down + 0.5), atol=1e-3)


def test_a_map_diverges_least_where_the_place_is_seen():
    places = make()
    seen = torch.tensor([[[[9.0, 21.0], [16.0, 16.0]]]])  # px: cells (4.5, 10.5), a centre, and (8, 8), a corner
    cells = torch.arange(16) + 0.5
    away = (cells - 4.5).square() + (cells - 10.5).square().unsqueeze(-1)  # another way to the same density
    right = (-away / (2 * 0.7**2)).flatten().log_softmax(0)
    maps = right.expand(1, 1, KINDS, 256)
    far = places.divergence(maps, seen)
    assert far.shape == (1, 1, KINDS)
    assert abs(far[0, 0, 0]) < 1e-5 and far[0, 0, 1] > 5
    spread = places.divergence(torch.full((1, 1, KINDS, 256), 1 / 256).log(), seen)
    expected = np.log(256) - torch.distributions.Categorical(logits=right).entropy()
    np.testing.assert_allclose(spread[0, 0, 0], expected, rtol=1e-5)


def test_levels_are_the_middle_of_where_episodes_succeed():
    places = make()
    place = torch.rand(9, KINDS, 3, generator=torch.Generator().manual_seed(1))
    reached = torch.tensor([True] * 5 + [False] * 4)
    texts = [TEXTS[0]] * 7 + [TEXTS[1]] * 2
    places.fit(place, reached, texts, place)
    middle = torch.from_numpy(np.median(place[:5, :, 2].numpy(), 0))
    torch.testing.assert_close(places.levels([TEXTS[0]])[0], middle)
    torch.testing.assert_close(places.levels([TEXTS[1]])[0], middle)  # where none does, those of all
    torch.testing.assert_close(places.levels(["something else"])[0], middle)
    torch.testing.assert_close(places.low, place[..., :2].flatten(0, 1).min(0).values)


def test_offsets_are_distances_and_their_waves():
    generator = torch.Generator().manual_seed(2)
    hand, point = 0.2 * torch.rand(3, 5, 3, generator=generator), 0.2 * torch.rand(3, 4, 2, generator=generator)
    told = offsets(hand, point)
    assert told.shape == (3, 5, 8 + 2 * 3 * 9)
    apart = (hand[:, :, None, :2] - point[:, None]).numpy()
    np.testing.assert_allclose(told[..., :8], np.clip(apart / 0.05, -4, 4).reshape(3, 5, 8), atol=1e-6)
    shortest = told[..., -18:-9]  # sines of what is shortest: 8 distances and the height, told as often as 6 cm
    where = np.concatenate([apart.reshape(3, 5, 8), hand[..., 2:].numpy()], -1)
    np.testing.assert_allclose(shortest, np.sin(2 * np.pi / 0.06 * where), atol=1e-4)


def test_what_is_left_over_elsewhere_does_not_move_a_place():
    places = make(texts=TEXTS[:1])
    peak = torch.zeros(16, 16)
    peak[9:12, 4:7] = torch.tensor([[1.0, 2, 1], [2, 5, 2], [1, 2, 0]])
    peak = peak.flatten() / peak.sum()
    rest = torch.rand(256, generator=torch.Generator().manual_seed(4))
    points = []
    for left_over in (0.0, 0.2):
        maps = (1 - left_over) * peak + left_over * rest / rest.sum() * (peak == 0)
        places.eyes[0].forward = lambda frames, words, maps=maps: maps.log().expand(1, KINDS, 256)
        frames, index = torch.zeros(1, 1, 3, SIZE, SIZE, dtype=torch.uint8), torch.zeros(1, 1, dtype=torch.int64)
        points.append(places(frames, index, index, torch.full((1, KINDS), 0.02))[1])
    apart = (points[1] - points[0]).norm(dim=-1)
    assert (apart < 0.003).all()  # the mean of the whole map moves by 3 cm
    assert not apart.eq(0).all()


@pytest.mark.parametrize(("beside", "within"), ((0.0, 0.007), (0.18, 0.013)))
def test_it_finds_a_place_from_hands_that_miss_it(beside, within):
    """Hands are 1 cm off (normal); the place of a block is found to a third of a pixel, one that lies nine pixels
    beside it to two thirds, on frames that it has not seen."""
    places, generator = make(texts=TEXTS[:1]), torch.Generator().manual_seed(3)

    def scene(count):
        block = torch.zeros(count, 3)
        block[:, :2] = 0.2 * torch.rand(count, 2, generator=generator) - 0.1
        seen = torch.from_numpy(FRONT.project(block.numpy(), SIZE))
        grid = torch.arange(SIZE) + 0.5
        right, down = ((grid - each.unsqueeze(-1)).square() for each in seen.unbind(-1))
        light = 220 * torch.exp(-(down[:, :, None] + right[:, None]) / 3)
        noise = torch.randint(0, 30, (count, 3, SIZE, SIZE), generator=generator)
        return block, (noise + light.unsqueeze(1)).to(torch.uint8).unsqueeze(1)

    words, view = torch.full((64, 1), 2), torch.zeros(64, 1, dtype=torch.int64)
    levels, optimizer = torch.zeros(64, KINDS), torch.optim.AdamW(places.parameters(), lr=2e-3)
    block, frames = scene(512)
    away = torch.tensor([0.0, beside, 0.0])
    for _ in range(150):
        rows = torch.randint(512, (64,), generator=generator)
        place = block[rows, None] + away + 0.01 * torch.randn(64, KINDS, 3, generator=generator)
        maps, _ = places(frames[rows], view, words, levels)
        seen = torch.from_numpy(FRONT.project(place.numpy(), SIZE)).float().unsqueeze(1)
        loss = places.divergence(maps, seen).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    block, frames = scene(64)
    with torch.no_grad():
        _, points = places(frames, view, words, levels)
    assert (points - (block + away)[:, None, :2]).norm(dim=-1).mean() < within
