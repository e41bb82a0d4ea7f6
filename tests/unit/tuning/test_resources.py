import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from slotfilm_dist.config import RunConfig
from slotfilm_dist.presets import paper, quick, smoke
from slotfilm_dist.tuning.dry_run import describe, show
from slotfilm_dist.tuning.estimate import estimate, total_hours
from slotfilm_dist.tuning.jobs import Job, build_jobs, build_trials
from slotfilm_dist.tuning.places import placement_in_group
from slotfilm_dist.tuning.resources import check_fits, fit_to_resources, job_resources, num_that_fit, runs_on_ray

LAPTOP = [{"CPU": 2.0, "memory": 16e9}]
HOST = [{"CPU": 64.0, "GPU": 2.0, "memory": 256e9}]
SPOT = [
    {"CPU": 64.0, "slotfilm_worker": 1.0, "memory": 256e9},
    {"CPU": 8.0, "slotfilm_state": 1.0, "memory": 64e9},
]


def job(mode: str = "ray", workers: int = 2, preset: RunConfig | None = None, **runtime: object) -> Job:
    base = preset or smoke()
    config = replace(base, runtime=replace(base.runtime, mode=mode, num_workers=workers, **runtime))
    return Job(key="job", kind="trial", config=config)


def test_trial_on_ray_has_a_bundle_for_each_role_and_its_memory_in_that_of_the_driver() -> None:
    given = job_resources(job(inference="worker"), HOST, gpus_per_trial=0.25)
    driver, learner, *others = given.bundles
    assert set(driver) == {"memory"}
    assert learner == {"CPU": 1.0, "GPU": 0.25}
    assert [set(bundle) for bundle in others] == [{"CPU", "memory"}] * 3
    assert given.num_cpus == 4
    assert sum(bundle.get("memory", 0.0) for bundle in given.bundles) == pytest.approx(given.memory_bytes, rel=0.01)


def test_gpu_that_is_asked_for_is_never_left_away() -> None:
    """A node with a GPU may join after the grid began; where none can, the trial is refused."""
    given = job_resources(job(), LAPTOP, gpus_per_trial=0.25)
    assert given.num_gpus == 0.25
    assert job_resources(job(), LAPTOP).num_gpus == 0
    with pytest.raises(ValueError, match=r"0\.25 GPUs"):
        check_fits("job", given, LAPTOP)


def test_nodes_for_workers_and_for_state_are_asked_for_where_there_are_any() -> None:
    driver, learner, *others = job_resources(job(), SPOT).bundles
    # Hub, learner and one shard take 0.001 each; two workers may share any bundle.
    assert driver["slotfilm_state"] == 0.003
    assert learner == {"CPU": 1.0, "slotfilm_state": 0.003}
    assert [bundle["slotfilm_worker"] for bundle in others] == [0.002] * 3
    assert not [bundle for bundle in others if "slotfilm_state" in bundle]
    assert not [bundle for bundle in job_resources(job(), HOST).bundles if {*bundle} - {"CPU", "GPU", "memory"}]


def test_run_in_one_process_lives_where_state_belongs() -> None:
    (bundle,) = job_resources(job("local"), SPOT).bundles
    assert bundle["slotfilm_state"] > 0
    assert "slotfilm_worker" not in bundle


def test_only_nodes_of_the_right_kind_count_for_what_fits() -> None:
    given = job_resources(job(), SPOT)
    assert num_that_fit(given, SPOT) == 8  # one core of the eight for state each, 3 of 64 for workers
    assert num_that_fit(job_resources(job("local"), SPOT), SPOT) == 8
    few = [{"CPU": 64.0, "slotfilm_state": 1.0, "memory": 64e9}, {"CPU": 1.0, "slotfilm_worker": 1.0, "memory": 64e9}]
    assert job_resources(job(), few).role_cpus == 0.25  # three roles on the only core for workers
    small = [SPOT[0], SPOT[1] | {"memory": 1e9}]
    assert num_that_fit(given, small) == 0


def test_learner_waits_for_no_core_where_it_must_live() -> None:
    on_spot, anywhere = job_resources(job(), SPOT), job_resources(job(), [{"CPU": 64.0}])
    assert placement_in_group(job().config, on_spot).learner_cpus == 0.0
    assert placement_in_group(job().config, anywhere).learner_cpus == 1.0


def test_nothing_is_kept_for_central_inference_which_no_trial_has() -> None:
    given = job_resources(job(inference="central"), HOST)
    assert given == job_resources(job(inference="worker"), HOST)
    assert fit_to_resources(job(inference="central").config, given).runtime.inference == "worker"


def test_trial_in_one_process_has_one_bundle() -> None:
    (bundle,) = job_resources(job("local"), LAPTOP, cpus_per_trial=0.5).bundles
    assert bundle["CPU"] == 0.5
    assert "GPU" not in bundle


def test_roles_share_cores_where_one_trial_would_not_fit_otherwise() -> None:
    assert job_resources(job(), LAPTOP).role_cpus == 0.5
    assert job_resources(job(), LAPTOP, cpus_per_trial=1).role_cpus == 0.25
    assert num_that_fit(job_resources(job(), LAPTOP, cpus_per_trial=1), LAPTOP) == 2


def test_memory_and_gpus_bound_how_many_fit() -> None:
    big = job("local", preset=replace(paper(), encoder=replace(paper().encoder, backbone="random")))
    assert num_that_fit(job_resources(big, HOST), HOST) == 2
    assert num_that_fit(job_resources(big, HOST, gpus_per_trial=0.25), HOST) == 8
    assert num_that_fit(job_resources(big, LAPTOP), LAPTOP) == 2
    assert num_that_fit(job_resources(job("local", device="cuda"), LAPTOP), LAPTOP) == 0


def test_trial_without_room_is_refused_with_what_it_asks_for() -> None:
    given = job_resources(job("local", device="cuda"), LAPTOP)
    with pytest.raises(ValueError, match=r"slotfilm asks for 1 cores, 1 GPUs .* the cluster has 2, 0"):
        check_fits("slotfilm", given, LAPTOP)
    check_fits("slotfilm", job_resources(job("local"), LAPTOP), LAPTOP)


@pytest.mark.parametrize(("cpus", "gpus"), [(0.0, None), (-1.0, None), (None, -0.5), (None, 1.5)])
def test_impossible_shares_are_refused(cpus: float | None, gpus: float | None) -> None:
    with pytest.raises(ValueError, match=r"--[cg]pus-per-trial"):
        job_resources(job(), HOST, cpus, gpus)


def test_trial_spreads_only_where_every_role_gets_a_core() -> None:
    assert not runs_on_ray(job().config, LAPTOP)
    assert runs_on_ray(job().config, HOST)
    assert not runs_on_ray(job(workers=63).config, HOST)


def test_trial_keeps_to_its_cores() -> None:
    config = job(auto_workers=True).config
    fitted = fit_to_resources(config, job_resources(job(inference="worker"), HOST, cpus_per_trial=8))
    assert fitted.runtime.learner_threads == 2
    assert not fitted.runtime.auto_workers
    own = replace(config, runtime=replace(config.runtime, learner_threads=3))
    assert fit_to_resources(own, job_resources(job(), HOST)).runtime.learner_threads == 3


def test_estimate_of_quick_on_ray_with_two_cores_is_within_what_was_measured() -> None:
    base = quick()
    config = replace(base, runtime=replace(base.runtime, mode="ray", num_workers=2))
    jobs = build_jobs(build_trials(config, ["slotfilm"], 1))
    assert len(jobs) == 3
    hours = sum(estimate(job, job_resources(job, [{"CPU": 2.0, "memory": 8e9}])).hours for job in jobs)
    assert 4.0 < 60 * hours < 6.5


def test_estimate_grows_with_steps_updates_and_pictures() -> None:
    def hours(config: RunConfig, variant: str = "slotfilm") -> float:
        trial = build_jobs(build_trials(config, [variant], 1))[-1]
        return estimate(trial, job_resources(job("local"), LAPTOP)).hours

    base = paper()
    half = replace(base, schedule=replace(base.schedule, total_steps=650_000))
    fewer = replace(base, schedule=replace(base.schedule, updates_per_step=0.5))
    assert hours(half) == pytest.approx(hours(base) / 2, rel=0.05)
    assert hours(fewer) < hours(base)
    assert hours(base, "state_only") < hours(base) < hours(base, "cnn") < hours(base, "drq")
    # 1.1 M updates of 14.2 ms and as many steps of 24.9 ms are 12 h; evaluations come on top.
    assert 12 < hours(base) < 14


def test_places_are_shared_and_a_trial_waits_for_its_artifacts() -> None:
    jobs = build_jobs(build_trials(smoke(), ["slotfilm", "no_state", "state_only"], 1))
    given = job_resources(job("local"), LAPTOP)
    estimates = {j.key: estimate(j, given) for j in jobs}
    one, many = total_hours(jobs, estimates, 1), total_hours(jobs, estimates, 100)
    assert one == pytest.approx(sum(e.hours for e in estimates.values()))
    trial = jobs[-2]
    assert many >= estimates[trial.key].hours + sum(estimates[key].hours for key in trial.needs)
    assert many < one


@pytest.mark.parametrize(("variants", "named"), [(["slotfilm", "no_state", "drq"], ["drq"]), (["slotfilm"], [])])
def test_dry_run_names_the_few_variants_that_take_most_of_the_hours(variants: list[str], named: list[str]) -> None:
    base = quick()
    jobs = build_jobs(build_trials(replace(base, runtime=replace(base.runtime, mode="local")), variants, 2))
    plan = describe(jobs, jobs, {job.key: job_resources(job, LAPTOP) for job in jobs}, LAPTOP, 0)
    assert list(plan["hours_by_name"]) == [*named, *(v for v in variants if v not in named)]
    trials = [row for row in plan["jobs"] if row["kind"] == "trial"]
    assert sum(plan["hours_by_name"].values()) == pytest.approx(sum(row["hours"] for row in trials))
    written = io.StringIO()
    show(plan, Path("grid"), Console(file=written, width=200))
    assert ("Most of the hours are those of drq (" in written.getvalue()) is bool(named)


def test_dry_run_names_what_has_no_room() -> None:
    jobs = build_jobs(build_trials(paper(), ["slotfilm", "cnn"], 1))
    jobs = [replace(j, config=replace(j.config, runtime=replace(j.config.runtime, mode="local"))) for j in jobs]
    resources = {j.key: job_resources(j, LAPTOP) for j in jobs}
    plan = describe(jobs, jobs, resources, LAPTOP, 0)
    assert plan["no_room"] == [jobs[-1].key]
    assert (plan["trials"], plan["to_do"], plan["at_once"]) == (2, 2, 2)
    assert plan["disk_bytes"] > plan["kept_bytes"] > 0
