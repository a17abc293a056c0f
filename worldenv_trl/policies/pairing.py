"""Whether an env shows a policy what it was trained on: asked before long work."""

from __future__ import annotations

from torchrl.envs import EnvBase

from worldenv_trl.keys import CHUNK, image_key
from worldenv_trl.policies.base import Policy

__all__ = ["check_pairing"]


def check_pairing(policy: Policy, env: EnvBase) -> None:
    """Holds an env against what a policy was trained for; :class:`~worldenv_trl.collectors.GroupCollector` does so.

    Nothing is checked of which the env says nothing: an env without ``proprio``, or with one action a step.

    Args:
        policy: what will act.
        env: where; its observation spec tells cameras and image size, its action spec the chunk length, and its
            attribute ``proprio`` the kind of proprioception.

    Raises:
        ValueError: if the env lacks one of the policy's cameras, its images have another size, its chunks another
            length, or its proprioception is of another kind.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl.data import Composite, UnboundedDiscrete
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy
        >>> policy = OFTPolicy(OFTConfig(instructions=("open the drawer",), cameras=("agentview", "wrist")))
        >>> images = Composite(observation=Composite(image=UnboundedDiscrete((3, 64, 64))))
        >>> env = SimpleNamespace(observation_spec=images, full_action_spec=Composite())
        >>> check_pairing(policy, env)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        ValueError: the policy looks through 'wrist', the env shows no ('observation', 'wrist_image'): ...
    """
    for camera in policy.cameras:
        image = env.observation_spec.get(image_key(camera), None)
        if image is None:
            raise ValueError(
                f"the policy looks through {camera!r}, the env shows no {image_key(camera)}: "
                f"build the env with cameras={policy.cameras}, or train a policy for the env's cameras"
            )
        size = tuple(image.shape[-2:])
        if size != (policy.image_size, policy.image_size):
            raise ValueError(
                f"the policy was trained on images of {policy.image_size} px, those of the env's {camera!r} are "
                f"{size[0]} x {size[1]} px: build the env with image_size={policy.image_size}, or train a policy for it"
            )
    chunk = env.full_action_spec.get(CHUNK, None)
    length = getattr(env, "chunk_length", None) if chunk is None else chunk.shape[-2]
    if length is not None and length != policy.chunk_length:
        raise ValueError(
            f"the policy writes chunks of {policy.chunk_length} actions, the env executes {length} of them a decision: "
            f"build the env with chunk_length={policy.chunk_length}, or train a policy with chunk_length={length}"
        )
    proprio = getattr(env, "proprio", None)
    if proprio is not None and proprio != policy.proprio:
        raise ValueError(
            f"the policy was trained on {policy.proprio} proprioception, the env's is {proprio}: "
            f"build the env with proprio={policy.proprio!r}, or train a policy with proprio={proprio!r}"
        )
