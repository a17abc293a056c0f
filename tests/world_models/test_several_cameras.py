"""One camera in the world and one on the hand, painted in one pass."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_models import DOWN, FRONT, ONE, PULL, PUSH, TWO, close, fresh_model, make_model, make_request

from worldenv_trl.keys import frames_key
from worldenv_trl.language import instructions_of
from worldenv_trl.robot import WRIST
from worldenv_trl.world_models import VideoWorldModel
from worldenv_trl.world_models.base import memory_key, reference_key

BOTH = [frames_key("agentview"), frames_key("wrist")]


@pytest.fixture(scope="module")
def model() -> VideoWorldModel:
    return make_model(TWO)


def views(model: VideoWorldModel, td) -> list:
    return model.conditions(td, instructions_of(td))["views"]


def test_every_camera_is_painted(model):
    out = model(make_request(model, 3))
    for key in BOTH:
        assert out[key].shape == (3, 8, 3, 32, 32) and out[key].dtype == torch.uint8
    assert not torch.equal(out[BOTH[0]], out[BOTH[1]])


def test_no_rows_give_no_frames_of_any_camera(model):
    out = model(make_request(model, 2)[:0])
    assert [out[key].shape for key in BOTH] == [(0, 8, 3, 32, 32)] * 2


def test_a_row_does_not_depend_on_the_other_rows(model):
    together = model(make_request(model, 6))
    alone = model(make_request(model, 6)[4:5])
    assert all(close(together[key][4:5], alone[key]) for key in BOTH)


def test_noise_of_two_cameras_is_a_function_of_the_rows_seed(model):
    model.deterministic = False
    first, again = model(make_request(model, 4)), model(make_request(model, 4)[2:])
    model.deterministic = True
    assert all(close(first[key][2:], again[key]) for key in BOTH)


def test_each_camera_is_seen_by_the_other(model):
    """One trunk: what the wrist's camera remembers changes what the other one shows."""
    td = make_request(model, 2)
    before = model(td.clone())[BOTH[0]]
    td[memory_key("wrist")] = 255 - td[memory_key("wrist")]
    assert not torch.equal(model(td)[BOTH[0]], before)


def test_an_untrained_model_shows_each_camera_its_own_last_frame():
    model = fresh_model(TWO)
    td = make_request(model, 2)
    td["poses"][:] = td["memory", "poses"][:, -1:]
    for camera in model.cameras:
        td[memory_key(camera)][:] = td[memory_key(camera)][:, -1:]
    out = model(td)
    for camera in model.cameras:
        last = td[memory_key(camera)][:, -1:].float()
        assert (out[frames_key(camera)].float() - last).abs().mean() < 0.4 * (last - 127.5).abs().mean()


def test_a_saved_and_reloaded_model_paints_the_same_frames(model, tmp_path):
    model.save_pretrained(tmp_path)
    again = VideoWorldModel.from_pretrained(tmp_path).eval()
    assert again.config == model.config and again.cameras == ("agentview", "wrist")
    first, second = model(make_request(model, 2)), again(make_request(again, 2))
    assert all(torch.equal(first[key], second[key]) for key in BOTH)


@pytest.mark.parametrize("camera", ["agentview", "wrist"])
def test_the_error_of_each_camera_reaches_its_own_encoder_and_painter(camera):
    model = make_model(TWO)
    index = model.cameras.index(camera)
    td = make_request(model, 1)
    model.predict(None, torch.zeros(1), model.conditions(td, [PULL]))[:, index].square().sum().backward()
    for part in (model.denoiser.painters, model.denoiser.encoders):
        for place, own in enumerate(part):
            reached = [p.grad is not None and bool(p.grad.any()) for n, p in own.named_parameters() if "noisy" not in n]
            used = place == index or part is model.denoiser.encoders  # the trunk reads every encoder
            assert all(reached) if used else not any(reached)


def test_a_missing_camera_is_named(model):
    for key in (memory_key("wrist"), ("memory", "frames")):
        with pytest.raises(ValueError, match=r"'(wrist_)?image'\) must be uint8 \[B, 3, 3, 32, 32\], got nothing"):
            model(make_request(model, 2).exclude(key))


def test_the_reference_of_a_camera_is_its_own(model):
    td = make_request(model, 2)
    before = model(td.clone())
    td[reference_key("wrist")] = 255 - td[reference_key("wrist")]
    assert not torch.equal(model(td)[BOTH[1]], before[BOTH[1]])


# ----------------------------------------------------------------------------------------------- where things are


def test_the_tool_moves_over_a_fixed_cameras_image(model):
    td = make_request(model, 2)
    motion = views(model, td)[0].motion
    last = FRONT.project(td["memory", "poses"][:, -1, :3].numpy(), 32)
    for step in range(8):
        expected = FRONT.project(td["poses"][:, step, :3].numpy(), 32) - last
        assert np.allclose(motion[:, step], expected, atol=1e-3)


def test_the_scenery_moves_against_the_tool_on_a_mounted_cameras_image(model):
    """The tool's way is measured on the image that the camera saw last, and turned round."""
    td = make_request(model, 2)
    motion = views(model, td)[1].motion
    last = td["memory", "poses"][:, -1]
    centre = WRIST.project(np.zeros(3), 32)
    for row in range(2):
        world_from_tool = last[row, 3:12].reshape(3, 3).numpy()
        for step in range(8):
            way = (td["poses"][row, step, :3] - last[row, :3]).numpy() @ world_from_tool  # in the tool's frame, then
            expected = centre - WRIST.project(way, 32)
            assert np.allclose(motion[row, step], expected.clip(-32, 32), atol=1e-3)


def test_a_point_of_the_scene_moves_the_way_that_a_mounted_cameras_motion_says(model):
    td = make_request(model, 1)
    td["memory", "poses"][0, -1, :3] = torch.tensor([0.0, 0.0, 0.2])
    ahead = np.array([0.02, 0.02, 0.0])  # on the table, below the tool
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        td["poses"][0, :, :3] = td["memory", "poses"][0, -1, :3]
        td["poses"][0, :, axis] += sign * 0.03
        seen = [
            WRIST.project((ahead - tool[:3].numpy()) @ DOWN.numpy(), 32)
            for tool in (td["memory", "poses"][0, -1], td["poses"][0, 0])
        ]
        motion = views(model, td)[1].motion[0, 0].numpy()
        moved = np.abs(seen[1] - seen[0]) > 0.5
        assert moved.any() and (np.sign(motion[moved]) == np.sign(seen[1] - seen[0])[moved]).all()


def test_a_hand_that_stands_still_leaves_both_images_where_they_are(model):
    td = make_request(model, 1)
    td["poses"][:] = td["memory", "poses"][:, -1:]
    assert all(not view.motion.any() for view in views(model, td))


def test_a_mounted_camera_draws_where_the_hand_goes_as_it_was_seen_last(model):
    td = make_request(model, 2)
    index = torch.zeros(2, 11, dtype=torch.int64)
    every = torch.cat([td["memory", "poses"], td["poses"]], 1)
    maps = model.action_maps[1](every, index, tool_pose=td["memory", "poses"][:, -1:].expand(-1, 11, -1))
    view = views(model, td)[1]
    assert torch.equal(view.memory_maps[:, :, :6], maps[:, :3]) and torch.equal(view.maps[:, :, :6], maps[:, 3:])


def test_the_hand_stands_still_on_the_image_of_the_camera_that_it_carries(model):
    fixed, carried = (view.hand for view in views(model, make_request(model, 2)))
    assert torch.allclose(carried, carried[:1, :1].expand_as(carried), atol=1e-4)
    assert not torch.allclose(fixed, fixed[:1, :1].expand_as(fixed), atol=1e-2)


def test_one_name_may_be_a_fixed_camera_in_one_scene_and_a_mounted_one_in_another():
    model = make_model({"eye": {PULL: FRONT, PUSH: WRIST}})
    fixed, mounted = make_model(ONE), make_model({"wrist": {PULL: WRIST, PUSH: WRIST}})
    mixed = views(model, make_request(model, 2, [PULL, PUSH]))[0]
    expected = views(fixed, make_request(fixed, 2))[0], views(mounted, make_request(mounted, 2))[0]
    for name in ("motion", "hand", "maps", "memory_maps"):
        for row in range(2):
            assert torch.allclose(getattr(mixed, name)[row], getattr(expected[row], name)[row], atol=1e-4), name
