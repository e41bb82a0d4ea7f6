"""Every setting of a run, with the paper's value as default unless a docstring says otherwise.

Sections are frozen dataclasses; a wrong value raises ``ValueError`` that names the field and the fix. `config_files`
writes the whole tree to ``config.json`` and reads it back.
"""

import dataclasses
import difflib
import math
from dataclasses import dataclass, field
from typing import Any, Literal

STATE_FIELD_DIMS: dict[str, int] = {
    "qpos": 9,
    "qvel": 9,
    "tcp_pose": 7,
    "tcp_twist": 6,
    "goal": 3,
    "is_grasped": 1,
    "tcp_to_goal": 3,
    "object_poses": 7,
    "object_pose": 7,
    "tcp_to_object": 3,
    "object_to_goal": 3,
    "object_to_goal_near": 3,
}
"""Size of each field of the proprioceptive vector; ``object_poses`` counts once per object of the task.

Those that name an object read the simulator's poses: only the validation variant ``oracle_state`` uses them.
"""

TEMPERATURE_FIELDS = ("temperature_mode", "temperature", "final_temperature", "annealing_updates")
"""Fields of `sac` that a resumed run may change."""

PROPRIO_FIELDS = ("qpos", "qvel", "tcp_pose", "tcp_twist", "goal", "is_grasped")


def check(ok: bool, name: str, value: object, want: str) -> None:
    """Raise ``ValueError`` naming the field, its value and what it should be."""
    if not ok:
        raise ValueError(f"{name} = {value!r}: {want}")


def _positive(section: str, obj: Any, *names: str) -> None:
    for name in names:
        value = getattr(obj, name)
        check(0 < value < math.inf, f"{section}.{name}", value, "must be greater than 0 and finite")


def _not_negative(section: str, obj: Any, *names: str) -> None:
    for name in names:
        value = getattr(obj, name)
        check(0 <= value < math.inf, f"{section}.{name}", value, "must be 0 or more and finite")


@dataclass(frozen=True, kw_only=True, slots=True)
class EnvConfig:
    """The simulated task and its wrist camera (Table 1, Table A4)."""

    task: str = "PickBanana-v1"
    """Task to learn; `slotfilm variants --tasks` lists those that are described."""
    assets: Literal["procedural", "ycb"] = "procedural"
    """Object meshes: generated here, or ManiSkill's downloaded YCB banana and bowl."""
    goal: Literal["near_bowl", "fixed", "random"] = "near_bowl"
    """Where the target point is: beside and above the bowl, at one fixed point, or anywhere above the table."""
    goal_height_m: tuple[float, ...] = (0.04, 0.12)
    """Lowest and highest target of `near_bowl`, in metres: low, for Figure 8 (c) shows the bowl being pushed."""
    goal_visible: bool = False
    """Draw the green target in the wrist camera's picture (ManiSkill hides goal markers from sensors)."""
    control_mode: str = "pd_ee_delta_pose"
    """ManiSkill controller; the paper's 7-D action is an end-effector pose delta plus the gripper."""
    max_steps: int = 400
    """Length of an episode in control steps; reaching it is a truncation, never a termination."""
    terminate_on_success: bool = False
    """End the episode at the first success; the paper's episodes always run their full length."""
    image_size: int = 128
    """Height and width of the wrist camera's picture in pixels; a multiple of 16."""
    fov_deg: float = 90.0
    """Field of view of the pinhole camera in degrees."""
    near_m: float = 0.01
    """Near clipping plane in metres."""
    far_m: float = 100.0
    """Far clipping plane in metres."""
    render_profile: Literal["wrist", "full"] = "wrist"
    """`wrist` leaves out triangles that the wrist camera cannot see; `full` draws ManiSkill's whole robot."""
    render_backend: Literal["auto", "cpu", "gpu"] = "auto"
    """Device that renders: `auto` takes a GPU where there is one, else the software driver."""
    sim_backend: Literal["cpu", "gpu"] = "cpu"
    """PhysX on the CPU (one environment a process) or on a GPU (needs SAPIEN's PhysX GPU library)."""
    occlusion: bool = False
    """Count an object hidden behind another one as not visible (needs a segmentation render)."""

    def __post_init__(self) -> None:
        _positive("env", self, "max_steps", "near_m")
        check(
            self.image_size >= 32 and self.image_size % 16 == 0,
            "env.image_size",
            self.image_size,
            "must be a multiple of 16, at least 32",
        )
        check(1 < self.fov_deg < 170, "env.fov_deg", self.fov_deg, "is in degrees and must lie between 1 and 170")
        low_high = len(self.goal_height_m) == 2 and 0 <= self.goal_height_m[0] <= self.goal_height_m[1] <= 0.5
        check(low_high, "env.goal_height_m", self.goal_height_m, "must be a lowest and a highest value in [0, 0.5]")
        check(self.far_m > self.near_m, "env.far_m", self.far_m, f"must be greater than env.near_m = {self.near_m}")


@dataclass(frozen=True, kw_only=True, slots=True)
class ObsConfig:
    """What the agent observes beside the picture."""

    state_fields: tuple[str, ...] = PROPRIO_FIELDS
    """Fields of the proprioceptive vector, in order. The paper's 35 dimensions leave 10 unexplained; see the README."""
    state_dim: int = 35
    """Total size of the fields; checked, so that a change of fields is a deliberate one."""
    num_objects: int = 2
    """Objects whose projected positions supervise the slots; set by the task."""
    normalize_state: bool = False
    """Standardise the state with mean and deviation of the random-policy data (the paper does not)."""

    def __post_init__(self) -> None:
        _positive("obs", self, "num_objects", "state_dim")
        for name in self.state_fields:
            if name not in STATE_FIELD_DIMS:
                near = difflib.get_close_matches(name, STATE_FIELD_DIMS, n=1)
                raise ValueError(
                    f"obs.state_fields: unknown field {name!r}"
                    + (f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(STATE_FIELD_DIMS)}")
                )
        total = sum(self.field_dim(name) for name in self.state_fields)
        check(
            total == self.state_dim,
            "obs.state_dim",
            self.state_dim,
            f"the fields {', '.join(self.state_fields)} add up to {total}; set obs.state_dim = {total} if meant so",
        )

    def field_dim(self, name: str) -> int:
        """Size of one field for this task's number of objects."""
        return STATE_FIELD_DIMS[name] * (self.num_objects if name == "object_poses" else 1)


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardWeights:
    """Weights of the reward's components; the paper gives none. Table 2's late phase suggests place = 2 reach."""

    reach: float = 1.0
    """Weight of the reaching term."""
    grasp: float = 1.0
    """Weight of the binary grasp term."""
    place: float = 2.0
    """Weight of the placing term."""
    post_grasp: float = 1.0
    """Weight of the transport term."""
    static: float = 1.0
    """Weight of the stability term; 0 removes it (Figure 12)."""

    def __post_init__(self) -> None:
        _not_negative("reward.weights", self, "reach", "grasp", "place", "post_grasp", "static")
        check(self.total > 0, "reward.weights", self, "at least one weight must be greater than 0")

    @property
    def total(self) -> float:
        """Sum of the weights, the divisor of `reward.normalize = sum`."""
        return self.reach + self.grasp + self.place + self.post_grasp + self.static


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardConfig:
    """The multiscale shaped reward (Section 4.5)."""

    alpha: float = 10.0
    """Decay of the exponential distance terms in 1/m (Figure 13 varies it, or `sac.reward_scale`)."""
    varpi: float = 5.0
    """Sharpness of the stability term in s/rad (Figure 11)."""
    delta_m: float = 0.025
    """Distance below which reach and place switch to the near form, and the radius of the target region, in metres."""
    near_form: Literal["bounded", "inverse", "exp_only"] = "bounded"
    """Near form: 1/(1+d+eps), the printed 1/(d+eps) capped at `near_cap`, or the exponential everywhere."""
    near_cap: float = 10.0
    """Cap of the `inverse` near form."""
    eps: float = 1e-5
    """Small constant of the near form."""
    pg_form: Literal["one_minus_exp", "exp", "exp_alpha"] = "one_minus_exp"
    """Post-grasp form: (1 - exp(-alpha d)), the printed exp(-d), or exp(-alpha d); times grasp."""
    place_gate: Literal["grasp", "none"] = "grasp"
    """Placing counts only while grasped (as written), or always."""
    static_norm: Literal["l2", "max"] = "l2"
    """Norm of the joint velocities in the stability term."""
    static_joints: Literal["arm", "all"] = "arm"
    """Joints whose velocity counts: the 7 of the arm, or the fingers too."""
    weights: RewardWeights = field(default_factory=RewardWeights)
    """Weights of the components."""
    normalize: Literal["sum", "none"] = "sum"
    """Divide by the sum of the weights, so that a step's reward lies in [0, 1] with the bounded form, or not."""

    def __post_init__(self) -> None:
        _positive("reward", self, "alpha", "varpi", "delta_m", "near_cap", "eps")

    @property
    def divisor(self) -> float:
        """What the weighted components are divided by."""
        return self.weights.total if self.normalize == "sum" else 1.0


@dataclass(frozen=True, kw_only=True, slots=True)
class SuccessConfig:
    """When an episode counts as solved."""

    require_static: bool = True
    """The arm must stand still (every arm joint below `static_threshold`), as ManiSkill asks."""
    static_threshold: float = 0.2
    """Largest arm joint velocity that counts as still, in rad/s."""
    require_release: bool = False
    """The gripper must have let go; the paper's Figure 8 ends holding."""

    def __post_init__(self) -> None:
        _positive("success", self, "static_threshold")


Precision = Literal["float32", "bfloat16", "auto"]
Fusion = Literal["film_tanh", "film_clamp", "concat_proj", "concat_late", "none", "state_only"]


@dataclass(frozen=True, kw_only=True, slots=True)
class EncoderConfig:
    """The fusion encoder (Sections 4.1 and 4.2), or a baseline's convolutions in its place (Section 5.1)."""

    kind: Literal["slots", "cnn", "drq", "drqv2"] = "slots"
    """The proposed slots, or a convolutional network that learns from pixels: plain, DrQ-v1's or DrQ-v2's."""
    conv_channels: int = 32
    """Filters of each of the four convolutions of a pixel encoder."""
    backbone: Literal["imagenet", "path", "random"] = "imagenet"
    """Initial ResNet-18 weights: torchvision's ImageNet download, a file, or random. Never falls back silently."""
    backbone_path: str = ""
    """ResNet-18 weights for `backbone = path`: .safetensors, or a torch state dict (loaded with weights_only)."""
    backbone_sha256: str = ""
    """SHA-256 of that file: filled in by the run that can read it, so that another file of this name is told apart."""
    frozen_precision: Precision = "float32"
    """Arithmetic of the frozen backbone on a CPU: bfloat16 takes two thirds of the time where the processor has it, and
    the tokens lose their third digit; `auto` takes it there and float32 elsewhere."""
    feature_dim: int = 42
    """Channels D of tokens, slots and FiLM; what a pixel encoder's convolutions are projected to."""
    num_heads: int = 3
    """Cross-attention heads; must divide `feature_dim`."""
    num_slots: int = 2
    """Learnable slot queries N_s."""
    pos_scale: float = 0.05
    """Lambda, the weight of the positional code."""
    slot_normalize: Literal["tokens", "slots"] = "tokens"
    """Softmax over tokens (the paper's mathematics) or over slots (slots compete, renormalised over tokens)."""
    fusion: Fusion = "film_tanh"
    """How the state enters; see `slotfilm variants`."""
    goal: bool = False
    """Add the goal query and its two-way gate."""
    goal_out_of_view_bias: float = -1e4
    """Bias of the goal's gate logit while the goal is out of view."""
    head_hidden: int = 256
    """Hidden width of the UV and visibility heads."""
    vis_head: Literal["pooled", "matched"] = "pooled"
    """Visibility from the pooled slots, one logit per object; or one logit per slot, matched like the positions."""

    def __post_init__(self) -> None:
        _positive("encoder", self, "conv_channels", "feature_dim", "num_heads", "num_slots", "head_hidden")
        check(
            not self.learns_from_pixels or (self.fusion in ("none", "concat_late") and not self.goal),
            "encoder.fusion",
            self.fusion,
            f"encoder.kind = {self.kind!r} takes 'none' or, with the state, 'concat_late', and no encoder.goal",
        )
        check(
            self.feature_dim % self.num_heads == 0 or self.learns_from_pixels,
            "encoder.num_heads",
            self.num_heads,
            f"must divide encoder.feature_dim = {self.feature_dim}",
        )
        check(
            self.feature_dim % 2 == 0, "encoder.feature_dim", self.feature_dim, "must be even, for the positional code"
        )
        wants_file = self.backbone == "path" and not self.backbone_path
        check(not wants_file, "encoder.backbone_path", self.backbone_path, "encoder.backbone = 'path' needs a file")
        check(self.uses_image or not self.goal, "encoder.goal", self.goal, "encoder.fusion = 'state_only' has no slots")
        bias = self.goal_out_of_view_bias
        check(bias <= 0, "encoder.goal_out_of_view_bias", bias, "must be 0 or less: it closes the gate to the goal")

    @property
    def learns_from_pixels(self) -> bool:
        """Whether it is a baseline's convolutional network, which keeps pictures and has no pre-training."""
        return self.kind != "slots"

    @property
    def uses_image(self) -> bool:
        """Whether the agent sees the camera at all."""
        return self.fusion != "state_only"

    @property
    def uses_state(self) -> bool:
        """Whether the state reaches the latent."""
        return self.fusion != "none"


@dataclass(frozen=True, kw_only=True, slots=True)
class PretrainConfig:
    """Supervised slot pre-training (Section 4.3)."""

    steps: int = 150_000
    """Gradient steps; 0 skips pre-training."""
    batch_size: int = 128
    """Frames per gradient step."""
    lr: float = 1e-4
    """Adam learning rate."""
    lambda_pos: float = 1.0
    """Weight of the position loss (the paper gives none of the three)."""
    lambda_vis: float = 1.0
    """Weight of the visibility loss."""
    lambda_attn: float = 1.0
    """Weight of the attention alignment loss."""
    attn_reduce: Literal["sum_clamped", "sum", "mean"] = "sum_clamped"
    """How the slots' attention at an object's token is combined; the printed sum can exceed 1, so it is clamped."""
    uv_units: Literal["unit", "pixels"] = "unit"
    """Position errors in [0, 1] image units, or in pixels."""
    train_backbone: Literal["all", "none"] = "all"
    """Train the whole ResNet, as the paper does, or keep it as initialised and learn on its cached features."""
    precision: Precision = "float32"
    """Arithmetic of backbone and projection where they are trained; losses and weights are float32 in each. bfloat16
    takes half of the time on a processor that has it; `auto` takes it there and float32 elsewhere."""
    holdout: float = 0.1
    """Share of the episodes' frames held out for the reported errors."""
    eval_every: int = 500
    """Steps between evaluations on held-out frames."""

    def __post_init__(self) -> None:
        _not_negative("pretrain", self, "steps", "lambda_pos", "lambda_vis", "lambda_attn")
        _positive("pretrain", self, "batch_size", "lr", "eval_every")
        check(0 < self.holdout < 1, "pretrain.holdout", self.holdout, "is a share and must lie between 0 and 1")


@dataclass(frozen=True, kw_only=True, slots=True)
class LrConfig:
    """Adam learning rates during RL (Table A1)."""

    actor: float = 1e-4
    """Actor (the table's `alpha`)."""
    critic_value: float = 1e-3
    """Critics and value network (the table's `beta`)."""
    fusion: float = 1e-4
    """Slot attention and FiLM."""
    goal_gate: float = 3e-5
    """Goal gate logits."""
    temperature: float = 3e-4
    """Temperature, when `sac.temperature_mode = auto`."""
    backbone: float = 1e-4
    """Backbone and projection, when they are trained end to end."""

    def __post_init__(self) -> None:
        _positive("lr", self, *(f.name for f in dataclasses.fields(self)))


@dataclass(frozen=True, kw_only=True, slots=True)
class SacConfig:
    """Soft Actor-Critic with a value network (Section 4.4, Table A1)."""

    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.005
    """Polyak rate of the target value network."""
    hidden: tuple[int, ...] = (256, 256)
    """Hidden layers of actor, critics and value network."""
    batch_size: int = 128
    """Transitions per update."""
    reward_scale: float = 10.0
    """Multiplies the reward in the critic's target; scale 10 with temperature 1 equals scale 1 with temperature 0.1."""
    temperature_mode: Literal["fixed", "auto", "annealed"] = "fixed"
    """Keep the temperature, tune it to `target_entropy`, or lower it geometrically to `final_temperature`."""
    temperature: float = 1.0
    """Entropy temperature, or its starting value; the paper names no value."""
    final_temperature: float = 0.01
    """Temperature after `annealing_updates`, when `temperature_mode = annealed`."""
    annealing_updates: int = 500_000
    """Updates over which the annealed temperature falls."""
    target_entropy: float = -7.0
    """Target entropy of `auto`, in nats: minus the action's dimensions, 7 with the paper's `env.control_mode`."""
    log_std_min: float = -5.0
    """Lower clamp of the policy's log standard deviation."""
    log_std_max: float = 2.0
    """Upper clamp of the policy's log standard deviation."""
    critic_norm: Literal["none", "layer"] = "none"
    """LayerNorm in the critics and the value network; keeps them from diverging (not in the paper)."""
    bootstrap: Literal["on_truncation", "always", "never"] = "on_truncation"
    """Bootstrap through time limits only, also through terminations, or through neither."""
    grad_clip: float = 0.0
    """Largest gradient norm of the critics and the encoder; 0 leaves gradients alone."""
    end_to_end: bool = False
    """Train backbone and projection through the critic's loss and keep images in replay (Section 7.4)."""
    augment_views: int = 0
    """Randomly shifted views of each picture that the critics average over (DrQ's K = M); 0 shifts nothing."""
    augment_shift_px: int = 4
    """Largest random shift of a view in pixels, each way."""

    def __post_init__(self) -> None:
        check(0 <= self.gamma < 1, "sac.gamma", self.gamma, "must lie in [0, 1)")
        check(0 < self.tau <= 1, "sac.tau", self.tau, "must lie in (0, 1]")
        check(
            len(self.hidden) > 0 and all(h > 0 for h in self.hidden),
            "sac.hidden",
            self.hidden,
            "needs at least one layer, each wider than 0",
        )
        _positive("sac", self, "batch_size", "reward_scale", "temperature", "final_temperature", "annealing_updates")
        _not_negative("sac", self, "grad_clip", "augment_views")
        _positive("sac", self, "augment_shift_px")
        check(
            self.log_std_min < self.log_std_max,
            "sac.log_std_min",
            self.log_std_min,
            f"must be below sac.log_std_max = {self.log_std_max}",
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class DdpgConfig:
    """DrQ-v2's deterministic policy gradient; discount, batch, reward scale and bootstrap are those of `sac`."""

    num_steps: int = 3
    """Rewards that a critic's target adds up before it bootstraps."""
    tau: float = 0.01
    """Polyak rate of the target critics."""
    lr: float = 1e-4
    """Adam learning rate of encoder, critics and actor."""
    hidden: tuple[int, ...] = (1024, 1024)
    """Hidden layers of actor and critics."""
    first_std: float = 1.0
    """Deviation of the exploration noise at the first step."""
    last_std: float = 0.1
    """Deviation of the exploration noise from `std_steps` on."""
    std_steps: int = 500_000
    """Environment steps over which the deviation falls linearly."""
    noise_clip: float = 0.3
    """Largest noise on an action in the losses; acting does not clip."""
    shift_px: int = 4
    """Largest random shift of a picture in pixels, each way."""
    shift: Literal["bilinear", "whole"] = "bilinear"
    """Shifts by any distance, with bilinear interpolation as published, or by whole pixels as in the released code."""

    def __post_init__(self) -> None:
        _positive("ddpg", self, "num_steps", "lr", "first_std", "last_std", "std_steps", "noise_clip", "shift_px")
        check(self.num_steps <= 255, "ddpg.num_steps", self.num_steps, "must be 255 or less")
        check(0 < self.tau <= 1, "ddpg.tau", self.tau, "must lie in (0, 1]")
        check(
            len(self.hidden) > 0 and all(h > 0 for h in self.hidden),
            "ddpg.hidden",
            self.hidden,
            "needs at least one layer, each wider than 0",
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayConfig:
    """The replay buffer."""

    capacity: int = 1_000_000
    """Steps kept, over all shards; the oldest go first."""
    num_shards: int = 1
    """Shards, each a process of its own on a cluster."""
    min_steps: int = 1_000
    """Steps that must be stored before the first update."""

    def __post_init__(self) -> None:
        _positive("replay", self, "capacity", "num_shards", "min_steps")
        check(
            self.min_steps <= self.capacity // 2,
            "replay.min_steps",
            self.min_steps,
            f"must not exceed half of replay.capacity = {self.capacity}: a ring of whole blocks is never quite full",
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class ScheduleConfig:
    """How long each phase lasts."""

    total_steps: int = 1_200_000
    """Environment steps over all phases: 3000 epochs of 400."""
    random_steps: int = 100_000
    """Steps of the random policy before any learning; also the pre-training data."""
    random_episode_steps: int = 0
    """Length of the random policy's episodes, `env.max_steps` at most and with 0. Short ones show more scenes."""
    updates_per_step: float = 1.0
    """Optimiser updates per environment step once learning has begun."""

    def __post_init__(self) -> None:
        _positive("schedule", self, "total_steps", "random_steps", "updates_per_step")
        _not_negative("schedule", self, "random_episode_steps")
        check(
            self.random_steps < self.total_steps,
            "schedule.random_steps",
            self.random_steps,
            f"must be less than schedule.total_steps = {self.total_steps}, or nothing is learned",
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluationConfig:
    """Deterministic evaluation on seeds that training never sees."""

    episodes: int = 50
    """Episodes of the final evaluation."""
    every_steps: int = 50_000
    """Environment steps between evaluations during training; 0 evaluates only at the end."""
    during_episodes: int = 10
    """Episodes of each evaluation during training."""
    seed: int = 10_000_000
    """First seed of the held-out range; training seeds stay below it."""
    videos: int = 2
    """Episodes recorded as video with the slots' attention drawn on them."""

    def __post_init__(self) -> None:
        _positive("evaluation", self, "episodes", "during_episodes")
        _not_negative("evaluation", self, "every_steps", "videos")
        check(
            10_000_000 <= self.seed < 1 << 31,
            "evaluation.seed",
            self.seed,
            "must be 10000000 or more, so that no training episode shares it, and below 2147483648",
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class RuntimeConfig:
    """Where the roles run."""

    mode: Literal["local", "ray"] = "ray"
    """`local` runs every role in one process, bit-reproducibly; `ray` spreads them over processes and machines."""
    num_workers: int = 2
    """Environment workers (`ray` mode); with `auto_workers` those to begin with."""
    auto_workers: bool = False
    """Add workers while the learner starves and cores are free, remove them while they wait (`ray` mode)."""
    max_workers: int = 0
    """Most workers that `auto_workers` asks for; 0 is as many as the cluster has cores."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the learner; `auto` takes a GPU where there is one."""
    cuda_graphs: bool = True
    """On a GPU, record updates, pre-training steps and central inference as CUDA graphs: several times faster."""
    compiled: bool = False
    """On a GPU, also compile the networks of the updates: fewer and larger kernels, a third faster, for half a minute
    at the start; needs a C compiler."""
    inference: Literal["auto", "worker", "central"] = "auto"
    """Who turns pictures into actions (`ray` mode): every worker for itself, or one process for all workers, in
    batches; `auto` is central where that process gets a GPU and the agent has a camera."""
    learner_threads: int = 0
    """Torch threads of the learner on a CPU; 0 takes half of the cores."""
    worker_threads: int = 1
    """Torch threads of an environment worker."""
    block_steps: int = 32
    """Steps a worker collects before it sends them."""
    publish_every: int = 50
    """Updates between weight snapshots."""
    max_staleness_s: float = 120.0
    """Longest time that workers act without word from the hub that their weights are the newest, in seconds; then they
    pause until it comes (`ray` mode). A healthy run has it about once a second, however rarely weights change."""
    max_memory_share: float = 0.9
    """Share of a machine's memory in use from which its workers are stopped, one after the other, until there is room
    again (`ray` mode); 1 never."""
    exact_resume: bool = False
    """Build the simulator anew for every training episode (`local` mode; half a second each): a resumed run then equals
    an uninterrupted one bit for bit. Without it PhysX's last digits depend on the episodes before."""
    metrics_port: int = 9464
    """Port where Prometheus finds the run's metrics, 0 for none: on loopback in `local` mode, of Ray's own agent in a
    cluster that the run starts. A taken port is stepped over."""

    def __post_init__(self) -> None:
        _positive("runtime", self, "num_workers", "worker_threads", "block_steps", "publish_every")
        _positive("runtime", self, "max_staleness_s")
        _not_negative("runtime", self, "learner_threads", "max_workers")
        check(
            self.max_workers == 0 or self.max_workers >= self.num_workers,
            "runtime.max_workers",
            self.max_workers,
            f"must be 0 or at least runtime.num_workers = {self.num_workers}",
        )
        check(self.cuda_graphs or not self.compiled, "runtime.compiled", self.compiled, "needs runtime.cuda_graphs")
        check(0 < self.max_memory_share <= 1, "runtime.max_memory_share", self.max_memory_share, "must lie in (0, 1]")
        check(0 <= self.metrics_port < 65536, "runtime.metrics_port", self.metrics_port, "must lie in [0, 65535]")


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckpointConfig:
    """Checkpoints of the learner."""

    every_updates: int = 10_000
    """Updates between checkpoints."""
    keep: int = 2
    """Checkpoints kept beside `best`."""
    save_replay: bool = True
    """Also write the replay buffer at the end and on Ctrl-C, so that a resumed run continues with its data."""
    strict: bool = False
    """Stop where the newest checkpoint is damaged instead of going back to the one before."""

    def __post_init__(self) -> None:
        _positive("checkpoint", self, "every_updates", "keep")


@dataclass(frozen=True, kw_only=True, slots=True)
class RunConfig:
    """One run: what is learned, how, for how long and where."""

    variant: str = "slotfilm"
    """Agent to train; `slotfilm variants` lists them."""
    seed: int = 0
    """Root of every random stream of the run."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Task and camera."""
    obs: ObsConfig = field(default_factory=ObsConfig)
    """State vector."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """Reward of PickBanana; other tasks bring their own."""
    success: SuccessConfig = field(default_factory=SuccessConfig)
    """Success of PickBanana; other tasks bring their own."""
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """Encoder."""
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    """Pre-training."""
    algorithm: Literal["sac", "ddpg"] = "sac"
    """Soft Actor-Critic, or DrQ-v2's deterministic policy gradient (Appendix A.5)."""
    sac: SacConfig = field(default_factory=SacConfig)
    """Reinforcement learning."""
    ddpg: DdpgConfig = field(default_factory=DdpgConfig)
    """What `algorithm = ddpg` does differently."""
    lr: LrConfig = field(default_factory=LrConfig)
    """Learning rates."""
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    """Replay buffer."""
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    """Lengths of the phases."""
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """Evaluation."""
    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)
    """Processes and devices."""
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    """Checkpoints."""

    def __post_init__(self) -> None:
        check(0 <= self.seed < 2**31, "seed", self.seed, "must lie in [0, 2147483648)")
        check(
            self.replay.min_steps < self.schedule.total_steps,
            "replay.min_steps",
            self.replay.min_steps,
            f"must be less than schedule.total_steps = {self.schedule.total_steps}, or no update ever happens",
        )
        check(
            self.encoder.num_slots >= self.obs.num_objects or not self.pretrains,
            "encoder.num_slots",
            self.encoder.num_slots,
            "pre-training matches every object to a slot of its own and needs at least "
            f"obs.num_objects = {self.obs.num_objects}",
        )
        self._check_pixel_encoder()

    def _check_pixel_encoder(self) -> None:
        """A baseline's encoder, its augmentation, its algorithm and the lack of pre-training belong together."""
        encoder = self.encoder
        check(
            not encoder.learns_from_pixels or self.pretrain.steps == 0,
            "pretrain.steps",
            self.pretrain.steps,
            f"encoder.kind = {encoder.kind!r} is not pre-trained; set it to 0",
        )
        check(
            encoder.kind in ("cnn", "drq") or self.sac.augment_views == 0,
            "sac.augment_views",
            self.sac.augment_views,
            "shifts pictures that a convolutional SAC encoder sees; it needs encoder.kind = 'cnn' or 'drq'",
        )
        check(
            (self.algorithm == "ddpg") == (encoder.kind == "drqv2"),
            "algorithm",
            self.algorithm,
            f"'ddpg' and encoder.kind = 'drqv2' go together, here it is {encoder.kind!r}; use --variant drqv2",
        )

    @property
    def pretrains(self) -> bool:
        """Whether the slots are pre-trained before RL."""
        return self.encoder.uses_image and self.pretrain.steps > 0

    @property
    def random_episode_length(self) -> int:
        """Steps of an episode of the random policy, never more than any other episode has."""
        return min(self.schedule.random_episode_steps or self.env.max_steps, self.env.max_steps)

    @property
    def n_step(self) -> int:
        """Rewards that a sampled transition adds up: 1, but for the algorithm with n-step returns."""
        return self.ddpg.num_steps if self.algorithm == "ddpg" else 1

    @property
    def stores_pictures(self) -> bool:
        """Whether replay keeps pictures, because what sees them is still learning."""
        return self.encoder.uses_image and (self.encoder.learns_from_pixels or self.sac.end_to_end)
