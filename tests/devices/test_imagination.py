"""Imagined rollouts stay on the GPU from the reset to the update; an actor there can act in an env on the CPU."""

from __future__ import annotations

import copy

import pytest
import torch
from imagined_worlds import make_contexts
from observations import observed, oft_policy
from small_models import ONE, make_model
from tensordict import TensorDict
from torchrl.envs.transforms import Compose, TransformedEnv
from torchrl.envs.utils import ExplorationType

from config import PostTrain
from data_parallel import DataParallel
from updates import ratios, update
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import episodes_from_rollouts, imagine_episodes, score_episodes, window_buffer
from worldenv_trl.devices import to_device
from worldenv_trl.envs import FramesAside, ImaginedEnv, Reflect
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.objectives import LOOPLoss, WorldModelLoss, rloo_advantage
from worldenv_trl.policies import DeviceBridge, laplace_actor, scale_bounds
from worldenv_trl.record import RolloutWriter, read_rollouts
from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig, StopRule

TEXTS = ("push", "pull")


def parts(**settings) -> tuple:
    torch.manual_seed(0)
    model = make_model(ONE, precision="float32", **settings)
    reflector = CompactReflector(CompactReflectorConfig(TEXTS, image_size=32)).eval()
    policy = oft_policy(instructions=TEXTS, image_size=32)
    return model, reflector, policy


def lived() -> TensorDict:
    """Rollouts [2, 16] that stand still and succeed in the end."""
    rollouts = TensorDict(batch_size=[2, 16])
    contexts = make_contexts(2, ("agentview",), 32)
    for key in (("observation", "image"), keys.STATE, keys.KINEMATIC_STATE, keys.TASK_ID, keys.CONTEXT_ID):
        rollouts[key] = contexts[key].unsqueeze(1).expand(2, 16, *contexts[key].shape[1:]).contiguous()
    rollouts["next"] = rollouts.clone()
    rollouts["next", "done"] = torch.arange(16).eq(15).view(1, 16, 1).expand(2, 16, 1).clone()
    rollouts["next", keys.SUCCESS] = rollouts["next", "done"].clone()
    rollouts[keys.ACTION] = torch.rand(2, 16, 7, generator=torch.Generator().manual_seed(0)) - 0.5
    rollouts[keys.INSTRUCTION] = "pull"
    return rollouts


def wave_of(device: torch.device, seed: int = 0, **settings) -> tuple:
    """A wave [2, 3] of greedy imagined rollouts, and what was there."""
    model, reflector, policy = (part.to(device) for part in parts(**settings))
    contexts = to_device(make_contexts(cameras=("agentview",), size=32), device)
    kinematics = ForwardKinematics().to(device)
    env = ImaginedEnv(model, kinematics, contexts, [2, 3], max_steps=20, seed=seed)
    aside = FramesAside()
    aside.keep = True
    rule = StopRule(0.999)
    env = TransformedEnv(env, Compose(Reflect(reflector, rule), aside))
    actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
    collector = GroupCollector(env, actor, groups_per_batch=2, exploration_type=ExplorationType.DETERMINISTIC)
    return next(iter(collector)), aside, policy, actor, model


def test_a_wave_is_the_same_there_and_stays_there(gpu):
    (here, frames, *_), (there, others, *_) = (wave_of(each) for each in (torch.device("cpu"), gpu))
    for key in here.keys(True, True):
        if isinstance(here[key], torch.Tensor):
            assert there[key].device.type == "cuda", key
            if here[key].is_floating_point():
                torch.testing.assert_close(there[key].cpu(), here[key], rtol=1e-3, atol=1e-3)
    assert torch.equal(there["next", keys.NOISE_SEED].cpu(), here["next", keys.NOISE_SEED])
    shown, expected = others.frames()[:, :, 0].contiguous(), frames.frames()[:, :, 0].contiguous()
    assert shown["frames", "image"].device.type == "cpu"  # they went to files
    assert int((shown["frames", "image"].int() - expected["frames", "image"].int()).abs().max()) <= 1


def test_noise_there_is_a_function_of_seed_context_rollout_and_chunk(gpu):
    sampled = {"deterministic": False, "num_denoise_steps": 2}
    (first, *_), (again, *_), (other, *_) = (wave_of(gpu, seed, **sampled) for seed in (0, 0, 1))
    assert torch.equal(first["next", "observation", "image"], again["next", "observation", "image"])
    assert not torch.equal(first["next", "observation", "image"], other["next", "observation", "image"])


def test_loop_updates_on_what_it_imagined_there(gpu, tmp_path):
    wave, _, policy, actor, _ = wave_of(gpu)
    wave[keys.ADVANTAGE] = rloo_advantage(torch.rand(2, 3, device=gpu))[..., None, None].expand(*wave.shape, 1)
    groups = policy.post_training_parameters(4)
    loss = LOOPLoss(actor, functional=False)
    optimizer = torch.optim.AdamW([{"params": group} for group in groups.values()], lr=1e-4)
    before = copy.deepcopy(policy.state_dict())
    learner = DataParallel(policy, lambda _: loss)
    figures = update(wave, policy.in_keys, learner, optimizer, list(groups.values()), PostTrain(minibatch_size=4))
    assert figures["updates"] > 0
    assert any(not torch.equal(value, before[name]) for name, value in policy.state_dict().items())
    wave.update(ratios(wave, policy.in_keys, loss))
    assert wave[keys.RATIO].device.type == "cuda" and bool(wave[keys.RATIO].isfinite().all())

    with RolloutWriter(tmp_path / "wave.mcap") as writer:
        writer.write(wave)
    assert torch.equal(read_rollouts(tmp_path / "wave.mcap")[keys.CHUNK], wave[keys.CHUNK].cpu())


def test_episodes_stay_on_the_cpu_and_are_imagined_and_scored_there(gpu):
    rollouts = lived()
    model, reflector, _ = parts()
    made = []
    for device in (torch.device("cpu"), gpu):
        model, reflector, kinematics = (copy.deepcopy(each).to(device) for each in (model, reflector, FK))
        episodes = episodes_from_rollouts(rollouts.to(device))
        imagined = imagine_episodes(model, episodes, kinematics, shown_chunks=None)
        imagine_episodes(model, episodes, kinematics, painted=imagined)
        frames = imagined.frames("agentview", torch.arange(2).unsqueeze(-1), torch.arange(17))
        made.append((frames, imagined["kinematic_states"], score_episodes(reflector, episodes)))
        loss = WorldModelLoss(model.train())
        windows = window_buffer(episodes, kinematics, model, batch_size=2, seed=0).sample()
        assert windows["actions"].device.type == device.type
        loss(windows)["loss_world_model"].backward()
        lesson = next(reflector.train_on(episodes))
        assert reflector.training_loss(lesson.sample())["loss_reflector"].device.type == device.type
    for here, there in zip(*made, strict=True):
        assert there.device.type == "cpu"
        torch.testing.assert_close(
            there.float(), here.float(), rtol=1e-3, atol=1.0 if here.dtype == torch.uint8 else 1e-3
        )


FK = ForwardKinematics()


@pytest.mark.parametrize("rows", [slice(None), slice(0, 1)])
def test_an_actor_on_a_gpu_acts_in_an_env_on_the_cpu(gpu, rows):
    policy, td = oft_policy(), observed()[rows]
    td["sim_state"] = torch.zeros(len(td), 70, dtype=torch.float64)
    expected = laplace_actor(policy)(td.copy())
    kept = td["sim_state"]
    acted = DeviceBridge(laplace_actor(copy.deepcopy(policy).to(gpu)))(td)
    assert acted is td and acted["sim_state"] is kept
    for key in (keys.LOC, keys.SCALE, keys.CHUNK):
        assert acted[key].device.type == "cpu"
        torch.testing.assert_close(acted[key], expected[key], rtol=1e-4, atol=1e-4)
