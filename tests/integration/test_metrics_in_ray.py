"""What Prometheus finds at Ray's metrics agent while a run trains on a cluster."""

import re
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import ray

from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.config import RunConfig
from slotfilm_dist.metrics import EXPORT_PREFIX, METRICS, find_metric
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import StopFlag

Start = Callable[..., RayBackend]

SAMPLE = re.compile(r"^(\w+)\{(.*)\} (\S+)$")
APPEARS_S = 300.0
"""Long enough for a busy machine."""


def scraped() -> list[tuple[str, dict[str, str], float]]:
    """Every sample of the system's own metrics: name, labels, value."""
    (node,) = [node for node in ray.nodes() if node["Alive"]]
    url = f"http://127.0.0.1:{node['MetricsExportPort']}/metrics"
    with urllib.request.urlopen(url, timeout=10) as answer:
        lines = answer.read().decode().splitlines()
    matches = [match for line in lines if line.startswith(EXPORT_PREFIX) and (match := SAMPLE.match(line))]
    return [(m[1], dict(re.findall(r'(\w+)="([^"]*)"', m[2])), float(m[3])) for m in matches]


class Watcher(Progress):
    """Looks at the metrics now and then while a run goes on, and ends it once all that are awaited were seen."""

    def __init__(self, run: str, stop: StopFlag, awaited: Callable[[], set[str]]) -> None:
        super().__init__()
        self.samples: dict[tuple[str, str], tuple[dict[str, str], float]] = {}
        self._run, self._stop, self._awaited = run, stop, awaited
        self._deadline = time.monotonic() + APPEARS_S

    @property
    def names(self) -> set[str]:
        return {name for name, _ in self.samples}

    @property
    def workers(self) -> set[str]:
        """Those that have told how many steps they made."""
        return {worker for name, worker in self.samples if name == EXPORT_PREFIX + "worker_env_steps_total"}

    def show(self, *arguments: object, **options: object) -> None:
        for name, labels, value in scraped():
            if labels["run"] == self._run:
                self.samples[name, labels["worker"]] = labels, value
        awaited = self._awaited()
        if (awaited and awaited <= self.names and self.workers == {"0", "1"}) or time.monotonic() > self._deadline:
            self._stop.signal_number = 2


def exported(keys: Iterator[str] | set[str]) -> set[str]:
    """Names at Prometheus of metrics by their keys."""
    metrics = [find_metric(key)[0] for key in keys]
    return {m.exported_name + ("_count" if m.kind == "histogram" else "") for m in metrics}


@pytest.fixture
def written(tmp_path: Path) -> Callable[[], set[str]]:
    """Keys of all metrics that the run has written to its own file, once it trains."""

    def read() -> set[str]:
        path = tmp_path / "watched" / "metrics.jsonl"
        text = path.read_text() if path.exists() else ""
        return set(re.findall(r'"(\w+(?:/\w+)?)":', text)) if "learner_critic_loss" in text else set()

    return read


def test_every_metric_of_a_run_is_at_rays_agent_under_its_name(
    start: Start, config: RunConfig, tmp_path: Path, written: Callable[[], set[str]]
) -> None:
    with RunDirectory(
        tmp_path / "watched", replace(config, checkpoint=replace(config.checkpoint, save_replay=False))
    ) as run:
        backend, stop = start(run.config, run.path), StopFlag()
        watcher = Watcher("watched", stop, lambda: exported(written()))
        with pytest.raises(Exception, match="stopped by"):
            Pipeline(run, backend, tmp_path / "artifacts", watcher, stop).execute()
    keys = written()
    assert exported(keys) - watcher.names == set()
    assert {"worker_env_steps_total", "limiter_ratio", "weights_age_s", "replay_stored_steps"} <= keys
    for (name, worker), (labels, _) in watcher.samples.items():
        plain = name.removeprefix(EXPORT_PREFIX)
        metric = METRICS.get(plain) or METRICS[re.sub("_(bucket|count|sum)$", "", plain)]
        assert labels["variant"] == "state_only"
        assert labels["seed"] == "0"
        assert labels["role"] == metric.role
        assert worker in (("0", "1") if metric.by_worker else ("",)), name
    assert watcher.workers == {"0", "1"}
