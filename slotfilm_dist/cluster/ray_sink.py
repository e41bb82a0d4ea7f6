"""Hands metrics to Ray's own agent, which serves those of a whole node to Prometheus."""

import math
from collections.abc import Mapping
from typing import Any

from ray.util.metrics import Gauge, Histogram

from slotfilm_dist.metrics import RAY_PREFIX, WAIT_BUCKETS_S, Metric, check_names, find_metric, zero_counters
from slotfilm_dist.sinks import Values


class RaySink:
    """A `MetricSink` on `ray.util.metrics`, with the names and labels of `PrometheusSink`.

    Counters are handed over as gauges that hold the total: Ray's counters outlive their process in the agent, so a run
    that is resumed on the same cluster would count twice. A value appears within Ray's reporting interval (10 s) and is
    gone two intervals after its process.

    Args:
        labels: of every value, such as the run's name.
        worker: number of the worker that this process is; empty in the driver, which leaves out what the workers'
            own processes tell.
    """

    def __init__(self, labels: Mapping[str, str], worker: str = "") -> None:
        self._labels = dict(labels)
        self._worker = worker
        self._instruments: dict[str, Any] = {}
        self._not_happened = {} if worker else zero_counters()

    def write(self, values: Values) -> None:
        """Show these values from Ray's next report on; raises ``ValueError`` for an unknown metric name.

        The driver also shows the `from_zero` counters that have not been written yet, at zero.
        """
        check_names(values)
        self._not_happened = {key: zero for key, zero in self._not_happened.items() if key not in values}
        for key, value in (self._not_happened | dict(values)).items():
            metric, label = find_metric(key)
            if metric.by_worker == bool(self._worker):
                self._write(metric, label, float(value))

    def close(self) -> None:
        """Nothing to release: Ray's agent forgets the values when this process ends."""

    def _write(self, metric: Metric, label: str, value: float) -> None:
        instrument = self._instruments.get(metric.name)
        if instrument is None:
            instrument = self._instruments[metric.name] = self._build(metric)
        tags = {**self._labels, "role": metric.role, "worker": self._worker}
        if metric.label:
            tags[metric.label] = label
        if metric.kind != "histogram":
            instrument.set(value, tags=tags)
        elif math.isfinite(value):
            instrument.observe(value, tags=tags)

    def _build(self, metric: Metric) -> Any:
        name = metric.exported_name.removeprefix(RAY_PREFIX)
        text = f"{metric.help} Unit: {metric.unit}."
        tags = (*self._labels, "role", "worker", *([metric.label] if metric.label else []))
        if metric.kind == "histogram":
            return Histogram(name, text, boundaries=list(WAIT_BUCKETS_S), tag_keys=tags)
        return Gauge(name, text, tag_keys=tags)
