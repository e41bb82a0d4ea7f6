"""The subjects of `slotfilm bench` by name."""

import importlib
from collections.abc import Iterator, Sequence

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.bench.contender import ContenderError
from slotfilm_dist.bench.results import BenchOptions, BenchResult, not_measured

SUBJECTS: dict[str, str] = {
    "render": "env steps with a picture: against the whole robot, against stock ManiSkill",
    "env": "env steps without a picture: against stock ManiSkill",
    "attention": "folded slot attention: against nn.MultiheadAttention",
    "learner": "updates: tokens against images, TorchRL and Stable-Baselines3; profile and floor",
    "replay": "sampling: shards against TorchRL's Ray buffer, and against cpprb in process",
    "runtime": "Ray-fed learner against in-process, worker scaling, publish to applied, messages",
    "e2e": "env steps at one update a step: against Stable-Baselines3 and RLlib",
    "pretrain": "pre-training: images/s against a plain loop",
    "scale": "cost as the work grows: stored steps, shards, workers",
    "gpu": "what only a GPU host can reach",
}


def run_subject(name: str, options: BenchOptions) -> list[BenchResult]:
    """Measure one subject; its module is imported here, and nothing of the others.

    Where its processes or its cluster cannot be started, there is one row that says so.
    """
    try:
        return importlib.import_module(f"slotfilm_dist.bench.{name}").run(options)
    except (ContenderError, RunFailedError) as error:
        return [not_measured(name, None, "-", str(error))]


def run_subjects(names: Sequence[str], options: BenchOptions) -> Iterator[tuple[str, list[BenchResult]]]:
    """Measure subjects one after another, in the order of `SUBJECTS`; all of them without any name.

    Raises:
        ValueError: a name is unknown; says which is near.
    """
    for name in names:
        if name not in SUBJECTS:
            import difflib

            near = difflib.get_close_matches(name, SUBJECTS, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(SUBJECTS)}"
            raise ValueError(f"{name!r} is no subject of the bench; {hint}")
    for name in SUBJECTS:
        if not names or name in names:
            yield name, run_subject(name, options)
