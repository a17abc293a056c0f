"""Policies: Laplace distribution and actor, the compact OFT policy, image augmentation."""

from worldenv_trl.policies.actor import LaplaceActor, laplace_actor, likelihood_actor
from worldenv_trl.policies.augmentation import random_shift
from worldenv_trl.policies.laplace import IndependentLaplace
from worldenv_trl.policies.oft import OFTConfig, OFTPolicy

__all__ = [
    "IndependentLaplace",
    "LaplaceActor",
    "OFTConfig",
    "OFTPolicy",
    "laplace_actor",
    "likelihood_actor",
    "random_shift",
]
