"""Rollouts as episodes, and the training batches made from them."""

from worldenv_trl.data.episodes import concatenate_episodes, episodes_from_rollouts, predicted_states
from worldenv_trl.data.samples import policy_samples
from worldenv_trl.data.windows import WindowSampler, imagine_episodes

__all__ = [
    "WindowSampler",
    "concatenate_episodes",
    "episodes_from_rollouts",
    "imagine_episodes",
    "policy_samples",
    "predicted_states",
]
