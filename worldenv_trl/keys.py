"""Names and sizes of every TensorDict entry that passes between the parts.

Extends :mod:`torchrl.data.vla`: the entries that TorchRL already names keep its names. ``*B`` is the batch,
``C`` the chunk length, ``A`` the action size, images are ``[3, H, W]`` uint8, upright.
"""

from __future__ import annotations

CHUNK_LENGTH = 8
ACTION_DIM = 7
STATE_DIM = 7
KINEMATIC_DIM = 20
POSE_DIM = 13
CONTROL_HZ = 20
POSITION_STEP = 0.05  # metres for an action of +1
ROTATION_STEP = 0.5  # radians for an action of +1

IMAGE = ("observation", "image")  # uint8 [*B, 3, H, W], agentview
WRIST_IMAGE = ("observation", "wrist_image")  # uint8 [*B, 3, H, W]
STATE = ("observation", "state")  # float32 [*B, 7]: position (m), axis-angle (rad), gripper opening in [0, 1]
KINEMATIC_STATE = "kinematic_state"  # float32 [*B, 20]: q (7), x_des (3), R_des (9, row-major), gripper opening
INSTRUCTION = "language_instruction"  # NonTensor str
TASK_ID = "task_id"  # int64 [*B, 1], index into the instructions of the run at hand; no identity
CONTEXT_ID = "context_id"  # int64 [*B, 1], the initial state a rollout started from
SIM_STATE = "sim_state"  # float64 [*B, S], MuJoCo integration state
NUM_STEPS = "num_steps"  # int64 [*B, 1], env steps executed since the reset

ACTION = "action"  # float32 [*B, 7], one env action
CHUNK = ("vla_action", "chunk")  # float32 [*B, C, 7], unclipped Laplace sample
TOKENS = ("vla_action", "tokens")  # int64 [*B, C, 7], of policies that act by tokens; [*B, L] of a whole chunk (FAST)
TOKEN_IS_PAD = ("vla_action", "token_is_pad")  # bool [*B, L], tokens behind the end of a sequence
LOGITS = ("vla_action", "logits")  # float [*B, C, 7, V], over the V tokens that an action's number can be
LOC = ("vla_action", "loc")  # float32 [*B, C, 7]
SCALE = ("vla_action", "scale")  # float32 [*B, C, 7], exp(log-scale)
LOG_SCALE = ("vla_action", "log_scale")  # float32 [*B, C, 7], the scale head's raw output
LOG_PROBS = ("vla_action", "log_probs")  # float32 [*B, C], summed over the 7 dimensions; of tokens like them
ACTION_IS_PAD = "action_is_pad"  # bool [*B, C]
WAYPOINT = ("vla_action", "waypoint")  # float32 [*B, 3], where the hand is when its gripper is next told otherwise (m)
APPROACH = ("vla_action", "approach")  # float32 [*B, C], share of the way to the waypoint that each action goes

FRAMES = "frames"  # ("frames", entry) uint8 [*B, C, 3, H, W] by camera, what one decision produced; see frames_key
STATES = "states"  # float32 [*B, C, 7], the proprioception that goes with the frames
KINEMATIC_STATES = "kinematic_states"  # float32 [*B, C, 20]
STEP_MASK = "step_mask"  # bool [*B, C], steps of the chunk that were executed
SUCCESS = "success"  # bool [*B, 1], from the physics
SUCCESS_PROB = "success_prob"  # float32 [*B, 1], R(o_1:t, g)
ADVANTAGE = "advantage"  # float32 [*B, 1]
HELD = "held"  # bool [*B, 1], decisions at which a policy is held to the reference below, and learns no advantage
REFERENCE_LOC = ("reference", "loc")  # float32 [*B, C, 7], of a policy to be kept to: the one that LOOP began with
REFERENCE_SCALE = ("reference", "scale")  # float32 [*B, C, 7]
RATIO = "ratio"  # float32 [*B, C], new over behaviour probability of each step, after an update (LOOPLoss.ratios)
CLIPPED = "clipped"  # bool [*B, C], whether that ratio is clipped
NOISE_SEED = "noise_seed"  # int64 [*B, 1], what the world model's noise for this decision was drawn from
ACTION_MAP = "action_map"  # uint8 [*B, 3, H, W], the hand's pose drawn for the eye, see ActionMap
PREDICTED_STATE = "predicted_state"  # float32 [*B, 7], the state that forward kinematics predicts from one step to this
TERMINATION = "termination"  # int64 [*B, 1], why a rollout ended, index into TERMINATIONS
TERMINATIONS = ("running", "success", "reflector", "step limit", "cut short")
ROW = "row"  # int64 [*B, 1], the env's row a recorded rollout ran in
EPISODE = "episode"  # int64 [*B, 1], how many rollouts that row had begun before
MASK = ("collector", "mask")  # bool [*B], entries that belong to a rollout (False after its end)

_IMAGE_ENTRIES = {"agentview": "image", "wrist": "wrist_image"}  # TorchRL's names; any other camera keeps its own


def image_entry(camera: str) -> str:
    """What a scene's ``camera`` is called below ``observation`` and ``frames``."""
    return _IMAGE_ENTRIES.get(camera, camera)


def image_key(camera: str) -> tuple[str, str]:
    """Where the current image of a scene's ``camera`` is: uint8 [*B, 3, H, W]."""
    return ("observation", image_entry(camera))


def frames_key(camera: str) -> tuple[str, str]:
    """Where the images of a scene's ``camera`` over a chunk are: uint8 [*B, C, 3, H, W]."""
    return (FRAMES, image_entry(camera))


def camera_of(entry: str) -> str:
    """The scene's camera whose images are called ``entry``: the inverse of :func:`image_entry`."""
    return next((camera for camera, name in _IMAGE_ENTRIES.items() if name == entry), entry)
