"""Gathers the runs of a study: which belong together, which are over, and what else a folder holds and why it is out.

Runs are pooled only where they differ by their variants and seeds alone. Places, checkpoints and the number of
evaluation episodes may differ; everything else that does sets a run apart, and the report says so.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slotfilm_dist.config import CheckpointConfig, EvaluationConfig, RunConfig, RuntimeConfig, changed_fields
from slotfilm_dist.evaluation.record import RunRecord, read_run
from slotfilm_dist.variants import VARIANTS, apply_variant

DEPTH = 3
"""How deep below the folder runs are looked for: a folder of grids holds grids, which hold runs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StudyRun:
    """One run of the study."""

    record: RunRecord
    config: RunConfig

    @property
    def variant(self) -> str:
        """What it trained."""
        return self.config.variant

    @property
    def seed(self) -> int:
        """Its seed."""
        return self.config.seed

    @property
    def path(self) -> Path:
        """Its directory."""
        return self.record.run_dir

    @property
    def env_steps(self) -> int:
        """How far training has come."""
        return self.record.episodes[-1].env_steps if self.record.episodes else 0

    @property
    def is_over(self) -> bool:
        """Whether it has trained as long as it was planned and been evaluated."""
        final = self.record.evaluation("final")
        return final is not None and final.env_steps >= self.config.schedule.total_steps

    @property
    def command(self) -> str:
        """What made it; empty if it did not say."""
        return str(self.record.versions.get("command", ""))


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """A job of a grid as its ledger has it."""

    key: str
    """Name of its directory."""
    kind: str
    variant: str
    seed: int
    state: str
    error: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Study:
    """Runs that may be compared, and what was found beside them."""

    folder: Path
    runs: tuple[StudyRun, ...]
    """Over and comparable, one for each variant and seed, in the order of the variants and seeds."""
    unfinished: tuple[StudyRun, ...]
    """Comparable but not over: drawn as curves, in no number."""
    makers: tuple[RunRecord, ...]
    """Directories of a grid's jobs that made data and encoders for its trials."""
    left_out: tuple[str, ...]
    """One sentence for each run that is in neither, and for each trial of a grid that has no run."""
    commands: tuple[str, ...]
    """What made the study: the grid's commands."""

    @property
    def variants(self) -> tuple[str, ...]:
        """Those with a run that is over, in the order of `slotfilm variants`."""
        return tuple(dict.fromkeys(run.variant for run in self.runs))

    def of(self, variant: str) -> tuple[StudyRun, ...]:
        """The runs of a variant that are over, by seed."""
        return tuple(run for run in self.runs if run.variant == variant)

    @property
    def reference(self) -> StudyRun:
        """The run whose settings stand for all: the proposed agent's where there is one."""
        everyone = (*self.runs, *self.unfinished)
        return next((run for run in everyone if run.variant == "slotfilm"), everyone[0])


def is_run(folder: Path) -> bool:
    """Whether a directory is a run's own."""
    return (folder / "config.json").is_file()


def collect_study(folder: Path, trials: Sequence[Trial] = (), commands: Sequence[str] = ()) -> Study:
    """Read every run below a folder and sort out which of them make a study.

    Args:
        folder: a folder of runs, or a grid's.
        trials: the grid's ledger.
        commands: the grid's commands.

    Raises:
        ValueError: no such folder, or no run in it that has trained.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no directory: give a run, a folder of runs, or a grid")
    kinds = {trial.key: trial for trial in trials}
    runs: list[StudyRun] = []
    makers: list[RunRecord] = []
    left_out: list[str] = []
    for path in _run_directories(folder, DEPTH):
        record = read_run(path)
        trial = kinds.get(path.name)
        if record.config is None:
            left_out.append(f"{_name(path, folder)}: its config.json cannot be read. {record.missing[0]}")
        elif trial is not None and trial.kind != "trial":
            makers.append(record)
        elif not record.episodes:
            left_out.append(f"{_name(path, folder)}: no training episode yet.")
        else:
            runs.append(StudyRun(record=record, config=record.config))
    if not runs:
        raise ValueError(f"{folder} holds no run that has trained; `slotfilm train` or `slotfilm grid` makes some")
    same, others = _comparable(runs)
    left_out += [f"{_name(run.path, folder)}: {why}" for run, why in others]
    over, repeated = _one_a_seed([run for run in same if run.is_over])
    left_out += [f"{_name(run.path, folder)}: {run.variant} with seed {run.seed} is there twice." for run in repeated]
    here = {(run.variant, run.seed) for run in over}
    cut, repeated = _one_a_seed([r for r in same if not r.is_over and (r.variant, r.seed) not in here])
    return Study(
        folder=folder,
        runs=tuple(over),
        unfinished=tuple(cut),
        makers=tuple(makers),
        left_out=(*left_out, *_absent(trials, {run.path.name for run in runs})),
        commands=tuple(commands),
    )


def _run_directories(folder: Path, depth: int) -> Iterator[Path]:
    for path in sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")):
        if is_run(path):
            yield path
        elif depth > 1:
            yield from _run_directories(path, depth - 1)


def _name(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder))


def _absent(trials: Sequence[Trial], present: set[str]) -> Iterator[str]:
    for trial in trials:
        if trial.state in ("failed", "pruned"):
            yield f"{trial.key}: {trial.state}" + (f", {trial.error}" if trial.error else "") + "."
        elif trial.kind == "trial" and trial.key not in present:
            yield f"{trial.key}: {trial.state}, not begun."


def _comparable(runs: Sequence[StudyRun]) -> tuple[list[StudyRun], list[tuple[StudyRun, str]]]:
    """The largest set of runs with the same settings but for their variants, and why the others are not in it."""
    settings = [_settings(run.config) for run in runs]
    kinds = list(dict.fromkeys(settings))
    alien = {a: {b: _differing(a, b) for b in kinds} for a in kinds}

    def followers(kind: RunConfig) -> int:
        return sum(not alien[kind][other] for other in settings)

    chosen = max(kinds, key=lambda kind: (followers(kind), kind.variant == "slotfilm"))
    same = [run for run, kind in zip(runs, settings, strict=True) if not alien[chosen][kind]]
    others = []
    for run, kind in zip(runs, settings, strict=True):
        if fields := alien[chosen][kind]:
            shown = ", ".join(fields[:4]) + (f" and {len(fields) - 4} more" if len(fields) > 4 else "")
            others.append((run, f"other settings than the rest ({shown}); report it from a folder of its own."))
    return same, others


def _settings(config: RunConfig) -> RunConfig:
    """A config without what may differ within a study."""
    return replace(
        config,
        seed=0,
        runtime=RuntimeConfig(),
        checkpoint=CheckpointConfig(),
        evaluation=EvaluationConfig(),
        replay=replace(config.replay, num_shards=1),
    )


def _differing(a: RunConfig, b: RunConfig) -> list[str]:
    """Fields in which two configs differ although neither's variant says so.

    Where one is the proposed agent's, the other must be its variant exactly. Else each may differ in the fields that
    its variant sets, whose values then go unchecked.
    """
    for proposed, other in ((a, b), (b, a)):
        if proposed.variant == "slotfilm" and other.variant in VARIANTS:
            return list(changed_fields(_settings(apply_variant(other.variant, proposed)), other))
    allowed = {"variant"} | _touched(a) | _touched(b)
    return [name for name in changed_fields(a, b) if name not in allowed]


def _touched(config: RunConfig) -> set[str]:
    """Fields that a config's variant sets, in the paper's lengths or in its own; none for an unknown variant."""
    if config.variant not in VARIANTS:
        return set()
    vary = VARIANTS[config.variant]
    bases = (RunConfig(), replace(RunConfig(), schedule=config.schedule, replay=config.replay))
    return {name for base in bases for name in changed_fields(base, vary(base))}


def _one_a_seed(runs: Sequence[StudyRun]) -> tuple[list[StudyRun], list[StudyRun]]:
    """The furthest run of each variant and seed, in order, and the others."""
    order = {name: place for place, name in enumerate(VARIANTS)}
    best: dict[tuple[str, int], StudyRun] = {}
    for run in runs:
        key = (run.variant, run.seed)
        if key not in best or run.env_steps > best[key].env_steps:
            best[key] = run
    kept = sorted(best.values(), key=lambda run: (order.get(run.variant, len(order)), run.variant, run.seed))
    chosen = {run.path for run in kept}
    return kept, [run for run in runs if run.path not in chosen]
