"""Moved demonstrations against MuJoCo's camera, moved the other way, and against points that are projected."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from spots import FRONT, SIDE, centre, check_shared, spot
from tensordict import NonTensorStack, TensorDict

from worldenv_trl import keys
from worldenv_trl.policies import SceneShift
from worldenv_trl.robot import WRIST


def samples(images, texts=("left",), more=None):
    out = TensorDict({keys.STATE: torch.zeros(len(images), 7), keys.IMAGE: images} | (more or {}), [len(images)])
    return out.set(keys.INSTRUCTION, NonTensorStack(*[texts[row % len(texts)] for row in range(len(images))]))


def test_what_lies_on_the_plane_is_seen_where_the_hand_says_that_it_is():
    torch.manual_seed(0)
    cameras, points = {"agentview": {"left": FRONT, "right": SIDE}}, ((0.02, -0.03, 0.05), (0.01, 0.04, 0.15))
    images = torch.stack([spot((FRONT, SIDE)[row % 2], points[row % 2], 2.0) for row in range(12)])
    moved = SceneShift(cameras, 0.06, 1.0, height={"left": 0.05, "right": 0.15})(samples(images, ("left", "right")))
    move = moved[keys.STATE][:, :3]
    assert move[:, 2].abs().max() == 0 and move[:, :2].abs().max() <= 0.06 and move[:, :2].std(0).min() > 0.02
    for row, image in enumerate(moved[keys.IMAGE]):
        expected = (FRONT, SIDE)[row % 2].project(np.array(points[row % 2]) + move[row].numpy(), 64)
        torch.testing.assert_close(centre(image), torch.tensor(expected, dtype=torch.float32), atol=0.15, rtol=0)


def test_mujoco_draws_it_so_when_its_camera_moves_the_other_way():
    """Flat things at the plane's height, with nothing behind them."""
    generator = np.random.default_rng(0)
    tiles = "".join(
        f"""<geom type="box" size=".06 .06 .0005" pos="{x} {y} .0295"
        rgba="{" ".join(f"{value:.2f}" for value in generator.random(3))} 1"/>"""
        for x in np.arange(-0.9, 0.6, 0.12)
        for y in np.arange(-0.9, 1.0, 0.12)
    )
    axes, place = " ".join(map(str, FRONT.axes)), " ".join(map(str, FRONT.position))
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><light pos="0 0 3" dir="0 0 -1" directional="true" castshadow="false"/>
        <camera name="agentview" pos="{place}" xyaxes="{axes}" fovy="{FRONT.fovy}"/>{tiles}</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, 96, 96) as renderer:

        def drawn(move):
            model.cam_pos[0] = np.array(FRONT.position) - move
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "agentview")
            return torch.from_numpy(renderer.render().copy()).permute(2, 0, 1)

        torch.manual_seed(1)
        plain = drawn(np.zeros(3))
        moved = SceneShift({"agentview": {"left": FRONT}}, 0.05, 1.0)(samples(plain[None].repeat(6, 1, 1, 1)))
        for image, (x, y) in zip(moved[keys.IMAGE], moved[keys.STATE][:, :2].tolist(), strict=True):
            expected = drawn(np.array([x, y, 0.0]))[:, 40:-12, 12:-12].float()  # the border repeats its edge
            before, after = ((each[:, 40:-12, 12:-12] - expected).square().mean() for each in (plain, image))
            assert after < before / 8, (x, y, before, after)


def test_nothing_else_changes_and_what_is_not_moved_keeps_its_bits():
    images = torch.randint(0, 256, (8, 3, 64, 64), dtype=torch.uint8)
    given = samples(images, more={keys.CHUNK: torch.rand(8, 8, 7)})
    before = given.clone()
    for shift in (
        SceneShift({"agentview": {"left": FRONT}}, 0.0),
        SceneShift({"agentview": {"left": FRONT}}, 0.05, 0.0),
    ):
        assert (shift(given) == before).all()
    moved = SceneShift({"agentview": {"left": FRONT}}, 0.05, share=0.5)(given)
    assert (given == before).all()
    assert torch.equal(moved[keys.CHUNK], before[keys.CHUNK]) and torch.equal(
        moved[keys.STATE][:, 2:], torch.zeros(8, 5)
    )
    still = (moved[keys.STATE] == 0).all(1)
    assert 0 < still.sum() < 8 and torch.equal(moved[keys.IMAGE][still], images[still])
    assert (moved[keys.IMAGE][~still] != images[~still]).flatten(1).any(1).all()


def test_the_waypoint_moves_with_the_scene():
    given = samples(torch.zeros(8, 3, 32, 32, dtype=torch.uint8), more={keys.WAYPOINT: torch.rand(8, 3)})
    before = given[keys.WAYPOINT].clone()
    moved = SceneShift({"agentview": {"left": FRONT}}, 0.05, 1.0)(given)
    torch.testing.assert_close(moved[keys.WAYPOINT] - before, moved[keys.STATE][:, :3])
    assert torch.equal(given[keys.WAYPOINT], before)


def test_a_camera_on_the_tool_sees_what_it_saw():
    images = torch.randint(0, 256, (4, 3, 32, 32), dtype=torch.uint8)
    given = samples(images, more={keys.WRIST_IMAGE: images.clone()})
    moved = SceneShift({"agentview": {"left": FRONT}, "wrist": {"left": WRIST}}, 0.05, 1.0)(given)
    assert torch.equal(moved[keys.WRIST_IMAGE], images) and not torch.equal(moved[keys.IMAGE], images)


def test_processes_that_share_a_batch_move_it_as_one_would():
    images = torch.randint(0, 256, (4, 3, 32, 32), dtype=torch.uint8)
    check_shared(SceneShift({"agentview": {"left": FRONT}}, 0.05), samples(images), (keys.IMAGE, keys.STATE))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"reach": -0.1}, "reach must be at least 0 m, got -0.1"),
        ({"reach": 0.1, "share": 2.0}, "share must lie .* got 2.0"),
    ],
)
def test_what_cannot_be_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        SceneShift({"agentview": {"left": FRONT}}, **settings)
