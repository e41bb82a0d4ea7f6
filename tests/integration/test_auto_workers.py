"""`--workers auto` on live runs: who waits for whom decides how many workers there are."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import ray
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from slotfilm_dist.backend import TrainReport
from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import make_slow_toy_env

Start = Callable[..., RayBackend]
MakeDataset = Callable[[RunConfig], Path]


def with_workers(config: RunConfig, updates_per_step: float, **runtime: object) -> RunConfig:
    """The config with another balance of both sides, and workers that follow it."""
    schedule = replace(config.schedule, updates_per_step=updates_per_step)
    return replace(config, schedule=schedule, runtime=replace(config.runtime, **runtime))


def reports_until(backend: RayBackend, dataset: Path, holds: Callable[[TrainReport], bool]) -> list[TrainReport]:
    """Train until a report satisfies the condition, at most 80 of them, one a second; the last is that of the end."""
    backend.begin_training(dataset, None, None)
    reports: list[TrainReport] = []
    for report in backend.train(lambda: bool(reports) and (holds(reports[-1]) or len(reports) >= 80)):
        reports.append(report)
    return reports


def test_starving_learner_gets_workers_up_to_the_bound(
    start: Start, config: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    auto = with_workers(config, 0.25, num_workers=1, auto_workers=True, max_workers=2)
    backend = start(auto, tmp_path / "run", make_env=make_slow_toy_env)
    reports = reports_until(backend, make_dataset(auto), lambda r: r.metrics["worker_alive_count"] == 2)
    assert reports[-2].metrics["worker_alive_count"] == 2
    assert max(r.metrics["worker_wanted_count"] for r in reports) == 2
    assert reports[-1].metrics["replay_inserted_steps_total"] == reports[-1].env_steps


def test_workers_that_wait_for_the_learner_are_removed(
    start: Start, config: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    auto = with_workers(config, 4.0, num_workers=3)
    backend = start(auto, tmp_path / "run")
    backend.want_auto_workers()
    reports = reports_until(backend, make_dataset(auto), lambda r: r.metrics["worker_alive_count"] == 1)
    assert reports[-2].metrics["worker_alive_count"] == 1
    updates = [report.updates for report in reports if report.updates]
    assert all(later > earlier for earlier, later in zip(updates, updates[3:-1], strict=False)), updates


def test_placement_group_has_no_cores_for_further_workers(session: Session) -> None:
    """A trial's group holds its first roles exactly; a worker that asked for more would wait in it for ever."""
    group = ray.util.placement_group([{"CPU": 0.5}])
    inside = PlacementGroupSchedulingStrategy(placement_group=group, placement_group_capture_child_tasks=True)

    def available() -> float:
        return Session().available_cpus()

    ask = ray.remote(num_cpus=0)(available)
    try:
        assert ray.get(ask.options(scheduling_strategy=inside).remote(), timeout=60) == 0.0
        assert ray.get(ask.remote(), timeout=60) > 0.0
    finally:
        ray.util.remove_placement_group(group)
