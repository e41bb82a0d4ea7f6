"""What a grid will take, before it is started: hours from measured costs of single steps, and bytes on disk.

The costs are CPU times of one core (AMD EPYC, torch 2.14 on one thread, software rendering, 2026-11-22), each the mean
of 1 to 150 repetitions with random numbers as input, at the paper's batch of 128 (256 for DrQ-v2). Updates scale with
the batch. A job's hours follow from its config (steps, updates, episodes, agent) and the cores that it is given;
starting processes and writing files is left out, seconds to half a minute a job. The proposed agent at `quick` comes
out at 4.7 minutes on Ray with two workers on two cores, data and pre-training included, where 4 to 6.5 were measured.

An agent that learns from pixels costs hundreds of times as much per update: on CPUs those few variants are nearly all
of a grid's hours. A GPU was not measured: there such an update costs a small part of this, and hours from here are an
upper bound that may lie far off.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slotfilm_dist.config import RunConfig
from slotfilm_dist.replay.memory import replay_bytes
from slotfilm_dist.tuning.jobs import Job
from slotfilm_dist.tuning.resources import TrialResources

SOURCE = "one core of an AMD EPYC without a GPU, measured 2026-11-22; a GPU was not measured and will be quicker"

ENV_STEP_S = {"blind": 0.0011, "camera": 0.0079}
"""A control step of PickBanana, with its picture or without."""
ACT_S = {"state": 0.0002, "slots": 0.0170, "pixels": 0.0040}
"""An action from an observation; slots run their ResNet."""
UPDATE_S = {
    "state": 0.0106,
    "slots": 0.0142,
    "cnn": 0.52,
    "drq": 4.92,
    "drqv2": 3.37,  # 6.75 s at its batch of 256
    "end_to_end": 5.92,
}
"""An update at a batch of 128."""
PRETRAIN_STEP_S = {"none": 0.0172, "all": 3.90}
"""A step of pre-training at a batch of 128, on cached features or through the whole ResNet."""
ENCODE_FRAME_S = 0.008
"""A frame through the ResNet, in batches."""
SAVED_BYTES = {"state": 4e6, "slots": 15.5e6, "cnn": 5.2e6, "drq": 67e6, "drqv2": 195e6, "end_to_end": 38e6}
"""A checkpoint."""
LOG_BYTES_PER_STEP = 60.0
"""Metrics, episodes and TensorBoard of a run, for each environment step."""
ENCODER_BYTES = 45e6
"""A pre-trained encoder with its optimiser."""
PAPER_BATCH = 128


@dataclass(frozen=True, kw_only=True, slots=True)
class JobEstimate:
    """What one job takes."""

    hours: float
    """On a CPU, with the cores that it is given."""
    disk_bytes: float
    """At the most: checkpoints, logs, and for a trial the replay that is dropped at its end."""
    kept_bytes: float
    """What stays when it has ended."""


def estimate(job: Job, resources: TrialResources) -> JobEstimate:
    """Hours and bytes of one job."""
    seconds = {"data": _collect_s, "encoder": _pretrain_s, "trial": _train_s}[job.kind](job.config, resources)
    kept = _kept_bytes(job)
    config = job.config
    replay = replay_bytes(config, min(config.replay.capacity, config.schedule.total_steps))
    # The one before stays until the next is whole.
    snapshot = 2 * replay if job.kind == "trial" and config.checkpoint.save_replay else 0
    return JobEstimate(hours=seconds / 3600, disk_bytes=kept + snapshot, kept_bytes=kept)


def total_hours(jobs: Sequence[Job], estimates: Mapping[str, JobEstimate], num_at_once: int) -> float:
    """Hours until a grid is done: jobs in their order, each on the first place that is free."""
    places = [0.0] * max(1, num_at_once)
    done: dict[str, float] = {}
    for job in jobs:
        place = places.index(min(places))
        ready = max((done.get(key, 0.0) for key in job.needs), default=0.0)
        places[place] = done[job.key] = max(places[place], ready) + estimates[job.key].hours
    return max(done.values(), default=0.0)


def _agent(config: RunConfig) -> str:
    """Row of the cost tables."""
    if config.sac.end_to_end:
        return "end_to_end"
    if config.encoder.learns_from_pixels:
        return config.encoder.kind
    return "slots" if config.encoder.uses_image else "state"


def _env_step_s(config: RunConfig) -> float:
    return ENV_STEP_S["camera" if config.encoder.uses_image else "blind"]


def _cores(resources: TrialResources, num_roles: int) -> float:
    """Cores that so many roles compute on while the trial's others wait; each computes on one at most."""
    return min(num_roles, resources.num_cpus)


def _num_workers(resources: TrialResources) -> int:
    """Processes that step environments: all but learner and player, or the only one."""
    return max(resources.num_roles - 2, 1)


def _collect_s(config: RunConfig, resources: TrialResources) -> float:
    return config.schedule.random_steps * _env_step_s(config) / _cores(resources, _num_workers(resources))


def _pretrain_s(config: RunConfig, resources: TrialResources) -> float:
    pretrain = config.pretrain
    step = PRETRAIN_STEP_S[pretrain.train_backbone] * pretrain.batch_size / PAPER_BATCH
    encoding = config.schedule.random_steps * ENCODE_FRAME_S if pretrain.train_backbone == "none" else 0.0
    return (pretrain.steps * step + encoding) / _cores(resources, 1)


def _train_s(config: RunConfig, resources: TrialResources) -> float:
    agent = _agent(config)
    steps = config.schedule.total_steps - config.schedule.random_steps
    act = ACT_S[agent if agent in ("state", "slots") else "slots" if agent == "end_to_end" else "pixels"]
    update = UPDATE_S[agent] * config.sac.batch_size / PAPER_BATCH
    acting = steps * (_env_step_s(config) + act)
    learning = steps * config.schedule.updates_per_step * update
    workers = _cores(resources, _num_workers(resources))
    # In one process they take turns; on Ray the slower of the two sets the pace, or the cores that they share.
    together = (acting + learning) / resources.num_cpus
    one = (acting + learning) / _cores(resources, 1)
    training = one if resources.num_roles == 1 else max(acting / workers, learning / _cores(resources, 1), together)
    encoding = config.schedule.random_steps * ENCODE_FRAME_S if agent == "slots" else 0.0
    every = config.evaluation.every_steps
    during = (steps // every) * config.evaluation.during_episodes if every else 0
    # The final evaluation plays the random policy as well.
    played = (during + 2 * config.evaluation.episodes) * config.env.max_steps
    return encoding / _cores(resources, 1) + training + played * (_env_step_s(config) + act) / workers


def _kept_bytes(job: Job) -> float:
    config = job.config
    if job.kind == "data":
        picture = 3 * config.env.image_size**2 if config.encoder.uses_image else 0
        return config.schedule.random_steps * (picture + 4.0 * config.obs.state_dim + 150)
    if job.kind == "encoder":
        return ENCODER_BYTES
    checkpoints = (config.checkpoint.keep + 1) * SAVED_BYTES[_agent(config)]
    return checkpoints + config.schedule.total_steps * LOG_BYTES_PER_STEP
