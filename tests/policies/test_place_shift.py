"""A thing that is moved is seen where the actions now lead."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from spots import FRONT, SIDE, centre, check_shared, spot
from tensordict import NonTensorStack, TensorDict

from worldenv_trl import keys
from worldenv_trl.policies import PlaceShift
from worldenv_trl.robot import WRIST

CAMERAS = {"agentview": {"left": FRONT, "right": SIDE}}
STEPS = 6  # until the gripper closes


def demonstrated(rows, place=(0.02, -0.03, 0.05), hand=(-0.25, 0.1, 0.3)):
    """Rows whose hand goes from ``hand`` straight to ``place`` in six steps and then waits."""
    place, hand = torch.tensor(place), torch.tensor(hand)
    chunk = torch.zeros(rows, 8, 7)
    chunk[:, :STEPS, :3] = (place - hand) / STEPS / keys.POSITION_STEP
    chunk[:, STEPS:, 6] = 1.0
    approach = (torch.arange(8) < STEPS).float().expand(rows, 8) / STEPS
    state = torch.cat([hand, torch.zeros(4)]).expand(rows, 7)
    images = torch.stack([spot((FRONT, SIDE)[row % 2], place.tolist(), 1.0) for row in range(rows)])
    entries = {keys.STATE: state, keys.IMAGE: images, keys.CHUNK: chunk, keys.APPROACH: approach}
    out = TensorDict(entries | {keys.WAYPOINT: place.expand(rows, 3)}, [rows])
    return out.set(keys.INSTRUCTION, NonTensorStack(*[("left", "right")[row % 2] for row in range(rows)]))


@pytest.mark.parametrize("hand", [(-0.25, 0.1, 0.3), (-0.02, -0.02, 0.12), (0.02, -0.03, 0.06)])
def test_the_actions_lead_to_where_the_thing_is_seen(hand):
    torch.manual_seed(0)
    given = demonstrated(12, hand=hand)
    moved = PlaceShift(CAMERAS, 0.03, 1.0)(given)
    move = moved[keys.WAYPOINT] - given[keys.WAYPOINT]
    assert move[:, 2].abs().max() == 0 and move.abs().max() <= 0.03 and move[:, :2].std(0).min() > 0.01
    reached = moved[keys.STATE][:, :3] + keys.POSITION_STEP * moved[keys.CHUNK][:, :STEPS, :3].sum(1)
    torch.testing.assert_close(reached, moved[keys.WAYPOINT])
    for row, (image, place) in enumerate(zip(moved[keys.IMAGE], moved[keys.WAYPOINT].numpy(), strict=True)):
        expected = torch.tensor((FRONT, SIDE)[row % 2].project(place, 64), dtype=torch.float32)
        torch.testing.assert_close(centre(image), expected, atol=0.2, rtol=0)


def test_a_hand_beside_the_thing_moves_with_it_and_one_far_away_stays():
    torch.manual_seed(0)
    shift = PlaceShift(CAMERAS, 0.03, 1.0)
    near, far = demonstrated(8, hand=(0.02, -0.03, 0.055)), demonstrated(8)
    moved = shift(near)
    torch.testing.assert_close(
        moved[keys.STATE][:, :3] - near[keys.STATE][:, :3], moved[keys.WAYPOINT] - near[keys.WAYPOINT]
    )
    assert torch.equal(moved[keys.CHUNK], near[keys.CHUNK])
    moved = shift(far)
    assert torch.equal(moved[keys.STATE], far[keys.STATE])
    assert (moved[keys.CHUNK] != far[keys.CHUNK])[:, :STEPS, :2].all()
    assert torch.equal(moved[keys.CHUNK][:, STEPS:], far[keys.CHUNK][:, STEPS:])


def test_what_is_far_from_the_place_keeps_its_bits():
    torch.manual_seed(0)
    images = torch.randint(0, 256, (8, 3, 64, 64), dtype=torch.uint8)
    given = demonstrated(8).set(keys.IMAGE, images)
    moved = PlaceShift(CAMERAS, 0.03, 1.0)(given)[keys.IMAGE]
    for row in range(8):
        camera, place = (FRONT, SIDE)[row % 2], np.array([0.02, -0.03, 0.05])
        ring = place + 0.18 * np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 6.2, 40)])
        seen, middle = camera.project(ring, 64), camera.project(place, 64)
        changed = (moved[row] != images[row]).any(0).nonzero().flip(1).numpy() + 0.5
        assert len(changed) > 50
        assert (np.linalg.norm(changed - middle, axis=1) <= np.linalg.norm(seen - middle, axis=1).max() + 1).all()


def test_without_a_place_ahead_and_without_its_share_nothing_changes():
    given = demonstrated(8)
    given[keys.APPROACH] = torch.zeros(8, 8)
    before = given.clone()
    assert (PlaceShift(CAMERAS, 0.03, 1.0)(given) == before).all()
    given = demonstrated(8)
    before = given.clone()
    assert (PlaceShift(CAMERAS, 0.03, 0.0)(given) == before).all()
    torch.manual_seed(0)
    moved = PlaceShift(CAMERAS, 0.03, 0.5)(given)
    still = (moved[keys.WAYPOINT] == before[keys.WAYPOINT]).all(-1)
    assert (given == before).all() and 0 < still.sum() < 8
    assert torch.equal(moved[keys.IMAGE][still], before[keys.IMAGE][still])
    assert torch.equal(moved[keys.CHUNK][still], before[keys.CHUNK][still])


def test_a_camera_on_the_tool_is_refused_as_it_would_show_the_thing_where_it_was():
    with pytest.raises(ValueError, match=r"camera wrist is mounted on the tool .*sft.place_shift_m 0.*sft.cameras"):
        PlaceShift(CAMERAS | {"wrist": dict.fromkeys(("left", "right"), WRIST)}, 0.03)


def test_processes_that_share_a_batch_change_it_as_one_would():
    check_shared(PlaceShift(CAMERAS, 0.03), demonstrated(4), (keys.IMAGE, keys.STATE, keys.CHUNK, keys.WAYPOINT))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"reach": -0.1}, "reach must be at least 0 m, got -0.1"),
        ({"reach": 0.1, "share": 2.0}, "share must lie .* got 2.0"),
        ({"reach": 0.04}, "reach must be less than 0.038 m with these radii, got 0.04: .* folds"),
        ({"reach": 0.1, "inner": 0.2, "outer": 0.1}, "inner must be .* less than outer, got 0.2 and 0.1"),
    ],
)
def test_what_cannot_be_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        PlaceShift(CAMERAS, **settings)
