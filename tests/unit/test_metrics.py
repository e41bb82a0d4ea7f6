import re

import pytest

from slotfilm_dist.metrics import (
    AXES,
    METRICS,
    PHASES,
    RESTART_REASONS,
    check_names,
    find_metric,
    phase_index,
    zero_counters,
)

ROLES = {
    "inference",
    *("run", "worker", "replay", "limiter", "weights", "learner"),
    *("episode", "eval", "pretrain", "checkpoint", "sink"),
}


def test_every_name_is_snake_case_with_a_known_role():
    for name, metric in METRICS.items():
        assert name == metric.name
        assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name)
        assert metric.role in ROLES
        assert metric.help.endswith(".")
        assert metric.unit


def test_no_metric_is_declared_twice():
    from slotfilm_dist import metrics

    groups = [v for k, v in vars(metrics).items() if k.isupper() and k.startswith("_") and isinstance(v, tuple)]
    assert sum(len(group) for group in groups) == len(METRICS)


def test_exactly_the_counters_end_in_total():
    assert {m.name for m in METRICS.values() if m.kind == "counter"} == {n for n in METRICS if n.endswith("_total")}


def test_unit_suffix_says_the_unit():
    suffixes = {"_s": "s", "_px": "px", "_bytes": "bytes", "_nats": "nats", "_steps": "steps", "_updates": "updates"}
    for name, metric in METRICS.items():
        for suffix, unit in suffixes.items():
            if name.endswith(suffix) and not name.endswith("_per_s"):
                assert metric.unit == unit, name


def test_counts_of_rare_events_begin_at_zero_for_every_reason():
    zeros = zero_counters()
    check_names(zeros)
    assert set(zeros.values()) == {0.0}
    assert {key for key in zeros if key.startswith("learner")} == {
        f"learner_restarts_total/{reason}" for reason in RESTART_REASONS
    }
    assert "checkpoint_failed_total" in zeros
    assert all(m.from_zero for m in METRICS.values() if m.kind == "counter" and m.label_values)
    assert "learner_updates_total" not in zeros


def test_axes_are_metrics_of_the_run():
    assert all(METRICS[name].role == "run" for name in AXES)


def test_unknown_name_is_refused_with_the_nearest_one():
    with pytest.raises(ValueError, match=r"'learner_critic_los'; did you mean 'learner_critic_loss'"):
        find_metric("learner_critic_los")


def test_name_without_resemblance_is_refused_with_where_to_declare_it():
    with pytest.raises(ValueError, match=r"slotfilm_dist/metrics\.py"):
        check_names(["env_steps", "zzz"])


def test_label_is_taken_apart():
    metric, label = find_metric("worker_restarts_total/hang")
    assert (metric.name, label) == ("worker_restarts_total", "hang")
    assert find_metric("episode_reward_term/any_word")[1] == "any_word"


@pytest.mark.parametrize(
    ("key", "problem"),
    [
        ("worker_restarts_total", "needs a reason"),
        ("worker_restarts_total/bad_mood", "must be one of crash, hang"),
        ("learner_critic_loss/x", "takes no label"),
        ("learner_critic_loss/", "takes no label"),
        ("episode_reward_term/", "needs a term"),
    ],
)
def test_wrong_label_is_refused(key, problem):
    with pytest.raises(ValueError, match=problem):
        find_metric(key)


def test_exported_name_has_the_prefix():
    assert METRICS["limiter_ratio"].exported_name == "ray_slotfilm_limiter_ratio"


def test_phase_index_round_trips_and_refuses_other_words():
    assert [PHASES[phase_index(p)] for p in PHASES] == list(PHASES)
    with pytest.raises(ValueError, match="collect, pretrain, train, evaluate"):
        phase_index("training")
