"""Whole grids on Ray Tune with the toy environment: killed, stopped, failed, and gone on with.

Run as a script this file is the driver: `slotfilm` with the toy environment in place of the simulator.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from slotfilm_dist.backend import Backend
from slotfilm_dist.config import RunConfig
from slotfilm_dist.tuning.resources import TrialResources

StillRunning = Callable[[list[psutil.Process], float], list[psutil.Process]]
FIELDS = ["--sac.hidden", "32", "32", "--schedule.random_steps", "120", "--replay.min_steps", "100"]
FIELDS += ["--checkpoint.every_updates", "200", "--env.max_steps", "20", "--runtime.metrics_port", "0"]
LIMIT_S = 400.0
pytestmark = pytest.mark.timeout(1500)


def toy_backend(config: RunConfig, run: Path, resources: TrialResources) -> Backend:
    """As `make_backend`, but in the toy environment: a slow one for seed 1, and the agent of seed 13 fails in it."""
    from slotfilm_dist.envs.toy import make_slow_toy_env, make_toy_env

    if config.runtime.mode == "ray":
        from slotfilm_dist.tuning.places import placed_backend

        return placed_backend(config, run, resources, make_toy_env)
    from slotfilm_dist.local import LocalBackend

    class StuckBackend(LocalBackend):
        # Without annotations: pickled by value, the class body does not bring this file's names along.
        def begin_training(self, *arguments):  # type: ignore[no-untyped-def]
            raise RuntimeError("the gripper is stuck")

    make_env = make_slow_toy_env if config.seed == 1 else make_toy_env
    return (StuckBackend if config.seed == 13 else LocalBackend)(config, make_env)


def drive() -> int:
    """`slotfilm` on the toy environment."""
    from slotfilm_dist.__main__ import main
    from slotfilm_dist.tuning import places

    places.make_backend = toy_backend
    return main()


class Drivers:
    """Starts drivers in a directory and ends what is left of them after the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._started: list[subprocess.Popen[str]] = []

    def start(self, *words: str) -> subprocess.Popen[str]:
        driver = subprocess.Popen(
            [sys.executable, __file__, "grid", "smoke", "--only", "state_only", "--json", *words, *FIELDS],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=(self.folder / f"stderr-{len(self._started)}").open("w"),
            text=True,
        )
        self._started.append(driver)
        return driver

    def outcome(self, driver: subprocess.Popen[str]) -> tuple[int, dict[str, dict[str, Any]]]:
        """Exit code, and the trials by their key's first two parts."""
        stdout, _ = driver.communicate(timeout=LIMIT_S)
        assert stdout, (self.folder / f"stderr-{self._started.index(driver)}").read_text()
        return driver.returncode, {t["key"].rpartition("-")[0]: t for t in json.loads(stdout)["trials"]}

    def said(self, driver: subprocess.Popen[str]) -> str:
        return (self.folder / f"stderr-{self._started.index(driver)}").read_text()

    def close(self) -> None:
        for driver in self._started:
            if driver.poll() is None:
                for process in [*psutil.Process(driver.pid).children(recursive=True), driver]:
                    process.kill()
            driver.wait()


@pytest.fixture
def drivers(tmp_path: Path) -> Iterator[Drivers]:
    running = Drivers(tmp_path)
    yield running
    running.close()


def wait_until(holds: Callable[[], Any], what: str) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < deadline, f"{what} did not happen"
        time.sleep(0.1)


def last_steps(run: Path) -> int:
    """Environment steps of training that a run has logged last."""
    try:
        lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    except (FileNotFoundError, json.JSONDecodeError):
        return 0
    return max((int(line["env_steps"]) for line in lines if "limiter_ratio" in line), default=0)


def records(grid: Path) -> dict[str, dict[str, Any]]:
    return {path.stem: json.loads(path.read_text()) for path in grid.glob("ledger/*.json")}


def test_killed_and_stopped_grid_goes_on_and_repeats_nothing(drivers: Drivers, still_running: StillRunning) -> None:
    words = ("--seeds", "2", "--name", "g", "--max-concurrent", "1", "--schedule.total_steps", "1500")
    words += ("--runtime.mode", "local")
    grid = drivers.folder / "runs" / "g"
    first = drivers.start(*words)
    wait_until(lambda: any(grid.glob("state_only-s1-*/checkpoints/updates-*[0-9]")), "a checkpoint of the second trial")
    children = psutil.Process(first.pid).children(recursive=True)
    first.kill()
    first.wait()
    assert not still_running(children, 20), "a killed driver leaves processes"
    before = records(grid)
    done = next(r for key, r in before.items() if key.startswith("state_only-s0"))
    assert done["state"] == "done"

    second = drivers.start(*words)
    run = next(grid.glob("state_only-s1-*"))
    known = last_steps(run)
    wait_until(lambda: last_steps(run) > known, "further steps")
    second.send_signal(signal.SIGTERM)
    code, trials = drivers.outcome(second)
    assert code == 128 + signal.SIGTERM
    assert trials["state_only-s1"]["state"] == "stopped"
    assert (run / "checkpoints" / "replay" / "manifest.json").exists()
    assert "go on with the same command: slotfilm grid smoke" in drivers.said(second)

    code, trials = drivers.outcome(drivers.start(*words))
    assert code == 0
    assert trials["state_only-s0"] == {name: done[name] for name in trials["state_only-s0"]}
    assert (trials["state_only-s1"]["state"], trials["state_only-s1"]["num_starts"]) == ("done", 3)
    assert not (run / "checkpoints" / "replay").exists()
    steps = [json.loads(line)["env_steps"] for line in (run / "metrics.jsonl").read_text().splitlines()]
    # The killed trial's checkpoint: 200 updates, half an update a step, after 120 random steps.
    assert min(steps[steps.index(known) :]) >= 520, "it began from nothing again"


def test_two_grids_share_what_one_makes_and_a_failing_trial_leaves_the_others_alone(drivers: Drivers) -> None:
    words = ("--retries", "1", "--seeds", "2", "--seed", "12", "--schedule.total_steps", "400")
    words += ("--runtime.mode", "local")
    both = [drivers.start("--name", name, *words) for name in ("a", "b")]
    for name, driver in zip("ab", both, strict=True):
        code, trials = drivers.outcome(driver)
        assert code == 1
        assert trials["state_only-s12"]["state"] == "done"
        assert trials["state_only-s12"]["result"]["mean_return"] > 0
        failed = trials["state_only-s13"]
        assert (failed["state"], failed["num_starts"]) == ("failed", 2)
        assert failed["error"] == "RuntimeError: the gripper is stuck"
        assert "the gripper is stuck" in drivers.said(driver)
        assert records(drivers.folder / "runs" / name)[failed["key"]]["trace"].startswith("Traceback")
    collected = [
        path.parent.name
        for path in drivers.folder.glob("runs/*/making/random-*/metrics.jsonl")
        if '"phase"' in path.read_text()
    ]
    assert len(collected) == len(set(collected)) == 2, collected


def test_trial_on_ray_lives_in_its_placement_group(drivers: Drivers) -> None:
    words = ("--seeds", "1", "--cpus-per-trial", "1.5", "--schedule.total_steps", "400", "--name", "g")
    words += ("--runtime.mode", "ray", "--runtime.num_workers", "1")
    code, trials = drivers.outcome(drivers.start(*words))
    assert code == 0
    assert trials["state_only-s0"]["state"] == "done"
    (run,) = (drivers.folder / "runs" / "g").glob("state_only-s0-*")
    assert json.loads((run / "config.json").read_text())["runtime"]["mode"] == "ray"
    assert last_steps(run) >= 400


if __name__ == "__main__":
    os.environ.setdefault("RAY_AUTH_MODE", "disabled")
    sys.exit(drive())
