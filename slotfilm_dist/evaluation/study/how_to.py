"""Commands that made what the report shows, or that would make what it lacks."""

import shlex
from collections.abc import Sequence

from slotfilm_dist.evaluation.study.collection import Study, StudyRun

_ONE_RUN = ("--variant", "--seed", "--name", "--resume")
_SELECTION = ("--only", "--exclude")


def train_commands(study: Study, variants: Sequence[str]) -> tuple[str, ...]:
    """What would train these variants like the runs at hand: the grid's command, or one run each of the first seed.

    Args:
        study: the runs at hand.
        variants: names.
    """
    if study.commands:
        words = _without(shlex.split(study.commands[-1]), _SELECTION, flags=("--dry-run", "--json"))
        return (shlex.join([*words, "--only", ",".join(variants)]),)
    reference = study.reference
    words = shlex.split(reference.command)
    if words[:2] != ["slotfilm", "train"] or "--resume" in words:
        return (f"slotfilm grid --only {','.join(variants)} --runs {shlex.quote(str(study.folder))}",)
    words = _without(words, _ONE_RUN)
    return tuple(shlex.join([*words, "--variant", name, "--seed", str(reference.seed)]) for name in variants)


def measure_command(run: StudyRun, command: str) -> str:
    """A command on one run, as in `evaluate RUN --what perception`; `RUN` stands for its directory."""
    return f"slotfilm {command}".replace("RUN", shlex.quote(str(run.path)))


def _without(words: Sequence[str], options: Sequence[str], flags: Sequence[str] = ()) -> list[str]:
    """A command line without these options and their values, and without these flags."""
    kept: list[str] = []
    skip = False
    for word in words:
        if skip and not word.startswith("--"):
            continue
        skip = word in options
        if not skip and word not in flags and word.split("=")[0] not in options:
            kept.append(word)
    return kept
