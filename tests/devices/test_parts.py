"""Every learned part on a GPU computes what it computes on the CPU, and nothing is left behind there."""

from __future__ import annotations

import copy

import pytest
import torch
from observations import INSTRUCTIONS, observed, oft_policy
from small_models import ONE, TWO, make_model, make_request
from small_windows import make_windows
from tensordict import NonTensorStack, TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss

from worldenv_trl import keys
from worldenv_trl.devices import to_device
from worldenv_trl.kinematics import ActionMap, ForwardKinematics
from worldenv_trl.objectives import LOOPLoss, ReflectorLoss, WorldModelLoss
from worldenv_trl.policies import laplace_actor, likelihood_actor, random_shift, scale_bounds
from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig
from worldenv_trl.robot import WRIST, look_at, panda
from worldenv_trl.vision import PretrainedEncoder


def near(there: torch.Tensor, here: torch.Tensor, tolerance: float = 1e-4) -> None:
    assert there.device.type == "cuda", "the result was left on the CPU"
    torch.testing.assert_close(there.detach().cpu().float(), here.detach().float(), rtol=tolerance, atol=tolerance)


def states(rows: int = 3) -> torch.Tensor:
    home = torch.as_tensor(panda.HOME_Q, dtype=torch.float32)
    return ForwardKinematics().initial_state(home + 0.05 * torch.randn(rows, 7))


def demonstrated() -> TensorDict:
    td = observed()
    generator = torch.Generator().manual_seed(2)
    td[keys.CHUNK] = torch.rand(6, 8, 7, generator=generator) - 0.5
    td[keys.ACTION_IS_PAD] = torch.rand(6, 8, generator=generator) < 0.2
    return td


def decided(policy) -> TensorDict:
    """Decisions as LOOP updates on, a little off the policy."""
    td = demonstrated()
    actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
    with torch.no_grad():
        td[keys.LOG_PROBS] = actor.get_dist(td.copy()).log_prob(td[keys.CHUNK]) + 0.02
    td[keys.ADVANTAGE] = torch.linspace(-1, 1, 6).unsqueeze(-1)
    td[keys.STEP_MASK] = torch.arange(8) < torch.tensor([8, 8, 3, 8, 1, 8]).unsqueeze(-1)
    return td.exclude(keys.ACTION_IS_PAD)


# ---------------------------------------------------------------------------------------------------- kinematics


def test_forward_kinematics(gpu):
    state, actions = states(), torch.rand(3, 8, 7) * 2 - 1
    here, there = ForwardKinematics(), ForwardKinematics().to(gpu)
    rolled = here.rollout(state, actions)
    near(there.rollout(state.to(gpu), actions.to(gpu)), rolled)
    near(there.pose(rolled.to(gpu)), here.pose(rolled))
    for proprio in ("measured", "commanded"):
        near(there.state(rolled.to(gpu), proprio), here.state(rolled, proprio))
    near(there.initial_state(state[:, :7].to(gpu)), here.initial_state(state[:, :7]))


def test_action_maps_of_a_still_and_a_carried_camera(gpu):
    here = ActionMap([look_at("front", (0.8, 0.0, 0.6), (0.0, 0.0, 0.1), 40.0), WRIST], 32)
    there, poses, which = copy.deepcopy(here).to(gpu), ForwardKinematics().pose(states(4)), torch.tensor([0, 1, 1, 0])
    expected = here(poses, which, tool_pose=poses)
    for index in (which, which.to(gpu)):
        near(there(poses.to(gpu), index, tool_pose=poses.to(gpu)), expected)
    near(there.project(poses[:, :3].to(gpu), which, poses.to(gpu)), here.project(poses[:, :3], which, poses))


# ---------------------------------------------------------------------------------------------------- policies


@pytest.mark.parametrize("settings", [{}, {"cameras": ("agentview", "wrist")}, {"vision_blocks": (2, 4)}])
def test_the_policy(gpu, settings):
    policy, td = oft_policy(**settings), observed(cameras=settings.get("cameras", ("agentview",)))
    policy.fit_statistics(torch.randn(20, 7), torch.rand(20, 7))
    expected, acted = policy(td.copy()), copy.deepcopy(policy).to(gpu)(to_device(td, gpu))
    tolerance = 0.05 if settings.get("vision_blocks") else 1e-4  # bfloat16 features
    near(acted[keys.LOC], expected[keys.LOC], tolerance)
    near(acted[keys.LOG_SCALE], expected[keys.LOG_SCALE], tolerance)


def test_statistics_are_taken_from_data_on_the_cpu(gpu):
    here = oft_policy()
    there, data = copy.deepcopy(here).to(gpu), (torch.randn(20, 7), torch.rand(20, 7))
    here.fit_statistics(*data)
    there.fit_statistics(*data)
    near(there.action_range, here.action_range)
    near(there.state_center, here.state_center)


def test_the_actor_samples_and_scores(gpu):
    policy = oft_policy().to(gpu)
    actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy), scale_factor=2.0)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        acted = actor(to_device(observed(), gpu))
    scored = actor.get_dist(acted).log_prob(acted[keys.CHUNK])
    near(scored, acted[keys.LOG_PROBS].cpu())
    actor.set_scale_factor(1.0)
    assert actor.scale_factor == 1.0


@pytest.mark.parametrize("name", ["l1", "nll"])
def test_behaviour_cloning(gpu, name):
    def loss_of(device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        policy = oft_policy().to(device)
        actor = laplace_actor(policy) if name == "l1" else likelihood_actor(policy)
        loss = BCLoss(actor, **({"loss_function": "l1"} if name == "l1" else {}))
        loss.set_keys(action=keys.CHUNK, pad_mask=keys.ACTION_IS_PAD)
        value = loss(to_device(demonstrated(), device))["loss_bc"]
        value.backward()
        return value, next(policy.loc_head.parameters()).grad

    here, there = loss_of(torch.device("cpu")), loss_of(gpu)
    near(there[0], here[0])
    near(there[1], here[1], 1e-3)


@pytest.mark.parametrize("rank", [0, 4])
@pytest.mark.parametrize("ratio_level", ["step", "chunk"])
def test_loop(gpu, rank, ratio_level):
    def updated(device: torch.device) -> tuple[TensorDict, list[torch.Tensor]]:
        policy = oft_policy()
        batch = decided(policy)
        policy = policy.to(device)
        torch.manual_seed(0)
        groups = policy.post_training_parameters(rank)
        actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
        loss, batch = LOOPLoss(actor, functional=False, ratio_level=ratio_level), to_device(batch, device)
        out = loss(batch)
        out["loss_objective"].backward()
        out["ratio"] = loss.ratios(batch)[keys.RATIO]
        return out, [each.grad for each in groups["heads"]]

    (here, gradients), (there, other) = updated(torch.device("cpu")), updated(gpu)
    for name in ("loss_objective", "kl_approx", "clip_fraction", "ESS", "ratio"):
        near(there[name], here[name], 1e-3)
    for mine, its in zip(gradients, other, strict=True):
        near(its, mine, 1e-3)


def test_images_are_shifted_where_they_are(gpu):
    images = torch.randint(0, 256, (4, 3, 16, 16), dtype=torch.uint8)
    torch.manual_seed(3)
    expected = random_shift(images)
    torch.manual_seed(3)
    assert torch.equal(random_shift(images.to(gpu)).cpu(), expected)


# ---------------------------------------------------------------------------------------------------- world model


@pytest.mark.parametrize("cameras", [ONE, TWO], ids=["one camera", "two"])
@pytest.mark.parametrize("steps", [1, 2], ids=["deterministic", "sampled"])
def test_the_world_model(gpu, cameras, steps):
    here = make_model(cameras, deterministic=steps == 1, num_denoise_steps=steps, precision="float32")
    there, asked = copy.deepcopy(here).to(gpu), make_request(here, 3, ["pull the drawer", "push the drawer", "what"])
    seen, expected = there(to_device(asked.copy(), gpu)), here(asked)
    for camera in here.cameras:
        frames = seen[keys.frames_key(camera)]
        assert frames.device.type == "cuda" and frames.dtype == torch.uint8
        if steps == 1:  # the CPU's noise is another
            assert int((frames.cpu().int() - expected[keys.frames_key(camera)].int()).abs().max()) <= 1


@pytest.mark.parametrize("cameras", [ONE, TWO], ids=["one camera", "two"])
@pytest.mark.parametrize("noise_prob", [0.0, 0.5])
def test_the_world_models_loss(gpu, cameras, noise_prob):
    here = make_model(cameras, unroll_prob=0.5, noise_prob=noise_prob, precision="float32")
    there, windows = copy.deepcopy(here).to(gpu), make_windows(here)
    torch.manual_seed(0)
    expected = WorldModelLoss(here)(windows)
    torch.manual_seed(0)
    out = WorldModelLoss(there)(to_device(windows, gpu))
    for loss in (out, expected):
        loss["loss_world_model"].backward()
    gradients = [(mine.grad, its.grad) for mine, its in zip(here.parameters(), there.parameters(), strict=True)]
    assert all((mine is None) == (its is None) for mine, its in gradients)
    assert all(its.device.type == "cuda" for _, its in gradients if its is not None)
    if not torch.cuda.is_available():  # a GPU draws other levels and other rows
        near(out["loss_world_model"], expected["loss_world_model"], 1e-3)


# ---------------------------------------------------------------------------------------------------- eyes, judge


def test_the_pretrained_encoder(gpu):
    here, images = PretrainedEncoder((2, 4)), torch.randint(0, 256, (5, 3, 32, 32), dtype=torch.uint8)
    for there, expected in zip(copy.deepcopy(here).to(gpu)(images.to(gpu)), here(images), strict=True):
        near(there, expected, 0.05)


@pytest.mark.parametrize("settings", [{}, {"vision_blocks": (4,)}, {"cameras": ("agentview", "wrist")}])
def test_the_reflector(gpu, settings):
    here = CompactReflector(CompactReflectorConfig(INSTRUCTIONS, image_size=16, num_frames=4, **settings)).eval()
    there, cameras = copy.deepcopy(here).to(gpu), here.cameras
    videos = {camera: torch.randint(0, 256, (3, 9, 3, 16, 16), dtype=torch.uint8) for camera in cameras}
    scores = {}
    for model, device in ((here, torch.device("cpu")), (there, gpu)):
        shown = {camera: video.to(device) for camera, video in videos.items()}
        state = model.begin({camera: video[:, 0] for camera, video in shown.items()}, INSTRUCTIONS)
        first = state["score"]
        state, middle = model.extend(state, {camera: video[:, 1:5] for camera, video in shown.items()})
        state, last = model.extend(state, {camera: video[:, 5:] for camera, video in shown.items()})
        scores[device.type] = torch.cat([first.unsqueeze(1), middle, last], 1)
    near(scores["cuda"], scores["cpu"], 0.02 if settings.get("vision_blocks") else 1e-4)


@pytest.mark.parametrize("kind", ["prefixes", "frames"])
def test_the_reflectors_loss(gpu, kind):
    here = CompactReflector(CompactReflectorConfig(INSTRUCTIONS, image_size=16))
    there, batch = copy.deepcopy(here).to(gpu), TensorDict(batch_size=[4])
    batch["words"] = here.vocabulary.ids([INSTRUCTIONS[i] for i in (0, 1, 2, 0)])
    batch["label"] = torch.tensor([[True], [False], [True], [True]])
    if kind == "prefixes":
        batch["features"], batch["lengths"] = torch.randn(4, 6, 96), torch.tensor([[6], [1], [3], [2]])
    else:
        batch["frames", "image"], batch["first", "image"] = 255 * torch.rand(2, 4, 3, 16, 16)
    expected, out = ReflectorLoss(here)(batch), ReflectorLoss(there)(batch.to(gpu))
    out["loss_reflector"].backward()
    for name in ("loss_reflector", "accuracy"):
        near(out[name], expected[name])
    assert all(each.grad is None or each.grad.device.type == "cuda" for each in there.parameters())


def test_a_tensor_left_on_the_cpu_is_found(gpu):
    """What the tests above rely on; on a GPU it is PyTorch that says so."""
    policy = oft_policy().to(gpu)
    td = to_device(observed(), gpu)
    policy.state_center = policy.state_center.cpu()
    with pytest.raises(RuntimeError, match="same device"):
        policy(td)
    texts = NonTensorStack(*INSTRUCTIONS)
    assert to_device(TensorDict({"a": torch.zeros(3), "text": texts}, [3]), gpu)["a"].device.type == "cuda"
