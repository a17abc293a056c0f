"""Rollouts as training batches: episodes, and what each learned part draws from them."""

from worldenv_trl.data.episodes import concatenate_episodes, episodes_from_rollouts
from worldenv_trl.data.hdf5 import hdf5_to_mcap, read_hdf5
from worldenv_trl.data.imagine import imagine_episodes
from worldenv_trl.data.lerobot import write_lerobot
from worldenv_trl.data.lerobot_reader import read_lerobot
from worldenv_trl.data.reflector_samples import reflector_samples
from worldenv_trl.data.samples import policy_samples
from worldenv_trl.data.windows import WindowSampler, predicted_poses, world_model_windows

__all__ = [
    "WindowSampler",
    "concatenate_episodes",
    "episodes_from_rollouts",
    "hdf5_to_mcap",
    "imagine_episodes",
    "policy_samples",
    "predicted_poses",
    "read_hdf5",
    "read_lerobot",
    "reflector_samples",
    "world_model_windows",
    "write_lerobot",
]
