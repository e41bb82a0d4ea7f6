"""What Prometheus reads from every sink that serves it: the same names, labels and values."""

import re
import time
import urllib.request
from collections.abc import Callable, Iterator

import pytest

from slotfilm_dist.cluster.ray_sink import RaySink
from slotfilm_dist.cluster.session import Session
from slotfilm_dist.contracts import MetricSink
from slotfilm_dist.sinks import ClosableSink, PrometheusSink

LABELS = {"run": "a run", "variant": "slotfilm", "seed": "3"}
OURS = {*LABELS, "role", "worker", "reason", "term", "le"}
"""Ray adds labels of its own to these."""

Page = Callable[[], dict[str, float]]


def samples(url: str) -> dict[str, float]:
    """Values by name and our labels, in one text."""
    with urllib.request.urlopen(url, timeout=10) as answer:
        text = answer.read().decode()
    found: dict[str, float] = {}
    for name, labels, value in re.findall(r"^(ray_slotfilm_\w+)\{(.*)\} (\S+)$", text, re.MULTILINE):
        own = sorted((k, v) for k, v in re.findall(r'(\w+)="([^"]*)"', labels) if k in OURS)
        if ("run", LABELS["run"]) in own:
            found[f"{name} {' '.join(f'{k}={v}' for k, v in own if k not in LABELS)}"] = float(value)
    return found


@pytest.fixture
def served(place: str, request: pytest.FixtureRequest) -> Iterator[tuple[ClosableSink, Page]]:
    """A sink, and what Prometheus would read."""
    if place == "ray":
        session: Session = request.getfixturevalue("session")
        (url,) = session.metric_pages()
        sink: ClosableSink = RaySink(LABELS)
    else:
        sink = PrometheusSink(0, LABELS)
        url = f"http://127.0.0.1:{sink.port}/metrics"
    yield sink, lambda: samples(url)
    sink.close()


def test_names_labels_and_values_are_the_same_wherever_they_are_read(served: tuple[ClosableSink, Page]) -> None:
    sink, page = served
    assert isinstance(sink, MetricSink)
    sink.write({"limiter_ratio": 0.25, "learner_updates_total": 0, "worker_restarts_total/hang": 2, "env_steps": 7})
    sink.write({"limiter_ratio": 0.5, "learner_updates_total": 40, "learner_update_s": 0.02})
    expected = {
        "ray_slotfilm_limiter_ratio role=limiter worker=": 0.5,
        "ray_slotfilm_learner_updates_total role=learner worker=": 40.0,
        "ray_slotfilm_worker_restarts_total reason=hang role=worker worker=": 2.0,
        "ray_slotfilm_worker_restarts_total reason=crash role=worker worker=": 0.0,
        "ray_slotfilm_checkpoint_failed_total role=checkpoint worker=": 0.0,
        "ray_slotfilm_env_steps role=run worker=": 7.0,
        "ray_slotfilm_learner_update_s_count role=learner worker=": 1.0,
        "ray_slotfilm_learner_update_s_bucket le=0.01 role=learner worker=": 0.0,
        "ray_slotfilm_learner_update_s_bucket le=0.03 role=learner worker=": 1.0,
    }
    deadline = time.monotonic() + 60
    while not expected.items() <= page().items():
        assert time.monotonic() < deadline, page()
        time.sleep(0.5)


def test_unknown_name_is_refused(served: tuple[ClosableSink, Page]) -> None:
    with pytest.raises(ValueError, match="did you mean 'limiter_ratio'"):
        served[0].write({"limiter_rati": 1.0})
