"""Recorded rollouts once more in a world model whose frames follow from actions and noise seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv

from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import ExpertPolicy, ImaginedEnv, Reflect, TabletopEnv
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.record import (
    RolloutWriter,
    provenance,
    read_attachments,
    read_metadata,
    read_rollouts,
    recorded,
    replay,
)
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.world_models import WorldModel

C, SIZE, TASK = 4, 16, "starter/open_the_top_drawer"
FRAMES, WRIST = keys.frames_key("agentview"), keys.frames_key("wrist")


class Painter(WorldModel):
    """Red follows the gripper's action, green is noise of the seed, blue counts the frames; ``tint`` is its weight.

    ``together`` adds the number of rows it is asked for at once: what rounding does, but visible. The wrist's picture
    is the others' upside down.
    """

    def __init__(self, tint: int = 0, together: bool = False, cameras: Sequence[str] = ("agentview",)) -> None:
        super().__init__(cameras=cameras, image_size=SIZE, chunk_length=C)
        self.register_buffer("tint", torch.tensor(tint))
        self.together, self.calls = together, 0

    def memory_indices(self, now: Tensor) -> Tensor:
        return now.unsqueeze(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.calls += 1
        count = len(tensordict)
        frames = torch.zeros(count, C, 3, SIZE, SIZE, dtype=torch.uint8)
        frames[:, :, 0] = ((tensordict["padded_actions"][..., 6] + 1) * 100).to(torch.uint8)[..., None, None]
        for row, seed in enumerate(tensordict["noise_seed"].flatten().tolist()):
            generator = torch.Generator().manual_seed(seed)
            frames[row, :, 1] = torch.randint(256, (C, SIZE, SIZE), generator=generator, dtype=torch.uint8)
        newest = tensordict["memory", "frames", "image"][:, -1, 2, 0, 0].long()
        counted = (newest[:, None] + torch.arange(1, C + 1) + self.tint).to(torch.uint8)
        frames[:, :, 2] = counted[..., None, None] + (count if self.together else 0)
        tensordict[FRAMES] = frames
        if "wrist" in self.cameras:
            tensordict[WRIST] = frames.flip(-2)
        return tensordict


class Redness(Reflector):
    """Scores a video by the red of its last frame."""

    factor = 1.0

    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        return TensorDict({"score": self._scores(frames["agentview"])}, [len(instructions)])

    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        scores = self._scores(frames["agentview"])
        return TensorDict({"score": scores[:, -1]}, state.batch_size), scores

    def _scores(self, frames: Tensor) -> Tensor:
        return (frames[..., 0, 0, 0].float() / 255 * self.factor).clamp(0.001, 0.999)


def closing(stop: int):
    """A policy whose gripper closes a little more at each decision; red reaches 200 of 255 at decision ``stop``."""

    def chunk(steps: Tensor) -> Tensor:
        out = torch.zeros(*steps.shape[:-1], C, 7)
        out[..., 6] = -1 + 2 * (steps / C + 1) / stop
        return out

    return TensorDictModule(chunk, [keys.NUM_STEPS], [keys.CHUNK])


def imagined(model, steps):
    contexts = TabletopEnv(TASK, 2, image_size=SIZE, cameras=model.cameras, seed=0, proprio="commanded").reset()
    contexts = contexts.exclude("done", "terminated", "truncated")
    return ImaginedEnv(model, ForwardKinematics(), contexts, [2, 2], max_steps=steps, seed=3)


def imagine(path, model, *, reflector=None, described=True, steps=16, parts=1):
    env = imagined(model, steps)
    models = {"world_model": model}
    if reflector is not None:
        env, models["reflector"] = TransformedEnv(env, Reflect(reflector, StopRule(0.7))), reflector
    wave = next(iter(GroupCollector(env, closing(4), groups_per_batch=2)))
    about = provenance(env, models=models, tasks=[TASK]) if described else {}
    with RolloutWriter(path, **about) as writer:
        for part in wave.chunk(parts):
            writer.write(part)
    return wave


def test_the_recorded_model_paints_the_same_frames_from_the_recorded_seeds(tmp_path):
    model = Painter()
    wave = imagine(tmp_path / "a.mcap", model).reshape(-1, 4)
    for row in range(4):
        report = replay(tmp_path / "a.mcap", row, world_model=model)
        assert report.exact is True and set(report.psnr.values()) == {float("inf")}
        played = read_rollouts(report.target)[0]
        assert torch.equal(played["next", *FRAMES], wave["next", *FRAMES][row])
        assert torch.equal(played["next", keys.NOISE_SEED], wave["next", keys.NOISE_SEED][row])
    assert not torch.equal(wave["next", *FRAMES][0], wave["next", *FRAMES][1])  # noise tells them apart
    again = replay(report.target, 0, world_model=model, write=False)
    assert again.exact is True


def test_a_rollout_that_does_not_begin_at_its_beginning_is_refused(tmp_path):
    wave = imagine(tmp_path / "a.mcap", Painter())
    about = provenance(imagined(Painter(), 16), models={"world_model": Painter()}, tasks=[TASK])
    with RolloutWriter(tmp_path / "later.mcap", **about) as file:
        file.write(wave[:, :, 1:])
    for options in ({"world_model": Painter()}, {"mode": "physics"}, {"world_model": Painter(), "from_step": 99}):
        with pytest.raises(ValueError, match=f"rollout 1 of .* begins at step {C}: the world model remembers"):
            replay(tmp_path / "later.mcap", 1, **options)


def test_every_camera_of_the_model_is_replayed_and_compared(tmp_path):
    model = Painter(cameras=("agentview", "wrist"))
    wave = imagine(tmp_path / "a.mcap", model).reshape(-1, 4)
    report = replay(tmp_path / "a.mcap", 1, world_model=model)
    assert report.exact is True and {"image", "wrist_image"} <= set(report.compared)
    played = read_rollouts(report.target)[0]
    for key in (FRAMES, WRIST):
        assert torch.equal(played["next", *key], wave["next", *key][1])
        assert torch.equal(played["next", "recorded", *key], wave["next", *key][1])
    late = replay(tmp_path / "a.mcap", 1, world_model=Painter(7, cameras=model.cameras), from_step=8, write=False)
    assert [step for step, value in late.psnr.items() if value == float("inf")] == list(range(9))
    assert {each.field for each in late.divergences} == {"image", "wrist_image"}


def test_a_recording_without_frames_is_replayed_by_what_it_shows(tmp_path):
    model = Painter()
    wave = imagine(tmp_path / "a.mcap", model)
    about = {"metadata": read_metadata(tmp_path / "a.mcap"), "attachments": read_attachments(tmp_path / "a.mcap")}
    with RolloutWriter(tmp_path / "b.mcap", **about) as writer:
        writer.write(wave.exclude(keys.FRAMES, ("next", keys.FRAMES)))
    report = replay(tmp_path / "b.mcap", 1, world_model=model)
    assert report.exact is True and list(report.psnr) == [0, 4, 8, 12, 16]
    played = read_rollouts(report.target)[0]
    shown = played["next", "recorded", *FRAMES]
    assert torch.equal(shown[:, -1], wave.reshape(-1, 4)["next", "observation", "image"][1])
    late = replay(tmp_path / "b.mcap", 1, world_model=Painter(7), edits={9: {6: 1.0}}, write=False)
    assert late.first.step == 10


def test_a_policy_of_another_chunk_length_is_refused(tmp_path):
    imagine(tmp_path / "a.mcap", Painter(), steps=4)
    policy = TensorDictModule(lambda steps: torch.zeros(*steps.shape[:-1], C + 1, 7), [keys.NUM_STEPS], [keys.CHUNK])
    with pytest.raises(ValueError, match="the policy's chunks have 5 actions, the world model's 4"):
        replay(tmp_path / "a.mcap", world_model=Painter(), policy=policy, write=False)


def test_a_model_of_a_camera_that_was_not_recorded_is_refused(tmp_path):
    imagine(tmp_path / "a.mcap", Painter(), steps=4)
    both = Painter(cameras=("agentview", "wrist"))
    with pytest.raises(ValueError, match=r"paints agentview, wrist, but rollout 0 of .*a\.mcap shows agentview"):
        replay(tmp_path / "a.mcap", world_model=both)


def test_another_model_gives_a_difference_curve_and_no_claim(tmp_path):
    imagine(tmp_path / "a.mcap", Painter())
    report = replay(tmp_path / "a.mcap", 1, world_model=Painter(tint=7))
    assert report.kind == "difference" and report.exact is None
    assert any("the world_model is not the recorded one" in note for note in report.notes)
    assert report.first.step == 1 and report.first.field == "image" and report.first.size == 7
    assert 20 < report.psnr[1] < 40 and report.psnr[16] < report.psnr[1]  # it counts on from its own frames
    assert read_metadata(report.target)["models"] != read_metadata(tmp_path / "a.mcap")["models"]


def test_a_model_of_another_hash_that_paints_the_same_is_not_called_exact(tmp_path):
    class Twin(Painter):
        pass

    imagine(tmp_path / "a.mcap", Painter())
    report = replay(tmp_path / "a.mcap", 0, world_model=Twin(), write=False)
    assert not report.divergences and report.exact is None
    assert "equality is not claimed" in str(report) and "bit-exact" not in str(report)


def test_a_file_that_names_no_model_is_not_called_exact(tmp_path):
    model = Painter()
    imagine(tmp_path / "a.mcap", model, described=False)
    report = replay(tmp_path / "a.mcap", 0, world_model=model, write=False)
    assert report.exact is None and any("does not name its world_model" in note for note in report.notes)


@pytest.mark.parametrize("parts", [1, 2])
def test_a_model_that_depends_on_its_batch_is_replayed_with_the_rows_of_its_wave(tmp_path, parts):
    model = Painter(together=True)
    imagine(tmp_path / "a.mcap", model, reflector=Redness(), parts=parts)  # post-training writes group by group
    report = replay(tmp_path / "a.mcap", 2, world_model=model, write=False)
    assert report.exact is True
    assert any("with the 4 rows of its wave" in note for note in report.notes)


def test_a_recorder_s_rollouts_are_replayed_with_their_wave_too(tmp_path):
    model = Painter(together=True)
    env = imagined(model, 8)
    about = provenance(env, models={"world_model": model}, tasks=[TASK])
    env = recorded(env, tmp_path / "a.mcap", **about)
    for _ in range(2):
        env.rollout(4, closing(4))
    env.close()
    for number in (1, 6):
        report = replay(tmp_path / "a.mcap", number, world_model=model, write=False)
        assert report.exact is True and any("4 rows of its wave" in note for note in report.notes)


def test_a_real_rollout_may_go_on_in_imagination_from_one_of_its_frames(tmp_path):
    env = TabletopEnv(TASK, 1, image_size=SIZE, seed=0, max_steps=12, with_sim_state=True, proprio="commanded")
    rollout = env.rollout(12)
    with RolloutWriter(tmp_path / "real.mcap", **provenance(env)) as writer:
        writer.write(rollout)
    report = replay(tmp_path / "real.mcap", world_model=Painter(), mode="imagination", from_step=8, write=False)
    assert [step for step, value in report.psnr.items() if value == float("inf")] == list(range(9))


def test_the_reflector_stops_where_it_did_and_another_threshold_stops_elsewhere(tmp_path):
    model, judge = Painter(), Redness()
    imagine(tmp_path / "a.mcap", model, reflector=judge)
    same = replay(tmp_path / "a.mcap", 0, world_model=model, reflector=judge, write=False)
    assert same.exact is True and "success_prob" in same.compared
    assert same.outcome["recorded"] == same.outcome["replayed"] and same.outcome["recorded"]["stopped"]
    assert same.outcome["replayed"]["last step"] == 13  # red is 200 / 255 from the fourth decision on

    class Hasty(Redness):
        factor = 1.3

    hasty = replay(tmp_path / "a.mcap", 0, world_model=model, reflector=Hasty())
    played, before = read_rollouts(hasty.target)[0], read_rollouts(tmp_path / "a.mcap", rollouts=0)[0]
    for path in (keys.STATE, ("success_prob",)):  # what was recorded lies beside it, decision by decision
        # The replay ends inside the second decision, and the recording is known there only as it was after the first.
        assert torch.equal(played["next", "recorded", path[-1]][0], before["next", *path][0]), path
    assert not torch.equal(played["next", "success_prob"], played["next", "recorded", "success_prob"])
    (end,) = (each for each in hasty.divergences if each.field == "end")
    assert end.step == 9 and "the recording ends at step 13, the replay at step 9" in str(hasty)
    lower = replay(tmp_path / "a.mcap", 0, world_model=model, reflector=judge, threshold=0.5, write=False)
    assert lower.kind == "what-if" and lower.outcome["replayed"]["last step"] == 9
    assert "without the change it ends at step 13, with it at step 9" in str(lower) and "no effect" not in str(lower)
    # Before the branch nothing stops it, although frames cross the new threshold there.
    late = replay(tmp_path / "a.mcap", 0, world_model=model, reflector=judge, threshold=0.3, from_step=8, write=False)
    assert late.outcome["replayed"]["last step"] == 9


class OfTwo(Redness):
    """Another one judges imagination."""

    def __init__(self) -> None:
        super().__init__(cameras=("agentview",))
        self.factor, self.imagined = 0.0, Redness(cameras=("agentview",))
        self.imagined.weight = torch.nn.Parameter(torch.ones(1))  # told apart by its hash

    def for_world(self, world: str) -> Reflector:
        return self.imagined if world == "imagined" else self


def test_imagination_is_judged_by_the_one_that_judged_it(tmp_path):
    model, judge = Painter(), OfTwo()
    imagine(tmp_path / "a.mcap", model, reflector=judge.imagined)
    same = replay(tmp_path / "a.mcap", 0, world_model=model, reflector=judge, write=False)
    assert same.exact is True and "success_prob" in same.compared and not same.notes
    lived = replay(tmp_path / "a.mcap", 0, mode="physics", reflector=judge, write=False)
    assert "the reflector's other part judges this world: its R is not the recorded one's" in lived.notes
    another = OfTwo()
    another.imagined.weight = torch.nn.Parameter(torch.zeros(1))
    lived = replay(tmp_path / "a.mcap", 0, mode="physics", reflector=another, write=False)
    assert any("the reflector is not the recorded one" in note for note in lived.notes)


def test_an_edit_is_told_apart_from_another_model(tmp_path):
    imagine(tmp_path / "a.mcap", Painter())
    other = Painter(tint=7)
    report = replay(tmp_path / "a.mcap", 0, world_model=other, edits={9: {6: 1.0}}, write=False)
    assert report.first.step == 10 and all(report.psnr[step] == float("inf") for step in range(10))
    nothing = replay(tmp_path / "a.mcap", 0, world_model=other, seed=0, from_step=16 - C, write=False)
    assert nothing.first.step == 16 - C + 1  # other noise from the branch on
    inside = replay(tmp_path / "a.mcap", 0, world_model=other, seed=0, from_step=16 - 1, write=False)
    assert inside.divergences == nothing.divergences and f"branch at step {16 - C}:" in str(inside)
    assert f"a decision takes {C} steps: the branch is at step {16 - C}, not 15" in inside.notes


def test_before_the_branch_the_model_is_not_asked(tmp_path):
    model = Painter()
    wave = imagine(tmp_path / "a.mcap", model).reshape(-1, 4)
    model.calls = 0
    report = replay(
        tmp_path / "a.mcap", 1, world_model=model, policy=closing(9), from_step=8, target=tmp_path / "b.mcap"
    )
    assert model.calls == 2 * 2  # with and without the change
    played = read_rollouts(tmp_path / "b.mcap")[0]
    assert torch.equal(played["next", *FRAMES][:2], wave["next", *FRAMES][1, :2])
    assert report.first.step == 9 and played["next", "recorded", *FRAMES].shape == (4, C, 3, SIZE, SIZE)


def test_real_rollouts_replay_in_imagination_and_imagined_ones_in_the_physics(tmp_path):
    env = TabletopEnv(TASK, 1, image_size=SIZE, seed=0, with_sim_state=True, proprio="commanded")
    rollout = next(iter(GroupCollector(env, ExpertPolicy(env), groups_per_batch=1, group_size=1)))[:, 0]
    with RolloutWriter(tmp_path / "real.mcap", **provenance(env)) as writer:
        writer.write(rollout)
    report = replay(tmp_path / "real.mcap", world_model=Painter(), mode="imagination")
    assert report.exact is None and report.steps == int(rollout[keys.MASK].sum()) and len(report.psnr) > 5
    state = next(d for d in report.divergences if d.field == "state")
    assert state.size < 1e-4  # forward kinematics follows the commanded targets
    model = Painter()
    imagine(tmp_path / "a.mcap", model)
    report = replay(tmp_path / "a.mcap", 0, mode="physics")
    assert report.exact is None and report.kind == "difference" and report.target.name.endswith("_physics.mcap")
    assert "success" in report.outcome["replayed"] and 16 in report.psnr


def test_a_missing_world_model_is_an_error(tmp_path):
    imagine(tmp_path / "a.mcap", Painter(), steps=4)
    with pytest.raises(ValueError, match="pass its world_model"):
        replay(tmp_path / "a.mcap")


class Whole(OfTwo):
    """Another one judges either world, where somebody asks."""

    def for_world(self, world: str) -> Reflector:
        return self.imagined


def test_the_physics_is_judged_by_all_of_a_reflector_that_judged_it(tmp_path):
    env, judge = TabletopEnv(TASK, 1, image_size=SIZE, seed=0, with_sim_state=True, proprio="commanded"), Whole()
    judged = TransformedEnv(env, Reflect(judge, StopRule(0.5)))
    rollout = next(iter(GroupCollector(judged, ExpertPolicy(env), groups_per_batch=1, group_size=1)))[:, 0]
    with RolloutWriter(tmp_path / "real.mcap", **provenance(judged, models={"reflector": judge})) as writer:
        writer.write(rollout)
    report = replay(tmp_path / "real.mcap", reflector=judge, write=False)
    assert report.exact is True and not report.notes
