"""One process acts for all workers of a live run."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from slotfilm_dist.backend import TrainReport
from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.config import RunConfig
from slotfilm_dist.variants import apply_variant

Start = Callable[..., RayBackend]
MakeDataset = Callable[[RunConfig], Path]

LIMIT_S = 400.0


def test_workers_act_through_a_process_that_may_be_killed(
    start: Start, config: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    seeing = apply_variant("slotfilm", config)
    seeing = replace(
        seeing,
        env=replace(seeing.env, image_size=32),
        pretrain=replace(seeing.pretrain, steps=0),
        runtime=replace(seeing.runtime, inference="central"),
    )
    backend = start(seeing, tmp_path / "run")
    backend.begin_training(make_dataset(seeing), None, None)
    reports: list[TrainReport] = []
    killed_at = 0.0
    began = time.monotonic()

    def should_stop() -> bool:
        assert time.monotonic() - began < LIMIT_S, reports[-1]
        return killed_at > 0 and reports[-1].metrics.get("inference_restarts_total/crash", 0) == 1 and goes_on()

    def goes_on() -> bool:
        return reports[-1].env_steps > steps + 100 and reports[-1].updates > updates + 20

    for report in backend.train(should_stop):
        reports.append(report)
        if not killed_at and report.updates > 20 and report.metrics.get("inference_steps_total", 0) > 100:
            killed_at, steps, updates = time.monotonic(), report.env_steps, report.updates
            os.kill(backend.process_ids()["inference"], signal.SIGKILL)
    print(f"killed inference: 100 steps more after {time.monotonic() - killed_at:.1f} s")
    last = reports[-1].metrics
    assert last["inference_batch_steps"] >= 1
    assert last.get("worker_restarts_total/crash", 0) == last.get("worker_restarts_total/hang", 0) == 0
    assert last["replay_inserted_steps_total"] == reports[-1].env_steps
    assert last["weights_version"] > 0
