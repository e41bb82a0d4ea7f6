"""A run on the toy environment that a real Prometheus watches, and homes of clusters that users start by hand."""

import contextlib
import itertools
import json
import math
import os
import random
import secrets
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.presets import smoke
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import StopFlag
from slotfilm_dist.variants import apply_variant

OPS = Path(__file__).parents[2] / "ops"
PORTS = range(20_000, 32_000)
"""Above those of Ray's workers, below those that the system gives to whoever connects."""
START_S = 30.0
"""Longest wait for Prometheus to answer."""
CLUSTER_START_S = 90.0
"""Longest wait for a cluster of two nodes on a loaded machine."""
Series = dict[tuple[tuple[str, str], ...], list[float]]
"""Values over time by labels."""


class Prometheus:
    """A Prometheus of its own on a loopback port; scrapes and evaluates the project's rules every second.

    Args:
        folder: for its data, its configuration, and Ray's list of endpoints.
        idle_port: where a run outside Ray would serve; nobody does.
    """

    def __init__(self, folder: Path, idle_port: int) -> None:
        self.discovery = folder / "prom_metrics_service_discovery.json"
        self.port = free_port()
        config = yaml.safe_load((OPS / "prometheus.yml").read_text())
        config["global"] = {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"}
        config["rule_files"] = [str(OPS / "prometheus" / "rules" / "*.yml")]
        ray, slotfilm = config["scrape_configs"]
        ray["file_sd_configs"] = [{"files": [str(self.discovery)], "refresh_interval": "1s"}]
        slotfilm["static_configs"] = [{"targets": [f"127.0.0.1:{idle_port}"]}]
        (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
        self._log = (folder / "prometheus.log").open("wb")
        self._process = subprocess.Popen(
            [
                "prometheus",
                f"--config.file={folder / 'prometheus.yml'}",
                f"--storage.tsdb.path={folder / 'tsdb'}",
                f"--web.listen-address=127.0.0.1:{self.port}",
            ],
            stdout=self._log,
            stderr=subprocess.STDOUT,
        )
        self._await_answer(folder / "prometheus.log")

    def get(self, path: str, **parameters: object) -> Any:
        """What its HTTP API answers; raises ``ValueError`` with its words when it refuses."""
        query = urllib.parse.urlencode(parameters)
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/api/v1/{path}?{query}", timeout=20) as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            raise ValueError(f"{parameters}: {error.read().decode()}") from None

    def over_time(self, query: str, start: float, end: float) -> Series:
        """Values of a query from start to end, one a second."""
        answer = self.get("query_range", query=query, start=start, end=end, step="1s")
        return {
            tuple(sorted(one["metric"].items())): [float(value) for _, value in one["values"]]
            for one in answer["result"]
        }

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait(30)
        self._log.close()

    def _await_answer(self, log: Path) -> None:
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            try:
                self.get("status/buildinfo")
                return
            except (OSError, ValueError):  # it answers 503 while it starts
                time.sleep(0.1)
        self._process.kill()
        raise AssertionError(f"Prometheus does not answer:\n{log.read_text()[-3000:]}")


@dataclass(frozen=True, kw_only=True, slots=True)
class WatchedRun:
    """A run that has ended, and what was seen of it."""

    config: RunConfig
    path: Path
    prometheus: Prometheus
    start: float
    end: float

    def values(self, query: str) -> Series:
        """Values of a query during the run."""
        return self.prometheus.over_time(query, self.start, self.end)

    def training(self, name: str) -> list[tuple[float, float]]:
        """Values that the run itself wrote down while it trained, each with its time in seconds."""
        lines = [json.loads(line) for line in (self.path / "metrics.jsonl").read_text().splitlines()]
        return [(line["time_s"], line[name]) for line in lines if line["phase"] == "train" and name in line]

    def seconds_since_start(self) -> float:
        """Since before its first sample."""
        return time.time() - self.start

    def without_data(self, queries: Iterable[str]) -> list[str]:
        """Those of the queries that gave not one finite value."""
        return [q for q in queries if not any(map(math.isfinite, itertools.chain(*self.values(q).values())))]


def free_port() -> int:
    """A loopback port that nobody uses now, and that the system gives nobody who does not ask for it."""
    for port in random.sample(PORTS, len(PORTS)):
        with contextlib.closing(socket.socket()) as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError(f"all of {PORTS} are in use")


def watched_config(metrics_port: int) -> RunConfig:
    """Every phase, with evaluations and checkpoints in between, on as few processes as that takes.

    Learning lasts for several of Ray's reports even on a fast machine: a rate needs two samples.
    """
    base = apply_variant("slotfilm", smoke())
    schedule = replace(base.schedule, total_steps=4000, random_steps=200, updates_per_step=0.5)
    runtime = replace(base.runtime, mode="ray", num_workers=1, block_steps=16, learner_threads=1, device="cpu")
    return replace(
        base,
        env=replace(base.env, max_steps=20),
        pretrain=replace(base.pretrain, steps=10),
        schedule=schedule,
        evaluation=replace(base.evaluation, episodes=1, every_steps=1000, during_episodes=1, videos=0),
        checkpoint=replace(base.checkpoint, every_updates=200),
        runtime=replace(runtime, metrics_port=metrics_port),
    )


@pytest.fixture(scope="session")
def program() -> Callable[[str], str]:
    """Where a program of ops/test-packages.txt is; without it a test is skipped, and fails where it must be there."""

    def find(name: str) -> str:
        path = shutil.which(name)
        if path is None:
            give_up = pytest.fail if os.environ.get("CI") else pytest.skip
            give_up(f"needs {name}, a program of ops/test-packages.txt: bash ops/setup.sh --test")
        return path

    return find


@pytest.fixture(scope="session")
def watched(tmp_path_factory: pytest.TempPathFactory, program: Callable[[str], str]) -> Iterator[WatchedRun]:
    program("prometheus")
    folder = tmp_path_factory.mktemp("watched")
    config = watched_config(free_port())
    prometheus = Prometheus(folder, free_port())
    try:
        start = time.time()
        with RunDirectory(folder / "watched", config) as run:
            backend = RayBackend(config, run.path, make_toy_env)
            try:
                backend.prepare()
                list_ray_endpoints(prometheus.discovery)
                Pipeline(run, backend, folder / "artifacts", Progress(), StopFlag()).execute()
            finally:
                backend.close()
        yield WatchedRun(config=config, path=folder / "watched", prometheus=prometheus, start=start, end=time.time())
    finally:
        prometheus.close()


def list_ray_endpoints(path: Path) -> None:
    """What the dashboard of a head writes; a private cluster has none."""
    import ray
    from ray._private.metrics_agent import PrometheusServiceDiscoveryWriter

    writer = PrometheusServiceDiscoveryWriter(ray.get_runtime_context().gcs_address, str(path.parent))
    writer.write()
    assert Path(writer.get_target_file_name()) == path


class Home:
    """A home directory of its own, in which a cluster file's commands run as they stand, but for ports.

    Args:
        folder: with a short path; the sockets below it may have no more than 107 characters.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.token = secrets.token_hex(32)
        (folder / "slotfilm_dist").symlink_to(OPS.parent)
        (folder / ".ray").mkdir()
        (folder / ".ray" / "auth_token").touch(mode=0o600)
        (folder / ".ray" / "auth_token").write_text(self.token)
        self._started: list[subprocess.Popen[bytes]] = []

    def start(self, command: str, **environment: str) -> None:
        """Run a command that stays."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        with (self.folder / f"{len(self._started)}.log").open("wb") as log:
            self._started.append(
                subprocess.Popen(
                    ["bash", "-c", command],
                    env={**kept, "HOME": str(self.folder), **environment},
                    cwd=self.folder,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
            )

    def free_ports(self, count: int) -> list[int]:
        """Loopback ports that nobody uses now."""
        ports: set[int] = set()
        while len(ports) < count:
            ports.add(free_port())
        return list(ports)

    def get(self, url: str, token: str = "") -> tuple[int, str]:
        """Status and text of an answer; 0 while nobody answers."""
        request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"} if token else {})
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, ""
        except OSError:
            return 0, ""

    def wait(self, what: str, condition: Callable[[], bool]) -> None:
        """Wait for a condition, with the logs in the failure."""
        deadline = time.monotonic() + CLUSTER_START_S
        while not condition():
            if time.monotonic() > deadline:
                logs = [path.read_text()[-2000:] for path in sorted(self.folder.glob("*.log"))]
                pytest.fail(f"no {what} within {CLUSTER_START_S:g} s\n" + "\n".join(logs))
            time.sleep(0.3)

    def close(self) -> None:
        """End what was started, and nothing else."""
        for process in self._started:
            process.terminate()
        for process in self._started:
            process.wait(60)


@pytest.fixture
def home() -> Iterator[Home]:
    with tempfile.TemporaryDirectory(prefix="slotfilm-", ignore_cleanup_errors=True) as folder:
        made = Home(Path(folder))
        yield made
        made.close()
