import dataclasses
import json

import pytest

from slotfilm_dist.config_files import load_config, save_config
from slotfilm_dist.evaluation.study.collection import Grid, Trial, collect_study
from slotfilm_dist.tuning.ledger import directory_of


def test_runs_are_ordered_by_variant_and_seed(tmp_path, write_small_run):
    for variant, seed in (("state_only", 1), ("slotfilm", 1), ("state_only", 0), ("slotfilm", 0)):
        write_small_run(tmp_path, variant, seed)
    study = collect_study(tmp_path)
    found = [(run.variant, run.seed) for run in study.runs]
    assert found == [("slotfilm", 0), ("slotfilm", 1), ("state_only", 0), ("state_only", 1)]
    assert study.variants == ("slotfilm", "state_only")
    assert study.left_out == ()


def test_every_variant_of_one_base_belongs_to_the_study(tmp_path, write_small_run):
    names = ("slotfilm", "cnn", "drq", "drqv2", "drqv2_state", "end_to_end", "slots_4", "reward_scale_5", "no_static")
    for name in names:
        write_small_run(tmp_path, name, 0)
    assert {run.variant for run in collect_study(tmp_path).runs} == set(names)


def test_variants_are_comparable_without_the_proposed_agent(tmp_path, write_small_run):
    for name in ("state_only", "drqv2", "cnn"):
        write_small_run(tmp_path, name, 0)
    assert len(collect_study(tmp_path).runs) == 3


def test_a_run_of_other_settings_is_named_and_left_out(tmp_path, write_small_run, small_base):
    for seed in (0, 1):
        write_small_run(tmp_path, "slotfilm", seed)
    other = dataclasses.replace(small_base, sac=dataclasses.replace(small_base.sac, gamma=0.5))
    write_small_run(tmp_path, "state_only", 0, base=other)
    study = collect_study(tmp_path)
    assert study.variants == ("slotfilm",)
    assert len(study.left_out) == 1
    assert study.left_out[0].startswith("state_only-s0: other settings")
    assert "sac.gamma" in study.left_out[0]


def test_a_variant_that_was_changed_by_hand_is_left_out(tmp_path, write_small_run, small_base):
    write_small_run(tmp_path, "slotfilm", 0)
    write_small_run(tmp_path, "slotfilm", 1)
    longer = dataclasses.replace(small_base, schedule=dataclasses.replace(small_base.schedule, total_steps=3000))
    write_small_run(tmp_path, "drqv2", 0, base=longer)
    assert "schedule.total_steps" in collect_study(tmp_path).left_out[0]


def test_places_checkpoints_and_evaluations_may_differ(tmp_path, write_small_run, small_base):
    write_small_run(tmp_path, "slotfilm", 0)
    elsewhere = dataclasses.replace(
        small_base,
        runtime=dataclasses.replace(small_base.runtime, mode="local", num_workers=7),
        evaluation=dataclasses.replace(small_base.evaluation, episodes=20),
        replay=dataclasses.replace(small_base.replay, num_shards=4),
    )
    write_small_run(tmp_path, "slotfilm", 1, base=elsewhere)
    assert [run.seed for run in collect_study(tmp_path).runs] == [0, 1]


def test_an_unfinished_run_is_in_no_number_but_known(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    write_small_run(tmp_path, "slotfilm", 1, over=False)
    study = collect_study(tmp_path)
    assert [run.seed for run in study.runs] == [0]
    assert [run.seed for run in study.unfinished] == [1]


def test_a_final_evaluation_from_before_the_run_was_prolonged_does_not_end_it(tmp_path, write_small_run):
    path = write_small_run(tmp_path, "slotfilm", 0)
    config = load_config(path / "config.json")
    longer = dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, total_steps=3000))
    save_config(longer, path / "config.json")
    study = collect_study(tmp_path)
    assert (len(study.runs), len(study.unfinished)) == (0, 1)


def test_the_same_variant_and_seed_counts_once(tmp_path, write_small_run):
    write_small_run(tmp_path / "a", "slotfilm", 0)
    write_small_run(tmp_path / "b", "slotfilm", 0)
    study = collect_study(tmp_path)
    assert len(study.runs) == 1
    assert study.left_out == ("b/slotfilm-s0: slotfilm with seed 0 is there twice; a/slotfilm-s0 counts.",)


@pytest.mark.parametrize("over", [True, False])
def test_an_unfinished_run_whose_seed_is_there_already_is_named(tmp_path, write_small_run, over):
    write_small_run(tmp_path / "a", "slotfilm", 0, over=False)
    write_small_run(tmp_path / "b", "slotfilm", 0, over=over)
    study = collect_study(tmp_path)
    assert (len(study.runs), len(study.unfinished)) == ((1, 0) if over else (0, 1))
    kept, left_out = ("b", "a") if over else ("a", "b")
    expected = f"{left_out}/slotfilm-s0: slotfilm with seed 0 is there twice; {kept}/slotfilm-s0 counts."
    assert study.left_out == (expected,)


def test_a_damaged_config_is_named(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    (write_small_run(tmp_path, "slotfilm", 1) / "config.json").write_text("{")
    study = collect_study(tmp_path)
    assert len(study.runs) == 1
    assert study.left_out[0].startswith("slotfilm-s1: its config.json cannot be read")


def test_trials_that_failed_or_never_began_are_named(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    trials = (
        Trial(path=tmp_path / "slotfilm-s0", kind="trial", variant="slotfilm", seed=0, state="done"),
        Trial(
            path=tmp_path / "cnn-s0-ab", kind="trial", variant="cnn", seed=0, state="failed", error="ValueError: boom"
        ),
        Trial(path=tmp_path / "drq-s0-cd", kind="trial", variant="drq", seed=0, state="waiting"),
    )
    assert collect_study(tmp_path, [Grid(path=tmp_path, trials=trials, commands=())]).left_out == (
        "cnn-s0-ab: failed, ValueError: boom.",
        "drq-s0-cd: waiting, not begun.",
    )


def test_a_grid_s_job_that_made_an_encoder_is_no_run_of_the_study(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    (tmp_path / "making").mkdir()
    maker = directory_of(tmp_path, "encoder-ab", "encoder")
    write_small_run(tmp_path, "slotfilm", 1, pretrained=True).rename(maker)
    trials = (Trial(path=maker, kind="encoder", variant="slotfilm", seed=1, state="done"),)
    study = collect_study(tmp_path, [Grid(path=tmp_path, trials=trials, commands=())])
    assert [run.seed for run in study.runs] == [0]
    assert [record.run_dir for record in study.makers] == [maker]
    assert study.grid_of(study.makers[0]) is study.grids[0]


def test_jobs_of_two_grids_may_have_the_same_names(tmp_path, write_small_run):
    write_small_run(tmp_path / "a", "slotfilm", 0, pretrained=True).rename(tmp_path / "a" / "same")
    write_small_run(tmp_path / "b", "slotfilm", 1).rename(tmp_path / "b" / "same")
    first, second = (
        Grid(
            path=tmp_path / name,
            trials=(Trial(path=tmp_path / name / "same", kind=kind, variant="slotfilm", seed=seed, state="done"),),
            commands=(f"slotfilm grid {name}",),
        )
        for name, kind, seed in (("a", "encoder", 0), ("b", "trial", 1))
    )
    study = collect_study(tmp_path, [first, second])
    assert [run.path for run in study.runs] == [tmp_path / "b" / "same"]
    assert [record.run_dir for record in study.makers] == [tmp_path / "a" / "same"]
    assert study.left_out == ()
    assert study.commands_of([*study.makers, study.runs[0].record]) == ("slotfilm grid a", "slotfilm grid b")


def test_what_a_grid_of_other_settings_made_is_left_out(tmp_path, write_small_run, small_base):
    write_small_run(tmp_path / "a", "slotfilm", 0)
    other = dataclasses.replace(small_base, sac=dataclasses.replace(small_base.sac, gamma=0.5))
    write_small_run(tmp_path / "b", "slotfilm", 0, base=other, pretrained=True).rename(tmp_path / "b" / "encoder-ab")
    trials = (Trial(path=tmp_path / "b" / "encoder-ab", kind="encoder", variant="slotfilm", seed=0, state="done"),)
    study = collect_study(tmp_path, [Grid(path=tmp_path / "b", trials=trials, commands=())])
    assert study.makers == ()
    assert study.left_out[0].startswith("b/encoder-ab: other settings than the rest (sac.gamma)")


def test_a_run_beside_a_grid_has_a_command_of_its_own(tmp_path, write_small_run):
    write_small_run(tmp_path / "grid", "slotfilm", 0)
    alone = write_small_run(tmp_path, "slotfilm", 1)
    study = collect_study(tmp_path, [Grid(path=tmp_path / "grid", trials=(), commands=("slotfilm grid",))])
    own = json.loads((alone / "versions.json").read_text())["command"]
    assert study.commands_of(run.record for run in study.runs) == ("slotfilm grid", own)


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no run that has trained"):
        collect_study(tmp_path)
    with pytest.raises(ValueError, match="is no directory"):
        collect_study(tmp_path / "none")
