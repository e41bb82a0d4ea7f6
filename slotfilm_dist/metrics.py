"""Every metric of the system, declared once: name, unit, kind and what it means.

A name is `role_thing_unit`; the axes `time_s`, `env_steps`, `updates` and `phase` have no role. A metric with a label
is written under `name/label`, as `worker_restarts_total/crash`. A counter's value is its total since the run began,
over all restarts, or since this start of the run where it is marked `from_zero`; a histogram's value is one
observation; a gauge's value replaces the one before.
"""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from slotfilm_dist.config import RunConfig

RAY_PREFIX = "ray_"
"""What Ray's metrics agent puts before every name by itself."""
EXPORT_PREFIX = RAY_PREFIX + "slotfilm_"
"""What Prometheus names begin with, inside Ray and outside, so that one rule fits both."""

PHASES = ("collect", "pretrain", "train", "evaluate")
"""Phases of a run in their order; the metric `phase` is an index into them."""

AXES = ("time_s", "env_steps", "updates", "phase")
"""Where in the run a value was taken."""

RESTART_REASONS = ("crash", "hang", "nonfinite", "memory", "node_lost", "preempted", "other")
"""Why a process was replaced."""

WAIT_BUCKETS_S = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
"""Upper bounds of the histograms of durations, in seconds."""

Kind = Literal["gauge", "counter", "histogram"]


@dataclass(frozen=True, slots=True)
class Metric:
    """One declared metric."""

    name: str
    unit: str
    """Unit of the value; `1` for a plain number, `share` for a part of 1."""
    kind: Kind
    help: str
    label: str = ""
    """Name of the label that splits the metric, empty without one."""
    label_values: tuple[str, ...] = ()
    """Labels allowed; any word when empty."""
    by_worker: bool = False
    """On a cluster every worker's process exports it itself, counted since that process began."""
    from_zero: bool = False
    """Counts rare events of this start of the run; exported as 0 before the first one, which then is an increase."""

    @property
    def role(self) -> str:
        """The part of the system that reports it; `run` for the axes."""
        return "run" if self.name in AXES else self.name.split("_", 1)[0]

    @property
    def exported_name(self) -> str:
        """Name in Prometheus."""
        return EXPORT_PREFIX + self.name


def _gauge(name: str, unit: str, text: str) -> Metric:
    return Metric(name, unit, "gauge", text)


def _counter(name: str, unit: str, text: str, *, by_worker: bool = False, from_zero: bool = False) -> Metric:
    return Metric(name, unit, "counter", text, by_worker=by_worker, from_zero=from_zero)


def _restarts(name: str, text: str) -> Metric:
    return Metric(name, "restarts", "counter", text, "reason", RESTART_REASONS, from_zero=True)


def _duration(name: str, text: str, *, by_worker: bool = False) -> Metric:
    return Metric(name, "s", "histogram", text, by_worker=by_worker)


_RUN = (
    _gauge("time_s", "s", "Time spent on the run, over all its restarts."),
    _gauge("env_steps", "steps", "Environment steps of the run, over all workers."),
    _gauge("updates", "updates", "Optimiser updates of the run."),
    _gauge("phase", "1", "Phase of the run: 0 collect, 1 pretrain, 2 train, 3 evaluate."),
    _gauge("run_eta_s", "s", "Estimated time to the end of the run."),
    _gauge("run_memory_bytes", "bytes", "Resident memory of driver and children: no roles of a joined cluster."),
    _gauge("run_gpu_memory_bytes", "bytes", "GPU memory that the learner has allocated."),
    _gauge("run_disk_free_bytes", "bytes", "Free space where the run is written."),
)

_WORKER = (
    _counter("worker_env_steps_total", "steps", "Environment steps collected by the workers.", by_worker=True),
    _gauge("worker_env_steps_per_s", "steps/s", "Environment steps collected a second, all workers together."),
    _counter("worker_cut_episodes_total", "episodes", "Episodes cut short by a restart; left out of every mean."),
    _counter("worker_blocks_total", "blocks", "Blocks of steps sent to replay.", by_worker=True),
    _gauge("worker_alive_count", "workers", "Workers that are running."),
    _gauge("worker_wanted_count", "workers", "Workers that should be running."),
    _gauge("worker_least_share", "share", "Steps of the slowest worker over the mean of all, since they are these."),
    _duration("worker_sim_s", "Time of one environment step, physics and rendering.", by_worker=True),
    _counter("worker_wait_s_total", "s", "Time the workers have waited for the limiter and replay.", by_worker=True),
    _gauge("worker_wait_share", "share", "Share of the workers' time spent waiting."),
    _counter("worker_nonfinite_total", "steps", "Steps refused for a non-finite reward, state or picture."),
    _restarts("worker_restarts_total", "Workers replaced, by reason."),
)

_REPLAY = (
    _gauge("replay_stored_steps", "steps", "Steps stored now, over all shards."),
    _gauge("replay_capacity_steps", "steps", "Steps that fit."),
    _gauge("replay_stored_bytes", "bytes", "Memory held by the stored steps."),
    _gauge("replay_sample_age_steps", "steps", "Mean age of the sampled steps, in environment steps."),
    _gauge("replay_sample_age_updates", "updates", "Mean age of the policy that collected the sampled steps."),
    _counter("replay_inserted_steps_total", "steps", "Steps ever stored."),
    _counter("replay_sampled_steps_total", "steps", "Steps ever sampled."),
    _counter("replay_duplicate_blocks_total", "blocks", "Blocks refused because they had been stored before."),
    _counter("replay_missing_blocks_total", "blocks", "Gaps in the workers' block numbers."),
    _gauge("replay_shards_alive_count", "shards", "Shards that answer."),
    _restarts("replay_restarts_total", "Shards replaced, by reason."),
    _gauge("replay_snapshot_failing_count", "shards", "Shards whose last snapshot could not be written or read."),
)

_LIMITER = (
    _gauge("limiter_ratio", "updates/step", "Updates per environment step achieved since learning began."),
    _gauge("limiter_target_ratio", "updates/step", "Updates per environment step asked for."),
    _gauge("limiter_waiting_workers_count", "workers", "Workers that the limiter holds back now."),
    _gauge("limiter_waiting_learner", "1", "1 while the limiter holds the learner back, else 0."),
)

_WEIGHTS = (
    _gauge("weights_version", "updates", "Version of the newest published weights."),
    _gauge("weights_age_updates", "updates", "Updates made since the weights that the workers act with."),
    _gauge("weights_age_s", "s", "Time since the weights that the workers act with were published."),
    _duration("weights_apply_s", "Time from the publication of weights until a worker acts with them.", by_worker=True),
    _counter("weights_published_total", "snapshots", "Weight snapshots published."),
)

_INFERENCE = (
    _counter("inference_steps_total", "steps", "Observations acted on by central inference, since its process began."),
    _counter("inference_busy_s_total", "s", "Time that central inference has computed, since its process began."),
    _gauge("inference_batch_steps", "steps", "Mean number of observations that central inference computes at once."),
    _restarts("inference_restarts_total", "Central inference processes replaced, by reason."),
)

_LEARNER = (
    _counter("learner_updates_total", "updates", "Optimiser updates done."),
    _gauge("learner_updates_per_s", "updates/s", "Optimiser updates a second."),
    _duration("learner_update_s", "Time of one update."),
    _duration("learner_batch_wait_s", "Time the learner waited for a batch."),
    _counter("learner_wait_s_total", "s", "Time the learner has waited for the limiter and replay."),
    _gauge("learner_wait_share", "share", "Share of the learner's time spent waiting."),
    _gauge("learner_critic_loss", "1", "Sum of both critics' losses, half the mean squared error to the target."),
    _gauge("learner_value_loss", "1", "Loss of the value network."),
    _gauge("learner_actor_loss", "1", "Loss of the actor, temperature times log-probability minus Q."),
    _gauge("learner_temperature_loss", "1", "Loss of the entropy temperature, when it is tuned."),
    _gauge("learner_temperature", "1", "Entropy temperature."),
    _gauge("learner_entropy_nats", "nats", "Mean entropy of the policy, from its own samples' log-probabilities."),
    _gauge("learner_policy_std", "1", "Mean standard deviation of the policy before the tanh."),
    _gauge("learner_q_mean", "scaled return", "Mean Q of the sampled actions."),
    _gauge("learner_q_max", "scaled return", "Largest Q of the sampled actions."),
    _gauge("learner_value_mean", "scaled return", "Mean of the value network."),
    _gauge("learner_target_mean", "scaled return", "Mean target of the critics."),
    _gauge("learner_reward_mean", "scaled reward", "Mean reward of the sampled steps, times the reward scale."),
    _gauge("learner_critic_gradient_norm", "1", "L2 norm of the critics' gradient, as the optimiser gets it."),
    _gauge("learner_value_gradient_norm", "1", "L2 norm of the value network's gradient, as the optimiser gets it."),
    _gauge("learner_actor_gradient_norm", "1", "L2 norm of the actor's gradient, as the optimiser gets it."),
    _gauge("learner_encoder_gradient_norm", "1", "L2 norm of the encoder's gradient, as the optimiser gets it."),
    _gauge("learner_film_gain", "1", "Mean |tanh gamma| of the FiLM layer: 0 ignores the state, 1 is its limit."),
    _gauge("learner_film_shift", "1", "Mean |beta| of the FiLM layer."),
    _gauge("learner_goal_gate", "share", "Mean weight of the goal slot in the two-way gate."),
    _counter("learner_nonfinite_total", "updates", "Updates skipped for a non-finite loss or gradient."),
    _counter("learner_rollbacks_total", "rollbacks", "Returns to a checkpoint after non-finite updates in a row."),
    _restarts("learner_restarts_total", "Learners replaced, by reason."),
)

_EPISODE = (
    _gauge("episode_return", "unscaled return", "Mean return of the episodes ended since the last line."),
    _gauge("episode_return_scaled", "scaled return", "The same times the reward scale, as the paper plots it."),
    _gauge("episode_length_steps", "steps", "Mean length of these episodes."),
    _gauge("episode_success", "share", "Share of these episodes solved at their last step."),
    _gauge("episode_success_once", "share", "Share of these episodes solved at some step."),
    _gauge("episode_placed", "share", "Share of these episodes with the object in the target region at the end."),
    _gauge("episode_grasped", "share", "Share of these episodes with a grasp."),
    Metric(
        "episode_reward_term", "unscaled return", "gauge", "Mean return of one component of the reward.", label="term"
    ),
)

_EVAL = (
    _gauge("eval_return", "unscaled return", "Mean return of the deterministic policy on held-out seeds."),
    _gauge("eval_return_scaled", "scaled return", "The same times the reward scale."),
    _gauge("eval_return_std", "unscaled return", "Standard deviation of the return between these episodes."),
    _gauge("eval_success_rate", "share", "Share of the evaluation's episodes solved at their last step."),
    _gauge("eval_success_once_rate", "share", "Share of the evaluation's episodes solved at some step."),
    _gauge("eval_duration_s", "s", "Time the evaluation took."),
    _counter("eval_episodes_total", "episodes", "Evaluation episodes finished."),
)

_PRETRAIN = (
    _counter("pretrain_steps_total", "steps", "Gradient steps of pre-training done."),
    _gauge("pretrain_steps_per_s", "steps/s", "Gradient steps of pre-training a second."),
    _gauge("pretrain_loss", "1", "Weighted sum of the three pre-training losses."),
    _gauge("pretrain_position_loss", "1", "Position loss, in the units of `pretrain.uv_units`."),
    _gauge("pretrain_visibility_loss", "nats", "Visibility loss, binary cross-entropy."),
    _gauge(
        "pretrain_attention_loss", "nats", "Attention alignment loss, minus the log of the attention on the object."
    ),
    _gauge("pretrain_position_error_px", "px", "Mean distance of predicted and true position, held-out frames."),
    _gauge("pretrain_baseline_error_px", "px", "The same for a constant prediction, the training frames' mean."),
    _gauge("pretrain_visibility_auroc", "share", "AUROC of the visibility head, held-out frames; 0.5 is chance."),
    _gauge("pretrain_attention_share", "share", "Mean attention on the visible objects' tokens, held-out frames."),
)

_CHECKPOINT = (
    _gauge("checkpoint_age_s", "s", "Time since the last checkpoint was committed."),
    _gauge("checkpoint_age_updates", "updates", "Updates since the last committed checkpoint."),
    _gauge("checkpoint_bytes", "bytes", "Size of the last checkpoint."),
    _duration("checkpoint_write_s", "Time to write one checkpoint."),
    _counter("checkpoint_written_total", "checkpoints", "Checkpoints committed."),
    _counter("checkpoint_failed_total", "checkpoints", "Checkpoints that could not be written.", from_zero=True),
)

_SINK = (
    _counter("sink_nonfinite_total", "values", "Metric values that were not finite, written as null.", from_zero=True),
    _counter("sink_failures_total", "writes", "Writes of metrics that failed in one of the sinks.", from_zero=True),
)

METRICS: dict[str, Metric] = {
    metric.name: metric
    for group in (
        *(_RUN, _WORKER, _REPLAY, _LIMITER, _WEIGHTS, _INFERENCE, _LEARNER),
        *(_EPISODE, _EVAL, _PRETRAIN, _CHECKPOINT, _SINK),
    )
    for metric in group
}
"""The catalogue, by name."""


def find_metric(key: str) -> tuple[Metric, str]:
    """The metric and the label behind a key such as `learner_critic_loss` or `worker_restarts_total/crash`.

    Raises:
        ValueError: an unknown name (with the nearest known one), a label too many, missing or not allowed.
    """
    name, slash, label = key.partition("/")
    metric = METRICS.get(name)
    if metric is None:
        near = difflib.get_close_matches(name, METRICS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else "declare it in slotfilm_dist/metrics.py"
        raise ValueError(f"unknown metric {name!r}; {hint}")
    if not metric.label:
        if slash:
            raise ValueError(f"metric {key!r}: {name} takes no label")
        return metric, ""
    if not label:
        raise ValueError(f"metric {key!r}: needs a {metric.label}, as in {name}/{(*metric.label_values, 'reach')[0]}")
    if metric.label_values and label not in metric.label_values:
        raise ValueError(f"metric {key!r}: {metric.label} must be one of {', '.join(metric.label_values)}")
    return metric, label


def zero_counters() -> dict[str, float]:
    """Every key of the counters marked `from_zero`, at zero."""
    counters = [metric for metric in METRICS.values() if metric.from_zero]
    return {"/".join(filter(None, (m.name, label))): 0.0 for m in counters for label in m.label_values or ("",)}


def check_names(keys: Iterable[str]) -> None:
    """Raise ``ValueError`` for the first key that `find_metric` does not know."""
    for key in keys:
        find_metric(key)


def metric_labels(config: RunConfig, run: str) -> dict[str, str]:
    """What Prometheus tells one run's values from another's by, whichever sink they go through."""
    return {"run": run, "variant": config.variant, "seed": str(config.seed)}


def phase_index(phase: str) -> int:
    """The value of the metric `phase`; raises ``ValueError`` for a word that is no phase."""
    if phase not in PHASES:
        raise ValueError(f"phase = {phase!r}: must be one of {', '.join(PHASES)}")
    return PHASES.index(phase)
