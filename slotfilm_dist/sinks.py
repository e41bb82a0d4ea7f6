"""Where metric values go: a file of JSON lines, TensorBoard, Prometheus, or all of them.

Inside Ray, `cluster/ray_sink.py` takes the place of `PrometheusSink`. Every sink is a `MetricSink`: `write(values)`
takes values by key (see `metrics.find_metric`), among them the axes `time_s`, `env_steps`, `updates` and `phase`. An
axis that is left out keeps its last value.
"""

import json
import logging
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.registry import Collector

from slotfilm_dist.metrics import AXES, PHASES, WAIT_BUCKETS_S, Metric, check_names, find_metric, zero_counters

_logger = logging.getLogger(__name__)

Values = Mapping[str, float | int]
"""Values by metric key."""

_PORTS_TRIED = 32


@runtime_checkable
class ClosableSink(Protocol):
    """A `MetricSink` that holds a file or a port."""

    def write(self, values: Values) -> None:
        """Record values by metric key."""
        ...

    def close(self) -> None:
        """Release what the sink holds; nothing written is lost."""
        ...


class JsonLinesSink:
    """Appends one JSON object a line, complete on disk when `write` returns.

    A line holds `time_s`, `env_steps`, `updates`, `phase` (a word) and the values written with them. A value that is
    not finite becomes null and is counted in `num_nonfinite`. Opening a file whose last line was torn by a crash cuts
    that line off; a write that fails half way (disk full) leaves no half line behind.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.num_nonfinite = 0
        self._axes: dict[str, float | str] = {"time_s": 0.0, "env_steps": 0, "updates": 0, "phase": PHASES[0]}
        self._end, last = _last_complete_line(path)
        self._axes |= {name: last[name] for name in AXES if name in last}
        self._file = path.open("ab", buffering=0)
        self._file.truncate(self._end)

    def write(self, values: Values) -> None:
        """Append one line.

        Raises:
            ValueError: an unknown metric name.
            OSError: the file cannot be written; it still ends with a complete line.
        """
        check_names(values)
        line: dict[str, Any] = dict(self._axes)
        for key, value in values.items():
            number = float(value)
            if key == "phase":
                line[key] = PHASES[int(number)]
            elif math.isfinite(number):
                line[key] = int(number) if number.is_integer() else number
            else:
                self.num_nonfinite += 1
                if key not in AXES:
                    line[key] = None
        if self.num_nonfinite:
            line["sink_nonfinite_total"] = self.num_nonfinite
        self._axes = {name: line[name] for name in AXES}
        self._append((json.dumps(line, allow_nan=False) + "\n").encode())

    def _append(self, line: bytes) -> None:
        try:
            if self._file.write(line) != len(line):
                raise OSError(f"{self._file.name}: the line was written only in part; is the disk full?")
        except OSError:
            self._file.truncate(self._end)
            raise
        self._end += len(line)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _last_complete_line(path: Path) -> tuple[int, dict[str, Any]]:
    """Where the last complete line ends, in bytes, and that line; (0, {}) without one."""
    if not path.exists():
        return 0, {}
    content = path.read_bytes()
    end = content.rfind(b"\n") + 1
    while end:
        start = content.rfind(b"\n", 0, end - 1) + 1
        try:
            line = json.loads(content[start:end])
        except (UnicodeDecodeError, json.JSONDecodeError):
            line = None
        if isinstance(line, dict):
            return end, line
        end = start
    return 0, {}


class TensorBoardSink:
    """Writes TensorBoard scalars, grouped by role, over environment steps; pre-training over its own steps."""

    def __init__(self, folder: Path) -> None:
        # Imported here because it imports torch, which takes seconds and which the other sinks do without.
        from torch.utils.tensorboard.writer import SummaryWriter

        self._writer = SummaryWriter(log_dir=str(folder))
        self._env_steps = 0
        self._pretrain_steps = 0

    def write(self, values: Values) -> None:
        """Add the values at the current step; raises ``ValueError`` for an unknown metric name."""
        check_names(values)
        self._env_steps = int(values.get("env_steps", self._env_steps))
        self._pretrain_steps = int(values.get("pretrain_steps_total", self._pretrain_steps))
        for key, value in values.items():
            role = find_metric(key)[0].role
            step = self._pretrain_steps if role == "pretrain" else self._env_steps
            self._writer.add_scalar(f"{role}/{key}", float(value), step)
        self._writer.flush()

    def close(self) -> None:
        """Write out what is buffered and close the file."""
        self._writer.close()


class PrometheusSink:
    """Serves the latest values to Prometheus on this machine's loopback address, with `from_zero` counters at once.

    A taken port does not stop a run: the next free one of 32 is used, and where there is none the values stay unserved
    and one warning says so. Each sink has a registry of its own, so that several fit into one process.

    Args:
        port: first port to try; 0 lets the system choose.
        labels: labels of every value, such as the run's name.
    """

    port: int | None
    """The port that serves, or None where none was free."""

    def __init__(self, port: int, labels: Mapping[str, str] | None = None) -> None:
        self._collector = _LatestValues(dict(labels or {}))
        registry = CollectorRegistry()
        registry.register(self._collector)
        self._server: Any = None
        for candidate in [port] if port == 0 else range(port, min(port + _PORTS_TRIED, 65536)):
            try:
                self._server, self._thread = start_http_server(candidate, addr="127.0.0.1", registry=registry)
            except OSError:
                continue
            break
        self.port = self._server.server_port if self._server else None
        if self.port is None:
            _logger.warning("no metrics for Prometheus: ports %d and following are taken; training goes on", port)
        elif port not in (0, self.port):
            _logger.warning("metrics for Prometheus are on port %d; port %d is taken", self.port, port)

    def write(self, values: Values) -> None:
        """Show these values from the next scrape on; raises ``ValueError`` for an unknown metric name."""
        self._collector.update(values)

    def close(self) -> None:
        """Stop serving and free the port."""
        if self._server:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()
            self._server = None


class _LatestValues(Collector):
    """The newest value of every gauge and counter, and the bucket counts of every histogram."""

    def __init__(self, labels: dict[str, str]) -> None:
        self._labels = labels
        self._lock = threading.Lock()
        self._values = zero_counters()
        self._buckets: dict[str, list[int]] = {}
        self._sums: dict[str, float] = {}

    def update(self, values: Values) -> None:
        check_names(values)
        with self._lock:
            for key, value in values.items():
                if find_metric(key)[0].kind == "histogram":
                    self._observe(key, float(value))
                else:
                    self._values[key] = float(value)

    def _observe(self, key: str, value: float) -> None:
        if not math.isfinite(value):
            return
        counts = self._buckets.setdefault(key, [0] * (len(WAIT_BUCKETS_S) + 1))
        counts[next((i for i, bound in enumerate(WAIT_BUCKETS_S) if value <= bound), len(WAIT_BUCKETS_S))] += 1
        self._sums[key] = self._sums.get(key, 0.0) + value

    def collect(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily | HistogramMetricFamily]:
        with self._lock:
            values = dict(self._values)
            buckets = {key: list(counts) for key, counts in self._buckets.items()}
            sums = dict(self._sums)
        families: dict[str, GaugeMetricFamily | CounterMetricFamily] = {}
        for key, value in values.items():
            metric, label = find_metric(key)
            family = families.setdefault(metric.name, self._family(metric))
            labels = [*self._labels.values(), metric.role, "", *([label] if metric.label else [])]
            family.add_metric(labels, value)
        yield from families.values()
        for key, counts in buckets.items():
            metric, _ = find_metric(key)
            names = [*self._labels, "role", "worker"]
            histogram = HistogramMetricFamily(metric.exported_name, metric.help, labels=names)
            histogram.add_metric([*self._labels.values(), metric.role, ""], _cumulative(counts), sums[key])
            yield histogram

    def _family(self, metric: Metric) -> GaugeMetricFamily | CounterMetricFamily:
        kind = CounterMetricFamily if metric.kind == "counter" else GaugeMetricFamily
        names = [*self._labels, "role", "worker", *([metric.label] if metric.label else [])]
        return kind(metric.exported_name, f"{metric.help} Unit: {metric.unit}.", labels=names)


def _cumulative(counts: Sequence[int]) -> list[tuple[str, float]]:
    """Prometheus's buckets: each bound with the number of observations up to it."""
    bounds = [*map(str, WAIT_BUCKETS_S), "+Inf"]
    return [(bound, float(sum(counts[: i + 1]))) for i, bound in enumerate(bounds)]


class FanOut:
    """Writes to several sinks; one that fails is warned about once, counted, and never stops training.

    A misspelt metric name is our own mistake and not a sink's: it raises ``ValueError`` before anything is written.
    """

    def __init__(self, sinks: Sequence[ClosableSink]) -> None:
        self._sinks = tuple(sinks)
        self.num_failures = [0] * len(self._sinks)
        """Writes that failed, by sink."""
        self.num_nonfinite = 0
        """Values that were not finite."""

    def write(self, values: Values) -> None:
        """Write to every sink; raises ``ValueError`` for an unknown metric name and nothing else."""
        check_names(values)
        self.num_nonfinite += sum(not math.isfinite(value) for value in values.values())
        if self.num_nonfinite:
            values = {**values, "sink_nonfinite_total": self.num_nonfinite}
        if sum(self.num_failures):
            values = {**values, "sink_failures_total": sum(self.num_failures)}
        for index in range(len(self._sinks)):
            self._attempt(index, values)

    def _attempt(self, index: int, values: Values) -> None:
        sink = self._sinks[index]
        try:
            sink.write(values)
        except Exception as error:
            self.num_failures[index] += 1
            if self.num_failures[index] == 1:
                _logger.warning("%s lost metrics, training goes on: %s", type(sink).__name__, error)

    def close(self) -> None:
        """Close every sink, also when one of them fails to."""
        for sink in self._sinks:
            try:
                sink.close()
            except Exception as error:
                _logger.warning("%s did not close: %s", type(sink).__name__, error)

    def __enter__(self) -> "FanOut":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
