"""Rollouts that go on from the middle of a recorded episode."""

from __future__ import annotations

import pytest
import torch
from imagined_worlds import FK, SIZE, TWO, C, CountingWorldModel, make_env, with_chunk
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from worldenv_trl import keys
from worldenv_trl.data import Episodes
from worldenv_trl.envs import BranchPoints, Reflect
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.robot import panda

STEPS = 3 * C


def recorded(reached: tuple[int, ...] = (-1, -1, -1, -1), length: int = STEPS) -> Episodes:
    """Episodes of two tasks in turn; red of the frames is 50 x episode + step; the goal is reached at those steps."""
    count, generator = len(reached), torch.Generator().manual_seed(5)
    actions = 0.3 * torch.randn(count, length, 7, generator=generator)
    first = FK.initial_state(torch.as_tensor(panda.HOME_Q, dtype=torch.float32).repeat(count, 1))
    kinematic = torch.cat([first.unsqueeze(1), FK.rollout(first, actions.clamp(-1, 1))], 1)
    success = torch.stack([torch.arange(length + 1) >= (each if each >= 0 else length + 1) for each in reached])
    row, step = torch.arange(count).repeat_interleave(length + 1), torch.arange(length + 1).repeat(count)
    frames = {}
    for index, camera in enumerate(TWO):
        image = torch.randint(256, (len(row), 3, SIZE, SIZE), generator=generator, dtype=torch.uint8)
        image[:, 0] = (50 * row + step + 7 * index).to(torch.uint8)[:, None, None]
        frames[keys.image_entry(camera)] = image
    entries = {
        "actions": actions.clamp(-1, 1),
        "states": FK.state(kinematic, "commanded"),
        keys.KINEMATIC_STATES: kinematic,
        "success": success,
        "length": torch.full((count, 1), length),
        keys.TASK_ID: torch.arange(count)[:, None] % 2,
        keys.CONTEXT_ID: 700 + torch.arange(count)[:, None],
    }
    texts = ["push" if row % 2 else "pull" for row in range(count)]
    return Episodes(TensorDict(entries, [count]), texts, TensorDict({keys.FRAMES: frames}, [len(row)]))


def branching(share: float = 1.0, **settings):
    episodes = recorded()
    points = BranchPoints(episodes, C, share=share, latest=2 * C)
    return make_env(4, 2, branch_points=points, **settings), episodes


def begun(env, td) -> list[tuple[int, int]]:
    """Episode and step that each row [G * N] begins at, read from what is seen."""
    red = td[keys.IMAGE][..., 0, 0, 0].flatten().long()
    return [(int(each) // 50, int(each) % 50) for each in red]


def test_points_are_whole_chunks_before_the_goal_or_the_end():
    points = BranchPoints(recorded((-1, C + 1, 2 * C + 2, 0)), C, share=1.0, latest=2 * C)
    at = list(zip(points.rows.tolist(), points.steps.tolist(), strict=True))
    # half a chunk is left everywhere: episode 1 reaches its goal one step after C, episode 3 has nothing to go on from
    assert at == [(0, C), (0, 2 * C), (2, C), (2, 2 * C)]
    assert len(BranchPoints(recorded((-1,), length=C), C, share=1.0, latest=2 * C)) == 0


def test_the_world_model_remembers_the_recorded_frames_and_goes_on_from_them():
    env, episodes = branching()
    td = env.reset()
    where = begun(env, td)
    assert {step for _, step in where} == {C, 2 * C} and where[0] == where[1]  # a group shares its point
    for row, (episode, step) in enumerate(where):
        group, place = divmod(row, 2)
        assert td[keys.TASK_ID][group, place] == episode % 2 == group % 2  # the tasks still come in turn
        assert td[keys.CONTEXT_ID][group, place] == 700 + episode and td[keys.NUM_STEPS][group, place] == step
        assert torch.equal(td[keys.KINEMATIC_STATE][group, place], episodes[keys.KINEMATIC_STATES][episode, step])
    td = env.step(with_chunk(td))["next"]
    asked = env.world_model.requests[-1]
    for row, (episode, step) in enumerate(where):
        for index, camera in enumerate(TWO):
            entry = keys.image_entry(camera)
            reds = asked["memory", "frames", entry][row, :, 0, 0, 0].tolist()
            assert reds == [50 * episode + each + 7 * index for each in (step // 2, step)]
            shown = episodes.frames(camera, torch.tensor(episode), torch.tensor(0))
            assert torch.equal(asked["memory", "reference", entry][row], shown)
        poses = FK.pose(episodes[keys.KINEMATIC_STATES][episode, torch.tensor([step // 2, step])])
        assert torch.allclose(asked["memory", "poses"][row], poses, atol=1e-6)
    ended = [step + C >= STEPS for _, step in where]
    assert td["truncated"].flatten().tolist() == ended and any(ended) and not all(ended)
    assert td[keys.NUM_STEPS].flatten().tolist() == [step + C for _, step in where]


def test_rows_that_restart_while_their_group_runs_begin_where_it_did():
    env, _ = branching()
    td = env.reset()
    before = begun(env, td)
    td = env.step(with_chunk(td))["next"]
    mask = torch.zeros(4, 2, 1, dtype=torch.bool)
    mask[:, 0] = True
    again = env.reset(td.set("_reset", mask), set_state=False)
    assert begun(env, again)[::2] == before[::2]
    assert again[keys.NUM_STEPS][:, 0].flatten().tolist() == [step for _, step in before[::2]]


def test_without_a_share_nothing_changes_and_with_half_of_it_half_the_groups_branch():
    plain, (none, _), (half, _) = make_env(4, 2), branching(0.0), branching(0.5)
    for _ in range(3):
        one, other = plain.reset(), none.reset()
        assert torch.equal(one[keys.IMAGE], other[keys.IMAGE])
    count = sum(int((half.reset()[keys.NUM_STEPS][:, 0] > 0).sum()) for _ in range(100))
    assert 160 < count < 240  # of 400; five standard deviations are 50
    half.branch_points.share = 0.0
    assert not half.reset()[keys.NUM_STEPS].any()


def test_starts_can_be_drawn_elsewhere_and_orders_continued():
    (draws, _), (begins, _), (goes_on, _) = branching(0.5), branching(0.5), branching(0.5)
    state = draws.order_state()
    begins.begin_with(draws.draw_starts())
    td = begins.reset()
    goes_on.load_order_state(state)
    assert torch.equal(td[keys.IMAGE], goes_on.reset()[keys.IMAGE]) and td[keys.NUM_STEPS].any()
    noise = [env.step(with_chunk(env.reset()))["next", keys.FRAMES, "image"] for env in (draws, goes_on)]
    assert torch.equal(*noise)


class Sum(Reflector):
    """Its score grows with all red that it has seen, and it reads where the hand is."""

    def __init__(self) -> None:
        super().__init__(cameras=TWO, reads_path=True)

    def begin(self, frames, instructions):
        red = sum(frames[camera][:, 0, 0, 0].float() for camera in TWO) + frames[keys.KINEMATIC_STATES][:, 0]
        return TensorDict({"score": red / 1e5, "seen": red.unsqueeze(-1)}, [len(red)])

    def extend(self, state, frames):
        red = sum(frames[camera][:, :, 0, 0, 0].float() for camera in TWO) + frames[keys.KINEMATIC_STATES][..., 0]
        scores = (state["seen"].sum(-1, keepdim=True) + red.cumsum(-1)) / 1e5
        return state.clone().set("score", scores[:, -1]).set("seen", torch.cat([state["seen"], red], 1)), scores


def test_the_reflector_has_seen_the_beginning_too():
    base, episodes = branching(0.5)
    env = TransformedEnv(base, Reflect(Sum(), StopRule(0.99, 1)))
    td = env.reset()
    where = base.branch_points.steps
    points = base._point.tolist()
    assert -1 in points and max(points) >= 0
    after = env.step(with_chunk(td))["next"]
    for row, point in enumerate(points):
        group, place = divmod(row, 2)
        shown = {camera: after[keys.frames_key(camera)][group, place].unsqueeze(0) for camera in TWO}
        shown[keys.KINEMATIC_STATES] = after[keys.KINEMATIC_STATES][group, place].unsqueeze(0)
        if point < 0:
            past = {camera: td[keys.image_key(camera)][group, place][None, None] for camera in TWO}
            past[keys.KINEMATIC_STATES] = td[keys.KINEMATIC_STATE][group, place][None, None]
        else:
            episode, numbers = base.branch_points.rows[point], torch.arange(int(where[point]) + 1)
            past = {camera: episodes.frames(camera, episode, numbers).unsqueeze(0) for camera in TWO}
            past[keys.KINEMATIC_STATES] = episodes[keys.KINEMATIC_STATES][episode, numbers].unsqueeze(0)
        video = {name: torch.cat([past[name], shown[name]], 1) for name in past}
        state = Sum().begin({name: values[:, 0] for name, values in video.items()}, ["pull"])
        _, scores = Sum().extend(state, {name: values[:, 1:] for name, values in video.items()})
        assert torch.allclose(after[keys.SUCCESS_PROB][group, place], scores[0, -1:], rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"share": 1.5}, "share must lie between 0 and 1, got 1.5"),
        ({"latest": C - 1}, "latest a whole number not below it, got 4 and 3"),
        ({"chunk_length": 3}, "chunk_length=3 and latest=8, the rollouts have chunks of 4"),
        ({"latest": STEPS}, "latest below max_steps"),
    ],
)
def test_refusals(change, message):
    options = {"chunk_length": C, "share": 1.0, "latest": 2 * C} | change
    with pytest.raises(ValueError, match=message):
        make_env(branch_points=BranchPoints(recorded(), options.pop("chunk_length"), **options))


def test_a_share_that_is_assigned_and_points_that_are_read_together_are_checked():
    points = BranchPoints(recorded(), C, share=1.0, latest=2 * C)
    with pytest.raises(ValueError, match="share must lie between 0 and 1, got nan"):
        points.share = float("nan")
    with pytest.raises(ValueError, match=r"the same step, got \[4, 8\]"):
        points.past(torch.tensor([0, 1]))


def test_episodes_must_be_labelled_and_show_what_the_world_model_paints():
    imagined = recorded()
    del imagined.entries["success"]
    with pytest.raises(ValueError, match="carry no success labels"):
        BranchPoints(imagined, C, share=1.0)
    points = BranchPoints(recorded().through(["agentview"]), C, share=1.0, latest=2 * C)
    with pytest.raises(ValueError, match="the world model looks at 'wrist'"):
        make_env(branch_points=points, world_model=CountingWorldModel())
