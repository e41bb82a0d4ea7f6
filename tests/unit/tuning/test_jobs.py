from dataclasses import replace

import pytest

from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.jobs import Job, build_jobs, build_trials, meaningless_variants, select_variants
from slotfilm_dist.variants import VARIANTS


def test_study_is_every_variant_but_those_for_validation() -> None:
    assert set(VARIANTS) - set(select_variants([], [])) == {"oracle_state"}
    assert select_variants(["oracle_state", "cnn"], ["cnn"]) == ["oracle_state"]


@pytest.mark.parametrize(("only", "exclude"), [(["state_onyl"], []), ([], ["state_onyl"])])
def test_unknown_variant_is_refused_with_the_nearest(only: list[str], exclude: list[str]) -> None:
    with pytest.raises(ValueError, match=r"state_onyl: no such variant; did you mean 'state_only'"):
        select_variants(only, exclude)


def test_grid_without_a_variant_is_refused() -> None:
    with pytest.raises(ValueError, match="leaves no variant"):
        select_variants(["cnn"], ["cnn"])


def test_on_a_stock_task_the_grid_has_no_variant_that_would_repeat_the_proposed_agent() -> None:
    everything = select_variants([], [])
    on_stackcube = replace(smoke(), env=replace(smoke().env, task="StackCube-v1"))
    own_reward = {"varpi_1", "varpi_10", "no_static", "alpha_5", "alpha_15"}
    assert meaningless_variants(on_stackcube, everything).keys() == own_reward | {"slotfilm_goal"}
    assert meaningless_variants(smoke(), everything) == {}


def test_trials_come_seed_by_seed_from_the_bases_seed_on() -> None:
    trials = build_trials(replace(smoke(), seed=7), ["slotfilm", "cnn"], 2)
    assert [(t.variant, t.seed) for t in trials] == [("slotfilm", 7), ("cnn", 7), ("slotfilm", 8), ("cnn", 8)]
    with pytest.raises(ValueError, match="--seeds 0"):
        build_trials(smoke(), ["slotfilm"], 0)


def test_every_distinct_artifact_is_made_once_and_before_its_trials() -> None:
    variants = ["slotfilm", "no_state", "alpha_5", "state_only", "cnn", "slots_4"]
    jobs = build_jobs(build_trials(smoke(), variants, 1))
    trials = {job.config.variant: job for job in jobs if job.kind == "trial"}
    # State-only has data without pictures; all others, also with another reward, share the proposed agent's.
    assert sum(job.kind == "data" for job in jobs) == 2
    assert sum(job.kind == "encoder" for job in jobs) == 2
    assert trials["slotfilm"].needs == trials["no_state"].needs
    assert trials["alpha_5"].needs == trials["slotfilm"].needs
    assert trials["slots_4"].needs[1] != trials["slotfilm"].needs[1]
    assert len(trials["state_only"].needs) == len(trials["cnn"].needs) == 1
    keys = [job.key for job in jobs]
    assert len(set(keys)) == len(keys)
    for job in jobs:
        assert all(keys.index(need) < keys.index(job.key) for need in job.needs)


def test_data_of_the_whole_study_are_two_sets_a_seed() -> None:
    jobs = build_jobs(build_trials(smoke(), select_variants([], []), 3))
    assert sum(job.kind == "data" for job in jobs) == 6


@pytest.mark.parametrize(("section", "values"), [("reward", {"delta_m": 0.05}), ("success", {"require_static": False})])
def test_data_depend_on_what_decides_success(section: str, values: dict[str, object]) -> None:
    base = smoke()
    other = replace(base, **{section: replace(getattr(base, section), **values)})
    assert build_jobs([other])[0].key != build_jobs([base])[0].key


def test_key_depends_on_what_decides_the_result_and_on_nothing_else() -> None:
    base = smoke()

    def key(config: object) -> str:
        return build_jobs([config])[-1].key  # type: ignore[list-item]  # a RunConfig

    elsewhere = replace(base, runtime=replace(base.runtime, mode="local", num_workers=9))
    longer = replace(base, schedule=replace(base.schedule, total_steps=401))
    assert key(base) == key(elsewhere) == key(replace(base, checkpoint=replace(base.checkpoint, keep=9)))
    assert key(longer) != key(base)
    assert key(base).startswith("slotfilm-s0-")


def test_trial_is_never_taken_for_an_artifact(tmp_path) -> None:
    trial, data = Job(key="a", kind="trial", config=smoke()), Job(key="b", kind="data", config=smoke())
    for job in (trial, data):
        (tmp_path / job.key).mkdir()
        assert not job.artifact_is_there(tmp_path)
        (tmp_path / job.key / "manifest.json").touch()
    assert not trial.artifact_is_there(tmp_path)
    assert data.artifact_is_there(tmp_path)
