"""The action map against MuJoCo's own camera and a slow per-pixel reference."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from worldenv_trl.kinematics import ActionMap
from worldenv_trl.robot import WRIST, Camera, look_at, panda
from worldenv_trl.scenes import load_task

FRONT = look_at("front", (0.75, 0.1, 0.55), (0.0, 0.0, 0.1), 45.0)
SIDE = look_at("side", (0.0, -0.8, 0.4), (0.0, 0.0, 0.1), 40.0)
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0])).flatten()


def make_pose(position, opening: float = 1.0, rotation: torch.Tensor = DOWN) -> torch.Tensor:
    return torch.cat([torch.as_tensor(position, dtype=torch.float32), rotation, torch.tensor([opening])])


def random_poses(*shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor([-0.15, -0.2, 0.02]), torch.tensor([0.15, 0.2, 0.3])
    position = low + (high - low) * torch.rand(*shape, 3, generator=generator)
    rotation = torch.linalg.qr(torch.randn(*shape, 3, 3, generator=generator))[0].flatten(-2)
    return torch.cat([position, rotation, torch.rand(*shape, 1, generator=generator)], -1)


def centroid(image: torch.Tensor) -> torch.Tensor:
    """Pixel (u, v) of the centre of mass of an image [H, W]."""
    rows, columns = torch.arange(image.shape[0]) + 0.5, torch.arange(image.shape[1]) + 0.5
    return torch.stack([(image.sum(0) * columns).sum(), (image.sum(1) * rows).sum()]) / image.sum()


def render_sphere(camera: Camera, position, size: int) -> torch.Tensor:
    """Where MuJoCo paints a white sphere: [H, W] in [0, 1]."""
    axes, place = " ".join(map(str, camera.axes)), " ".join(map(str, camera.position))
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual><worldbody>
        <camera name="c" pos="{place}" xyaxes="{axes}" fovy="{camera.fovy}"/>
        <geom type="sphere" size="0.015" pos="{" ".join(map(str, position))}" rgba="1 1 1 1"/>
        </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, size, size)
    try:
        renderer.update_scene(data, "c")
        return torch.as_tensor(renderer.render().copy()).float().mean(-1) / 255
    finally:
        renderer.close()


@pytest.mark.parametrize("camera", [FRONT, SIDE], ids=lambda camera: camera.name)
@pytest.mark.parametrize("size", [64, 128])
def test_the_disc_lies_where_mujocos_camera_sees_the_point(camera, size):
    action_map = ActionMap(camera, size)
    for position in ((0.0, 0.0, 0.1), (0.12, -0.15, 0.05), (-0.1, 0.18, 0.25)):
        seen = centroid(render_sphere(camera, position, size))
        assert (action_map.project(torch.tensor(position)) - seen).norm() < 1.0
        assert (centroid(action_map(make_pose(position))[0]) - seen).norm() < 1.0


def test_projection_equals_the_camera_classs():
    points = random_poses(50)[:, :3]
    expected = FRONT.project(points.numpy(), 96)
    assert np.abs(ActionMap(FRONT, 96).project(points).numpy() - expected).max() < 1e-3


def test_a_wide_image_keeps_square_pixels():
    wide, square = ActionMap(FRONT, (64, 96)), ActionMap(FRONT, 64)
    points = random_poses(20)[:, :3]
    assert torch.allclose(wide.project(points), square.project(points) + torch.tensor([16.0, 0.0]), atol=1e-4)
    assert wide(random_poses(2)).shape == (2, 6, 64, 96)


def test_maps_equal_a_slow_reference():
    action_map, size = ActionMap(FRONT, 48), 48
    pose = random_poses(1)[0]
    position, axes, opening = pose[:3], pose[3:12].view(3, 3).T, pose[12]
    metre = size / 2 / math.tan(math.radians(22.5))
    back = torch.tensor(FRONT.rotation)[:, 2]

    def scale(point):  # pixels per metre at the point's depth
        return metre / float((torch.tensor(FRONT.position) - point) @ back)

    def coverage(distance, radius):
        return min(1.0, max(0.0, 0.5 + radius / 2 - distance**2 / (2 * radius)))

    def draw(value):
        return torch.tensor([[value(torch.tensor([u + 0.5, v + 0.5])) for u in range(size)] for v in range(size)])

    def disc(point, radius):
        return draw(lambda p: coverage(float((p - action_map.project(point)).norm()), radius))

    def segment(start, end, half_width):
        a, b = action_map.project(start), action_map.project(end)

        def value(p):
            t = min(1.0, max(0.0, float((p - a) @ (b - a) / (b - a).square().sum())))
            return coverage(float((p - a - t * (b - a)).norm()), half_width) * (1 - 0.5 * t)

        return draw(value)

    palm = disc(position, max(1.25, 0.016 * scale(position))) * (0.3 + 0.7 * float(opening))
    lines = [segment(position, position + 0.08 * axis, max(0.75, 0.0032 * scale(position))) for axis in axes]
    tips = [position + sign * 0.04 * opening * axes[1] for sign in (1, -1)]
    fingers = torch.maximum(*[disc(tip, max(1.0, 0.008 * scale(tip))) for tip in tips])
    floor = position * torch.tensor([1.0, 1.0, 0.0])
    shadow = disc(floor, max(1.25, 0.016 * scale(floor)))
    expected = torch.stack([palm, *lines, fingers, shadow])
    assert torch.allclose(action_map(pose), expected, atol=2e-3)


def test_any_batch_gives_the_same_maps():
    action_map, poses = ActionMap(FRONT, 32), random_poses(5, 30)
    maps = action_map(poses)
    assert maps.shape == (5, 30, 6, 32, 32) and maps.min() >= 0 and maps.max() <= 1
    for row, column in ((0, 0), (2, 7), (4, 29)):
        assert torch.allclose(action_map(poses[row, column]), maps[row, column], atol=1e-5)
    assert action_map(poses[:0]).shape == (0, 30, 6, 32, 32)


def test_the_opening_brightens_the_disc_and_spreads_the_fingertips():
    maps = ActionMap(FRONT, 64)(torch.stack([make_pose((0, 0, 0.1), opening) for opening in (0.0, 0.5, 1.0)]))
    brightness = maps[:, 0].amax((-1, -2))
    assert brightness[0] > 0.25 and (brightness.diff() > 0.2).all()
    columns = torch.arange(64) + 0.5
    weight = maps[:, 4].sum(-2) / maps[:, 4].sum((-1, -2))[:, None]
    spread = ((weight * columns.square()).sum(-1) - (weight * columns).sum(-1).square()).sqrt()
    assert (spread.diff() > 0.5).all()


def test_the_shadow_stays_on_the_table_while_the_hand_rises():
    maps = ActionMap(FRONT, 64)(torch.stack([make_pose((0.05, 0.05, height)) for height in (0.05, 0.25)]))
    assert (centroid(maps[0, 5]) - centroid(maps[1, 5])).norm() < 0.1
    assert centroid(maps[0, 0])[1] - centroid(maps[1, 0])[1] > 5


def test_nothing_is_drawn_for_a_hand_behind_the_camera_or_outside_the_image():
    action_map = ActionMap(FRONT, 32)
    assert not action_map(make_pose((2.0, 0.1, 0.6))).any()
    assert not action_map(make_pose((0.0, 3.0, 0.1))).any()


def test_each_element_is_seen_by_the_camera_of_its_index():
    both, poses = ActionMap([FRONT, SIDE], 32), random_poses(4, 2)
    index = torch.tensor([0, 1, 1, 0])
    front, side = ActionMap(FRONT, 32)(poses), ActionMap(SIDE, 32)(poses)
    expected = torch.stack([front[0], side[1], side[2], front[3]])
    for same in (index, index[:, None], index[:, None].expand(4, 2), index[:, None, None].expand(4, 2, 1)):
        assert torch.allclose(both(poses, same), expected, atol=1e-5)
    points = both.project(poses[:, 0, :3], index)
    assert torch.allclose(points[1], ActionMap(SIDE, 32).project(poses[1, 0, :3]), atol=1e-4)


def test_one_camera_needs_no_index_and_takes_its_own():
    poses, single = random_poses(3), ActionMap([SIDE], 32)
    assert torch.equal(single(poses, torch.zeros(3, dtype=torch.int64)), single(poses))
    assert torch.equal(single(poses), ActionMap(SIDE, 32)(poses))


# ----------------------------------------------------------------------------------------------------- on the tool


def on_the_wrist(count: int):
    """Poses of the tool [n, 13], points around it [n, 3] and where MuJoCo's wrist camera sees them [n, 2] at 64 px."""
    model = load_task("starter/put_the_bowl_on_the_plate").build()
    data, camera, site = mujoco.MjData(model), model.camera("panda/wrist").id, model.site("panda/tcp").id
    arm = [model.joint(f"panda/{joint.name}").qposadr[0] for joint in panda.JOINTS]
    rng, poses, points, seen = np.random.default_rng(0), [], [], []
    focal = 32 / math.tan(math.radians(model.cam_fovy[camera]) / 2)
    for angles in panda.HOME_Q + 0.3 * rng.standard_normal((count, 7)):
        data.qpos[arm] = angles
        mujoco.mj_forward(model, data)
        local = rng.uniform((-0.05, -0.05, -0.4), (0.05, 0.05, -0.1))  # in front of the camera, in its axes
        points.append(data.cam_xpos[camera] + data.cam_xmat[camera].reshape(3, 3) @ local)
        seen.append(32 + focal * local[:2] * (1, -1) / -local[2])
        poses.append(np.concatenate([data.site_xpos[site], data.site_xmat[site], [rng.uniform()]]))
    return [torch.as_tensor(np.stack(part), dtype=torch.float32) for part in (poses, points, seen)]


def test_the_wrist_camera_sees_points_where_mujoco_s_does():
    poses, points, seen = on_the_wrist(40)
    pixels = ActionMap(WRIST, 64).project(points, tool_pose=poses)
    assert (pixels - seen).norm(dim=-1).max() < 1e-2
    assert (pixels - ActionMap(WRIST, 64).project(points, tool_pose=poses[:1])).norm(dim=-1)[1:].min() > 0.1


def test_the_wrist_camera_draws_a_later_pose_from_where_it_is_now():
    now, points, _ = on_the_wrist(12)
    later, action_map = torch.cat([points, now[:, 3:]], -1), ActionMap(WRIST, 64)
    maps, pixels = action_map(later, tool_pose=now), action_map.project(points, tool_pose=now)
    whole = ((pixels > 12) & (pixels < 52)).all(-1)  # discs that are not cut off by the image's edge
    assert whole.sum() >= 4
    for image, pixel in zip(maps[whole, 0], pixels[whole], strict=True):
        assert (centroid(image) - pixel).norm() < 1.0
    still = [centroid(image) for image in action_map(now, tool_pose=now)[:, 0]]
    assert all((place - still[0]).norm() < 1e-2 for place in still)  # the hand itself does not move in its own picture


def test_a_fixed_camera_beside_the_wrist_s_draws_bit_for_bit_what_it_drew_alone():
    poses = random_poses(5, 3)
    both, index = ActionMap([FRONT, WRIST], 32), torch.tensor([0, 1, 0, 1, 0])
    alone = ActionMap(FRONT, 32)
    maps = both(poses, index, poses[:, :1])
    assert torch.equal(maps[::2], alone(poses[::2]))
    assert torch.equal(maps[1::2], ActionMap(WRIST, 32)(poses[1::2], tool_pose=poses[1::2, :1]))
    assert torch.equal(both(poses, torch.zeros(5, dtype=torch.int64)), alone(poses))  # no tool pose where none is used
    assert torch.equal(both.project(poses[..., :3], index, poses)[0], alone.project(poses[0, :, :3]))


def test_maps_of_the_wrist_are_differentiable_in_where_the_tool_is():
    now, points, _ = on_the_wrist(3)
    now.requires_grad_()
    ActionMap(WRIST, 32).project(points, tool_pose=now).sum().backward()
    assert now.grad.isfinite().all() and now.grad[:, :12].abs().amax(0).min() > 0


def test_maps_are_differentiable_in_the_pose():
    pose = random_poses(2).requires_grad_()
    action_map = ActionMap(FRONT, 32)
    (action_map(pose)[:, 0] * torch.linspace(0, 1, 32)).sum().backward()
    assert pose.grad.isfinite().all() and pose.grad[:, 1].abs().min() > 0
    assert torch.allclose(action_map(pose).detach(), action_map(pose.detach()), atol=1e-6)


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match="at least 16 px"):
        ActionMap(FRONT, 8)
    with pytest.raises(ValueError, match="empty sequence"):
        ActionMap([], 32)
    with pytest.raises(ValueError, match=r"pose must be \[\*B, 13\]"):
        ActionMap(FRONT, 32)(torch.zeros(2, 7))


@pytest.mark.parametrize(
    ("cameras", "index", "message"),
    [
        ((FRONT, SIDE), None, "camera_index is needed: this map has 2 cameras, front, side"),
        ((FRONT, SIDE), torch.tensor([0, 2]), r"camera_index must be in \[0, 2\), the cameras of this map, got 2"),
        ((FRONT, SIDE), torch.tensor([-1, 0]), "got -1"),
        ((FRONT,), torch.tensor([0, 5]), r"camera_index must be in \[0, 1\), the cameras of this map, got 5"),
        ((FRONT, SIDE), torch.tensor([0.0, 1.0]), "camera_index must be whole numbers, got torch.float32"),
        ((FRONT, SIDE), torch.tensor([0, 1, 0]), r"camera_index must be \[2\], .* got \[3\]"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(cameras, index, message):
    action_map, poses = ActionMap(cameras, 32), random_poses(2)
    for call in (lambda: action_map(poses, index), lambda: action_map.project(poses[:, :3], index)):
        with pytest.raises(ValueError, match=message):
            call()


def test_a_camera_on_the_tool_needs_to_know_where_the_tool_is():
    poses, both = random_poses(2), ActionMap([FRONT, WRIST], 32)
    used = torch.tensor([0, 1])
    for call in (
        lambda: ActionMap(WRIST, 32)(poses),
        lambda: both(poses, used),
        lambda: both.project(poses[:, :3], used),
    ):
        with pytest.raises(ValueError, match="tool_pose is needed, as the camera wrist is mounted on the tool"):
            call()
    with pytest.raises(ValueError, match=r"tool_pose must be \[\*B, 13\]"):
        both(poses, used, poses[:, :12])
    with pytest.raises(ValueError, match=r"tool_pose must broadcast to \[2, 13\], got \[3, 13\]"):
        both(poses, used, random_poses(3))
