import json
import logging
import math
import socket
import urllib.request

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from slotfilm_dist.metrics import RESTART_REASONS, phase_index
from slotfilm_dist.sinks import FanOut, JsonLinesSink, PrometheusSink, TensorBoardSink


def lines_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def scrape(sink):
    with urllib.request.urlopen(f"http://127.0.0.1:{sink.port}/metrics", timeout=10) as answer:
        return answer.read().decode()


class Broken:
    """A sink whose disk is full."""

    def __init__(self):
        self.writes = 0

    def write(self, values):
        self.writes += 1
        raise OSError("no space left on device")

    def close(self):
        raise OSError("still no space")


def test_json_line_holds_the_axes_and_the_values(tmp_path):
    sink = JsonLinesSink(tmp_path / "run" / "metrics.jsonl")
    sink.write({"env_steps": 400.0, "phase": phase_index("train"), "learner_critic_loss": 0.25})
    expected = {"time_s": 0, "env_steps": 400, "updates": 0, "phase": "train", "learner_critic_loss": 0.25}
    assert lines_of(tmp_path / "run" / "metrics.jsonl") == [expected]


def test_json_line_is_on_disk_when_write_returns(tmp_path):
    path = tmp_path / "metrics.jsonl"
    sink = JsonLinesSink(path)
    for count in range(1, 4):
        sink.write({"updates": count})
        assert [line["updates"] for line in lines_of(path)] == list(range(1, count + 1))


def test_axis_left_out_keeps_its_last_value_also_over_a_resume(tmp_path):
    path = tmp_path / "metrics.jsonl"
    first = JsonLinesSink(path)
    first.write({"time_s": 1.5, "env_steps": 7, "updates": 3, "phase": 2})
    first.write({"learner_q_mean": 1.0})
    first.close()
    JsonLinesSink(path).write({"updates": 4})
    axes = [(r["time_s"], r["env_steps"], r["updates"], r["phase"]) for r in lines_of(path)]
    assert axes == [(1.5, 7, 3, "train"), (1.5, 7, 3, "train"), (1.5, 7, 4, "train")]


@pytest.mark.parametrize(
    "torn", [b'{"time_s": 1, "env_', b'{"time_s": 1}\x00\x00\n', b"\x00" * 9 + b"\n", b"\xff\xfe\n"]
)
def test_torn_last_line_is_cut_off_when_resuming(tmp_path, torn):
    path = tmp_path / "metrics.jsonl"
    JsonLinesSink(path).write({"env_steps": 1})
    whole = path.read_bytes()
    path.write_bytes(whole + torn)
    JsonLinesSink(path).write({"env_steps": 2})
    assert path.read_bytes().startswith(whole)
    assert [line["env_steps"] for line in lines_of(path)] == [1, 2]


def test_file_with_nothing_but_a_torn_line_starts_anew(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"time_s": 1')
    JsonLinesSink(path).write({"env_steps": 2})
    assert [line["env_steps"] for line in lines_of(path)] == [2]


def test_non_finite_value_becomes_null_and_is_counted(tmp_path):
    path = tmp_path / "metrics.jsonl"
    sink = JsonLinesSink(path)
    sink.write({"learner_critic_loss": math.nan, "learner_q_mean": math.inf, "env_steps": 5})
    sink.write({"learner_q_mean": 2.5})
    first, second = lines_of(path)
    assert first["learner_critic_loss"] is None
    assert first["learner_q_mean"] is None
    assert (first["sink_nonfinite_total"], second["sink_nonfinite_total"], sink.num_nonfinite) == (2, 2, 2)


def test_failed_write_leaves_only_complete_lines(tmp_path):
    resource = pytest.importorskip("resource")
    signal = pytest.importorskip("signal")
    path = tmp_path / "metrics.jsonl"
    sink = JsonLinesSink(path)
    sink.write({"env_steps": 1})
    size = path.stat().st_size
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 10, limits[1]))
        with pytest.raises(OSError, match=r"in part|too large"):
            sink.write({"env_steps": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.stat().st_size == size
    sink.write({"env_steps": 3})
    assert [line["env_steps"] for line in lines_of(path)] == [1, 3]


def test_unknown_name_is_refused_and_nothing_is_written(tmp_path):
    path = tmp_path / "metrics.jsonl"
    with pytest.raises(ValueError, match="did you mean 'limiter_ratio'"):
        JsonLinesSink(path).write({"env_steps": 1, "limiter_rati": 1.0})
    assert path.read_bytes() == b""


def test_tensorboard_reads_back_what_was_written_at_its_step(tmp_path):
    sink = TensorBoardSink(tmp_path)
    sink.write({"env_steps": 100, "learner_critic_loss": 0.5})
    sink.write({"learner_critic_loss": 0.25, "pretrain_steps_total": 30, "pretrain_loss": 2.0})
    sink.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    critic = [(e.step, e.value) for e in events.Scalars("learner/learner_critic_loss")]
    assert critic == [(100, 0.5), (100, 0.25)]
    assert [(e.step, e.value) for e in events.Scalars("pretrain/pretrain_loss")] == [(30, 2.0)]


def test_prometheus_serves_gauges_counters_and_labels():
    sink = PrometheusSink(0, labels={"run": "a"})
    try:
        sink.write({"limiter_ratio": 0.5, "worker_restarts_total/crash": 1, "worker_restarts_total/hang": 2})
        sink.write({"limiter_ratio": 1.0})
        text = scrape(sink)
    finally:
        sink.close()
    assert 'ray_slotfilm_limiter_ratio{role="limiter",run="a",worker=""} 1.0' in text
    assert 'ray_slotfilm_worker_restarts_total{reason="crash",role="worker",run="a",worker=""} 1.0' in text
    assert 'ray_slotfilm_worker_restarts_total{reason="hang",role="worker",run="a",worker=""} 2.0' in text
    assert "# TYPE ray_slotfilm_worker_restarts_total counter" in text
    assert "# TYPE ray_slotfilm_limiter_ratio gauge" in text


def test_prometheus_sees_counts_of_rare_events_at_zero_before_the_first_one():
    sink = PrometheusSink(0, labels={"run": "a"})
    try:
        before = scrape(sink)
        sink.write({"worker_restarts_total/hang": 1})
        after = scrape(sink)
    finally:
        sink.close()
    for reason in RESTART_REASONS:
        line = f'ray_slotfilm_worker_restarts_total{{reason="{reason}",role="worker",run="a",worker=""}}'
        assert f"{line} 0.0" in before
        assert f"{line} {float(reason == 'hang')}" in after
    assert 'ray_slotfilm_checkpoint_failed_total{role="checkpoint",run="a",worker=""} 0.0' in before
    assert "ray_slotfilm_learner_updates_total" not in before


def test_values_that_are_not_finite_are_counted_for_every_sink():
    kept = PrometheusSink(0)
    with FanOut([kept]) as sink:
        sink.write({"learner_critic_loss": math.nan, "learner_q_mean": math.inf})
        sink.write({"learner_q_mean": 2.5})
        text = scrape(kept)
    assert sink.num_nonfinite == 2
    assert 'ray_slotfilm_sink_nonfinite_total{role="sink",worker=""} 2.0' in text


def test_prometheus_histogram_counts_every_observation_once():
    sink = PrometheusSink(0)
    try:
        for wait_s in (0.002, 0.01, 5.0, 99.0):
            sink.write({"learner_batch_wait_s": wait_s})
        text = scrape(sink)
    finally:
        sink.close()
    for bound, count in (("0.001", 0), ("0.003", 1), ("0.01", 2), ("3.0", 2), ("10.0", 3), ("30.0", 3), ("+Inf", 4)):
        assert (
            f'ray_slotfilm_learner_batch_wait_s_bucket{{le="{bound}",role="learner",worker=""}} {float(count)}' in text
        )
    assert 'ray_slotfilm_learner_batch_wait_s_count{role="learner",worker=""} 4.0' in text
    assert 'ray_slotfilm_learner_batch_wait_s_sum{role="learner",worker=""} 104.012' in text


def test_taken_port_leads_to_the_next_free_one():
    first = PrometheusSink(0)
    second = PrometheusSink(first.port)
    try:
        assert second.port is not None
        assert first.port < second.port < first.port + 32
        second.write({"updates": 5})
        assert 'ray_slotfilm_updates{role="run",worker=""} 5.0' in scrape(second)
        assert 'ray_slotfilm_updates{role="run",worker=""} 5.0' not in scrape(first)
    finally:
        first.close()
        second.close()


def test_no_free_port_is_logged_once_and_writing_goes_on(caplog):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 65535))
        taken.listen()
        with caplog.at_level(logging.WARNING):
            sink = PrometheusSink(65535)
            sink.write({"updates": 1})
            sink.write({"updates": 2})
        sink.close()
    assert sink.port is None
    assert len(caplog.records) == 1


def test_closed_prometheus_sink_frees_its_port():
    first = PrometheusSink(0)
    first.close()
    second = PrometheusSink(first.port)
    second.close()
    assert second.port == first.port


def test_failing_sink_never_stops_the_others_and_warns_once(tmp_path, caplog):
    path = tmp_path / "metrics.jsonl"
    broken = Broken()
    with caplog.at_level(logging.WARNING), FanOut([broken, JsonLinesSink(path)]) as sink:
        for step in range(3):
            sink.write({"env_steps": step})
        assert len(caplog.records) == 1
    assert broken.writes == 3
    assert sink.num_failures == [3, 0]
    assert [line["env_steps"] for line in lines_of(path)] == [0, 1, 2]
    assert lines_of(path)[-1]["sink_failures_total"] == 2


def test_fan_out_refuses_an_unknown_name_before_it_writes(tmp_path):
    path = tmp_path / "metrics.jsonl"
    sink = FanOut([JsonLinesSink(path)])
    with pytest.raises(ValueError, match="unknown metric"):
        sink.write({"no_such_thing": 1.0})
    assert path.read_bytes() == b""
    assert sink.num_failures == [0]
