"""Joins the Ray cluster that is there, or starts a private one on this machine."""

import contextlib
import functools
import hashlib
import json
import logging
import os
import re
import secrets
import shutil
import signal
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import psutil
import ray
from ray._private import ray_constants

from slotfilm_dist.atomic import write_atomic
from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster.placement import check_grown, place
from slotfilm_dist.cluster.watchdog import MARK, Watchdog
from slotfilm_dist.machine import ends_all_at_once, usable_cores, usable_memory_bytes

STORE_BYTES = 1 << 30
"""Object store of a private cluster: only blocks, batches and weights under way live there."""
START_ATTEMPTS = 3
"""Ray gives its own processes half a minute to start, which a loaded machine may miss."""
PORTS_TRIED = 32
GROW_S = 300.0
"""Longest wait for the nodes of a cluster that was just started."""
LISTENER_S = 5.0
"""Longest wait until somebody takes a connection at a cluster's address."""
FOLDER_PREFIX, OWNER_FILE = "slotfilm-", "owner"
"""A private cluster's folder, and the file in it that names the driver's process."""
CLUSTER_FILE = "cluster.json"
"""In the run directory: how `slotfilm scale` finds the run."""

SYSTEM_CONFIG = {
    "agent_register_timeout_ms": 100_000,
    # Roles at the usual priority: at Ray's own 15 anything else on the machine would starve them.
    "worker_niceness": 0,
}
"""Of a private cluster."""
WITHOUT_MONITOR = {"memory_monitor_refresh_ms": 0, "worker_oom_score_adjustment": 0}
"""At 95 % Ray would end what it can start again, replay first, and then as much as brings it below, all roles at once
if they are small. Our workers stop before that (`MemoryGuard`), and the system ends the rest in our order, unless it
would end all of a container."""

_logger = logging.getLogger(__name__)


class Session:
    """A connection to Ray; closing it ends a private cluster and removes its files.

    With `RAY_ADDRESS` set, as inside a Ray job, or where Ray is connected already, as inside a Tune trial, that cluster
    is used and left running. Otherwise a private one is started, without a dashboard or usage reports, with a token of
    its own (unless `RAY_AUTH_MODE` says otherwise) in a folder that nobody else can read. It listens on the loopback
    only, so that nobody reaches it from another machine, and the token keeps this machine's other users out. A
    `Watchdog` ends it and deletes its files even if this process is killed.

    Args:
        num_cpus: cores of a private cluster; 0 takes all that may be used.
        metrics_port: where a private cluster serves metrics to Prometheus, or at a later port while others use that
            one; 0 leaves the choice to Ray.

    Raises:
        ValueError: nobody answers at `RAY_ADDRESS`, or the nodes of that cluster do not join in `GROW_S`.
    """

    def __init__(self, num_cpus: int = 0, metrics_port: int = 0) -> None:
        self.private = False
        self._joined = False
        self._folder: Path | None = None
        self._watchdog: Watchdog | None = None
        self._environment: dict[str, str | None] = {}
        self._loopback = contextlib.ExitStack()
        if ray.is_initialized():
            return
        self._joined = True
        with _signal_handlers_kept():
            if os.environ.get("RAY_ADDRESS"):
                _require_listener("RAY_ADDRESS", os.environ["RAY_ADDRESS"])
                ray.init(address=os.environ["RAY_ADDRESS"], log_to_driver=False, logging_level=logging.ERROR)
                self._await_nodes()
            else:
                self._start_private(num_cpus or max(1, int(usable_cores())), metrics_port)

    @property
    def address(self) -> str:
        """Of the cluster's head."""
        return ray.get_runtime_context().gcs_address

    @property
    def token_path(self) -> str:
        """File of the private cluster's token; empty without one."""
        return self._environment_now("RAY_AUTH_TOKEN_PATH") if self.private else ""

    def nodes(self) -> list[Mapping[str, float]]:
        """Resources of every live node."""
        return [node["Resources"] for node in ray.nodes() if node["Alive"]]

    def metric_pages(self) -> list[str]:
        """Where Prometheus finds the metrics of every live node."""
        nodes = [node for node in ray.nodes() if node["Alive"] and node["MetricsExportPort"] > 0]
        return [f"http://{node['NodeManagerAddress']}:{node['MetricsExportPort']}/metrics" for node in nodes]

    def place(self, resource: str) -> dict[str, float]:
        """What a role asks for to be put onto a live node that offers a resource; nothing where none does.

        In a placement group, such as a Tune trial's, the bundles stand for the nodes.
        """
        group = ray.util.get_current_placement_group()
        return place(self.nodes() if group is None else group.bundle_specs, resource)

    def available_cpus(self) -> float:
        """Cores that nobody has asked for; in a placement group, whose bundles are its first roles', there are none."""
        if ray.util.get_current_placement_group() is not None:
            return 0.0
        return float(ray.available_resources().get("CPU", 0.0))

    def write_cluster_file(self, run: Path, namespace: str, starts: int) -> None:
        """Note in the run directory where the run lives, and how often it has been started, this time included."""
        values = {
            "address": self.address,
            "namespace": namespace,
            "token_path": self.token_path,
            "metrics": self.metric_pages(),
            "starts": starts,
        }
        write_atomic(run / CLUSTER_FILE, [json.dumps(values, indent=1).encode()])

    def close(self) -> None:
        """Leave the cluster, or end the private one."""
        if not self._joined:
            return
        ray.shutdown()
        self._joined = False
        self._loopback.close()
        for name, value in self._environment.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if self._watchdog is not None:
            self._watchdog.close()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _await_nodes(self) -> None:
        """Give a cluster that was just started time to grow; raises ``ValueError`` if it does not."""
        deadline, told = time.monotonic() + GROW_S, False
        while True:
            try:
                check_grown(self.nodes())
                return
            except ValueError as error:
                if time.monotonic() > deadline:
                    self.close()
                    raise
                if not told:
                    _logger.warning("waiting up to %g s for nodes: %s", GROW_S, error)
                told = True
            time.sleep(1.0)

    def _start_private(self, num_cpus: int, metrics_port: int) -> None:
        self.private = True
        # A short path: the sockets below it may have no more than 107 characters.
        remove_stale_folders(Path(tempfile.gettempdir()))
        self._folder = Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX))
        (self._folder / OWNER_FILE).write_text(_process_name(os.getpid()))
        self._watchdog = Watchdog(self._folder)
        self._set(MARK, str(self._folder))
        self._set("RAY_USAGE_STATS_ENABLED", "0")
        self._set(ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR, "0")
        self._loopback.enter_context(_on_loopback())
        if not os.environ.get("RAY_AUTH_MODE"):
            token = self._folder / "token"
            token.touch(mode=0o600)
            token.write_text(_own_token())
            self._set("RAY_AUTH_TOKEN_PATH", str(token))
            self._environment.setdefault("RAY_AUTH_MODE", None)  # Ray turns it on by itself where a token is there
        for attempt in range(START_ATTEMPTS):
            try:
                # Should somebody else take that port in the same instant, the next attempt leaves the choice to Ray.
                self._init(num_cpus, free_port(metrics_port) if metrics_port and attempt == 0 else 0)
                return
            except Exception as error:  # Ray raises plain Exceptions when a process of its own starts too slowly
                ray.shutdown()
                if attempt == START_ATTEMPTS - 1:
                    self.close()
                    raise RunFailedError(
                        f"Ray did not start here in {START_ATTEMPTS} attempts ({str(error).splitlines()[0]}); "
                        "is the machine overloaded? --runtime.mode local runs without Ray"
                    ) from error

    def _init(self, num_cpus: int, metrics_port: int) -> None:
        assert self._folder is not None
        ray.init(
            num_cpus=num_cpus,
            object_store_memory=min(STORE_BYTES, usable_memory_bytes() // 4),
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.ERROR,
            _temp_dir=str(self._folder / "ray"),  # Ray lets everybody write there
            _node_ip_address="127.0.0.1",
            _metrics_export_port=metrics_port or None,
            _system_config=SYSTEM_CONFIG | ({} if ends_all_at_once() else WITHOUT_MONITOR),
        )

    def _set(self, name: str, value: str) -> None:
        self._environment.setdefault(name, os.environ.get(name))
        os.environ[name] = value

    @staticmethod
    def _environment_now(name: str) -> str:
        return os.environ.get(name, "")


@functools.cache
def _own_token() -> str:
    """One for all private clusters of this process: Ray reads a token once and keeps it while the process lives."""
    return secrets.token_hex(32)


def free_port(first: int) -> int:
    """The first port from `first` on that nobody listens at, among a few; 0 if there is none."""
    for port in range(first, min(first + PORTS_TRIED, 65536)):
        with contextlib.closing(socket.socket()) as candidate, contextlib.suppress(OSError):
            candidate.bind(("", port))
            return port
    return 0


def remove_stale_folders(parent: Path) -> int:
    """Delete what private clusters have left whose driver was killed; gives how many there were."""
    count = 0
    for owner in parent.glob(f"{FOLDER_PREFIX}*/{OWNER_FILE}"):
        with contextlib.suppress(OSError, ValueError):  # somebody else's, or just being deleted
            name = owner.read_text()
            if name and name != _process_name(int(name.split()[0])):
                shutil.rmtree(owner.parent, ignore_errors=True)
                count += 1
    return count


def _process_name(pid: int) -> str:
    """A process beyond the reuse of its number: number and time of its start; empty if there is none."""
    try:
        return f"{pid} {psutil.Process(pid).create_time()}"
    except psutil.Error:
        return ""


def namespace_of(run: Path) -> str:
    """Under what name a run's hub is found; runs of the same name in other folders have others."""
    path = run.resolve()
    return f"slotfilm-{re.sub(r'[^A-Za-z0-9._-]', '-', path.name)}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:8]}"


def read_cluster_file(run: Path) -> dict[str, Any]:
    """What `write_cluster_file` wrote; empty if there is nothing."""
    try:
        values = json.loads((run / CLUSTER_FILE).read_text(encoding="utf-8"))
    except (FileNotFoundError, UnicodeDecodeError, json.JSONDecodeError):
        return {}
    return values if isinstance(values, dict) else {}


@contextlib.contextmanager
def joined(run: Path) -> Iterator[str]:
    """Connect to the cluster of a live run while the body runs; gives the run's namespace.

    Raises:
        ValueError: the run has never been on a cluster, or its cluster is gone.
    """
    values = read_cluster_file(run)
    if not values:
        raise ValueError(f"{run} has no {CLUSTER_FILE}: the run does not use Ray, or has not started yet")
    if not all(isinstance(values.get(name), str) for name in ("address", "namespace", "token_path")):
        raise ValueError(f"{run / CLUSTER_FILE} is damaged; `slotfilm train --resume {run}` writes it anew")
    _require_listener(str(run), values["address"])
    if values["token_path"]:
        os.environ["RAY_AUTH_TOKEN_PATH"] = values["token_path"]
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    here = _on_loopback() if values["address"].startswith("127.") else contextlib.nullcontext()
    try:
        with here:
            ray.init(address=values["address"], log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{run}: its cluster at {values['address']} does not answer ({reason}); is it running?"
        ) from None
    try:
        yield values["namespace"]
    finally:
        ray.shutdown()


def _require_listener(who: str, address: str) -> None:
    """Ray itself tries for many minutes to reach a cluster that is gone; an address with a scheme is left to it."""
    host, _, port = address.rpartition(":")
    if not port.isdecimal() or "/" in host:
        return
    try:
        with socket.create_connection((host.strip("[]"), int(port)), LISTENER_S):
            return
    except (OSError, OverflowError) as error:
        raise ValueError(
            f"{who}: nobody answers at {address}, where the cluster should be ({error}); it has ended, or cannot be "
            "reached from here"
        ) from None


@contextlib.contextmanager
def _on_loopback() -> Iterator[None]:
    """Let Ray take 127.0.0.1 for a node's address while the body runs.

    Otherwise it puts the machine's own address in its place and listens on every interface. Its switch for that is the
    one by which it keeps a laptop's firewall quiet; Ray reads the variable when imported, so its value is set too.
    """
    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


@contextlib.contextmanager
def _signal_handlers_kept() -> Iterator[None]:
    """Ray takes SIGTERM for itself when it starts; the run's own way to stop stays."""
    try:
        before = signal.getsignal(signal.SIGTERM)
    except ValueError:
        before = None
    yield
    with contextlib.suppress(ValueError):  # not the main thread: Ray has not taken it either
        if before is not None:
            signal.signal(signal.SIGTERM, before)
