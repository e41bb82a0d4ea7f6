"""What a run directory says: its files read into typed records, with a name for everything that is missing.

A run that is still going, was cut short or is damaged in part is read as far as it goes; each gap becomes one sentence
in `RunRecord.missing`. A run that was resumed repeats some steps: what the repetition replaced is left out. Random data
that had to be collected once more replace the data alone, not what was learned since.
"""

import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import load_config
from slotfilm_dist.evaluation.statistics import not_superseded, wilson_interval
from slotfilm_dist.messages import EpisodeSummary, TrainingEpisode

AGENT = "trained, deterministic"
"""What `Evaluation.policy` says of a run's own agent."""
BEFORE_RL = ("collect", "pretrain")
"""Phases that a resumed run may go through once more while its agent has trained for long."""
Points = Float64[np.ndarray, " points"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation:
    """One evaluation: a policy, frozen, on the seeds of the held-out range."""

    name: str
    """`final`, `random`, or `step-50000`."""
    policy: str
    """Who acted, as in `trained, deterministic` or `random`."""
    env_steps: int
    """Environment steps that the policy had learned from."""
    episodes: tuple[EpisodeSummary, ...]
    mean_return: float
    """Mean unscaled return."""
    std_return: float
    """Standard deviation of the return between episodes, with n - 1."""
    success_rate: float
    """Share of the episodes solved at their last step."""
    success_interval: tuple[float, float]
    """95 % Wilson interval of that share."""
    reward_term_names: tuple[str, ...]

    @property
    def returns_by_seed(self) -> dict[int, float]:
        """Unscaled return of each seed."""
        return {e.seed: e.episode_return for e in self.episodes}


def summarize(
    name: str, policy: str, env_steps: int, episodes: tuple[EpisodeSummary, ...], reward_term_names: tuple[str, ...]
) -> Evaluation:
    """The evaluation that these episodes make; raises ``ValueError`` without episodes."""
    if not episodes:
        raise ValueError(f"evaluation {name!r} has no episodes: set evaluation.episodes to 1 or more")
    returns = np.array([e.episode_return for e in episodes])
    successes = sum(e.success_at_end for e in episodes)
    return Evaluation(
        name=name,
        policy=policy,
        env_steps=env_steps,
        episodes=episodes,
        mean_return=float(returns.mean()),
        std_return=float(returns.std(ddof=1)) if len(returns) > 1 else 0.0,
        success_rate=successes / len(episodes),
        success_interval=wilson_interval(successes, len(episodes)),
        reward_term_names=reward_term_names,
    )


def save_evaluation(evaluation: Evaluation, run_dir: Path) -> Path:
    """Write `evaluation/<name>.json` of the run and give its path."""
    path = run_dir / "evaluation" / f"{evaluation.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(dataclasses.asdict(evaluation), indent=1) + "\n", encoding="utf-8")
    return path


@dataclass(frozen=True, kw_only=True, slots=True)
class RunRecord:
    """Everything a run directory holds."""

    run_dir: Path
    config: RunConfig | None
    versions: dict[str, Any]
    """Packages, machine, command and start, as the run wrote them."""
    lines: tuple[dict[str, Any], ...]
    """The lines of `metrics.jsonl`."""
    episodes: tuple[TrainingEpisode, ...]
    """Episodes of collection and training, oldest first: the lines of `episodes.jsonl`."""
    evaluations: tuple[Evaluation, ...]
    """By environment steps."""
    videos: tuple[Path, ...]
    missing: list[str] = field(default_factory=list)
    """What is not there and how to get it, one sentence each."""

    @property
    def learning_episodes(self) -> tuple[TrainingEpisode, ...]:
        """Those in which the agent acted; the random policy's have a length of their own and teach nothing yet."""
        return tuple(e for e in self.episodes if e.policy_version >= 0)

    def series(self, key: str, axis: str = "env_steps") -> tuple[Points, Points]:
        """A metric over an axis: positions and values, without nulls and what a resume replaced."""
        lines = [r for r in self.lines if _is_number(r.get(key)) and _is_number(r.get(axis))]
        x, y = np.array([(r[axis], r[key]) for r in lines], dtype=np.float64).reshape(-1, 2).T
        kept = _not_repeated(x, [r.get("phase") in BEFORE_RL for r in lines])
        return x[kept], y[kept]

    def last(self, key: str) -> float | None:
        """The newest value of a metric; None if it was never written."""
        return next((float(line[key]) for line in reversed(self.lines) if _is_number(line.get(key))), None)

    def evaluation(self, name: str) -> Evaluation | None:
        """The evaluation of that name, if the run has one."""
        return next((e for e in self.evaluations if e.name == name), None)

    @property
    def final(self) -> Evaluation | None:
        """The agent's evaluation at the end of its training; one that was made before the run was extended is not."""
        found = self.evaluation("final")
        planned = self.config.schedule.total_steps if self.config else 0
        return found if found and found.env_steps >= planned else None

    @property
    def of_agent(self) -> list[Evaluation]:
        """Evaluations of what the run trained: not of the random policy, nor of the expert."""
        return [e for e in self.evaluations if e.policy == AGENT]

    @property
    def best_known(self) -> Evaluation | None:
        """The agent's final evaluation, or while there is none the one that had learned from most steps."""
        return self.final or (self.of_agent[-1] if self.of_agent else None)

    @property
    def reward_term_names(self) -> tuple[str, ...]:
        """Names of the reward's components; numbered ones while no evaluation has named them."""
        named = next((e.reward_term_names for e in self.evaluations if e.reward_term_names), ())
        count = len(self.episodes[0].summary.reward_terms) if self.episodes else len(named)
        return named if len(named) == count else tuple(f"term {i + 1}" for i in range(count))


def read_run(run_dir: Path) -> RunRecord:
    """Read a run directory.

    Raises:
        ValueError: the directory does not exist.
    """
    if not run_dir.is_dir():
        raise ValueError(f"{run_dir} is no directory: give the directory of a run, which holds its config.json")
    missing: list[str] = []
    lines = tuple(_json_lines(run_dir / "metrics.jsonl", missing, "no curves of learning can be drawn"))
    record = RunRecord(
        run_dir=run_dir,
        config=_config(run_dir / "config.json", missing),
        versions=_json_object(run_dir / "versions.json", missing, "versions, machine and command are unknown"),
        lines=lines,
        episodes=_episodes(run_dir / "episodes.jsonl", missing),
        evaluations=_evaluations(run_dir / "evaluation", missing, _replaced_steps(lines)),
        videos=tuple(sorted((run_dir / "videos").glob("*.mp4"))),
        missing=missing,
    )
    if not record.final:
        missing.append(
            "evaluation/final.json: the run has no final evaluation yet; `slotfilm train --resume` on it writes one."
        )
    if not record.evaluation("random"):
        missing.append(
            "evaluation/random.json: the random policy was not evaluated, so nothing says what chance gives."
        )
    if not record.videos:
        missing.append("videos/*.mp4: no rollout was recorded; evaluation.videos is how many the end of a run records.")
    return record


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_endless(value: object) -> bool:
    """NaN or infinity, which no run writes and no curve can show."""
    return isinstance(value, float) and not math.isfinite(value)


def _config(path: Path, missing: list[str]) -> RunConfig | None:
    try:
        return load_config(path)
    except ValueError as error:
        missing.append(f"config.json: {str(error).replace(str(path), 'the file')}.")
        return None


def _json_object(path: Path, missing: list[str], consequence: str) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        missing.append(f"{path.name} is not there: {consequence}.")
        return {}
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        missing.append(f"{path.name} is not valid JSON ({error}): {consequence}.")
        return {}
    return content if isinstance(content, dict) else {}


def _json_lines(path: Path, missing: list[str], consequence: str) -> Iterator[dict[str, Any]]:
    if not path.exists():
        missing.append(f"{path.name} is not there: {consequence}.")
        return
    unreadable = 0
    for raw in path.read_bytes().splitlines():
        try:
            line = json.loads(raw)
        except (ValueError, RecursionError):  # also bytes that are no text, and numbers of thousands of digits
            line = None
        if isinstance(line, dict):
            yield {key: None if is_endless(value) else value for key, value in line.items()}
        else:
            unreadable += 1
    if unreadable:
        missing.append(f"{path.name}: {unreadable} unreadable line(s) left out, as a crash leaves them.")


def _episode(values: dict[str, Any]) -> EpisodeSummary:
    fields = {f.name: values[f.name] for f in dataclasses.fields(EpisodeSummary)}
    fields["episode_return"] = float(fields["episode_return"])
    fields["reward_terms"] = tuple(float(term) for term in fields["reward_terms"])
    return EpisodeSummary(**fields)


def _episodes(path: Path, missing: list[str]) -> tuple[TrainingEpisode, ...]:
    episodes = []
    for line in _json_lines(path, missing, "training returns cannot be shown"):
        try:
            summary = _episode(line)
            episodes.append(
                TrainingEpisode(
                    summary=summary, env_steps=int(line["env_steps"]), policy_version=int(line["policy_version"])
                )
            )
        except KeyError as error:
            missing.append(f"{path.name}: a line without {error}; its episode is left out.")
        except (TypeError, ValueError) as error:
            missing.append(f"{path.name}: a line that is no episode ({error}); it is left out.")
    steps = np.array([e.env_steps for e in episodes], dtype=np.float64)
    return tuple(episodes[i] for i in _not_repeated(steps, [e.policy_version < 0 for e in episodes]))


def _not_repeated(steps: Points, before_rl: Sequence[bool]) -> Int64[np.ndarray, " kept"]:
    """Indices of the points that count, in the order of their steps; those before RL and of it are judged apart."""
    early = np.array(before_rl, dtype=bool)
    kept = np.zeros(len(steps), dtype=bool)
    for part in (early, ~early):
        kept[part] = not_superseded(steps[part])
    indices = np.flatnonzero(kept)
    return indices[np.argsort(steps[indices], kind="stable")]


def _replaced_steps(lines: Sequence[dict[str, Any]]) -> set[float]:
    """Steps of evaluations that a resume has gone back behind and not made again."""
    made = [r["env_steps"] for r in lines if _is_number(r.get("eval_return")) and _is_number(r.get("env_steps"))]
    steps = np.array(made, dtype=np.float64)
    return set(steps) - set(steps[not_superseded(steps)])


def _evaluations(folder: Path, missing: list[str], replaced: set[float]) -> tuple[Evaluation, ...]:
    evaluations = []
    for path in sorted(folder.glob("*.json")):
        values = _json_object(path, missing, "this evaluation is left out")
        try:
            evaluations.append(_evaluation(values))
        except (KeyError, TypeError, ValueError) as error:
            missing.append(f"evaluation/{path.name}: incomplete ({error}), left out.")
    kept = [e for e in evaluations if not (e.name.startswith("step-") and e.env_steps in replaced)]
    return tuple(sorted(kept, key=lambda e: (e.env_steps, e.name == "final")))


def _evaluation(values: dict[str, Any]) -> Evaluation:
    low, high = values["success_interval"]
    return Evaluation(
        name=values["name"],
        policy=values["policy"],
        env_steps=values["env_steps"],
        episodes=tuple(_episode(e) for e in values["episodes"]),
        mean_return=float(values["mean_return"]),
        std_return=float(values["std_return"]),
        success_rate=float(values["success_rate"]),
        success_interval=(float(low), float(high)),
        reward_term_names=tuple(values["reward_term_names"]),
    )
