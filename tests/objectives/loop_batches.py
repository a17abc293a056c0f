"""A small stochastic actor, and ragged rollouts of it as a wave holds them."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.testing import assert_close
from torchrl.modules import ProbabilisticActor

from worldenv_trl import keys
from worldenv_trl.objectives import rloo_advantage
from worldenv_trl.policies import ChunkLaplace, IndependentLaplace

G, N, T, C, A, OBS = 2, 3, 3, 4, 7, 5
_DENSITIES = {"step": IndependentLaplace, "chunk": ChunkLaplace}
LENGTHS = [[9, 4, 12], [1, 6, 8]]  # executed steps: stops inside a chunk (9, 1, 6), at its end (4, 8), and never (12)


class Heads(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.loc, self.beta = nn.Linear(OBS, C * A), nn.Linear(OBS, C * A)

    def forward(self, features):
        return self.loc(features).unflatten(-1, (C, A)), self.beta(0.2 * features).unflatten(-1, (C, A)).exp()


def make_actor(event_dims: int = 1, seed: int = 0, noise: str = "step") -> ProbabilisticActor:
    torch.manual_seed(seed)
    return ProbabilisticActor(
        TensorDictModule(Heads().double(), in_keys=["features"], out_keys=[keys.LOC, keys.SCALE]),
        in_keys={"loc": keys.LOC, "scale": keys.SCALE},
        out_keys=[keys.CHUNK],
        distribution_class=_DENSITIES[noise],
        distribution_kwargs={"event_dims": event_dims},
        return_log_prob=True,
        log_prob_key=keys.LOG_PROBS,
    )


def make_batch(event_dims: int = 1, spread: float = 0.15, seed: int = 8, noise: str = "step") -> TensorDict:
    """Ragged rollouts [G, N, T] as a rollout writes them: the root's step mask belongs to the decision before."""
    actor, generator = make_actor(event_dims, noise=noise), torch.Generator().manual_seed(seed)
    features = torch.randn(G, N, T, OBS, generator=generator, dtype=torch.float64)
    batch = TensorDict({"features": features}, [G, N, T])
    with torch.no_grad():
        loc, scale = actor.module[0].module(features)
        each = torch.rand(loc.shape, generator=generator, dtype=torch.float64) - 0.5
        unit = -each.sign() * torch.log1p(-2 * each.abs())
        density = _DENSITIES[noise](loc, scale, event_dims)
        chunk = loc + density.noise_scale * (unit if noise == "step" else unit[..., :1, :])
        log_probs = density.log_prob(chunk)
    batch[keys.CHUNK] = chunk
    shift = spread * torch.randn(log_probs.shape, generator=generator, dtype=torch.float64)
    batch[keys.LOG_PROBS] = log_probs + (shift if noise == "step" else shift[:, :, :, :1])
    steps = torch.arange(T * C).view(T, C) < torch.tensor(LENGTHS)[..., None, None]
    batch["next"] = TensorDict({keys.STEP_MASK: steps}, [G, N, T])
    batch[keys.STEP_MASK] = torch.cat([torch.zeros_like(steps[:, :, :1]), steps[:, :, :-1]], 2)
    batch[keys.MASK] = steps.any(-1)
    returns = torch.rand(G, N, generator=generator, dtype=torch.float64)
    batch["returns"] = returns[..., None].expand(G, N, T).clone()
    batch[keys.ADVANTAGE] = rloo_advantage(returns)[..., None, None].expand(G, N, T, 1).clone()
    return batch


def value_and_gradient(actor, loss, *batches):
    actor.zero_grad()
    value = 0.0
    for batch in batches:
        part = loss(batch)["loss_objective"]
        part.backward()
        value += part.item()
    gradients = [parameter.grad for parameter in actor.parameters()]
    return value, [
        0.0 * each if grad is None else grad.clone() for grad, each in zip(gradients, actor.parameters(), strict=True)
    ]


def assert_same(left, right):
    assert_close(left[0], right[0], rtol=0, atol=1e-12)
    for one, other in zip(left[1], right[1], strict=True):
        assert_close(one, other, rtol=0, atol=1e-12)
