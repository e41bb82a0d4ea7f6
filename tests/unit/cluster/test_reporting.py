"""Metrics made of what the roles say."""

from dataclasses import replace

import pytest

from slotfilm_dist.cluster.messages import HubStatus, InferenceStatus, LearnerStatus, ShardBeat, WorkerBeat
from slotfilm_dist.cluster.reporting import Reporter, WorkerMetrics
from slotfilm_dist.metrics import METRICS, check_names
from slotfilm_dist.presets import smoke
from slotfilm_dist.replay.ring import SampleTotals
from slotfilm_dist.replay.shard import ShardStats


def beat(**values: object) -> WorkerBeat:
    return WorkerBeat(
        **{
            "worker_id": 1,
            "incarnation": 0,
            "activity": "stepping",
            "limit_s": 30.0,
            "idle_s": 0.0,
            "num_steps": 0,
            "num_blocks": 0,
            "policy_version": 0,
            "waited_s": 0.0,
            "step_s": 0.0,
        }
        | values
    )


HUB = HubStatus(
    admitted_steps=1_000,
    env_steps=1_000,
    updates=400,
    updates_owed=0,
    ratio=0.5,
    waiting_workers=1,
    waiting_learner=False,
    waited_workers_s=3.0,
    num_blocks=60,
    num_refunded_steps=0,
    weights_version=400,
    num_published=9,
    weights_age_updates=10.0,
    weights_age_s=0.5,
    steps_by_worker={0: 300, 1: 500},
    wanted_workers=2,
    auto_workers=False,
    alive_workers=2,
    finished=False,
)


class Kept:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.written: list[dict[str, float]] = []

    def write(self, values: dict[str, float]) -> None:
        check_names(values)
        self.written.append(dict(values))


def test_rates_and_shares_are_those_since_the_last_report() -> None:
    now = [100.0]
    reporter = Reporter(smoke(), clock=lambda: now[0])
    waited = {"learner_wait_s_total": 5.0}
    first = LearnerStatus(updates=400, metrics=waited, waiting_for="")
    workers = [beat(worker_id=0, waited_s=1.0), beat(worker_id=1, waited_s=2.0)]
    reporter.metrics(HUB, first, workers, [], {}, 0)
    now[0] = 110.0
    later = LearnerStatus(updates=450, metrics={"learner_wait_s_total": 7.5}, waiting_for="")
    workers = [replace(workers[0], waited_s=6.0), replace(workers[1], waited_s=7.0)]
    hub = replace(HUB, env_steps=1_100, steps_by_worker={0: 360, 1: 600})
    values = reporter.metrics(hub, later, workers, [], {"crash": 2}, 1)
    check_names(values)
    assert values["worker_env_steps_per_s"] == pytest.approx(10.0)
    assert values["learner_updates_per_s"] == pytest.approx(5.0)
    assert values["worker_wait_share"] == pytest.approx(0.5)
    assert values["learner_wait_share"] == pytest.approx(0.25)
    assert values["worker_least_share"] == pytest.approx(0.75)
    assert (values["worker_restarts_total/crash"], values["replay_restarts_total/crash"]) == (2, 1)


def test_share_of_the_slowest_counts_only_what_the_same_workers_collect_together() -> None:
    learner = LearnerStatus(updates=0, metrics={}, waiting_for="")
    reporter, team = Reporter(smoke()), [beat(worker_id=0), beat(worker_id=1)]

    def share(steps: dict[int, int], workers: list[WorkerBeat]) -> float | None:
        hub = replace(HUB, steps_by_worker=steps)
        return reporter.metrics(hub, learner, workers, [], {}, 0).get("worker_least_share")

    assert share({0: 1000, 1: 1000}, team) is None
    assert share({0: 1100, 1: 1050}, team) == pytest.approx(2 / 3)
    more = [*team, beat(worker_id=2)]
    assert share({0: 1200, 1: 1150}, more) is None
    assert share({0: 1300, 1: 1250, 2: 100}, more) == pytest.approx(1.0)
    assert share({0: 1400, 1: 1350, 2: 100}, team) is None


def shard(starts: str, drawn: SampleTotals) -> ShardBeat:
    stats = ShardStats(
        num_steps=100,
        capacity_steps=200,
        inserted_steps=100,
        inserted_blocks=10,
        duplicate_blocks=0,
        missing_blocks=0,
        ring_bytes=1,
        drawn=drawn,
    )
    return ShardBeat(stats=stats, starts=starts, restored_steps=0)


def test_ages_are_those_of_what_was_drawn_since_the_last_report() -> None:
    learner, reporter = LearnerStatus(updates=0, metrics={}, waiting_for=""), Reporter(smoke())

    def ages(updates: int, *shards: ShardBeat) -> tuple[float | None, float | None]:
        values = reporter.metrics(replace(HUB, updates=updates), learner, [], shards, {}, 0)
        return values.get("replay_sample_age_steps"), values.get("replay_sample_age_updates")

    old = SampleTotals(num_steps=1000, age_steps=5000, policy_version=100_000)
    assert ages(400, shard("a", old)) == (None, None)
    new = SampleTotals(num_steps=1100, age_steps=5000 + 100 * 7, policy_version=100_000 + 100 * 380)
    assert ages(420, shard("a", new)) == (7.0, 40.0)
    again = shard("b", old)  # the shard's process was replaced and took its sums from a snapshot
    assert ages(430, again) == (None, None)


def test_lateness_of_weights_is_the_median_over_workers() -> None:
    workers = [beat(weights_lags_s=(0.01, 0.02)), beat(weights_lags_s=(0.5,)), beat()]
    learner = LearnerStatus(updates=0, metrics={}, waiting_for="")
    assert Reporter(smoke()).metrics(HUB, learner, workers, [], {}, 0)["weights_apply_s"] == 0.02
    assert "weights_apply_s" not in Reporter(smoke()).metrics(HUB, learner, [beat()], [], {}, 0)


def test_central_inference_tells_its_batches_and_its_restarts_also_while_it_is_away() -> None:
    status = InferenceStatus(
        policy_version=3,
        num_requests=10,
        num_steps=30,
        num_batches=10,
        busy_s=1.5,
        weights_lags_s=(0.03, 0.01, 0.02),
        starts="a",
    )
    values = Reporter(smoke()).of_inference(status, 1)
    check_names(values)
    assert values["inference_batch_steps"] == 3.0
    assert values["weights_apply_s"] == 0.02
    assert Reporter(smoke()).of_inference(None, 2) == {"inference_restarts_total/crash": 2.0}


def test_workers_own_counts_go_on_when_it_is_set_to_work_anew() -> None:
    sink = Kept()
    metrics = WorkerMetrics(sink)
    metrics.note(beat(num_steps=32, num_blocks=2, step_s=0.01, weights_lags_s=(0.1, 0.2)))
    metrics.note(beat(num_steps=32, num_blocks=2, step_s=0.01))
    metrics.note(beat(incarnation=1, num_steps=16, num_blocks=1, waited_s=4.0))
    assert [v["worker_env_steps_total"] for v in sink.written if "worker_env_steps_total" in v] == [32, 32, 48]
    assert [v["worker_blocks_total"] for v in sink.written if "worker_blocks_total" in v] == [2, 2, 3]
    assert [v["worker_sim_s"] for v in sink.written if "worker_sim_s" in v] == [0.01]
    assert [v["weights_apply_s"] for v in sink.written if "weights_apply_s" in v] == [0.1, 0.2]
    assert all(METRICS[name].by_worker for values in sink.written for name in values)
