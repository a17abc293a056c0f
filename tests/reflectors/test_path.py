"""What is seen around the hand, scores of growing paths, and what a path reflector learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv
from videos import Videos, work_through

from worldenv_trl.data import score_episodes
from worldenv_trl.envs import Reflect, TabletopEnv
from worldenv_trl.reflectors import PathLessons, PathReflector, PathReflectorConfig, StopRule
from worldenv_trl.robot.camera import WRIST, look_at

SIZE = 32
FRONT = look_at("front", (0.8, 0.0, 0.6), (0.0, 0.0, 0.1), 40.0)
BESIDE = look_at("beside", (0.0, 0.9, 0.5), (0.0, 0.0, 0.1), 45.0)
TEXTS = ("touch the block", "reach for the block")


def make(cameras=("front",), texts=TEXTS, lessons=None, **settings):
    torch.manual_seed(0)
    views = {"front": FRONT, "beside": BESIDE}
    config = PathReflectorConfig.for_cameras(
        {name: {text: views[name] for text in texts} for name in cameras},
        **{"image_size": SIZE, "crop_size": 9, "width": 32, "feature_dim": 16} | settings,
    )
    return PathReflector(config, *([] if lessons is None else [lessons])).eval()


def paths(count, steps, seed=0):
    """Kinematic states [count, steps + 1, 20] of hands on their way through what the cameras see."""
    generator = torch.Generator().manual_seed(seed)
    states = torch.zeros(count, steps + 1, 20)
    ends = 0.2 * torch.rand(count, 2, 3, generator=generator) - torch.tensor([0.1, 0.1, -0.05])
    share = torch.linspace(0, 1, steps + 1).view(1, -1, 1)
    states[..., 7:10] = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])
    states[..., 10:19] = torch.eye(3).flatten()
    return states


def scenes(count, cameras=("front",), seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        camera: torch.randint(256, (count, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8) for camera in cameras
    }


def begun(reflector, first, states, texts):
    return reflector.begin(first | {"kinematic_states": states[:, 0]}, texts)


def further(reflector, state, states, start, stop):
    return reflector.extend(state, {"kinematic_states": states[:, start:stop]})


@pytest.mark.parametrize("cameras", [("front",), ("front", "beside")])
def test_crops_are_the_frame_around_where_the_camera_sees_the_hand(cameras):
    reflector, states = make(cameras, crop_size=9, window=8 / SIZE), paths(5, 3)
    ramp = torch.arange(SIZE, dtype=torch.float32)
    frame = torch.stack([ramp.expand(SIZE, SIZE), ramp.unsqueeze(-1).expand(SIZE, SIZE), torch.zeros(SIZE, SIZE)]) * 8
    first = frame.to(torch.uint8).expand(5, len(cameras), 3, SIZE, SIZE)
    crops = reflector.crops(first, reflector.views_of(TEXTS[:1] * 5), states[..., 7:20])
    assert crops.shape == (5, 4, 3 * len(cameras), 9, 9)
    for number, camera in enumerate({"front": FRONT, "beside": BESIDE}[name] for name in cameras):
        u, v = np.moveaxis(camera.project(states[..., 7:10].numpy(), SIZE), -1, 0)  # pixel centres at half-integers
        inside = (np.abs(u - SIZE / 2) < SIZE / 2 - 5) & (np.abs(v - SIZE / 2) < SIZE / 2 - 5)
        assert inside.sum() > 5
        offset = np.linspace(-4, 4, 9)
        red = ((crops[:, :, 3 * number].numpy() + 0.5) * 255 / 8 + 0.5)[inside]
        green = ((crops[:, :, 3 * number + 1].numpy() + 0.5) * 255 / 8 + 0.5)[inside]
        np.testing.assert_allclose(red, np.broadcast_to((u[inside, None] + offset)[:, None], red.shape), atol=1e-3)
        np.testing.assert_allclose(green, np.broadcast_to((v[inside, None] + offset)[..., None], red.shape), atol=1e-3)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_scores_are_those_of_each_prefix_alone_in_whatever_pieces_the_path_comes(stride):
    reflector, states, first = make(stride=stride), paths(3, 13), scenes(3)
    texts = [TEXTS[0], TEXTS[1], TEXTS[0]]
    state = begun(reflector, first, states, texts)
    streamed = [state["score"].unsqueeze(1)]
    for start, stop in ((1, 4), (4, 5), (5, 13), (13, 14)):
        state, scores = further(reflector, state, states, start, stop)
        streamed.append(scores)
        torch.testing.assert_close(state["score"], scores[:, -1])
    streamed = torch.cat(streamed, 1)
    for row in range(3):
        one = {camera: frames[row : row + 1] for camera, frames in first.items()}
        for last in range(14):  # a whole pass over this prefix, without a state
            poses = states[row : row + 1, : last + 1 : stride, 7:20]
            crops = reflector.crops(one["front"].unsqueeze(1), reflector.views_of([texts[row]]), poses)
            looks = reflector.look(crops)
            words = reflector.vocabulary.ids([texts[row]])
            levels = reflector.places.levels([texts[row]])
            view = reflector.views_of([texts[row]])
            _, places = reflector.places(one["front"].unsqueeze(1), view, words, levels)
            alone = reflector.logits(looks, reflector.path(poses, places), words)[:, -1].sigmoid().mean()
            torch.testing.assert_close(streamed[row, last], alone)


def test_rows_of_different_lengths_go_on_together_as_they_would_alone():
    reflector, states, first = make(), paths(3, 12), scenes(3)
    _, expected = further(reflector, begun(reflector, first, states, [TEXTS[0]] * 3), states, 1, 13)
    state = begun(reflector, first, states, [TEXTS[0]] * 3)
    ahead, _ = further(reflector, state[1:2], states[1:2], 1, 6)  # the second is five frames ahead
    for name in ("poses", "looks"):
        whole = torch.zeros(3, 6, *state[name].shape[2:])
        whole[:, :1], whole[1] = state[name], ahead[name][0]
        state[name] = whole
    state["seen"] = torch.tensor([1, 6, 1])
    next_states = torch.stack([states[0, 1:8], states[1, 6:13], states[2, 1:8]])
    _, scores = reflector.extend(state, {"kinematic_states": next_states})
    torch.testing.assert_close(scores[[0, 2]], expected[[0, 2], :7])
    torch.testing.assert_close(scores[1], expected[1, 5:])


def test_what_comes_later_changes_no_earlier_score():
    reflector, states, first = make(), paths(2, 12), scenes(2)
    other = states.clone()
    other[:, 7:] += 0.05
    one, two = (further(reflector, begun(reflector, first, s, TEXTS), s, 1, 13)[1] for s in (states, other))
    assert torch.equal(one[:, :6], two[:, :6])
    assert (one[:, 8:] != two[:, 8:]).all()


def showing(pixel, steps, generator):
    """Dark frames [n, steps + 1, 3, H, W] of which the first alone shows a block at ``pixel`` [n, 2]."""
    frames = torch.randint(0, 30, (len(pixel), steps + 1, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8)
    grid = torch.arange(SIZE) + 0.5
    near = ((grid - pixel[:, :1]).abs() < 2)[:, None, :] & ((grid - pixel[:, 1:]).abs() < 2)[:, :, None]
    frames[:, 0] = torch.where(near.unsqueeze(1), 250, frames[:, 0])
    return frames


def touching(count, seed, texts=TEXTS):
    """Labelled episodes: a block somewhere on the table; the goal is reached where the hand is seen to pass near it."""
    generator = torch.Generator().manual_seed(seed)
    states, steps = paths(count, 12, seed), 12
    share = torch.rand(count, 1, generator=generator)
    block = torch.lerp(states[:, 0, 7:10], states[:, -1, 7:10], share)  # somewhere under the way, or beside it
    block = block + 0.24 * (torch.rand(count, 3, generator=generator) - 0.5)
    pixel = torch.from_numpy(FRONT.project(block.numpy(), SIZE))
    frames = showing(pixel, steps, generator)
    task = [row % len(texts) for row in range(count)]
    close = torch.from_numpy(FRONT.project(states[..., 7:10].numpy(), SIZE))  # as the camera sees it
    reached = ((close - pixel.unsqueeze(1)).norm(dim=-1) < 2.5).long().cummax(1).values > 0
    episodes = Videos({"front": frames}, [texts[number] for number in task], reached, task)
    episodes["kinematic_states"] = states
    return episodes


def test_it_learns_from_the_first_frame_and_the_path_whether_the_goal_is_reached():
    lessons = PathLessons(epochs=31, place_epochs=2.5, batch_size=32)
    reflector = make(lessons=lessons, members=1, stride=1, window=0.4, crop_size=13)
    for lesson in reflector.train().train_on(touching(256, 0)):
        losses = work_through(reflector)(lesson)
    assert lesson.name == "paths" and sum(losses[-20:]) < 0.6 * sum(losses[:20])
    held_out = touching(128, 1)
    scores = score_episodes(reflector.eval(), held_out)
    right = (scores[:, -1] > 0.5) == held_out["success"][:, -1]
    assert 0.2 < held_out["success"][:, -1].float().mean() < 0.8
    assert right.float().mean() > 0.85
    blind = touching(128, 1)
    blind.films["front"].zero_()
    blind.video[0]["frames", "front"].zero_()
    lost = (score_episodes(reflector, blind)[:, -1] > 0.5) == blind["success"][:, -1]
    assert lost.float().mean() < right.float().mean() - 0.15  # it is the block that it looks at


def test_the_loss_of_a_batch_is_the_mean_of_its_episodes():
    reflector, episodes = make(lessons=PathLessons(epochs=1, batch_size=8)), touching(8, 0)
    assert 0 < episodes["success"].any(1).sum() < 8
    names = []
    for lesson in reflector.train_on(episodes):
        batch = lesson.sample()
        if lesson.name == "paths":
            batch["weight"][3, 2:] = 0  # an episode that ended early
        each = [reflector.training_loss(batch[row : row + 1])["loss_reflector"] for row in range(8)]
        torch.testing.assert_close(reflector.training_loss(batch)["loss_reflector"], torch.stack(each).mean())
        names.append(lesson.name)
    assert names == ["places", "paths"]


def test_a_training_that_is_begun_again_goes_on_from_the_places_that_it_had_found():
    lessons = PathLessons(epochs=0.5, place_epochs=1.5, batch_size=8)
    one, other, episodes = make(lessons=lessons), make(lessons=lessons), touching(16, 0)
    straight, again = one.train_on(episodes), other.train_on(episodes)
    work_through(one)(next(straight))
    next(again)  # a new process comes here, and takes the weights that the first had saved
    other.load_state_dict(one.state_dict())
    drawn = []
    for rest in (straight, again):
        lesson = next(rest)
        torch.manual_seed(5)
        drawn.append(lesson.sample())
    assert (drawn[0] == drawn[1]).all()


@pytest.mark.parametrize(("count", "batch_size", "steps"), [(32, 8, [6, 10]), (64, 8, [12, 20]), (32, 9, [6, 10])])
def test_it_learns_for_longer_where_there_is_more_to_learn_from(count, batch_size, steps):
    lessons = PathLessons(epochs=2.5, place_epochs=1.5, batch_size=batch_size)
    made = make(lessons=lessons).train_on(touching(count, 0))  # of two tasks: 9 are shared as 8
    assert [lesson.steps for lesson in made] == steps


@pytest.mark.parametrize("change", [{"epochs": 0.0}, {"place_epochs": float("inf")}, {"batch_size": 0}])
def test_lessons_that_cannot_be_are_named(change):
    with pytest.raises(ValueError, match=r"epochs and place_epochs must be above 0.*got .*" + str(*change.values())):
        PathLessons(**change)


def test_where_nothing_ever_succeeds_there_are_no_places_to_learn():
    episodes = touching(8, 0)
    episodes["success"] = torch.zeros_like(episodes["success"])
    (lesson,) = make(lessons=PathLessons(epochs=1, batch_size=8)).train_on(episodes)
    assert lesson.name == "paths" and not lesson.sample()["label"].any()


def test_later_frames_are_not_looked_at():
    reflector, episodes = make(), touching(4, 0)
    before = score_episodes(reflector, episodes)
    shown, first = episodes.video
    rest = torch.ones(len(shown), dtype=torch.bool)
    rest[first] = False
    shown["frames", "front"][rest] = 255
    assert torch.equal(score_episodes(reflector, episodes), before)
    assert not reflector.reads_video and reflector.reads_path


def test_an_env_shows_it_the_same_path_as_a_recording():
    env = TabletopEnv("starter/open_the_top_drawer", 2, seed=0, image_size=SIZE)
    text, camera = env.tasks[0].language, env.tasks[0].camera("agentview")
    torch.manual_seed(0)
    config = PathReflectorConfig.for_cameras({"agentview": {text: camera}}, image_size=SIZE)
    reflector = PathReflector(config).eval()
    judged = TransformedEnv(env, Reflect(reflector, StopRule(0.999, 3)))
    rollout = judged.rollout(5)
    path = {"kinematic_states": rollout["next", "kinematic_state"]}
    state = reflector.begin(
        {"agentview": rollout["observation", "image"][:, 0], "kinematic_states": rollout["kinematic_state"][:, 0]},
        [text] * 2,
    )
    torch.testing.assert_close(rollout["success_prob"][:, 0, 0], state["score"])
    torch.testing.assert_close(rollout["next", "success_prob"].squeeze(-1), reflector.extend(state, path)[1])
    env.close()


def test_it_is_saved_with_its_cameras_and_what_it_learned(tmp_path):
    lessons = PathLessons(epochs=0.5, place_epochs=0.5, batch_size=4)
    reflector, episodes = make(("front", "beside"), lessons=lessons), touching(8, 0)
    episodes = Videos(
        {"front": episodes.films["front"], "beside": episodes.films["front"]},
        episodes.instructions,
        episodes["success"],
        episodes["task_id"].squeeze(-1).tolist(),
    )
    episodes["kinematic_states"] = paths(8, 12)
    for lesson in reflector.train_on(episodes):
        work_through(reflector)(lesson)
    reflector.save_pretrained(tmp_path)
    again = PathReflector.from_pretrained(tmp_path).eval()
    assert (
        again.config.instructions == TEXTS
        and again.cameras == ("front", "beside")
        and float(reflector.std.max()) != 1.0
    )
    assert torch.equal(again.places.height, reflector.places.height) and (again.places.height != 0).all()
    assert torch.equal(score_episodes(again, episodes), score_episodes(reflector.eval(), episodes))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": {}}, "cameras must give every camera for the same instructions"),
        ({"stride": 0}, "stride, feature_dim, width and members must be at least 1"),
        ({"window": 0.0}, r"window must be in \(0, 1\]"),
        ({"cameras": {"wrist": {"a": WRIST}}}, "the camera 'wrist' moves with the hand"),
    ],
)
def test_settings_that_cannot_be_are_named(change, message):
    settings = {"cameras": {"front": {"a": FRONT}}} | change
    with pytest.raises(ValueError, match=message):
        PathReflectorConfig.for_cameras(settings.pop("cameras"), **settings)


def test_episodes_that_teach_nothing_are_refused_at_once():
    episodes = touching(4, 0)
    with pytest.raises(ValueError, match="'reach for the block' is not among them"):
        make(texts=("open",)).train_on(episodes)
    episodes.entries.del_("success")
    with pytest.raises(ValueError, match="carry no success labels"):
        make().train_on(episodes)
    with pytest.raises(ValueError, match=r"frames of 'front' must be \[n, 3, 32, 32\], got \[2, 3, 8, 8\]"):
        begun(make(), {"front": torch.zeros(2, 3, 8, 8, dtype=torch.uint8)}, paths(2, 1), TEXTS)
