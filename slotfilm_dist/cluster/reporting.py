"""Turns the counters of all roles into the metrics of one report."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence

from slotfilm_dist.cluster.messages import HubStatus, InferenceStatus, LearnerStatus, ShardBeat, WorkerBeat
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import MetricSink
from slotfilm_dist.replay.ring import SampleTotals


class Reporter:
    """Remembers the last report, for rates.

    Args:
        config: the run.
        clock: seconds that only grow.
    """

    def __init__(self, config: RunConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self._config = config
        self._clock = clock
        self._last: tuple[float, HubStatus, LearnerStatus, float] | None = None
        self._team: frozenset[int] = frozenset()
        self._team_began: Mapping[int, int] = {}
        self._drawn: dict[str, SampleTotals] = {}

    def metrics(
        self,
        hub: HubStatus,
        learner: LearnerStatus,
        workers: Sequence[WorkerBeat],
        shards: Sequence[ShardBeat],
        restarts: Mapping[str, int],
        shard_restarts: int,
    ) -> dict[str, float]:
        """Values by the metric catalogue's names."""
        now, waited_s = self._clock(), sum(beat.waited_s for beat in workers)
        values = (
            learner.metrics
            | self._of_workers(hub, workers, waited_s)
            | self._of_replay(hub, shards)
            | self._of_limiter(hub)
            | {f"worker_restarts_total/{reason}": float(count) for reason, count in restarts.items()}
            | {"replay_restarts_total/crash": float(shard_restarts)}
        )
        if self._last is not None:
            then, hub_then, learner_then, waited_then = self._last
            elapsed = max(now - then, 1e-6)
            learner_waited = learner.metrics.get("learner_wait_s_total", 0.0)
            learner_waited -= learner_then.metrics.get("learner_wait_s_total", 0.0)
            values |= {
                "worker_env_steps_per_s": max(0, hub.env_steps - hub_then.env_steps) / elapsed,
                "learner_updates_per_s": max(0, learner.updates - learner_then.updates) / elapsed,
                "worker_wait_share": _share((waited_s - waited_then) / (elapsed * max(1, len(workers)))),
                "learner_wait_share": _share(learner_waited / elapsed),
            }
        self._last = now, hub, learner, waited_s
        return values

    def of_inference(self, status: InferenceStatus | None, num_restarts: int) -> dict[str, float]:
        """Metrics of central inference; what it would tell itself is missing while it does not answer."""
        if status is None:
            return {"inference_restarts_total/crash": float(num_restarts)}
        values = {
            "inference_steps_total": float(status.num_steps),
            "inference_busy_s_total": status.busy_s,
            "inference_batch_steps": status.num_steps / max(1, status.num_batches),
            "inference_restarts_total/crash": float(num_restarts),
        }
        if status.weights_lags_s:
            values["weights_apply_s"] = statistics.median(status.weights_lags_s)
        return values

    def _of_workers(self, hub: HubStatus, workers: Sequence[WorkerBeat], waited_s: float) -> dict[str, float]:
        team = frozenset(beat.worker_id for beat in workers)
        if team != self._team:  # somebody has left or come: only what they collect together compares
            self._team, self._team_began = team, dict(hub.steps_by_worker)
        by_worker = [hub.steps_by_worker.get(one, 0) - self._team_began.get(one, 0) for one in team]
        values = {
            "worker_env_steps_total": float(hub.env_steps),
            "worker_blocks_total": float(hub.num_blocks),
            "worker_alive_count": float(hub.alive_workers),
            "worker_wanted_count": float(hub.wanted_workers),
            "worker_wait_s_total": waited_s,
        }
        stepping = [beat.step_s for beat in workers if beat.step_s]
        lags = [lag_s for beat in workers for lag_s in beat.weights_lags_s]
        if lags:
            values["weights_apply_s"] = statistics.median(lags)
        if stepping:
            values["worker_sim_s"] = sum(stepping) / len(stepping)
        if sum(by_worker) > 0:
            values["worker_least_share"] = min(by_worker) * len(by_worker) / sum(by_worker)
        return values

    def _of_replay(self, hub: HubStatus, shards: Sequence[ShardBeat]) -> dict[str, float]:
        stats = [beat.stats for beat in shards]
        values = {
            "replay_stored_steps": float(sum(s.num_steps for s in stats)),
            "replay_capacity_steps": float(self._config.replay.capacity),
            "replay_stored_bytes": float(sum(s.ring_bytes * s.num_steps / max(1, s.capacity_steps) for s in stats)),
            "replay_inserted_steps_total": float(sum(s.inserted_steps for s in stats)),
            "replay_sampled_steps_total": float(sum(s.drawn.num_steps for s in stats)),
            "replay_duplicate_blocks_total": float(sum(s.duplicate_blocks for s in stats)),
            "replay_missing_blocks_total": float(sum(s.missing_blocks for s in stats)),
            "replay_shards_alive_count": float(len(shards)),
            "replay_snapshot_failing_count": float(sum(bool(beat.snapshot_error) for beat in shards)),
        }
        drawn = self._newly_drawn(shards)
        if drawn.num_steps:
            values["replay_sample_age_steps"] = len(shards) * drawn.age_steps / drawn.num_steps
            mean_version = drawn.policy_version / drawn.num_steps
            values["replay_sample_age_updates"] = max(0.0, hub.updates - mean_version)
        return values

    def _newly_drawn(self, shards: Sequence[ShardBeat]) -> SampleTotals:
        """Sums over what was drawn since the last report; of a shard's new process only from its second on."""
        new = SampleTotals()
        for beat in shards:
            now, then = beat.stats.drawn, self._drawn.get(beat.starts)
            if then is not None:
                new.num_steps += now.num_steps - then.num_steps
                new.age_steps += now.age_steps - then.age_steps
                new.policy_version += now.policy_version - then.policy_version
            self._drawn[beat.starts] = now
        return new

    def _of_limiter(self, hub: HubStatus) -> dict[str, float]:
        return {
            "limiter_ratio": hub.ratio,
            "limiter_target_ratio": self._config.schedule.updates_per_step,
            "limiter_waiting_workers_count": float(hub.waiting_workers),
            "limiter_waiting_learner": float(hub.waiting_learner),
            "weights_version": float(hub.weights_version),
            "weights_age_updates": hub.weights_age_updates,
            "weights_age_s": hub.weights_age_s,
            "weights_published_total": float(hub.num_published),
        }


class WorkerMetrics:
    """Writes one worker's own metrics where its process exports them.

    Args:
        sink: takes them.
    """

    def __init__(self, sink: MetricSink) -> None:
        self._sink = sink
        self._steps_before = self._blocks_before = 0
        self._last: WorkerBeat | None = None

    def note(self, beat: WorkerBeat) -> None:
        """Write what changed since the last beat; counts go on over the incarnations of the process."""
        last = self._last
        if last is not None and beat.incarnation != last.incarnation:
            self._steps_before += last.num_steps
            self._blocks_before += last.num_blocks
        values = {
            "worker_env_steps_total": float(self._steps_before + beat.num_steps),
            "worker_blocks_total": float(self._blocks_before + beat.num_blocks),
            "worker_wait_s_total": beat.waited_s,
        }
        if last is None or beat.num_blocks != last.num_blocks:
            values |= {"worker_sim_s": beat.step_s} if beat.step_s else {}
        self._last = beat
        self._sink.write(values)
        for lag_s in beat.weights_lags_s:
            self._sink.write({"weights_apply_s": lag_s})


def _share(value: float) -> float:
    return min(1.0, max(0.0, value))
