"""What a grid is made of: trials, and before them the data and encoders that several of them share."""

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from slotfilm_dist.config import CheckpointConfig, RunConfig, RuntimeConfig
from slotfilm_dist.config_files import config_hash
from slotfilm_dist.envs.tasks import check_goal, objection
from slotfilm_dist.learning.learner import dataset_hash, pretrain_hash
from slotfilm_dist.replay.dataset import MANIFEST
from slotfilm_dist.variants import SECTIONS, VARIANTS, apply_variant

JobKind = Literal["data", "encoder", "trial"]
"""The random policy's data, a pre-trained encoder, or a whole run of one variant and seed."""
MAX_SEEDS = 10_000
"""More are a slip of the finger, and take minutes only to be listed."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """One piece of work of a grid."""

    key: str
    """Names it everywhere: its ledger record, its directory; ends with a hash of what decides its result."""
    kind: JobKind
    config: RunConfig
    needs: tuple[str, ...] = ()
    """Keys of the jobs that must be done before."""

    @property
    def config_hash(self) -> str:
        """Hash of what decides a trial's result, 16 hex digits: all but where it runs and what is kept."""
        return config_hash(replace(self.config, runtime=RuntimeConfig(), checkpoint=CheckpointConfig()))

    def artifact_is_there(self, artifacts: Path) -> bool:
        """Whether the shared artifact that it makes has been made already, by whomever; never for a trial."""
        if self.kind == "data":
            return (artifacts / self.key / MANIFEST).exists()
        return self.kind == "encoder" and (artifacts / self.key).exists()


def select_variants(only: Sequence[str], exclude: Sequence[str]) -> list[str]:
    """The variants of a grid: the study's, which are all but those for validation, or the ones named.

    Raises:
        ValueError: a name that is no variant (with the nearest known one), or nothing is left.
    """
    for option, names in (("--only", only), ("--exclude", exclude)):
        for name in names:
            if name not in VARIANTS:
                near = difflib.get_close_matches(name, VARIANTS, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(VARIANTS)}"
                raise ValueError(f"{option} {name}: no such variant; {hint}")
    validation = {variant.__name__ for variant in SECTIONS["validation"]}
    chosen = list(dict.fromkeys(only)) or [name for name in VARIANTS if name not in validation]
    left = [name for name in chosen if name not in exclude]
    if not left:
        raise ValueError(f"--exclude {','.join(exclude)}: leaves no variant to train")
    return left


def meaningless_variants(base: RunConfig, variants: Iterable[str]) -> dict[str, str]:
    """The variants that the base's task makes impossible or the proposed agent again, each with the reason."""
    reasons = {name: objection(base, apply_variant(name, base)) for name in variants}
    return {name: reason for name, reason in reasons.items() if reason}


def build_trials(base: RunConfig, variants: Iterable[str], num_seeds: int) -> list[RunConfig]:
    """The trials' configs, seed by seed, so that a grid that is cut short has every variant's first seed.

    Args:
        base: the proposed agent; its seed is the first one. Each variant is a difference from it.
        variants: names.
        num_seeds: seeds of each variant.

    Raises:
        ValueError: `num_seeds` is not positive, or a variant does not go with the base.
    """
    if num_seeds < 1:
        raise ValueError(f"--seeds {num_seeds}: must be 1 or more")
    if num_seeds > MAX_SEEDS:
        raise ValueError(f"--seeds {num_seeds}: must be {MAX_SEEDS} or fewer")
    configs = [apply_variant(name, base) for name in variants]
    for config in configs:
        check_goal(config)
    return [replace(config, seed=seed) for seed in range(base.seed, base.seed + num_seeds) for config in configs]


def build_jobs(trials: Sequence[RunConfig]) -> list[Job]:
    """All jobs of these trials, each after what it needs; every distinct artifact is made by one job."""
    shared: dict[str, Job] = {}
    jobs: list[Job] = []
    for config in trials:
        data = Job(key=f"random-{dataset_hash(config)}", kind="data", config=config)
        shared.setdefault(data.key, data)
        needs = [data.key]
        if config.pretrains:
            key = f"encoder-{pretrain_hash(config)}"
            shared.setdefault(key, Job(key=key, kind="encoder", config=config, needs=(data.key,)))
            needs.append(key)
        trial = Job(key="", kind="trial", config=config, needs=tuple(needs))
        jobs.append(replace(trial, key=f"{config.variant}-s{config.seed}-{trial.config_hash[:8]}"))
    # Data and encoders of a seed come before those of the next, so that its trials can begin meanwhile.
    return [*shared.values(), *jobs]
