from collections.abc import Set

from ray.tune.experiment import Trial
from ray.tune.schedulers import TrialScheduler
from ray.tune.search import Searcher

from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.jobs import Job, build_jobs, build_trials
from slotfilm_dist.tuning.queue import HalvingByReward, JobQueue


class Asked:
    """A queue with names for what it hands out."""

    def __init__(self, jobs: list[Job], there: set[str] | None = None, homeless: Set[str] = frozenset()) -> None:
        self.stopped = False
        self.given_up: dict[str, str] = {}
        self.queue = JobQueue(
            jobs, there or set(), lambda: self.stopped, lambda job, why: self.given_up.update({job.key: why}), homeless
        )

    def next(self) -> str | None:
        answer = self.queue.suggest(f"id-{self}")
        if isinstance(answer, dict):
            self.queue._given[answer["key"]] = self.queue._given.pop(f"id-{self}")
            return answer["key"]
        return answer

    def done(self, key: str, *, error: bool = False) -> None:
        self.queue.on_trial_complete(key, error=error)


def test_trial_waits_for_its_artifacts_and_the_others_go_ahead() -> None:
    jobs = build_jobs(build_trials(smoke(), ["slotfilm", "state_only"], 1))
    slotfilm, state_only = (job for job in jobs if job.kind == "trial")
    asked = Asked(jobs)
    assert {asked.next(), asked.next()} == {slotfilm.needs[0], state_only.needs[0]}
    assert asked.next() is None
    asked.done(state_only.needs[0])
    assert asked.next() == state_only.key
    assert asked.next() is None
    asked.done(slotfilm.needs[0])
    assert asked.next() == slotfilm.needs[1]
    assert asked.next() is None
    asked.done(slotfilm.needs[1])
    assert asked.next() == slotfilm.key
    assert asked.next() == Searcher.FINISHED


def test_artifacts_that_are_there_are_not_waited_for() -> None:
    jobs = build_jobs(build_trials(smoke(), ["slotfilm"], 1))
    assert Asked(jobs[-1:], set(jobs[-1].needs)).next() == jobs[-1].key


def test_lost_artifact_takes_its_trials_along_and_no_others() -> None:
    jobs = build_jobs(build_trials(smoke(), ["slotfilm", "state_only"], 1))
    slotfilm, state_only = (job for job in jobs if job.kind == "trial")
    asked = Asked(jobs)
    for _ in range(2):
        key = asked.next()
        assert key is not None
        asked.done(key, error=key == slotfilm.needs[0])
    assert asked.next() == state_only.key
    assert asked.given_up == {
        slotfilm.needs[1]: f"{slotfilm.needs[0]} could not be made",
        slotfilm.key: f"{slotfilm.needs[0]} could not be made",
    }
    assert asked.next() == Searcher.FINISHED


def test_jobs_that_no_node_holds_are_handed_out_one_at_a_time() -> None:
    jobs = build_jobs(build_trials(smoke(), ["state_only"], 4))
    trials = [job.key for job in jobs if job.kind == "trial"]
    asked = Asked(jobs[-4:], {key for job in jobs for key in job.needs}, homeless={*trials[:3]})
    assert [asked.next(), asked.next(), asked.next()] == [trials[0], trials[3], None]
    asked.done(trials[0])
    assert [asked.next(), asked.next()] == [trials[1], None]


def test_nothing_is_handed_out_after_a_stop() -> None:
    asked = Asked(build_jobs(build_trials(smoke(), ["state_only"], 1)))
    asked.stopped = True
    assert asked.next() == Searcher.FINISHED


def test_halving_compares_within_a_reward_only() -> None:
    jobs = build_jobs(build_trials(smoke(), ["state_only", "no_state", "slotfilm", "alpha_5"], 1))
    marked: list[str] = []
    halving = HalvingByReward({job.key: job for job in jobs}, marked.append)
    trials = [Trial("job", trial_id=job.key, config={"key": job.key}, stub=True) for job in jobs]

    def decide(trial: Trial, episode_return: float) -> str:
        return halving.on_trial_result(None, trial, {"env_steps": 300, "episode_return": episode_return})

    for trial in trials:
        halving.on_trial_add(None, trial)
    data, *_ = trials
    *_, state_only, no_state, slotfilm, alpha_5 = trials
    assert decide(state_only, 9.0) == TrialScheduler.CONTINUE
    assert decide(slotfilm, 10.0) == TrialScheduler.CONTINUE
    assert decide(no_state, 1.0) == TrialScheduler.STOP
    assert decide(alpha_5, 0.1) == TrialScheduler.CONTINUE
    assert decide(data, 0.0) == TrialScheduler.CONTINUE
    assert halving.on_trial_result(None, state_only, {"phase": "evaluate"}) == TrialScheduler.CONTINUE
    assert marked == [no_state.config["key"]]
