"""Whole runs on Ray with the toy environment."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.config import RunConfig
from slotfilm_dist.metrics import check_names
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import StopFlag

Start = Callable[..., RayBackend]
StillRunning = Callable[[list[psutil.Process], float], list[psutil.Process]]
MakeDataset = Callable[[RunConfig], Path]


def test_run_goes_from_nothing_to_its_report(start: Start, config: RunConfig, tmp_path: Path) -> None:
    short = replace(config, schedule=replace(config.schedule, total_steps=600))
    with RunDirectory(tmp_path / "run", short) as run:
        backend = start(short, run.path)
        page = Pipeline(run, backend, tmp_path / "artifacts", Progress(), StopFlag()).execute()
    assert page.exists()
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    last = next(line for line in reversed(lines) if "worker_env_steps_total" in line)
    assert 600 <= last["env_steps"] < 600 + 2 * 16
    assert last["replay_inserted_steps_total"] == last["env_steps"]
    for line in lines:
        check_names(line)


def test_stopped_run_goes_on_with_its_steps_updates_and_replay(
    start: Start, config: RunConfig, make_dataset: MakeDataset, tmp_path: Path
) -> None:
    folder = tmp_path / "run" / "checkpoints"
    first = start(config, tmp_path / "run")
    first.begin_training(make_dataset(config), None, None)
    reports: list = []
    for report in first.train(lambda: bool(reports) and reports[-1].updates > 20):
        reports.append(report)
    first.save(folder, {"mine": 1}, with_replay=True)
    first.close()
    second = start(config, tmp_path / "run")
    values = second.begin_training(make_dataset(config), None, folder)
    assert values["mine"] == 1
    again: list = []
    for report in second.train(lambda: bool(again) and again[-1].updates > reports[-1].updates + 20):
        again.append(report)
    assert again[0].env_steps >= reports[-1].env_steps
    assert again[-1].metrics["replay_stored_steps"] > reports[-1].metrics["replay_stored_steps"]
    assert again[-1].metrics["replay_inserted_steps_total"] == again[-1].env_steps


def test_close_ends_every_process_in_15_seconds(
    start: Start, config: RunConfig, make_dataset: MakeDataset, tmp_path: Path, still_running: StillRunning
) -> None:
    backend = start(config, tmp_path / "run")
    backend.begin_training(make_dataset(config), None, None)
    training = backend.train(lambda: False)
    next(training)
    processes = [psutil.Process(pid) for pid in backend.process_ids().values()]
    assert len(processes) == 6
    began = time.monotonic()
    backend.close()
    assert not still_running(processes, max(0.0, 15 - (time.monotonic() - began)))
    print(f"close: no process left after {time.monotonic() - began:.1f} s")


def test_gpu_that_no_node_has_is_refused_at_once(start: Start, config: RunConfig, tmp_path: Path) -> None:
    wanted = replace(config, runtime=replace(config.runtime, device="cuda"))
    with pytest.raises(ValueError, match=r"runtime\.device = 'cuda': no node .* --runtime\.device cpu"):
        start(wanted, tmp_path / "run")
