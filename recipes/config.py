"""Settings of every stage, and the presets. ``python recipes/world_env.py smoke --help`` lists them all."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

GOAL_TASKS = (
    "starter/put_the_bowl_on_the_plate",
    "starter/open_the_top_drawer",
    "starter/turn_on_the_stove",
)

GOAL_SUITE = tuple(
    f"goal/{name}"
    for name in (
        "open_the_middle_drawer",
        "open_the_top_drawer",
        "open_the_top_drawer_and_put_the_bowl_inside",
        "push_the_plate_to_the_front_of_the_stove",
        "put_the_bowl_on_the_plate",
        "put_the_bowl_on_the_stove",
        "put_the_bowl_on_top_of_the_cabinet",
        "put_the_cream_cheese_in_the_bowl",
        "put_the_wine_bottle_on_the_rack",
        "turn_on_the_stove",
    )
)


@dataclass(frozen=True)
class Demonstrate:
    """Scripted-expert demonstrations, or LIBERO's where ``tasks`` names its files: the only supervised data."""

    episodes_per_task: int = 5
    """Demonstrations per task: the expert's from ``states``, LIBERO's first successful ones."""
    states: str = "first"
    """Training initial states that the expert starts from: the ``first``, which are drawn at random, or those that are
    ``spread``: all others lie as near to one of them as can be. Of the expert's; not read for LIBERO's."""
    actions: str = "path"
    """Of LIBERO's demonstrations: ``path``, what moves the hand along their path here, or ``stored``, the commands for
    LIBERO's controller, which forward kinematics does not follow: then SFT is the last stage."""


@dataclass(frozen=True)
class SFT:
    """Supervised fine-tuning: L1 on the action chunk, then the Laplace scale head alone (World-Env Eq. 8)."""

    steps: int = 1500
    """Of all tasks together. Suites of ten gained 4 and 22 points with 900 for each instead of 300."""
    batch_size: int = 64
    lr: float = 1e-3
    weight_decay: float = 1e-4
    shift_px: int = 2
    """Random image shift, the augmentation that helps with five demonstrations."""
    scene_shift_m: float = 0.0
    """Largest distance by which a sample's scene and hand are moved over the table together, along each of its axes:
    demonstrations in places where none was given (``policies.SceneShift``). Before the shift above."""
    place_shift_m: float = 0.0
    """Largest distance by which what lies where the gripper next closes or opens, or puts what it holds, is moved and
    the actions with it, along each of the table's axes: the policy has to look where that is (``policies.PlaceShift``).
    """
    aim_weight: float = 0.0
    """Of a second lesson, beside the actions: where on the image the gripper next closes or opens
    (``objectives.AimedCloning``). For policies that aim, others learn their actions alone; without the random shift
    above."""
    decision_share: float = 0.0
    """Share of each batch that comes from where whole chunks of an episode begin, its first step above all: there a
    rollout decides, and of a demonstration's steps only one of ``chunk_length`` is such a place. The rest is drawn from
    all steps alike."""
    cameras: tuple[str, ...] = ()
    """Cameras that the policy looks through, of the run's; all of them when empty. World model and reflector may see
    more than it does."""
    dim: int = 128
    depth: int = 2
    vision_blocks: tuple[int, ...] = ()
    """Blocks of a frozen ImageNet encoder that the policy sees through, too, for instance 2 4 10."""
    scale_steps: int = 200
    scale_lr: float = 1e-3


@dataclass(frozen=True)
class Explore:
    """The policy's own rollouts in the scenes, perturbed: data for both models."""

    episodes_per_task: int = 160
    """Rounded up to whole waves of ``num_envs`` for each scale factor."""
    scale_factors: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0)
    """Multiples of the policy's Laplace scale, or of its temperature if it acts by tokens; the episodes are shared out
    equally. 0 is the greedy policy."""
    noise: str = "step"
    """As ``post_train.noise``. LOOP may have another one than the models were shown."""
    num_envs: int = 32


@dataclass(frozen=True)
class WorldModel:
    """Video world model training on demonstrations and exploration."""

    steps: int = 2400
    refit_steps: int = 700
    """Steps of the later rounds, which continue from the model of the round before."""
    batch_size: int = 8
    lr: float = 1.5e-3
    weight_decay: float = 1e-3
    unroll_prob: float = 0.5
    """Share of updates in which the second chunk is generated from the model's own first chunk."""
    failure_share: float | None = 0.6
    """Share of the windows, in every task, that come from episodes that fail; None draws from all episodes alike."""
    patch: int = 4
    """Pixels per cell of the network's finest grid: twice the image at twice the patch costs the trunk nothing."""
    width: int = 96
    denoise_steps: int = 1
    deterministic: bool = True
    """One step from zero noise; set to False to sample with ``denoise_steps`` steps."""
    holdout: float = 0.08
    """Share of exploration episodes kept out for the fidelity figures (by initial state)."""


@dataclass(frozen=True)
class Reflector:
    """Instant reflector: frozen encoder, trained reward head."""

    vision_blocks: tuple[int, ...] = ()
    """Blocks of a frozen ImageNet encoder that it sees through, too, for instance 4 10."""
    encoder_frames: int = 6000
    """Drawn of each task and outcome, for its encoder."""
    prefixes: int = 10000
    """Likewise, of their videos, for its head."""
    batch_size: int = 32
    """Half the frames or prefixes in a batch."""
    lr: float = 1e-3
    imagined_share: float = 0.5
    """Share of the training episodes that are imagined replays of recorded actions, labelled by the physics."""
    path_epochs: float = 0.0
    """Passes over the rollouts for a second reflector, which judges in imagination by where the hand goes over the
    first frame; none when 0. Half as many come before, in which it finds the places that matter there. In the world
    both judge, and no imagined episodes are made for the first one."""
    holdout: float = 0.2
    """Share of the exploration's initial states kept out, for the figures and for the choice of the stopping rule."""
    threshold: float = 0.5
    consecutive: int = 1
    choose_threshold: bool = False
    """Choose threshold and consecutive frames on held-out training rollouts instead of the two settings above."""


@dataclass(frozen=True)
class Adapt:
    """Before LOOP the policy learns to do on imagined frames what it does on the real ones (``adapt.py``)."""

    steps: int = 0
    """0 leaves the stage out."""
    episodes_per_task: int = 64
    """Explored episodes of each task that are imagined for it, as many as there are at most."""
    batch_size: int = 48
    """Decisions, each seen both ways."""
    lr: float = 1e-4
    correct_steps: int = 0
    """First the policy is taught where the hand has to go in the explored initial states (``correct.py``); 0 does not.
    Like the others not read where ``steps`` is 0."""
    correct_lr: float = 5e-4


@dataclass(frozen=True)
class PostTrain:
    """LOOP (World-Env Algorithm 1)."""

    env: str = "imagined"
    """``imagined`` (the world model) or ``tabletop`` (the physics: the upper bound; same recipe otherwise)."""
    iterations: int = 24
    groups: int = 24
    group_size: int = 8
    epochs: int = 4
    minibatch_size: int = 256
    momentum: float = 0.9
    """Adam's first decay: with .95 and two updates a wave, an update goes where the last ten waves point."""
    clip_epsilon: float = 0.1
    ratio_level: str = "step"
    """``step`` (World-Env Eq. 5), ``chunk``: one ratio for all steps of a chunk, or ``token``: one for each token of a
    policy that acts by tokens. FAST's belong to whole chunks: ``chunk`` or ``token``."""
    lora_rank: int = 16
    """Of the adapters; at 0 the whole policy is updated instead, but for frozen encoders."""
    lora_lr: float = 2e-4
    """Of the adapters, or of the rest of the policy at rank 0; at 0 the heads alone are updated."""
    head_lr: float = 2e-4
    draw: int = 0
    """Another one gives LOOP other random numbers, and leaves the rest of the run as it is: how much of a result is
    chance."""
    averaging: float = 0.8
    """Decay per iteration of the running mean of the weights that is saved."""
    hold: float = 0.0
    """Weight of a pull of the policy's mean to where it was before LOOP, in units of its scale, on rollouts of tasks it
    solves; their returns are not learned from. At 0 nothing is held."""
    hold_from: float = 0.85
    """A task is solved if this share of its greedy rollouts in exploration reached the goal."""
    trust: float = 0.0
    """Least agreement (Cohen's kappa) of imagination's verdicts with exploration's greedy outcomes (``trust.py``) by
    which a task is learned from; others are held like solved ones. At 0 nobody asks; in the physics neither."""
    noise: str = "step"
    """Of the Laplace density that is sampled and scored: ``step``, each step's own (World-Env Eq. 2), or ``chunk``, one
    displacement for all steps of a chunk, whose ratio each of them has (``policies.ChunkLaplace``). Policies that act
    by tokens have none."""
    scale_factor: float = 1.0
    """Behaviour and scored density use this multiple of the policy's scale, or of its temperature if it acts by tokens.
    """
    warmup_iterations: int = 2
    max_kl: float = 0.1
    """An iteration's updates stop when the approximate KL per step exceeds this; per chunk where ``noise`` is of
    chunks."""
    max_grad_norm: float = 1.0
    standardize: bool = True
    """Divide the advantages of a batch by their overall standard deviation (World-Env does not)."""
    probe_every: int = 4
    """Iterations between greedy probes on training contexts, in the physics and in imagination (logged, never learned
    from); the first and the last are always probed, 0 is never. Every fourth costs under a tenth of the time."""
    probe_contexts: int = 16
    """Contexts of each task in a probe."""
    false_alarm_rate: float = 0.05
    """Of a whole run: of the warning that success rises in imagination and not in the physics."""


@dataclass(frozen=True)
class Evaluate:
    """Greedy success on held-out initial states, both protocols, before and after."""

    episodes_per_task: int = 200
    num_envs: int = 50


@dataclass(frozen=True)
class RealSize:
    """Local folders of pretrained parts, and what they are made with. Read with ``parts`` at ``real-size`` alone."""

    policy: Path | None = None
    """A vision-language model as transformers' ``save_pretrained`` wrote it, a checkpoint of OpenVLA or OpenVLA-OFT, or
    LeRobot's of SmolVLA, pi0, pi0.5 or pi0-FAST."""
    statistics: str = ""
    """Key of the checkpoint's ``dataset_statistics.json``; the only one when empty."""
    action_head: str = "continuous"
    """Of the policy: ``continuous`` (OpenVLA-OFT's heads, a Laplace density), ``tokens`` (OpenVLA's, the vocabulary's
    last tokens one after the other) or ``fast`` (pi0-FAST's, tokens of whole chunks). LeRobot's policies have their
    own: leave it out."""
    action_tokenizer: str = ""
    """Folder or Hub id of FAST's tokenizer; when empty that of LeRobot's policy, and for ``fast`` on a vision-language
    model one is trained on the run's demonstrations."""
    backbone: str = ""
    """Folder or Hub id of which LeRobot's policy has its tokenizer, and SmolVLA its backbone's config; when empty its
    own folder, and what its config names."""
    mirror: bool = False
    """LeRobot's policy sees images with left and right swapped: those of LIBERO's data sets are mirrored."""
    reflector: Path | None = None
    """A LLaVA-OneVision or LLaVA-Video model as ``save_pretrained`` wrote it."""
    world_model: Path | None = None
    """A folder of diffusers with ``vae``, ``unet`` and ``image_encoder``, those there are."""
    frame_size: tuple[int, int] = (320, 512)
    """Height and width (px) of the frames inside the world model."""
    rows_per_call: int = 2
    """Videos whose next chunk the world model paints at once; more are quicker and take more memory."""
    num_frames: int = 32
    """Frames of a video that the reflector looks at."""
    score_every: int = 8
    """Frames between two judgements of the reflector, a pass of its language model each."""
    dtype: str = "bfloat16"
    """Of the frozen weights of policy and reflector: ``bfloat16`` or ``float32``."""


@dataclass(frozen=True)
class WorldEnvConfig:
    """The whole loop: demonstrations -> SFT -> exploration -> world model -> reflector -> LOOP -> evaluation."""

    run_dir: Path = Path("runs/world_env")
    """Folder of checkpoints, rollouts, metrics and plots; the same command on the same folder continues."""
    seed: int = 0
    """Of every random choice; demonstrations and initial states stay the same."""
    begin_from: Path | None = None
    """Another run's folder: a new run begins with copies of the stages that are finished there, up to the first that
    depends on a setting which is another one here."""
    num_threads: int = 2
    """CPU threads. Beside other jobs 1 is faster: threads that wait for a busy core make all wait."""
    device: str = "auto"
    """Of the models, imagination and every update: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one.
    The physics and the recordings stay on the CPU."""
    parallel: str = "ddp"
    """Of what torchrun's processes train together, in each a copy (``ddp``) or a share of the weights (``fsdp``)."""
    collectors: str = "local"
    """Who explores, imagines and evaluates: ``local``, this process; ``process:2``, two others of one thread each;
    ``ray:4``, four of a Ray cluster (``RAY_ADDRESS``, or one of this machine): pip install worldenv_trl[ray].
    ``ray:4/12`` cuts every wave into 12 shares: equal shares give equal rollouts, whoever collects them."""
    checkpoint_minutes: float = 2.0
    """Between two checkpoints of the running stage: at most so much is lost when it is killed."""
    logger: tuple[str, ...] = ()
    """Where figures, plots and videos go beside ``metrics.jsonl``: any of csv, tensorboard, wandb, mlflow, mcap."""
    parts: str = "compact"
    """``compact``, made here, or ``real-size``: pretrained ones of the folders in ``real_size``."""
    tasks: tuple[str, ...] = GOAL_TASKS
    """``suite/name``, a ``suite`` for all of it, or a ``.bddl`` file, each once; ``task_id`` is the place in this list.
    LIBERO's ``_demo.hdf5`` files, or a folder of them, bring their demonstrations along."""
    cameras: tuple[str, ...] = ("agentview",)
    """Cameras that every part sees through: ``agentview``, ``wrist`` and any other that the scenes have."""
    image_size: int = 64
    vision_weights: Path | None = None
    """Weights of the frozen ImageNet encoder; those of the extra ``vision`` when None."""
    chunk_length: int = 8
    max_steps: int = 72
    """Env steps (20 Hz) of an episode at most, a multiple of ``chunk_length``."""
    scale_floor: tuple[float, float, float] = (0.04, 0.0025, 0.15)
    """Lower bound of the Laplace scale of position, rotation and gripper, in normalised action units.

    The scale head learns what is left on the demonstrations, a few hundredths of what the policy is off elsewhere:
    without a floor the rollouts of a group all end alike and LOOP learns nothing."""
    scale_share: float = 0.125
    """The scale of a dimension is at least this share of the half-range that the demonstrations use of it, too.

    Where they turn the hand, noise that suits rotations they never use is so small that the smallest update exceeds
    ``post_train.max_kl``."""
    train_states: int = 50
    """Training initial states of each task that exploration starts from, and LOOP after it. 50 is the standard; another
    one costs a rollout of exploration, no demonstration."""
    rounds: int = 1
    """Times that exploration, both models and LOOP run in turn, each with the policy reached so far."""
    demonstrate: Demonstrate = field(default_factory=Demonstrate)
    sft: SFT = field(default_factory=SFT)
    explore: Explore = field(default_factory=Explore)
    world_model: WorldModel = field(default_factory=WorldModel)
    reflector: Reflector = field(default_factory=Reflector)
    adapt: Adapt = field(default_factory=Adapt)
    post_train: PostTrain = field(default_factory=PostTrain)
    evaluate: Evaluate = field(default_factory=Evaluate)
    real_size: RealSize = field(default_factory=RealSize)


_IMPROVE = WorldEnvConfig(
    run_dir=Path("runs/improve"),
    train_states=150,
    demonstrate=Demonstrate(episodes_per_task=2, states="spread"),
    sft=SFT(
        steps=3000,
        shift_px=0,
        scene_shift_m=0.025,
        place_shift_m=0.025,
        aim_weight=0.5,
        decision_share=0.5,
        vision_blocks=(2, 4, 10),
    ),
    explore=Explore(episodes_per_task=480),
    reflector=Reflector(choose_threshold=True, path_epochs=20.0),
    adapt=Adapt(steps=500, correct_steps=1000),
    post_train=PostTrain(iterations=36, lora_rank=0, lora_lr=1e-4, head_lr=1e-4, hold=1.0),
)


PRESETS: dict[str, tuple[str, WorldEnvConfig]] = {
    "smoke": (
        "Every stage for real in at most 6 minutes on 2 cores; too short to improve anything.",
        WorldEnvConfig(
            run_dir=Path("runs/smoke"),
            sft=SFT(steps=800, scale_steps=60),
            explore=Explore(episodes_per_task=24, num_envs=24),
            world_model=WorldModel(steps=160),
            reflector=Reflector(encoder_frames=600, prefixes=800),
            post_train=PostTrain(iterations=2, groups=6, probe_every=1, probe_contexts=5),
            evaluate=Evaluate(episodes_per_task=20, num_envs=20),
        ),
    ),
    "improve": (
        "Meant to raise held-out success (README: how far it does), in half an hour on 2 idle cores; extra vision.",
        _IMPROVE,
    ),
    "thorough": (
        "`improve` for ten tasks: five demonstrations, SFT three times as long; about 4 hours; extra vision.",
        replace(
            _IMPROVE,
            run_dir=Path("runs/thorough"),
            tasks=GOAL_SUITE,
            max_steps=152,
            demonstrate=replace(_IMPROVE.demonstrate, episodes_per_task=5),
            sft=replace(_IMPROVE.sft, steps=9000),
            evaluate=Evaluate(episodes_per_task=60),
        ),
    ),
    "real-size": (
        "Pretrained parts of billions of parameters, from local folders (--real-size.*), on GPUs; first --dry-run.",
        WorldEnvConfig(
            run_dir=Path("runs/real_size"),
            device="cuda",
            parts="real-size",
            tasks=GOAL_SUITE,
            cameras=("agentview", "wrist"),
            image_size=256,
            max_steps=152,
            sft=SFT(steps=5000, batch_size=64, lr=5e-4, shift_px=0, scale_steps=1000, scale_lr=5e-4),
            world_model=WorldModel(steps=10000, batch_size=16, lr=5e-5, denoise_steps=4, deterministic=False),
            post_train=PostTrain(minibatch_size=32, lora_rank=32, lora_lr=1e-4, head_lr=1e-5),
        ),
    ),
}
