import dataclasses
import json

import numpy as np
import pytest

from slotfilm_dist.config_files import load_config, save_config
from slotfilm_dist.evaluation.page import write_page
from slotfilm_dist.evaluation.record import read_run, save_evaluation, summarize
from slotfilm_dist.metrics import phase_index
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


def test_random_data_collected_once_more_leaves_what_was_learned_since(tmp_path, write_run):
    run_dir = write_run(tmp_path / "run", finished=True)
    before = read_run(run_dir)
    lines = (run_dir / "episodes.jsonl").read_text().splitlines()
    again = [line for line in map(json.loads, lines) if line["env_steps"] <= 20_000]
    with (run_dir / "episodes.jsonl").open("a") as file:
        file.writelines(json.dumps(line | {"env_steps": line["env_steps"] - 1}) + "\n" for line in again)
    sink = JsonLinesSink(run_dir / "metrics.jsonl")
    for step in range(400, 20_001, 400):
        sink.write({"env_steps": step, "phase": phase_index("collect"), "run_memory_bytes": 1e9})
    after = read_run(run_dir)
    assert [e.env_steps for e in after.episodes[: len(again)]] == list(range(399, 20_000, 400))
    assert after.episodes[len(again) :] == before.episodes[len(again) :]
    assert len(after.series("run_memory_bytes")[0]) == len(before.series("run_memory_bytes")[0]) + len(again)
    assert np.all(np.diff(after.series("run_memory_bytes")[0]) >= 0)


def test_evaluation_that_a_resume_went_back_behind_is_left_out(tmp_path, make_evaluation):
    rng = np.random.default_rng(0)
    sink = JsonLinesSink(tmp_path / "metrics.jsonl")
    for step in (18_010, 12_000, 18_003):
        sink.write({"env_steps": step, "phase": phase_index("train"), "eval_return": 1.0})
    for step in (18_010, 18_003):
        save_evaluation(make_evaluation(f"step-{step}", step, 0.5, 2, rng), tmp_path)
    assert [e.name for e in read_run(tmp_path).evaluations] == ["step-18003"]


def test_evaluation_from_before_the_run_was_extended_is_not_its_final_one(tmp_path, write_run, make_evaluation):
    run_dir = write_run(tmp_path / "run", finished=True)
    assert read_run(run_dir).final is not None
    config = load_config(run_dir / "config.json")
    schedule = dataclasses.replace(config.schedule, total_steps=300_000)
    save_config(dataclasses.replace(config, schedule=schedule), run_dir / "config.json")
    save_evaluation(make_evaluation("step-200000", 200_000, 0.9, 2, np.random.default_rng(0)), run_dir)
    record = read_run(run_dir)
    assert record.final is None
    assert record.best_known.name == "step-200000"
    assert any("no final evaluation yet" in sentence for sentence in record.missing)
    page = write_page(run_dir).read_text()
    assert "The final policy" not in page
    assert "evaluate: not yet" in page


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


def test_expert_and_random_policy_never_stand_in_for_the_agent(tmp_path, make_evaluation):
    rng = np.random.default_rng(0)
    policies = {"random": "random", "random-10000000-2": "random", "expert-10000000-2": "scripted expert"}
    for name, policy in policies.items():
        save_evaluation(dataclasses.replace(make_evaluation(name, 0, 0.5, 2, rng), policy=policy), tmp_path)
    record = read_run(tmp_path)
    assert record.of_agent == []
    assert record.best_known is None
    save_evaluation(make_evaluation("step-50000", 50_000, 0.5, 2, rng), tmp_path)
    assert read_run(tmp_path).best_known.name == "step-50000"


@pytest.mark.parametrize(
    "odd",
    [{"reward_terms": 3}, {"episode_return": "abc"}, {"env_steps": None}, {"policy_version": [1]}],
)
def test_odd_line_of_an_episode_is_left_out_and_told(tmp_path, write_run, odd):
    run = write_run(tmp_path / "run", finished=False)
    before = read_run(run)
    lines = (run / "episodes.jsonl").read_text().splitlines()
    odd_line = json.dumps(json.loads(lines[-1]) | odd)
    (run / "episodes.jsonl").write_text("\n".join([*lines, odd_line, "[" * 100_000]) + "\n")
    after = read_run(run)
    assert after.episodes == before.episodes
    assert any("no episode" in told for told in after.missing)
    assert any("1 unreadable line" in told for told in after.missing)
