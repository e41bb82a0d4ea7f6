"""Where a run's metrics go."""

from slotfilm_dist.metrics import metric_labels
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.sinks import ClosableSink, JsonLinesSink, PrometheusSink, TensorBoardSink


def open_sinks(run: RunDirectory) -> list[ClosableSink]:
    """Its own files, and Prometheus unless that is turned off."""
    sinks: list[ClosableSink] = [JsonLinesSink(run.metrics), TensorBoardSink(run.path / "tensorboard")]
    config = run.config
    if config.runtime.metrics_port and config.runtime.mode == "ray":
        from slotfilm_dist.cluster.ray_sink import RaySink  # Ray is imported only where it is used

        sinks.append(RaySink(metric_labels(config, run.path.name)))
    elif config.runtime.metrics_port:
        sinks.append(PrometheusSink(config.runtime.metrics_port, metric_labels(config, run.path.name)))
    return sinks
