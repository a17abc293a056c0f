"""Policies: the interface, the Laplace distribution and actor, the compact OFT policy, policies over
Hugging Face vision-language models and behind servers, LeRobot's flow-matching policies, image augmentation."""

from worldenv_trl.policies.action_tokens import QuantileActionTokenizer
from worldenv_trl.policies.actor import LaplaceActor, laplace_actor, likelihood_actor, policy_actor, scale_bounds
from worldenv_trl.policies.augmentation import random_shift
from worldenv_trl.policies.autoregressive import AutoregressiveActor, TeacherForcing, token_cross_entropy
from worldenv_trl.policies.base import Aims, Policy
from worldenv_trl.policies.chunk_laplace import ChunkLaplace
from worldenv_trl.policies.device_bridge import DeviceBridge
from worldenv_trl.policies.external import ExternalConfig, ExternalPolicy
from worldenv_trl.policies.fast import FASTConfig, FASTPolicy
from worldenv_trl.policies.fast_tokens import FASTActionTokenizer
from worldenv_trl.policies.flow import FlowConfig, FlowPolicy
from worldenv_trl.policies.hf import HFConfig, HFPolicy
from worldenv_trl.policies.hf_tokens import HFTokenConfig, HFTokenPolicy
from worldenv_trl.policies.laplace import IndependentLaplace
from worldenv_trl.policies.lerobot import load_lerobot
from worldenv_trl.policies.oft import OFTConfig, OFTPolicy
from worldenv_trl.policies.openvla import load_openvla
from worldenv_trl.policies.openvla_oft import load_openvla_oft
from worldenv_trl.policies.pairing import check_pairing
from worldenv_trl.policies.place_shift import PlaceShift
from worldenv_trl.policies.scene_shift import SceneShift
from worldenv_trl.policies.serving import ServedPolicy
from worldenv_trl.policies.token_actor import IndependentCategorical, TokenActor, token_actor
from worldenv_trl.policies.token_policy import TokenPolicy

__all__ = [
    "Aims",
    "AutoregressiveActor",
    "ChunkLaplace",
    "DeviceBridge",
    "ExternalConfig",
    "ExternalPolicy",
    "FASTActionTokenizer",
    "FASTConfig",
    "FASTPolicy",
    "FlowConfig",
    "FlowPolicy",
    "HFConfig",
    "HFPolicy",
    "HFTokenConfig",
    "HFTokenPolicy",
    "IndependentCategorical",
    "IndependentLaplace",
    "LaplaceActor",
    "OFTConfig",
    "OFTPolicy",
    "PlaceShift",
    "Policy",
    "QuantileActionTokenizer",
    "SceneShift",
    "ServedPolicy",
    "TeacherForcing",
    "TokenActor",
    "TokenPolicy",
    "check_pairing",
    "laplace_actor",
    "likelihood_actor",
    "load_lerobot",
    "load_openvla",
    "load_openvla_oft",
    "policy_actor",
    "random_shift",
    "scale_bounds",
    "token_actor",
    "token_cross_entropy",
]
