"""Rollouts as training batches: episodes, and what each learned part draws from them."""

from worldenv_trl.data.episodes import concatenate_episodes, episodes_from_rollouts
from worldenv_trl.data.imagine import imagine_episodes
from worldenv_trl.data.reflector_samples import reflector_samples
from worldenv_trl.data.samples import policy_samples
from worldenv_trl.data.windows import WindowSampler, predicted_poses, world_model_windows

__all__ = [
    "WindowSampler",
    "concatenate_episodes",
    "episodes_from_rollouts",
    "imagine_episodes",
    "policy_samples",
    "predicted_poses",
    "reflector_samples",
    "world_model_windows",
]
