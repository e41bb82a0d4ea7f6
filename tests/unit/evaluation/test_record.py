import json

import numpy as np
import pytest

from slotfilm_dist.evaluation.record import read_run, save_evaluation, summarize
from slotfilm_dist.sinks import JsonLinesSink


def test_steps_that_a_resume_repeated_count_once(tmp_path):
    sink = JsonLinesSink(tmp_path / "metrics.jsonl")
    for env_steps, value in ((10, 1), (20, 2), (30, 3), (20, 20), (30, 30), (40, 40)):
        sink.write({"env_steps": env_steps, "learner_q_mean": value})
    sink.write({"env_steps": 50, "learner_q_mean": float("nan")})
    steps, values = read_run(tmp_path).series("learner_q_mean")
    assert steps.tolist() == [10, 20, 20, 30, 40]
    assert values.tolist() == [1, 2, 20, 30, 40]


def test_evaluation_reads_back_as_it_was_saved(tmp_path, make_evaluation):
    evaluation = make_evaluation("step-400", 400, 0.5, 3, np.random.default_rng(0))
    save_evaluation(evaluation, tmp_path)
    assert read_run(tmp_path).evaluations == (evaluation,)


def test_evaluation_without_episodes_is_refused():
    with pytest.raises(ValueError, match=r"evaluation\.episodes"):
        summarize("final", "trained", 0, (), ("reach",))


def test_training_episodes_that_a_resume_repeated_count_once(tmp_path, write_run):
    run_dir = write_run(tmp_path / "run", finished=False)
    lines = (run_dir / "episodes.jsonl").read_text().splitlines()
    repeated = [json.loads(line) | {"seed": 7} for line in lines[-10:]]
    with (run_dir / "episodes.jsonl").open("a") as file:
        file.writelines(json.dumps(line) + "\n" for line in repeated[:5])
    episodes = read_run(run_dir).episodes
    assert len(episodes) == len(lines) - 4
    assert [e.summary.seed for e in episodes[-5:]] == [7] * 5


def test_without_names_reward_components_are_numbered(tmp_path, write_run):
    run_dir = write_run(tmp_path / "run", finished=False)
    assert read_run(run_dir).reward_term_names == ("reach", "grasp", "place", "post_grasp", "static")
    (run_dir / "evaluation" / "step-50000.json").unlink()
    assert read_run(run_dir).reward_term_names == ("term 1", "term 2", "term 3", "term 4", "term 5")


def test_newest_evaluation_stands_in_until_the_final_one_exists(tmp_path, make_evaluation):
    rng = np.random.default_rng(0)
    for name, env_steps in (("random", 0), ("step-400", 400), ("step-1200", 1200)):
        save_evaluation(make_evaluation(name, env_steps, 0.5, 2, rng), tmp_path)
    assert read_run(tmp_path).best_known.name == "step-1200"
    save_evaluation(make_evaluation("final", 1200, 0.5, 2, rng), tmp_path)
    assert read_run(tmp_path).best_known.name == "final"
