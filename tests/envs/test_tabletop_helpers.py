"""TabletopEnv with a process that helps to draw is TabletopEnv without, in daemonic processes too; its texts."""

import multiprocessing
import time

import torch
from tensordict import TensorDict

from worldenv_trl.envs import TabletopEnv
from worldenv_trl.keys import ACTION, IMAGE, INSTRUCTION, WRIST_IMAGE
from worldenv_trl.scenes import list_tasks, load_task, rendering

TASKS = list_tasks("starter")


def make(threads, tasks=TASKS, n=14):
    return TabletopEnv(
        tasks, n, image_size=16, cameras=("agentview", "wrist"), seed=0, num_threads=threads, max_steps=3
    )


def helped(env):
    """Resets until a helper is there; then as many episodes have begun as it returns."""
    resets, end = 0, time.monotonic() + 60
    while not env._pool.helpers and time.monotonic() < end:
        env.reset()
        resets += 1
    assert env._pool.helpers
    return resets


def seen(env):
    """Images of whole and of partial steps and resets."""
    plan = 0.8 * (torch.rand(8, env.num_envs, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1)
    some = torch.arange(env.num_envs) % 3 > 0
    td, shown = env.reset(), []
    for step, action in enumerate(plan):
        td = env.step(td.set(ACTION, action).set("_step", some if step == 1 else torch.ones_like(some)))["next"]
        shown += [td[IMAGE], td[WRIST_IMAGE]]
        if step % 3 == 2:
            td = env.reset(TensorDict({"_reset": some[:, None]}, [env.num_envs]))
            shown += [td[IMAGE], td[WRIST_IMAGE]]
    return torch.stack(shown)


def episodes_equal(worker=None):
    """Whether an env with a helper shows what one without does, after as many resets."""
    torch.set_num_threads(1)
    rendering.PAYS_AFTER, rendering._cores = -1.0, lambda: 2
    many, one = make(2), make(1)
    for _ in range(helped(many)):
        one.reset()
    equal = torch.equal(seen(many), seen(one))
    still = bool(many._pool.helpers)
    many.close(), one.close()
    if worker is not None:
        worker.put((equal, still))
    return equal and still


def test_images_are_the_same_with_a_helper(monkeypatch):
    monkeypatch.setattr(rendering, "PAYS_AFTER", -1.0)
    monkeypatch.setattr(rendering, "_cores", lambda: 2)
    assert episodes_equal()


def test_a_daemonic_process_may_have_a_helper():
    context = multiprocessing.get_context("spawn")
    results = context.SimpleQueue()
    process = context.Process(target=episodes_equal, args=(results,), daemon=True)
    process.start()
    assert results.get() == (True, True)
    process.join()
    assert process.exitcode == 0


def test_every_row_keeps_its_task_s_text_through_rollouts_indices_and_pipes():
    env = TabletopEnv(TASKS, 6, cameras=(), seed=0, max_steps=2)
    words = [load_task(TASKS[row % 3]).language for row in range(6)]
    rollout = env.rollout(5, break_when_any_done=False)
    assert [row[0] for row in rollout[INSTRUCTION]] == [row[4] for row in rollout["next", INSTRUCTION]] == words
    td = env.reset()
    assert list(td[1:3][INSTRUCTION]) == words[1:3]
    here, there = multiprocessing.Pipe()
    here.send(td.select(INSTRUCTION))
    assert list(td.clone()[INSTRUCTION]) == list(there.recv()[INSTRUCTION]) == words
    assert list(torch.cat([td, td])[INSTRUCTION]) == words * 2
