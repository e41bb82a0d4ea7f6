"""Shares of the reward's components over training, against sums done by hand."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from slotfilm_dist.config import RewardConfig, RunConfig
from slotfilm_dist.config_files import save_config
from slotfilm_dist.evaluation.record import RunRecord, read_run
from slotfilm_dist.evaluation.reward_windows import component_rows, draw_components, moving_average, window_rows

#        reach grasp place post static
EARLY = (6.0, 1.0, 2.0, 2.0, 3.0)
LATE = (2.0, 5.0, 6.0, 0.0, 1.0)


def run_with(
    folder: Path, episodes: list[tuple[int, tuple[float, ...]]], num_random: int = 0, reward: RewardConfig | None = None
) -> RunRecord:
    base = RunConfig(reward=reward or RewardConfig())
    schedule = dataclasses.replace(base.schedule, total_steps=1200, random_steps=100)
    save_config(
        dataclasses.replace(base, schedule=schedule, replay=dataclasses.replace(base.replay, min_steps=100)),
        folder / "config.json",
    )
    line = {
        "seed": 1,
        "length": 100,
        "success_once": False,
        "success_at_end": False,
        "placed_at_end": False,
        "grasped_once": False,
    }
    text = [
        json.dumps(
            line
            | {"env_steps": steps, "episode_return": sum(terms), "reward_terms": terms}
            | {"policy_version": -1 if i < num_random else 0}
        )
        for i, (steps, terms) in enumerate(episodes)
    ]
    (folder / "episodes.jsonl").write_text("\n".join(text))
    return read_run(folder)


def test_shares_of_each_window_add_up_over_the_tables_three_components(tmp_path: Path) -> None:
    zero = (0.0,) * 5
    record = run_with(tmp_path, [(100, EARLY), (400, (10.0, 0, 0, 0, 0)), (900, LATE), (1000, zero), (1200, LATE)])
    rows = {(r["window"], r["share_of"], r["component"]): r for r in window_rows(record)}
    early = [rows["early", "table_2", name]["mean_percent"] for name in ("reach", "post_grasp", "place")]
    assert early == pytest.approx([(60 + 100) / 2, 20 / 2, 20 / 2])
    assert rows["early", "table_2", "reach"]["std_percent"] == pytest.approx(np.std([60, 100], ddof=1))
    assert rows["late", "table_2", "place"]["mean_percent"] == pytest.approx(75)
    assert rows["late", "all_components", "place"]["mean_percent"] == pytest.approx(100 * 6 / 14)
    assert rows["late", "table_2", "place"]["num_episodes"] == 2  # the one that earned nothing has no shares
    assert not any(window == "mid" for window, _, _ in rows)
    assert (rows["late", "table_2", "place"]["from_step"], rows["late", "table_2", "place"]["to_step"]) == (800, 1200)


def test_episodes_of_the_random_policy_count_nowhere(tmp_path: Path) -> None:
    (tmp_path / "with").mkdir()
    own = [(400, EARLY), (900, LATE)]
    record = run_with(tmp_path / "with", [(100, LATE), *own], num_random=1)
    without = run_with(tmp_path, own)
    assert window_rows(record) == window_rows(without)
    assert component_rows(record) == component_rows(without)
    with pytest.raises(ValueError, match="no training episode yet"):
        window_rows(run_with(tmp_path, own, num_random=2))


def test_components_are_divided_by_their_weights(tmp_path: Path) -> None:
    # Weights 1, 1, 2, 1, 1 divided by 6: a component at its largest gives 100 x weight / 6 in 100 steps.
    full = tuple(100 * w / 6 for w in (1, 1, 2, 1, 1))
    rows = component_rows(run_with(tmp_path, [(100, full), (200, tuple(x / 2 for x in full))]))
    for name in ("reach", "grasp", "place", "post_grasp", "static"):
        assert [row[name] for row in rows] == pytest.approx([1.0, 0.5])
    assert draw_components(rows, tmp_path / "c.png").stat().st_size > 5_000


def test_capped_near_form_counts_in_the_largest_value(tmp_path: Path) -> None:
    # The cap of 10 lifts reach and place to 10 and 20 sixths of a step.
    full = tuple(100 * w / 6 for w in (10, 1, 20, 1, 1))
    rows = component_rows(run_with(tmp_path, [(100, full)], reward=RewardConfig(near_form="inverse")))
    assert [rows[0][name] for name in ("reach", "grasp", "place", "post_grasp", "static")] == pytest.approx([1.0] * 5)


def test_moving_average_is_causal_and_starts_at_the_first_value() -> None:
    assert moving_average(np.array([4.0, 4.0, 4.0]), 0.9) == pytest.approx([4, 4, 4])
    assert moving_average(np.array([0.0, 1.0]), 0.5) == pytest.approx([0, 1 / 1.5])
    rising = moving_average(np.array([0.0, 0.0, 1.0]), 0.9)
    assert (rising[:2] == 0).all()


def test_run_without_episodes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no training episode yet"):
        window_rows(run_with(tmp_path, []))
