"""A run over several Ray nodes, one of which is lost."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import save_config
from slotfilm_dist.replay.dataset import open_dataset

SCENARIO = Path(__file__).with_name("node_loss.py")


def test_workers_of_a_removed_node_work_on_another_one(
    config: RunConfig, make_dataset: Callable[[RunConfig], Path], tmp_path: Path
) -> None:
    save_config(replace(config, runtime=replace(config.runtime, metrics_port=0)), tmp_path / "config.json")
    dataset = make_dataset(config)
    child = subprocess.run(
        [sys.executable, str(SCENARIO), str(tmp_path), str(dataset)], capture_output=True, text=True, timeout=550
    )
    assert child.returncode == 0, child.stderr[-3000:]
    told = json.loads(child.stdout.splitlines()[-1])
    assert told["workers_there"], "workers run where the nodes offer slotfilm_worker"
    assert told["workers_apart"], "learner and shards run elsewhere"
    print(
        f"node removed: env steps/s {told['rate_before']:.0f} before, {told['rate_after']:.0f} again after "
        f"{told['back_after_s']:.1f} s"
    )
    assert told["back_after_s"] <= 60
    assert told["updates"] > told["updates_before"]
    metrics = told["metrics"]
    assert metrics["worker_restarts_total/node_lost"] >= 1
    assert metrics["replay_duplicate_blocks_total"] == 0
    assert metrics["replay_inserted_steps_total"] == told["env_steps"]
    owed = 0.5 * (told["env_steps"] - open_dataset(dataset, dataset.name).num_steps)
    assert abs(told["updates"] - owed) <= 0.5 * 100
