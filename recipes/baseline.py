"""LOOP's advantage over a baseline that is learned from its own waves, as they come."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import processes
from config import WorldEnvConfig
from worldenv_trl import keys
from worldenv_trl.data.store import without_notices
from worldenv_trl.devices import device_of, to_device
from worldenv_trl.objectives import ValueBaseline, baseline_advantage
from worldenv_trl.policies import Hidden, Policy

_DECISIONS = 24_000  # that are remembered: the last ten waves or so
_STEPS = 250  # of learning, a wave
_BATCH = 512
_LR = 1e-3
_AT_ONCE = 256  # decisions that the policy looks at together


class LearnedBaseline:
    """A :class:`ValueBaseline` of the policy's own features; a wave is judged by what was learned of those before it.

    The first wave has none before it: each half of its groups is judged by what the other half teaches. All processes
    learn the same from the groups of all.

    Args:
        policy: whose :class:`~worldenv_trl.policies.Hidden` states tell where a rollout stands, as they are at the
            time; of another policy only its proprioception does.
        config: settings.
    """

    def __init__(self, policy: Policy, config: WorldEnvConfig) -> None:
        self._policy, self._tasks, self._max_steps = policy, len(config.tasks), config.max_steps
        self._decisions = -(-config.max_steps // config.chunk_length)
        self._lmbda, self._standardize = config.post_train.baseline_lambda, config.post_train.standardize
        self._value: ValueBaseline | None = None
        self._seen = TensorDictReplayBuffer(storage=LazyTensorStorage(_DECISIONS), batch_size=_BATCH)
        self.explained = 0.0
        """Share of the returns' variance that was told in advance, over the decisions of the last wave."""

    def advantage(self, wave: TensorDictBase, returns: Tensor) -> Tensor:
        """``[all G, N, D]`` at the decisions that a rollout can have, 0 where it has none; learns from the wave
        afterwards.

        Args:
            wave: [G, N, T], this process's.
            returns: [all G, N], of all processes.
        """
        features = processes.gathered(self._padded(self._features(wave)))
        mask = processes.gathered(self._padded(wave[keys.MASK].cpu()))
        values = torch.zeros(mask.shape)
        if self._value is None:
            half = torch.arange(len(mask)) % 2 == 0
            for judged in (half, ~half):
                learned = self._made(features[mask])
                self._learn(learned, self._decisions_of(features, mask, returns, ~judged))
                values[judged] = _judged(learned, features[judged])
            self._value = self._made(features[mask])
        else:
            values = _judged(self._value, features)
        reached = returns.unsqueeze(-1).expand_as(mask)[mask]
        self.explained = 1 - ((reached - values[mask]).square().mean() / reached.var().clamp_min(1e-6)).item()
        everyone = torch.ones(len(mask), dtype=torch.bool)
        with without_notices():
            self._seen.extend(self._decisions_of(features, mask, returns, everyone))
        self._learn(self._value, self._seen)
        advantage = baseline_advantage(returns, values, mask, self._lmbda)
        return advantage / advantage[mask].std().clamp_min(1e-6) if self._standardize else advantage

    @torch.no_grad()
    def _features(self, wave: TensorDictBase) -> Tensor:
        """[G, N, T, F]; zeros outside the mask."""
        mask, policy = wave[keys.MASK].flatten(), self._policy
        flat = wave.select(*policy.in_keys, keys.TASK_ID, keys.NUM_STEPS).reshape(-1)
        parts = []
        for rows in mask.nonzero().squeeze(-1).split(_AT_ONCE):
            part = to_device(flat[rows], device_of(policy))
            images, state, instructions = policy.observed(part)[1]
            task = torch.nn.functional.one_hot(part[keys.TASK_ID].squeeze(-1), self._tasks)
            known = [state, task.float(), part[keys.NUM_STEPS] / self._max_steps]
            if isinstance(policy, Hidden):
                known.append(policy.hidden(images, state, instructions))
            parts.append(torch.cat(known, -1).cpu())
        found = torch.cat(parts)
        features = found.new_zeros(len(mask), found.shape[-1])
        features[mask.cpu()] = found
        return features.unflatten(0, wave.shape)

    def _padded(self, values: Tensor) -> Tensor:
        """[G, N, T, ...] with as many decisions as a rollout can have: processes put theirs together."""
        padded = values.new_zeros(*values.shape[:2], self._decisions, *values.shape[3:])
        padded[:, :, : values.shape[2]] = values
        return padded

    def _made(self, features: Tensor) -> ValueBaseline:
        value = ValueBaseline(features.shape[-1])
        value.normalize(features)
        return value.eval()

    @staticmethod
    def _decisions_of(features: Tensor, mask: Tensor, returns: Tensor, groups: Tensor) -> TensorDict:
        chosen = mask & groups[:, None, None]
        entries = {"features": features[chosen].half(), "return": returns.unsqueeze(-1).expand_as(mask)[chosen]}
        return TensorDict(entries, [int(chosen.sum())])

    def _learn(self, value: ValueBaseline, decisions: TensorDict | TensorDictReplayBuffer) -> None:
        optimizer = torch.optim.AdamW(value.parameters(), _LR, weight_decay=1e-2)
        value.train()
        for _ in range(_STEPS):
            if isinstance(decisions, TensorDictReplayBuffer):
                batch = decisions.sample()
            else:
                batch = decisions[torch.randint(len(decisions), (_BATCH,))]
            optimizer.zero_grad()
            value.loss(batch["features"].float(), batch["return"]).backward()
            optimizer.step()
        value.eval()

    # ------------------------------------------------------------------------------------------------- to continue

    def state_dict(self) -> dict[str, Any]:
        if self._value is None:
            return {}
        return {"value": self._value.state_dict(), "seen": self._seen.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if state:
            self._value = ValueBaseline(len(state["value"]["center"])).eval()
            self._value.load_state_dict(state["value"])
            self._seen.load_state_dict(state["seen"])


@torch.no_grad()
def _judged(value: ValueBaseline, features: Tensor) -> Tensor:
    return torch.stack([value(group) for group in features]) if len(features) else features[..., 0]
