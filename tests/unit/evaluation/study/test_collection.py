import dataclasses

import pytest

from slotfilm_dist.config import load_config, save_config
from slotfilm_dist.evaluation.study.collection import Trial, collect_study


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
    assert "is there twice" in study.left_out[0]


def test_a_damaged_config_is_named(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    (write_small_run(tmp_path, "slotfilm", 1) / "config.json").write_text("{")
    study = collect_study(tmp_path)
    assert len(study.runs) == 1
    assert study.left_out[0].startswith("slotfilm-s1: its config.json cannot be read")


def test_trials_that_failed_or_never_began_are_named(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    trials = [
        Trial(key="slotfilm-s0", kind="trial", variant="slotfilm", seed=0, state="done"),
        Trial(key="cnn-s0-ab", kind="trial", variant="cnn", seed=0, state="failed", error="ValueError: boom"),
        Trial(key="drq-s0-cd", kind="trial", variant="drq", seed=0, state="waiting"),
    ]
    assert collect_study(tmp_path, trials).left_out == (
        "cnn-s0-ab: failed, ValueError: boom.",
        "drq-s0-cd: waiting, not begun.",
    )


def test_a_grid_s_job_that_made_an_encoder_is_no_run_of_the_study(tmp_path, write_small_run):
    write_small_run(tmp_path, "slotfilm", 0)
    write_small_run(tmp_path, "slotfilm", 1, pretrained=True).rename(tmp_path / "encoder-ab")
    trials = [Trial(key="encoder-ab", kind="encoder", variant="slotfilm", seed=1, state="done")]
    study = collect_study(tmp_path, trials)
    assert [run.seed for run in study.runs] == [0]
    assert [record.run_dir.name for record in study.makers] == ["encoder-ab"]


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no run that has trained"):
        collect_study(tmp_path)
    with pytest.raises(ValueError, match="is no directory"):
        collect_study(tmp_path / "none")
