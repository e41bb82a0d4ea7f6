import json

import pytest

from slotfilm_dist.evaluation.study.collection import Grid, collect_study
from slotfilm_dist.evaluation.study.how_to import measure_command, train_commands


def test_missing_variants_are_trained_like_the_run_at_hand(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 3)
    commands = train_commands(collect_study(tmp_path), ["cnn", "drq"])
    common = f"slotfilm train smoke --runs {tmp_path.name} --variant"
    assert commands == (f"{common} cnn --seed 3", f"{common} drq --seed 3")


@pytest.mark.parametrize(
    ("recorded", "common"),
    [
        ("slotfilm train --name foo quick", "slotfilm train quick"),
        ("slotfilm train --name=foo quick", "slotfilm train quick"),
        ("slotfilm train quick --seed 3 --variant", "slotfilm train quick"),
        ("slotfilm train quick --runs '/a b/c'", "slotfilm train quick --runs '/a b/c'"),
        ("slotfilm train quick --runs /home/o'brien/runs", """slotfilm train quick --runs '/home/o'"'"'brien/runs'"""),
    ],
)
def test_recorded_command_keeps_all_but_the_options_of_one_run(tmp_path, write_small_run, recorded, common):
    path = write_small_run(tmp_path, "slotfilm", 0)
    (path / "versions.json").write_text(json.dumps({"command": recorded}))
    assert train_commands(collect_study(tmp_path), ["cnn"]) == (f"{common} --variant cnn --seed 0",)


@pytest.mark.parametrize(
    "given",
    [
        "slotfilm grid quick --only slotfilm,no_state --seeds 2",
        "slotfilm grid quick --only slotfilm --only no_state --seeds 2 --json",
        "slotfilm grid quick --exclude=cnn --seeds 2",
        "slotfilm grid --only slotfilm quick --seeds 2",
    ],
)
def test_missing_variants_of_a_grid_are_trained_by_its_own_command(tmp_path, write_small_run, given):
    write_small_run(tmp_path, "slotfilm", 0)
    grid = Grid(path=tmp_path, trials=(), commands=("slotfilm grid quick --seeds 1", given))
    study = collect_study(tmp_path, [grid])
    assert train_commands(study, ["cnn", "drq"]) == ("slotfilm grid quick --seeds 2 --only cnn,drq",)


def test_a_measurement_is_of_the_run_s_directory(tmp_path, write_small_run):
    path = write_small_run(tmp_path, "slotfilm", 0)
    run = collect_study(tmp_path).runs[0]
    assert measure_command(run, "evaluate RUN --what perception") == f"slotfilm evaluate {path} --what perception"
