"""What the paper prints: every figure and table that a study can be set beside, with the numbers given for it.

Numbers are copied as printed, each with where it stands. The text that they were read from has lost its minus signs;
where a sign matters and is not printed, the line says so. `computed` marks what follows from printed numbers.
"""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["curves", "pretraining", "pictures", "components", "table"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Item:
    """A figure or table of the paper."""

    number: str
    """As the paper counts it: `Figure 7`, `Table A3`."""
    title: str
    kind: Kind
    variants: tuple[str, ...] = ("slotfilm",)
    """Whose runs it shows, the proposed agent first."""
    printed: tuple[str, ...] = ()
    """What the paper says of it, one sentence each, with the section."""
    returns: tuple[tuple[str, str, str], ...] = ()
    """Variant, its printed return at reward scale 10 over episodes of 400 steps, and what is said of its curve."""
    needs: tuple[str, ...] = ()
    """It is shown if one of these has run; empty for any of the variants but the proposed one."""

    @property
    def anchor(self) -> str:
        """Its name in links and files."""
        return self.number.lower().replace(" ", "-")


NOT_PRINTED = "not printed"
_PROPOSED = ("slotfilm", "3.7 to 3.9 k", "converges at about 1.1 to 1.2 k episodes (6.2)")

FIGURES: tuple[Item, ...] = (
    Item(
        number="Figure 3",
        title="Pre-training losses",
        kind="pretraining",
        printed=(
            "No number is printed. Attention alignment “approaches near-zero values”; position “drops rapidly” and "
            "“remains low”; visibility stabilises “at low value” (6.1). 150,000 gradient steps (Table A1).",
        ),
    ),
    Item(
        number="Figure 4",
        title="Attention of the two slots",
        kind="pictures",
        printed=(
            "One slot attends to the banana and the other to the bowl, with rare permutations; with neither in view, "
            "attention goes to the end-effector (6.1). No number is printed.",
        ),
    ),
    Item(
        number="Figure 5",
        title="Predicted and true positions",
        kind="pictures",
        printed=(
            "Predictions “lie close” to the projections in (a to d); (e) is a case out of view (6.1). No number.",
        ),
    ),
    Item(
        number="Figure 6",
        title="Attention on a real camera",
        kind="pictures",
        printed=(
            "Printed images of a banana and a bowl before a phone; maps “remained localized”, with occasional swaps "
            "(6.1). No number is printed.",
        ),
    ),
    Item(
        number="Figure 7",
        title="Return of baselines and ablations",
        kind="curves",
        variants=("slotfilm", "slotfilm_goal", "no_state", "concat_late", "state_only", "cnn", "drq"),
        returns=(
            _PROPOSED,
            ("slotfilm_goal", "3.1 to 3.2 k", "second highest (6.2)"),
            ("no_state", "peak 2.6 to 2.7 k", "rises much later, declines toward the end (6.2)"),
            ("concat_late", NOT_PRINTED, "slower and lower (6.2)"),
            ("state_only", NOT_PRINTED, "delayed but steady, moderate (6.2)"),
            ("cnn", NOT_PRINTED, "fails to learn (6.2)"),
            ("drq", "in the 300 range", "modest (6.2)"),
        ),
        printed=("3000 episodes of 400 steps, a single run of each (5.1).",),
    ),
    Item(
        number="Figure 8",
        title="A whole episode, from reaching to holding",
        kind="pictures",
        printed=(
            "Reach, grasp, lift and push the bowl, place, hold (caption).",
            "92 % success over 50 deterministic episodes of the final checkpoint (6.2); computed: 46 of 50, 95 % "
            "Wilson interval [81.2, 96.8] %, of one training run.",
        ),
    ),
    Item(
        number="Figure 9",
        title="Reward components over training",
        kind="components",
        printed=("Post-grasp rises only after about 0.6 M steps; reach, post-grasp and place are shown (6.3).",),
    ),
    Item(
        number="Figure 10",
        title="FiLM and other ways to bring in the state",
        kind="curves",
        variants=("slotfilm", "film_clamp", "concat_proj", "concat_late"),
        returns=(
            _PROPOSED,
            ("film_clamp", NOT_PRINTED, "learns, more slowly and to less (7.1)"),
            ("concat_proj", NOT_PRINTED, "fails to learn (7.1)"),
            ("concat_late", NOT_PRINTED, "learns, substantially lower (7.1)"),
        ),
    ),
    Item(
        number="Figure 11",
        title="Sharpness ϖ of the stability term",
        kind="curves",
        variants=("slotfilm", "varpi_1", "varpi_10"),
        returns=(
            _PROPOSED,
            ("varpi_1", NOT_PRINTED, "slowest and most unstable (7.2)"),
            ("varpi_10", NOT_PRINTED, "delayed (7.2)"),
        ),
        printed=("2000 episodes are shown; all three learn the task (7.2).",),
    ),
    Item(
        number="Figure 12",
        title="Without the stability term",
        kind="curves",
        variants=("slotfilm", "no_static"),
        returns=(
            ("slotfilm", "3900", "highest in the end (7.2)"),
            ("no_static", "around 3700", "faster at first (7.2)"),
        ),
        printed=("The curves part at about episode 1250 (7.2).",),
    ),
    Item(
        number="Figure 13",
        title="Reward scale (its labels), distance decay alpha (its text)",
        kind="curves",
        variants=("slotfilm", "reward_scale_5", "reward_scale_15", "alpha_5", "alpha_15"),
        returns=(
            _PROPOSED,
            ("reward_scale_5", NOT_PRINTED, "slower, unstable in the transition (7.2)"),
            ("reward_scale_15", NOT_PRINTED, "later onset (7.2)"),
            ("alpha_5", NOT_PRINTED, "slower, unstable in the transition (7.2)"),
            ("alpha_15", NOT_PRINTED, "later onset (7.2)"),
        ),
        printed=(
            "The labels say RewardScale 5, 10, 15, the text says alpha 5, 10, 15; both are shown. 2000 episodes.",
        ),
    ),
    Item(
        number="Figure 14",
        title="Attention with four slots",
        kind="pictures",
        variants=("slots_4",),
        printed=("The two strongest slots attend to the objects, the others are diffuse (7.3). No number.",),
    ),
    Item(
        number="Figure 15",
        title="Positions with four slots",
        kind="pictures",
        variants=("slots_4",),
        printed=("Localization “remains highly accurate” (7.3). No number is printed.",),
    ),
    Item(
        number="Figure 16",
        title="End to end, without pre-training",
        kind="curves",
        variants=("slotfilm", "end_to_end"),
        returns=(_PROPOSED, ("end_to_end", NOT_PRINTED, "rises, never completes the task (7.4)")),
    ),
    Item(
        number="Figure A1",
        title="Return of all baselines, with DrQ-v2",
        kind="curves",
        needs=("drqv2",),
        variants=("slotfilm", "slotfilm_goal", "no_state", "concat_late", "state_only", "cnn", "drq", "drqv2"),
        returns=(
            _PROPOSED,
            ("drq", "in the 300 range", "modest (6.2)"),
            ("drqv2", NOT_PRINTED, "lower throughout, 0 success (A.5)"),
        ),
        printed=("DrQ-v2 ran 2000 epochs, the others 3000; the first 2000 are shown (A.5).",),
    ),
)

TABLES: tuple[Item, ...] = (
    Item(number="Table 1", title="Environment and observation", kind="table"),
    Item(
        number="Table 2",
        title="Shares of the reward's components",
        kind="table",
        printed=(
            "Windows of 0 to 0.4 M, 0.4 to 0.8 M and 0.8 to 1.2 M steps (6.3), over environment steps.",
            "The text gives the late post-grasp share as 4.1 ± 5.0 (6.3), the table as 4.5 ± 5.0.",
        ),
    ),
    Item(
        number="Table 3",
        title="Linear probes of the latent",
        kind="table",
        variants=("slotfilm", "state_only", "no_state", "concat_late"),
        printed=("10 episodes (6.4); mean ± deviation over three seeds, while 5.1 speaks of a single run.",),
    ),
    Item(number="Table A1", title="Hyperparameters", kind="table"),
    Item(number="Table A2", title="Computers", kind="table"),
    Item(
        number="Table A3",
        title="Parameters, latency and memory",
        kind="table",
        printed=("Batch of one, 100 passes after 10 to warm up, on an NVIDIA RTX A6000 (A.3).",),
    ),
    Item(number="Table A4", title="Cameras", kind="table"),
)

ITEMS: tuple[Item, ...] = FIGURES + TABLES
"""Figures 3 to 16 and A1, Tables 1 to 3 and A1 to A4. Figures 1 and 2 are drawings."""

TABLE_1 = (
    ("Robot model", "7-DOF Franka Emika Panda"),
    ("Camera setup", "egocentric RGB camera on the end-effector"),
    ("State vector", "35-D proprioceptive state (joint positions, velocities, gripper pose)"),
    ("Action space", "7-D continuous"),
    ("Objects", "banana, target location, bowl"),
    ("Simulator", "SAPIEN via ManiSkill (panda_wristcam)"),
)

TABLE_2 = {
    ("early", "reach"): (79.1, 13.4),
    ("early", "post_grasp"): (0.3, 1.1),
    ("early", "place"): (20.6, 13.4),
    ("mid", "reach"): (72.9, 18.2),
    ("mid", "post_grasp"): (3.5, 4.1),
    ("mid", "place"): (23.6, 18.3),
    ("late", "reach"): (31.9, 24.4),
    ("late", "post_grasp"): (4.5, 5.0),
    ("late", "place"): (63.6, 25.9),
}
"""Percent of the reward, mean and standard deviation, by window and component."""

PROBE_SCORES = (
    ("contact_auroc", "contact AUROC"),
    ("delta_dist_r2", "Δdist R²"),
    ("delta_obj_r2", "Δobj R²"),
    ("auroc_change_occlusion", "ΔAUROC occlusion"),
    ("auroc_change_noise", "ΔAUROC noise"),
    ("auroc_change_affine", "ΔAUROC affine"),
    ("auroc_change_together", "ΔAUROC together"),
)
"""Scores of Table 3 and two that it lacks, as `slotfilm probe` names them."""

TABLE_3 = {
    "slotfilm": ("0.879 ± 0.019", "0.841 ± 0.011", "0.552 ± 0.029", "|0.002| ± 0.026", "|0.001| ± 0.006"),
    "state_only": ("0.852 ± 0.009", "0.813 ± 0.008", "0.570 ± 0.025", "0.000 ± 0.000", "0.000 ± 0.000"),
    "no_state": ("0.638 ± 0.142", "0.821 ± 0.022", "0.529 ± 0.024", "|0.038| ± 0.101", "|0.020| ± 0.101"),
    "concat_late": ("0.531 ± 0.206", "0.846 ± 0.014", "0.577 ± 0.035", "|0.058| ± 0.131", "+0.042 ± 0.088"),
}
"""By variant: FiLM (full), State-only, Image-only, Concat (no FiLM). Bars stand where the sign has been lost."""

TABLE_A1 = (
    ("Actor learning rate", "0.0001", "lr.actor"),
    ("Critic and value learning rate", "0.001", "lr.critic_value"),
    ("Discount", "0.99", "sac.gamma"),
    ("Target network soft update", "0.005", "sac.tau"),
    ("Reward scale", "10", "sac.reward_scale"),
    ("Hidden layers", "256, 256", "sac.hidden"),
    ("Batch size", "128", "sac.batch_size"),
    ("Buffer size", "1 M", "replay.capacity"),
    ("Encoder learning rate (pre-training)", "0.0001", "pretrain.lr"),
    ("Feature dimension", "42", "encoder.feature_dim"),
    ("Attention heads", "3", "encoder.num_heads"),
    ("Pre-training steps", "150,000", "pretrain.steps"),
    ("Fusion layers' learning rate", "0.0001", "lr.fusion"),
    ("Goal gate's learning rate", "0.00003", "lr.goal_gate"),
    ("Distance decay alpha", "10", "reward.alpha"),
    ("Stability ϖ", "5", "reward.varpi"),
    ("Proximity threshold δ (m)", "0.025", "reward.delta_m"),
    ("Environment steps (5.1)", "1,200,000", "schedule.total_steps"),
    ("Random steps (5.1)", "100,000", "schedule.random_steps"),
    ("Updates per step (5.1)", "1", "schedule.updates_per_step"),
    ("Steps of an episode (5.1)", "400", "env.max_steps"),
)
"""Parameter, printed value, the field of the config that holds it."""

TABLE_A2 = (
    ("Operating system", "Ubuntu 22.04.2 (jammy)", "platform"),
    ("GPU", "NVIDIA RTX A6000", "gpu"),
    ("CPU", "AMD EPYC 7313P (16-Core)", "cpu"),
    ("CUDA", "12.6", ""),
    ("PyTorch (5.1)", "2.3.0", "torch"),
    ("Python (5.1)", "3.9", "python"),
)
"""Component, printed value, the key of `versions.json` that holds it."""

TABLE_A3 = (
    ("Total parameters", "2.91 M", "total_params"),
    ("Encoder parameters (A.3)", "2.83 M", "encoder_params"),
    ("Actor parameters (A.3)", "0.08 M", "actor_params"),
    ("Mean latency (ms)", "2.57 ± 0.09", "latency_ms_mean"),
    ("Rate (Hz)", "388", "rate_hz"),
    ("Peak memory (MB)", "148.8", "peak_memory_mb"),
)
"""Metric, printed value, the field of `slotfilm cost --json` that holds it."""

TABLE_A4 = (
    ("Field of view", "90°", "about 79° (main lens, 1080p video)"),
    ("Resolution", "128 x 128 at 20 fps", "1920 x 1080 at 25 fps, downsampled to 128 x 128"),
    ("Model", "pinhole, no distortion", "real lens with distortion"),
    ("Near / far", "0.01 m / 100 m", "not applicable"),
    ("Mount", "wrist, identity pose to camera_link", "handheld"),
)
"""Property, simulated wrist camera, Samsung Galaxy Note 20."""
