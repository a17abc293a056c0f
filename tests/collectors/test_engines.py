"""TorchRL's own process and Ray engines, each worker with a GroupCollector."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from shared_waves import DECISIONS, ROLLOUTS, make_env, make_policy
from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector

from worldenv_trl.collectors import GroupCollector, RayWorkers
from worldenv_trl.keys import CHUNK, CONTEXT_ID, MASK

GROUPS = 2
SIZES = {"groups_per_batch": GROUPS, "group_size": ROLLOUTS, "length": DECISIONS + 1}
FRAMES = GROUPS * ROLLOUTS * (DECISIONS + 1)  # of a worker's batch: what the engines count


def check(batches: list) -> None:
    """Whole groups, as the engines want them."""
    for batch in batches:
        assert batch.shape[-3:] == (GROUPS, ROLLOUTS, DECISIONS + 1)
        groups = batch[CONTEXT_ID][..., 0, 0].reshape(-1, ROLLOUTS)
        assert (groups == groups[:, :1]).all()
        assert batch[MASK].sum(-1).eq(DECISIONS).all()
        assert batch["collector", "traj_ids"].shape == batch.shape


def updated(collector, policy, batches: int) -> list:
    """Batches, the weights becoming zero after the first."""
    seen = []
    for batch in collector:
        seen.append(batch.clone())
        if len(seen) == 1:
            with torch.no_grad():
                policy.module.weight.zero_()
            collector.update_policy_weights_(policy)
        if len(seen) == batches:
            break
    return seen


@pytest.mark.parametrize("engine", [MultiSyncCollector, MultiAsyncCollector])
def test_the_process_engines_replicate_it(engine):
    policy = make_policy()
    makers = [partial(make_env, GROUPS, seed=seed) for seed in (3, 4)]
    cat = {"cat_results": "stack"} if engine is MultiSyncCollector else {}
    collector = engine(
        makers,
        policy,
        frames_per_batch=2 * FRAMES if cat else FRAMES,
        total_frames=-1,
        collector_class=partial(GroupCollector, **SIZES),
        use_buffers=False,
        **cat,
    )
    batches = updated(collector, policy, 6)
    collector.shutdown()
    check(batches)
    assert batches[0][CHUNK][batches[0][MASK]].abs().min() > 0 and batches[-1][CHUNK].abs().max() == 0


def test_an_engine_that_would_cut_groups_is_refused():
    for option in ({"max_frames_per_traj": 5}, {"split_trajs": True}, {"trajs_per_batch": 3}):
        with pytest.raises(ValueError, match="groups are collected whole: "):
            GroupCollector(partial(make_env, GROUPS), make_policy(), groups_per_batch=GROUPS, group_size=2, **option)


def test_an_option_that_nobody_knows_is_refused():
    with pytest.raises(TypeError, match="GroupCollector has no option 'max_decision'"):
        GroupCollector(partial(make_env, GROUPS), make_policy(), groups_per_batch=GROUPS, group_size=2, max_decision=3)


def test_batches_longer_than_their_length_are_refused():
    sizes = SIZES | {"length": DECISIONS - 1}
    collector = GroupCollector(partial(make_env, GROUPS), make_policy(), **sizes)
    with pytest.raises(ValueError, match="length must be at least that of the longest rollout, 2, got 1"):
        collector.next()
    with pytest.raises(ValueError, match="length must be at least 1, got 0"):
        GroupCollector(partial(make_env, GROUPS), make_policy(), **SIZES | {"length": 0})


def test_a_policy_comes_as_it_is_or_from_a_factory():
    options = {"create_env_kwargs": {"groups": GROUPS}, "groups_per_batch": GROUPS, "group_size": ROLLOUTS}
    batches = []
    for given in ({"policy": make_policy()}, {"policy_factory": make_policy}):
        torch.manual_seed(0)
        batches.append(GroupCollector(make_env, **given, **options).next())
    assert torch.equal(batches[0][CHUNK], batches[1][CHUNK])
    with pytest.raises(ValueError, match="policy or policy_factory, not both"):
        GroupCollector(make_env, make_policy(), policy_factory=make_policy, **options)


def test_batches_are_stored_and_policies_act_where_they_are_told():
    policy = make_policy()
    options = {"groups_per_batch": GROUPS, "group_size": ROLLOUTS, "env_device": "cpu"}
    collector = GroupCollector(partial(make_env, GROUPS), policy, policy_device="cpu", storing_device="meta", **options)
    assert collector.policy is policy  # there already: no copy
    assert collector.next()[CHUNK].device.type == "meta"


@pytest.fixture(scope="module")
def cluster():
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'worldenv_trl[ray]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RAY_ADDRESS", raising=False)
        workers = RayWorkers(1)  # connects as the package does
        for actor in workers._actors:
            ray.kill(actor)  # the engine's come in its place
        yield
        workers.shutdown()


@pytest.mark.parametrize("sync", [True, False])
def test_the_ray_engine_replicates_it(sync, cluster):
    from torchrl.collectors.distributed import RayCollector

    policy = make_policy()
    collector = RayCollector(
        [partial(make_env, GROUPS, seed=3)],
        policy,
        frames_per_batch=FRAMES,
        total_frames=4 * FRAMES,
        collector_class=GroupCollector,
        collector_kwargs=[dict(SIZES)],
        remote_configs={"num_cpus": 1},
        sync=sync,
    )
    batches = updated(collector, policy, 3)
    collector.shutdown()
    check(batches)
    assert batches[0][CHUNK][batches[0][MASK]].abs().min() > 0 and batches[-1][CHUNK].abs().max() == 0
