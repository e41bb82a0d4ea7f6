"""Which measurements of several runs may stand side by side, and the commands that made them."""

import json

import pytest

from slotfilm_dist.evaluation.study.collection import collect_study
from slotfilm_dist.evaluation.study.how_to import measure_command, measured_otherwise
from slotfilm_dist.evaluation.study.measurements import in_one_way, measured
from slotfilm_dist.evaluation.study.report import write_study

FRAMES = {"source": "expert", "first_seed": 10_000_000, "episodes": 10, "steps": 0}
PROBED = {"checkpoint": "last", "env_steps": 1500, "frames": FRAMES}
SCORE = {"value": 0.75, "interval": [0.7, 0.8], "null": 0.51}
PROBES = {"contact_auroc": SCORE, "delta_dist_r2": SCORE, "delta_obj_r2": SCORE, "auroc_change": {"noise": SCORE}}
PLAYED = {"checkpoint": "last", "env_steps": 1500, "hold": "frame", "first_seed": 10_000_000}


def write(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values))


def select(folder, write_small_run, name, values_of_seeds, preferred=()):
    """Seeds kept and left out of runs with these measurements, with the measurements themselves."""
    for seed, values in enumerate(values_of_seeds):
        write(write_small_run(folder, "slotfilm", seed) / name, values)
    kept, left_out = in_one_way(measured(collect_study(folder).runs, name), preferred)
    return [m.run.seed for m in kept], [m.run.seed for m in left_out], kept, left_out


@pytest.mark.parametrize(
    "other",
    [
        {"frames": FRAMES | {"episodes": 2}},
        {"frames": FRAMES | {"steps": 50}},
        {"frames": FRAMES | {"first_seed": 7}},
        {"frames": FRAMES | {"source": "runs/other"}},
        {"checkpoint": "best"},
        {"env_steps": 900},
        {"frames": {}},
    ],
)
def test_probe_that_was_made_in_another_way_is_left_out(tmp_path, write_small_run, other):
    values = [PROBED | other, PROBED, PROBED]
    kept, left_out, _, _ = select(tmp_path, write_small_run, "probe/expert-last/probes.json", values)
    assert (kept, left_out) == ([1, 2], [0])


@pytest.mark.parametrize("other", [{"hold": "episode"}, {"first_seed": 7}, {"episodes": {"noise": [{}]}}])
def test_robustness_that_was_measured_in_another_way_is_left_out(tmp_path, write_small_run, other):
    played = PLAYED | {"episodes": {"noise": [{}, {}]}}
    kept, left_out, _, _ = select(tmp_path, write_small_run, "robustness/policy.json", [played | other, played, played])
    assert (kept, left_out) == ([1, 2], [0])


def test_training_that_ended_a_few_steps_apart_is_the_same(tmp_path, write_small_run):
    values = [PROBED | {"env_steps": steps} for steps in (1500, 1503, 1511)]
    kept, left_out, _, _ = select(tmp_path, write_small_run, "probe/expert-last/probes.json", values)
    assert (kept, left_out) == ([0, 1, 2], [])


def test_the_best_checkpoints_of_runs_are_the_same_at_whatever_step(tmp_path, write_small_run):
    values = [PROBED | {"checkpoint": "best", "env_steps": steps} for steps in (700, 1200)]
    kept, _, _, _ = select(tmp_path, write_small_run, "probe/expert-best/probes.json", values)
    assert kept == [0, 1]


def test_files_that_say_nothing_of_how_they_were_made_are_read(tmp_path, write_small_run):
    kept, left_out, found, _ = select(tmp_path, write_small_run, "robustness/policy.json", [{"rows": []}] * 2)
    assert (kept, left_out) == ([0, 1], [])
    assert found[0].options == {}


def test_a_run_with_other_measurements_beside_the_chosen_one_is_not_left_out(tmp_path, write_small_run):
    path = write_small_run(tmp_path, "slotfilm", 0)
    for name in ("random-last", "random-pretrained"):
        write(path / "perception" / name / "quality.json", {"checkpoint": name.split("-")[1]})
    found = measured(collect_study(tmp_path).runs, "perception/*/quality.json")
    kept, left_out = in_one_way(found, ("-pretrained",))
    assert [m.folder.name for m in kept] == ["random-pretrained"]
    assert left_out == []


def test_command_of_a_measurement_gives_all_that_its_file_tells(tmp_path, write_small_run):
    values = PROBED | {"frames": FRAMES | {"source": "my runs/RUN"}}
    _, _, found, _ = select(tmp_path, write_small_run, "probe/expert-last/probes.json", [values])
    expected = f"slotfilm probe {tmp_path}/slotfilm-s0 --checkpoint last --frames 'my runs/RUN' --episodes 10 --steps 0"
    assert measure_command(found[0].run, "probe RUN", found[0].options) == f"{expected} --seed 10000000"


def test_what_is_left_out_is_named_with_what_sets_it_apart(tmp_path, write_small_run):
    values = [PROBED, PROBED, PROBED | {"env_steps": 900, "frames": FRAMES | {"episodes": 2}}]
    _, _, kept, left_out = select(tmp_path, write_small_run, "probe/expert-last/probes.json", values)
    (missing,) = measured_otherwise(left_out, kept[0], "probe RUN")
    assert missing.text == "Measured in another way and left out: slotfilm, seed 2 (--episodes 2, after 900 steps)."
    assert missing.commands == (measure_command(left_out[0].run, "probe RUN", kept[0].options),)
    assert measured_otherwise([], kept[0], "probe RUN") == []


def test_report_pools_only_what_was_measured_in_one_way(tmp_path, write_small_run):
    solved, lost = ({"success_at_end": value, "episode_return": 2.0} for value in (True, False))
    for seed, episodes in enumerate(([solved] * 4, [solved] * 4, [lost] * 3)):
        path = write_small_run(tmp_path / "runs", "slotfilm", seed)
        write(path / "robustness" / "policy.json", PLAYED | {"rows": [], "episodes": {"noise": episodes}})
        probed = PROBED | {"probes": {"policy_input": PROBES, "visual": None}}
        probed["frames"] = FRAMES | {"episodes": len(episodes)}
        write(path / "probe" / "expert-last" / "probes.json", probed)
    written = write_study(collect_study(tmp_path / "runs"), tmp_path / "out")
    text = written.page.with_suffix(".md").read_text(encoding="utf-8").replace("\N{NO-BREAK SPACE}", " ")
    assert "| slotfilm, noise | 8 of 8 |" in text
    assert "| slotfilm, policy input | 2 |" in text
    assert text.count("Measured in another way and left out: slotfilm, seed 2 (--episodes 3).") >= 2
    run = f"{tmp_path}/runs/slotfilm-s0"
    options = "--checkpoint last --hold frame --episodes 4 --seed 10000000"
    assert f"slotfilm evaluate {run} --what robustness {options}" in text
