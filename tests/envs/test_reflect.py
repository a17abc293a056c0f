"""Reward and stop by reflectors whose scores are written by hand, over films and over the physics."""

from __future__ import annotations

import pytest
import torch
from films import FilmEnv, FirstPixel, film, roll
from tensordict import NonTensorStack, TensorDict
from torchrl.envs import Compose, ExcludeTransform, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from worldenv_trl import keys
from worldenv_trl.envs import Reflect, TabletopEnv, chunked
from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig, StopRule
from worldenv_trl.scenes import load_task

TASK = "starter/open_the_top_drawer"


def reflected(scores, rule=StopRule(), reflector=None, texts=("shine",), **films):  # noqa: B008
    films = films or {"agentview": film(scores)}
    return TransformedEnv(FilmEnv(films, texts), Reflect(FirstPixel() if reflector is None else reflector, rule))


def executed(wave):
    return (wave["next", keys.STEP_MASK] & wave["mask"].unsqueeze(-1)).sum((0, 2)).tolist()


def last(wave, *key):
    steps = wave["mask"].sum(0) - 1
    return wave["next"][key][steps, torch.arange(wave.shape[1])]


# ------------------------------------------------------------------------------------------------- chunks


def test_the_rule_ends_a_row_inside_the_chunk_with_its_score_as_the_reward():
    wave = roll(reflected([[10, 20, 30, 40, 50, 200, 250, 250], [10] * 8]))
    assert executed(wave) == [6, 8]
    assert last(wave, "terminated").squeeze(-1).tolist() == [True, False]
    assert last(wave, "truncated").squeeze(-1).tolist() == [False, True]
    torch.testing.assert_close(last(wave, "reward").squeeze(-1), torch.tensor([200 / 255, 10 / 255]))
    assert last(wave, *keys.IMAGE)[0, 0, 0, 0] == 200  # the frame that ended it, not the chunk's last
    assert last(wave, keys.NUM_STEPS).squeeze(-1).tolist() == [6, 8]
    assert last(wave, *keys.STATE)[:, 0].tolist() == [6, 8] and last(wave, keys.KINEMATIC_STATE)[:, 0].tolist() == [
        6,
        8,
    ]


def test_the_images_of_every_camera_are_those_of_the_frame_that_ended_the_row():
    wrist = film([[1, 2, 3, 4, 5, 6, 7, 8]], size=16)
    wave = roll(reflected(None, agentview=film([[10, 20, 250, 40, 50, 60, 70, 80]]), wrist=wrist))
    assert executed(wave) == [3]
    assert last(wave, *keys.IMAGE)[0, 0, 0, 0] == 250 and last(wave, *keys.WRIST_IMAGE)[0, 0, 0, 0] == 3


def test_a_reflector_looks_at_its_own_camera():
    films = {"agentview": film([[250] * 8]), "wrist": film([[10, 10, 10, 10, 10, 250, 10, 10]])}
    assert executed(roll(reflected(None, reflector=FirstPixel(cameras=("wrist",)), **films))) == [6]


def test_reward_is_zero_before_the_end():
    wave = roll(reflected([[10, 20, 30, 40, 50, 60, 70, 80]]))
    assert wave["next", "reward"].flatten().tolist() == [0.0, pytest.approx(80 / 255)]


def test_consecutive_frames_must_cross_also_over_the_seam_of_two_chunks():
    scores = [[200, 10, 200, 200, 200, 10, 10, 10]]
    assert executed(roll(reflected(scores, StopRule(consecutive=3)))) == [5]
    assert executed(roll(reflected(scores, StopRule(consecutive=1)))) == [1]
    assert executed(roll(reflected(scores, StopRule(consecutive=4)))) == [8]


def test_the_threshold_is_exclusive_and_can_be_moved():
    scores = [[10, 102, 204, 204, 10, 10, 10, 10]]
    assert executed(roll(reflected(scores, StopRule(0.7)))) == [3]
    assert executed(roll(reflected(scores, StopRule(0.9)))) == [8]


def test_the_last_frame_ends_a_row_as_done_not_as_cut_short():
    wave = roll(reflected([[10, 20, 30, 40, 50, 60, 70, 250]]))
    assert last(wave, "terminated").tolist() == [[True]] and last(wave, "truncated").tolist() == [[False]]


def test_frames_behind_the_step_limit_end_nothing():
    reflector = FirstPixel()
    wave = roll(reflected([[10, 20, 30, 40, 50, 60]], reflector=reflector))
    assert executed(wave) == [6]
    torch.testing.assert_close(last(wave, keys.SUCCESS_PROB), torch.tensor([[60 / 255]]))


def test_finished_rows_are_not_looked_at_again():
    reflector = FirstPixel()
    roll(reflected([[200] + [10] * 7, [10] * 8], reflector=reflector))
    assert reflector.shown == 2 + 2 * 4 + 1 * 4  # first frames, one chunk of both rows, one of the row that runs


@pytest.mark.parametrize("consecutive", [1, 2, 3, 5, 9])
@pytest.mark.parametrize("threshold", [0.3, 0.5, 0.8])
def test_streaming_stops_where_the_rule_stops_whole_videos(threshold, consecutive):
    generator = torch.Generator().manual_seed(consecutive)
    red = torch.randint(256, (40, 18), generator=generator)
    red[20:] = torch.randint(150, 256, (20, 18), generator=generator)  # long runs, too
    rule = StopRule(threshold, consecutive)
    whole = torch.cat([torch.zeros(40, 1), red / 255], 1)
    expected = rule.first(whole, torch.ones_like(whole, dtype=torch.bool))
    wave = roll(reflected(red, rule))
    stopped = torch.where(last(wave, "terminated").squeeze(-1), torch.tensor(executed(wave)), -1)
    assert stopped.tolist() == expected.tolist()
    assert (expected >= 0).any() or consecutive == 9


def test_a_rule_may_be_assigned_while_the_rollout_runs_and_stopping_switched_off_before():
    env = reflected([[250, 250, 250, 250, 250, 250, 10, 10]])
    reflect = env.transform
    reflect.stops = False
    td = env.reset().set(keys.CHUNK, torch.zeros(1, 4, 7))
    td = env.step(td)
    assert not td["next", "done"].any() and td["next", keys.SUCCESS_PROB].item() == pytest.approx(250 / 255)
    reflect.stops, reflect.rule = True, StopRule(0.5, 2)
    td = env.step(step_mdp(td).set(keys.CHUNK, torch.zeros(1, 4, 7)))
    assert td["next", keys.NUM_STEPS].item() == 6  # the frames before do not count
    assert reflect.rule == StopRule(0.5, 2) and "consecutive=2" in repr(reflect)


def test_a_row_that_is_reset_begins_to_count_anew():
    env = reflected([[10, 10, 10, 250, 10, 10, 10, 10]], StopRule(0.5, 2))
    td = step_mdp(env.step(env.reset().set(keys.CHUNK, torch.zeros(1, 4, 7))))
    env.base_env.films["agentview"][:, 1, 0, 0, 0] = 250
    td["_reset"] = torch.ones(1, 1, dtype=torch.bool)
    td = env.step(env.reset(td).set(keys.CHUNK, torch.zeros(1, 4, 7)))
    assert td["next", keys.STEP_MASK].all() and not td["next", "done"].any()


# ------------------------------------------------------------------------------------------------- states


class Diary(FirstPixel):
    """Keeps scores, texts and lengths of the videos, and scores a prefix by its mean; its state grows."""

    def begin(self, frames, instructions):
        first = self.read(frames)
        state = {"score": first, "kept": first.unsqueeze(1), "seen": torch.ones(len(first), dtype=torch.int64)}
        return TensorDict(state, batch_size=[len(first)]).set("goal", NonTensorStack(*instructions))

    def extend(self, state, frames):
        new = self.read(frames)
        kept = torch.cat([state["kept"], torch.zeros_like(new)], 1)
        place = state["seen"].unsqueeze(-1) + torch.arange(new.shape[1])
        kept[torch.arange(len(new)).unsqueeze(-1), place] = new
        scores = kept.cumsum(1).gather(1, place) / (place + 1)
        grown = {"score": scores[:, -1], "kept": kept, "seen": state["seen"] + new.shape[1]}
        return TensorDict(grown, batch_size=[len(new)]).set("goal", state.get("goal")), scores


def test_a_growing_state_with_texts_is_put_back_row_by_row():
    red = torch.randint(256, (5, 12), generator=torch.Generator().manual_seed(0))
    reflector, texts = Diary(), ("one", "two", "three", "four", "five")
    env = reflected(red, StopRule(0.999), reflector, texts)
    td, order = env.reset(), [[0, 1, 2, 3, 4], [1, 3], [0, 1], [3, 4], [2]]
    steps = torch.zeros(5, dtype=torch.int64)
    for rows in order:
        td["_step"] = torch.zeros(5, 1, dtype=torch.bool)
        td["_step"][rows] = True
        steps[rows] += 4
        td = step_mdp(env.step(td.set(keys.CHUNK, torch.zeros(5, 4, 7))))
        whole = torch.cat([torch.zeros(5, 1), red / 255], 1)
        mean = whole.cumsum(1)[torch.arange(5), steps] / (steps + 1)
        torch.testing.assert_close(td[keys.SUCCESS_PROB].squeeze(-1), mean)
    assert env.transform._memory["state"].get("goal").tolist() == list(texts)
    td["_reset"] = torch.tensor([[False], [True], [False], [False], [True]])
    td = env.reset(td)
    assert td[keys.SUCCESS_PROB].squeeze(-1)[[1, 4]].tolist() == [0, 0]
    torch.testing.assert_close(td[keys.SUCCESS_PROB].squeeze(-1)[[0, 2, 3]], mean[[0, 2, 3]])
    td = env.step(td.set(keys.CHUNK, torch.zeros(5, 4, 7)).set("_step", torch.tensor([[False]] * 4 + [[True]])))
    torch.testing.assert_close(td["next", keys.SUCCESS_PROB][4], (whole[4, :5].sum() / 5).reshape(1))


def test_goals_are_the_texts_of_the_rows_that_are_reset():
    heard = []

    class Listening(FirstPixel):
        def begin(self, frames, instructions):
            heard.append(list(instructions))
            return super().begin(frames, instructions)

    env = reflected([[10] * 8] * 3, reflector=Listening(), texts=("one", "two", "three"))
    td = env.reset()
    td["_reset"] = torch.tensor([[False], [True], [True]])
    env.reset(td)
    assert heard == [["one", "two", "three"], ["two", "three"]]


def test_an_instruction_that_the_reflector_never_saw_is_warned_of_once_and_judged():
    config = CompactReflectorConfig(("open the drawer",), image_size=16)
    env = reflected([[10] * 8] * 2, StopRule(0.99), CompactReflector(config), texts=("open the drawer", "juggle"))
    with pytest.warns(UserWarning, match="never trained on the instruction 'juggle'") as warned:
        wave = roll(env)
        env.reset()
    assert len(warned) == 1 and wave["next", keys.SUCCESS_PROB].isfinite().all()


@pytest.mark.parametrize("spoil", ["begin", "extend"])
def test_scores_of_another_shape_are_refused(spoil):
    class Columns(FirstPixel):
        def begin(self, frames, instructions):
            state = super().begin(frames, instructions)
            return state.set("score", state["score"].unsqueeze(-1)) if spoil == "begin" else state

        def extend(self, state, frames):
            state, scores = super().extend(state, frames)
            return state, scores.unsqueeze(-1)

    with pytest.raises(ValueError, match=rf"Columns.{spoil}: .* must be \(2,"):
        roll(reflected([[10] * 8] * 2, reflector=Columns()))


@pytest.mark.parametrize("call", ["begin", "extend"])
@pytest.mark.parametrize("score", [float("nan"), 1.5, -0.1])
def test_scores_that_are_no_probabilities_are_refused(call, score):
    class Percent(FirstPixel):
        def begin(self, frames, instructions):
            state = super().begin(frames, instructions)
            return state.set("score", state["score"] * 0 + score) if call == "begin" else state

        def extend(self, state, frames):
            state, scores = super().extend(state, frames)
            return state, scores * 0 + score

    with pytest.raises(ValueError, match=rf"Percent.{call}: .* must be probabilities, in \[0, 1\], got {score:g}"):
        roll(reflected([[10] * 8] * 2, reflector=Percent()))


# ------------------------------------------------------------------------------------------------- specs


@pytest.mark.parametrize("cameras", [("agentview",), ("agentview", "wrist")])
def test_specs_hold_with_and_without_the_frames(cameras):
    films = {camera: film([[10] * 8] * 2) for camera in cameras}
    check_env_specs(reflected(None, **films))
    bare = reflected(None, **films)
    bare.append_transform(ExcludeTransform(*map(keys.frames_key, cameras)))
    check_env_specs(bare)
    wave = roll(bare)
    assert not any(keys.frames_key(camera) in wave["next"].keys(True) for camera in cameras)
    assert wave["next", keys.SUCCESS_PROB].isfinite().all()


@pytest.mark.parametrize("around", [lambda reflect: reflect, lambda reflect: Compose(StepCounter(), reflect)])
@pytest.mark.parametrize(
    ("trained_for", "message"),
    [
        ({"cameras": ("agentview", "wrist")}, r"camera 'wrist'.* shows image\): pass cameras=\('agentview', 'wrist'\)"),
        ({"image_size": 32}, r"frames of 32 px, .* are 16 x 16 px: pass image_size=32"),
    ],
)
def test_an_env_that_does_not_show_what_the_reflector_looks_at_is_refused_at_once(trained_for, message, around):
    reflect = Reflect(FirstPixel(**trained_for))
    with pytest.raises(ValueError, match=message):
        TransformedEnv(FilmEnv({"agentview": film([[10] * 8])}), around(reflect))


@pytest.mark.parametrize("given", [(FirstPixel(), 0.5), (torch.nn.Identity(), StopRule())])
def test_what_is_no_reflector_or_no_rule_is_refused_at_once(given):
    with pytest.raises(TypeError, match=r"must be a (Reflector|StopRule), got (Identity|float)"):
        Reflect(*given)


def test_a_refused_transform_may_be_put_onto_another_env():
    reflect = Reflect(FirstPixel(cameras=("wrist",)))
    with pytest.raises(ValueError, match="'wrist'"):
        TransformedEnv(FilmEnv({"agentview": film([[10] * 8])}), reflect)
    assert executed(roll(TransformedEnv(FilmEnv({"wrist": film([[10] * 8])}), reflect))) == [8]


def test_chunks_without_frames_are_refused():
    env = FilmEnv({"agentview": film([[10] * 8])})
    with pytest.raises(ValueError, match="put Reflect onto the step-level env"):
        TransformedEnv(env, Compose(ExcludeTransform(keys.frames_key("agentview")), Reflect(FirstPixel())))


# ------------------------------------------------------------------------------------------------- the physics


@pytest.fixture
def physics():
    made = []

    def make(rows, rule=StopRule(), reflector=None, around=lambda env: env, **settings):  # noqa: B008
        settings = {"image_size": 16, "terminate_on_success": False, "max_steps": 8, "num_threads": 1} | settings
        made.append(TabletopEnv(TASK, rows, **settings))
        return around(TransformedEnv(made[-1], Reflect(reflector or Length(), rule)))

    yield make
    for env in made:
        env.close()


class Length(FirstPixel):
    """Scores a prefix by the number of its frames: a tenth each."""

    def begin(self, frames, instructions):
        count = len(self.read(frames))
        return TensorDict({"score": torch.full((count,), 0.1)}, batch_size=[count])

    def extend(self, state, frames):
        self.read(frames)
        scores = state["score"].unsqueeze(-1) + torch.arange(1, 1 + frames[self.cameras[0]].shape[1]) / 10
        return state.copy().set("score", scores[:, -1]), scores


def test_over_the_physics_a_stop_leaves_the_rest_of_the_chunk_unexecuted(physics):
    env = physics(2, StopRule(0.35), around=lambda env: chunked(env, 4))
    check_env_specs(env)
    td = env.reset()
    td = env.step(td.set(keys.CHUNK, torch.zeros(2, 4, 7)))
    assert td["next", keys.STEP_MASK].tolist() == [[True, True, True, False]] * 2
    assert td["next", "terminated"].all()
    torch.testing.assert_close(td["next", "reward"], torch.full((2, 1), 0.4))
    assert td["next", keys.NUM_STEPS].squeeze(-1).tolist() == [3, 3]


def test_a_rule_that_is_assigned_counts_inside_chunks_of_the_physics(physics):
    stepped = physics(1, StopRule(0.95))
    env = chunked(stepped, 4)
    td = env.step(env.reset().set(keys.CHUNK, torch.zeros(1, 4, 7)))
    assert td["next", keys.STEP_MASK].all()
    stepped.transform.rule = StopRule(0.65)
    td = env.step(step_mdp(td).set(keys.CHUNK, torch.zeros(1, 4, 7)))
    assert td["next", keys.STEP_MASK].tolist() == [[True, True, False, False]]


def test_a_partial_reset_forgets_the_video_of_the_reset_rows_only(physics):
    env = physics(2, StopRule(0.95))
    td = env.reset()
    torch.testing.assert_close(td[keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.1, 0.1]))
    for _ in range(2):
        td = env.step_mdp(env.step(td.set(keys.ACTION, torch.zeros(2, 7))))
    td["_reset"] = torch.tensor([[True], [False]])
    td = env.reset(td)
    torch.testing.assert_close(td[keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.1, 0.3]))
    td = env.step(td.set(keys.ACTION, torch.zeros(2, 7)))
    torch.testing.assert_close(td["next", keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.2, 0.4]))


def test_rows_that_are_not_stepped_keep_their_video_and_score(physics):
    env = physics(2, StopRule(0.95))
    td = env.reset().set(keys.ACTION, torch.zeros(2, 7))
    td["_step"] = torch.tensor([True, False])
    td = env.step_mdp(env.step(td))
    td["_step"] = torch.tensor([True, True])
    td = env.step(td.set(keys.ACTION, torch.zeros(2, 7)))
    torch.testing.assert_close(td["next", keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.3, 0.2]))


def test_chunks_of_the_physics_are_scored_as_its_steps_are(physics):
    torch.manual_seed(0)
    reflector = CompactReflector(CompactReflectorConfig((load_task(TASK).language,), image_size=32))
    actions = torch.zeros(1, 8, 7)
    actions[..., 1] = 1.0

    def score(around):
        env = physics(1, StopRule(0.999), reflector, around, image_size=32, seed=0)
        td = env.reset()
        if around is chunked:
            return env.step(td.set(keys.CHUNK, actions))["next", keys.SUCCESS_PROB]
        for step in range(8):
            td = env.step(td.set(keys.ACTION, actions[:, step]))["next"]
        return td[keys.SUCCESS_PROB]

    assert torch.equal(score(chunked), score(lambda env: env))
