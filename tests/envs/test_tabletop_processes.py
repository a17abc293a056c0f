"""TabletopEnv gives the same data, bit for bit, in any batch, on any threads, in any process, TorchRL's included."""

import hashlib
import math
import multiprocessing

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import ParallelEnv

from worldenv_trl.envs import TabletopEnv
from worldenv_trl.keys import ACTION, CONTEXT_ID, IMAGE, INSTRUCTION, NUM_STEPS, SIM_STATE, STATE, TASK_ID, WRIST_IMAGE
from worldenv_trl.scenes import load_task

BOWL, STOVE = "starter/put_the_bowl_on_the_plate", "starter/turn_on_the_stove"
MIXED = [BOWL, STOVE]
SEEN = (IMAGE, STATE, SIM_STATE, NUM_STEPS, CONTEXT_ID, TASK_ID)


def make(tasks, n, threads=1, size=32, cameras=("agentview",), max_steps=None):
    return TabletopEnv(
        tasks, n, image_size=size, cameras=cameras, init_state_mode="cycle", seed=0, num_threads=threads,
        with_sim_state=True, terminate_on_success=False, max_steps=max_steps,
    )  # fmt: skip


def played(tasks, n, threads=1, steps=6):
    """Images ``[n, steps, 3, H, W]`` and states ``[n, steps, S]`` under actions that depend on row and step only."""
    env = make(tasks, n, threads)
    plan = torch.rand(16, steps, 7, generator=torch.Generator().manual_seed(1)) * 1.6 - 0.8
    td, shown = env.reset(), []
    for step in range(steps):
        td = env.step(td.set(ACTION, plan[:n, step]))["next"]
        shown.append((td[IMAGE], td[SIM_STATE]))
    env.close()
    images, states = zip(*shown, strict=True)
    return torch.stack(images, 1), torch.stack(states, 1)


def digest(pair):
    return hashlib.sha256(b"".join(tensor.contiguous().numpy().tobytes() for tensor in pair)).hexdigest()


def digests(jobs):
    torch.set_num_threads(1)
    return [digest(played(*job)) for job in jobs]


class Wave(TensorDictModuleBase):
    """A policy that is a function of ``num_steps`` and the row."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [NUM_STEPS], [ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows = torch.arange(tensordict.numel()).reshape(*tensordict.shape, 1) % 4
        phase = tensordict[NUM_STEPS] + rows + torch.arange(7)
        return tensordict.set(ACTION, 0.6 * torch.sin(phase * math.pi / 5))


def pairs_of(worker: int = 0) -> TabletopEnv:
    """Four rows of two tasks; episodes of five steps."""
    torch.set_num_threads(1)
    return make(MIXED, 4, max_steps=5)


# ----------------------------------------------------------------------------------------------------- determinism


@pytest.mark.parametrize("tasks", [BOWL, MIXED], ids=["one task", "two tasks"])
def test_rows_do_not_depend_on_batch_size_or_threads(tasks):
    images, states = played(tasks, 16)
    assert len({digest((image,)) for image in images[:, -1]}) == 16  # every row shows something else
    for n, threads in ((1, 1), (2, 2), (4, 1), (4, 2), (16, 2)):
        if n >= len(MIXED) or tasks == BOWL:
            few = played(tasks, n, threads)
            assert torch.equal(few[0], images[:n]) and torch.equal(few[1], states[:n]), (n, threads)


def test_rows_of_a_mixed_batch_are_those_of_a_single_row_of_their_task():
    images, states = played(MIXED, 2)
    alone = played(BOWL, 1)
    size = alone[1].shape[-1]
    assert torch.equal(images[:1], alone[0]) and torch.equal(states[:1, :, :size], alone[1])


def test_another_process_draws_and_computes_the_same():
    jobs = [(BOWL, 4, 1), (MIXED, 4, 2)]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply_async(digests, (jobs,))
        assert digests(jobs) == there.get(timeout=120)


# ----------------------------------------------------------------------------------------------------- TorchRL


def test_two_workers_of_a_parallel_env_are_two_serial_envs():
    env = ParallelEnv(2, pairs_of)
    try:
        together = env.rollout(4, Wave(), break_when_any_done=False)
    finally:
        env.close()
    single = pairs_of()
    alone = single.rollout(4, Wave(), break_when_any_done=False)
    single.close()
    assert together.shape == (2, 4, 4)
    assert together["next", IMAGE].shape == (2, 4, 4, 3, 32, 32)
    for worker in together.unbind(0):
        for key in SEEN:
            assert torch.equal(worker[key], alone[key]) and torch.equal(worker["next", key], alone["next", key]), key
        for row, task in enumerate(MIXED * 2):
            assert worker[row, 2][INSTRUCTION] == load_task(task).language


def test_a_collector_in_a_process_of_its_own_collects_what_one_here_does_resets_included():
    options = {"frames_per_batch": 32, "total_frames": 32, "auto_register_policy_transforms": False}
    here = Collector(pairs_of(), Wave(), **options)
    expected = next(iter(here)).clone()
    here.shutdown()
    there = MultiSyncCollector([pairs_of], Wave(), **options)
    try:
        batch = next(iter(there))[0].clone()  # of its only worker
    finally:
        there.shutdown()
    assert batch.shape == expected.shape == (4, 8)
    assert expected["next", "done"].squeeze(-1).nonzero().tolist() == [[row, 4] for row in range(4)]
    for key in SEEN:
        assert torch.equal(batch[key], expected[key]), key
        assert torch.equal(batch["next", key], expected["next", key]), key
    starts = expected[CONTEXT_ID].squeeze(-1)
    assert (starts[:, 5] == starts[:, 0] + 2).all()  # the next two states of each task


# ----------------------------------------------------------------------------------------------------- images


def test_both_cameras_at_every_size_show_the_same():
    frames = {}
    for size in (64, 128, 256):
        env = make(MIXED, 2, size=size, cameras=("agentview", "wrist"))
        td = env.reset()
        for key in (IMAGE, WRIST_IMAGE):
            assert td[key].shape == (2, 3, size, size) and td[key].dtype == torch.uint8
            frames[key, size] = td[key].float()
        env.close()
    for key in (IMAGE, WRIST_IMAGE):
        small = frames[key, 64]
        assert small.flatten(1).std(1).min() > 10
        for size in (128, 256):
            error = (torch.nn.functional.avg_pool2d(frames[key, size], size // 64) - small).abs().mean((1, 2, 3))
            assert (error < 2).all() and (error < 0.2 * small.flatten(1).std(1)).all(), (key, size, error)
    assert (frames[IMAGE, 64] - frames[WRIST_IMAGE, 64]).abs().mean() > 20
