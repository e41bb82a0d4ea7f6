"""Gathers the runs of a study: which belong together, which are over, and what else a folder holds and why it is out.

Runs are pooled only where they differ by their variants and seeds alone. Places, checkpoints and the number of
evaluation episodes may differ; everything else that does sets a run apart, and the report says so.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slotfilm_dist.config import CheckpointConfig, EvaluationConfig, RunConfig, RuntimeConfig
from slotfilm_dist.config_files import changed_fields
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
        return self.record.final is not None

    @property
    def command(self) -> str:
        """What made it; empty if it did not say."""
        return str(self.record.versions.get("command", ""))


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """A job of a grid as its ledger has it."""

    path: Path
    """Its directory."""
    kind: str
    variant: str
    seed: int
    state: str
    error: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Grid:
    """What a grid's directory says of itself."""

    path: Path
    trials: tuple[Trial, ...]
    """Its ledger."""
    commands: tuple[str, ...]
    """What it was started with, oldest first."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Study:
    """Runs that may be compared, and what was found beside them."""

    folder: Path
    runs: tuple[StudyRun, ...]
    """Over and comparable, one for each variant and seed, in the order of the variants and seeds."""
    unfinished: tuple[StudyRun, ...]
    """Comparable but not over: drawn as curves, in no number."""
    makers: tuple[RunRecord, ...]
    """Directories of grids' jobs that made data and encoders for their trials."""
    left_out: tuple[str, ...]
    """One sentence for each run that is in neither, and for each trial of a grid that has no run."""
    grids: tuple[Grid, ...]
    """Those that the folder is or holds."""

    @property
    def variants(self) -> tuple[str, ...]:
        """Those with a run that is over, in the order of `slotfilm variants`."""
        return tuple(dict.fromkeys(run.variant for run in self.runs))

    def of(self, variant: str) -> tuple[StudyRun, ...]:
        """The runs of a variant that are over, by seed."""
        return tuple(run for run in self.runs if run.variant == variant)

    def grid_of(self, record: RunRecord) -> Grid | None:
        """The grid that a run or another job belongs to, if any."""
        return next((grid for grid in self.grids if grid.path in record.run_dir.parents), None)

    def commands_of(self, records: Iterable[RunRecord]) -> tuple[str, ...]:
        """What made these: the commands of their grids, or their own."""
        found: dict[str, None] = {}
        for record in records:
            grid = self.grid_of(record)
            own = str(record.versions.get("command", ""))
            found |= dict.fromkeys(grid.commands if grid and grid.commands else (own,))
        return tuple(command for command in found if command)

    @property
    def reference(self) -> StudyRun:
        """The run whose settings stand for all: the proposed agent's where there is one."""
        everyone = (*self.runs, *self.unfinished)
        return next((run for run in everyone if run.variant == "slotfilm"), everyone[0])


def is_run(folder: Path) -> bool:
    """Whether a directory is a run's own."""
    return (folder / "config.json").is_file()


def folders_of_runs(folder: Path, depth: int = DEPTH) -> Iterator[Path]:
    """The folder and those below it in which runs are looked for, each of which may be a grid's."""
    yield folder
    for path in _subfolders(folder) if depth > 1 else ():
        if not is_run(path):
            yield from folders_of_runs(path, depth - 1)


def collect_study(folder: Path, grids: Sequence[Grid] = ()) -> Study:
    """Read every run below a folder and sort out which of them make a study.

    Args:
        folder: a folder of runs or of grids, or a grid's.
        grids: those of its `folders_of_runs` that are grids.

    Raises:
        ValueError: no such folder, or no run in it that has trained.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no directory: give a run, a folder of runs, or a grid")
    kinds = {trial.path: trial.kind for grid in grids for trial in grid.trials}
    runs: list[StudyRun] = []
    makers: list[StudyRun] = []
    left_out: list[str] = []
    for path in sorted(path for place in folders_of_runs(folder) for path in _subfolders(place) if is_run(path)):
        record = read_run(path)
        if record.config is None:
            left_out.append(f"{_name(path, folder)}: its config.json cannot be read. {record.missing[0]}")
        elif kinds.get(path, "trial") != "trial":
            makers.append(StudyRun(record=record, config=record.config))
        elif not record.episodes:
            left_out.append(f"{_name(path, folder)}: no training episode yet.")
        else:
            runs.append(StudyRun(record=record, config=record.config))
    if not runs:
        raise ValueError(f"{folder} holds no run that has trained; `slotfilm train` or `slotfilm grid` makes some")
    chosen = _shared_settings(runs)
    alien = {run.path: names for run in (*runs, *makers) if (names := _differing(chosen, _settings(run.config)))}
    left_out += [f"{_name(path, folder)}: {_other_settings(names)}" for path, names in alien.items()]
    same = [run for run in runs if run.path not in alien]
    kept = _one_a_seed(same)
    for run in same:
        if (other := kept[run.variant, run.seed]) is not run:
            place = _name(other.path, folder)
            left_out.append(
                f"{_name(run.path, folder)}: {run.variant} with seed {run.seed} is there twice; {place} counts."
            )
    return Study(
        folder=folder,
        runs=tuple(run for run in kept.values() if run.is_over),
        unfinished=tuple(run for run in kept.values() if not run.is_over),
        makers=tuple(maker.record for maker in makers if maker.path not in alien),
        left_out=(*left_out, *_absent(folder, grids)),
        grids=tuple(grids),
    )


def _subfolders(folder: Path) -> list[Path]:
    return sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))


def _name(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder))


def _absent(folder: Path, grids: Sequence[Grid]) -> Iterator[str]:
    for trial in (trial for grid in grids for trial in grid.trials):
        if trial.state in ("failed", "pruned"):
            yield f"{_name(trial.path, folder)}: {trial.state}" + (f", {trial.error}" if trial.error else "") + "."
        elif trial.kind == "trial" and not is_run(trial.path):
            yield f"{_name(trial.path, folder)}: {trial.state}, not begun."


def _shared_settings(runs: Sequence[StudyRun]) -> RunConfig:
    """The settings that most runs have, but for what their variants change."""
    counts = Counter(_settings(run.config) for run in runs)

    def followers(kind: RunConfig) -> int:
        return sum(count for other, count in counts.items() if not _differing(kind, other))

    return max(counts, key=lambda kind: (followers(kind), kind.variant == "slotfilm"))


def _other_settings(names: Sequence[str]) -> str:
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"other settings than the rest ({shown}); report it from a folder of its own."


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


def _one_a_seed(runs: Sequence[StudyRun]) -> dict[tuple[str, int], StudyRun]:
    """One run for each variant and seed, in their order: one that is over before one that is not, then the furthest."""
    order = {name: place for place, name in enumerate(VARIANTS)}
    best: dict[tuple[str, int], StudyRun] = {}
    for run in runs:
        other = best.setdefault((run.variant, run.seed), run)
        if (run.is_over, run.env_steps) > (other.is_over, other.env_steps):
            best[run.variant, run.seed] = run
    return dict(sorted(best.items(), key=lambda item: (order.get(item[0][0], len(order)), *item[0])))
