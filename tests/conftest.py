"""Checks shapes and types of every call in the package, and keeps Ray to itself."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxtyping
import pytest

PACKAGE = Path(__file__).parents[1] / "slotfilm_dist"
UNCHECKED = {"slotfilm_dist.cluster.actors"}
"""Ray looks for its marks on the innermost function, where a checked method of an actor does not carry them."""

_modules = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in PACKAGE.rglob("*.py")}
# With the numeric tower, as in PEP 484: an int may be given where a float is asked for.
jaxtyping.install_import_hook(
    sorted(_modules - UNCHECKED), "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
)

# Read by Ray when it starts, in this process and in those that it starts: no token in the user's home, no reports.
_ray_files = tempfile.TemporaryDirectory(prefix="slotfilm-ray-")
os.environ["RAY_AUTH_MODE"] = "disabled"
os.environ["RAY_AUTH_TOKEN_PATH"] = str(Path(_ray_files.name) / "token")
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
# A process reads it once, before its first cluster; otherwise metrics are reported every 10 s.
os.environ["RAY_metrics_report_interval_ms"] = "1000"  # noqa: SIM112

# Of whoever runs the tests: colours and widths would change what is printed, a proxy would be asked for the loopback.
for _name in ("FORCE_COLOR", "COLUMNS", "LINES"):
    os.environ.pop(_name, None)
os.environ["no_proxy"] = "127.0.0.1,localhost"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests that need a GPU where torch finds none."""
    needing = [item for item in items if item.get_closest_marker("gpu")]
    if not needing:
        return
    import torch

    if not torch.cuda.is_available():
        for item in needing:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA GPU"))


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Torch on one thread: the tests' tensors are small, and threads that wait for each other spin."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def write_agent_run() -> Callable[..., Path]:
    """Writes a run directory with a config and a checkpoint: of this agent, or of one that is new."""

    def write_agent_run(folder: Path, config: Any, learner: Any = None) -> Path:
        import torch

        from slotfilm_dist.config_files import save_config
        from slotfilm_dist.learning.checkpoint import CheckpointStore
        from slotfilm_dist.learning.learner import Learner

        if learner is None:
            learner = Learner(config, 7, torch.device("cpu"))
            learner.begin_rl(None)
        folder.mkdir(parents=True)
        save_config(config, folder / "config.json")
        CheckpointStore(folder / "checkpoints", 1).write(learner.checkpoint({"limiter": {"env_steps": 12}}), 0)
        return folder

    return write_agent_run


@pytest.fixture(scope="session")
def still_running() -> Callable[[Any, float], Any]:
    """Waits for processes to end; gives those that have not. One that nobody has asked for its exit code has ended."""

    def still_running(processes: Any, timeout_s: float) -> Any:
        import psutil

        _, there = psutil.wait_procs(processes, timeout=timeout_s)
        running = []
        for process in there:
            try:
                if process.status() != psutil.STATUS_ZOMBIE:
                    running.append(process)
            except psutil.NoSuchProcess:
                continue
        return running

    return still_running
