"""Commands that made what the report shows, or that would make what it lacks."""

import shlex
from collections.abc import Mapping, Sequence

from slotfilm_dist.evaluation.study.blocks import Missing
from slotfilm_dist.evaluation.study.collection import Study, StudyRun
from slotfilm_dist.evaluation.study.measurements import Measurement

_ONE_RUN = ("--variant", "--seed", "--name", "--resume")
_SELECTION = ("--only", "--exclude")


def train_commands(study: Study, variants: Sequence[str]) -> tuple[str, ...]:
    """What would train these variants like the runs at hand: the grid's command, or one run each of the first seed.

    Args:
        study: the runs at hand.
        variants: names.
    """
    reference = study.reference
    grid = study.grid_of(reference.record)
    if grid and grid.commands:
        words = _without(_words(grid.commands[-1]), _SELECTION, flags=("--dry-run", "--json"))
        return (shlex.join([*words, "--only", ",".join(variants)]),)
    words = _words(reference.command)
    if words[:2] != ["slotfilm", "train"] or "--resume" in words:
        return (f"slotfilm grid --only {','.join(variants)} --runs {shlex.quote(str(study.folder))}",)
    words = _without(words, _ONE_RUN)
    return tuple(shlex.join([*words, "--variant", name, "--seed", str(reference.seed)]) for name in variants)


def measure_command(run: StudyRun, command: str, options: Mapping[str, str] | None = None) -> str:
    """A command on one run, as in `evaluate RUN --what perception`; `RUN` stands for its directory."""
    words = [word for option in (options or {}).items() for word in option]
    return " ".join([f"slotfilm {command}".replace("RUN", shlex.quote(str(run.path))), *map(shlex.quote, words)])


def measured_otherwise(left_out: Sequence[Measurement], like: Measurement, command: str) -> list[Missing]:
    """Names measurements that were made in another way than the rest, with what would make them like that.

    Args:
        left_out: those measurements.
        like: one of the rest.
        command: what measures, as in `probe RUN`.
    """
    if not left_out:
        return []
    names = []
    for m in left_out:
        ways = [f"{option} {value}" for option, value in m.options.items() if like.options.get(option) != value]
        ways += [m.stage] if m.stage != like.stage else []
        names.append(
            f"{m.run.variant}, seed {m.run.seed} ({', '.join(filter(None, ways)) or 'as its file tells less'})"
        )
    commands = dict.fromkeys(measure_command(m.run, command, like.options) for m in left_out if m.run.is_over)
    return [Missing(text=f"Measured in another way and left out: {'; '.join(names)}.", commands=tuple(commands))]


def _words(command: str) -> list[str]:
    """Words of a recorded command; early records joined them with blanks alone, so that a quote may have no end."""
    try:
        return shlex.split(command)
    except ValueError:
        return command.split()


def _without(words: Sequence[str], options: Sequence[str], flags: Sequence[str] = ()) -> list[str]:
    """A command line without these options, each with its one value, and without these flags."""
    kept: list[str] = []
    rest = iter(words)
    for word in rest:
        if word in options:
            next(rest, None)
        elif word not in flags and word.split("=")[0] not in options:
            kept.append(word)
    return kept
