"""What a run needs of the place where its roles live: one process, or a Ray cluster."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from slotfilm_dist.messages import EpisodeSummary, TrainingEpisode, TransitionBlock

Player = Literal["random", "expert", "agent"]
"""Who acts in an evaluation; `agent` is the learner's newest weights, acting deterministically."""


IsDue = Callable[[int, int], bool]
"""Whether something is due at these environment steps and updates."""


def never_due(env_steps: int, updates: int) -> bool:
    """Nothing is ever due."""
    return False


class RunFailedError(RuntimeError):
    """The run cannot go on; the message names the cause and the remedy."""


class EvaluationFailedError(RunFailedError):
    """Episodes could not be played, or their result not be written; training itself could go on."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainReport:
    """What happened since the last report."""

    env_steps: int
    """Environment steps of the run so far."""
    updates: int
    """Updates so far."""
    metrics: Mapping[str, float]
    """Values by the metric catalogue's names."""
    episodes: tuple[TrainingEpisode, ...] = ()
    """Training episodes that ended."""
    settled: bool = True
    """Evaluations and checkpoints may follow; in one process only where an episode starts and no update is owed."""


@runtime_checkable
class Backend(Protocol):
    """The roles of one run. Every method that takes long gives control back regularly, so that a run can be stopped."""

    @property
    def action_dim(self) -> int:
        """Size of an action."""
        ...

    @property
    def reward_term_names(self) -> tuple[str, ...]:
        """Names of the reward's components."""
        ...

    def prepare(self) -> None:
        """Find out, before anything is written, whether all that the run needs is there; raises ``ValueError``."""
        ...

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        """Blocks of the random policy, `num_steps` steps or a little more, after `start` steps that are there."""
        ...

    def pretrain(self, dataset: Path, artifact: Path) -> Iterator[dict[str, float]]:
        """Pre-train on a dataset and write the result as a checkpoint; gives metrics as it goes.

        An interrupted pre-training continues from what it wrote beside the artifact.
        """
        ...

    def begin_training(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> dict[str, Any]:
        """Build the learner and fill replay; gives the plain values that the resumed checkpoint was written with.

        Args:
            dataset: the random policy's data.
            pretrained: checkpoint of the pre-trained encoder; None without pre-training.
            resume_from: folder of the run's checkpoints; None for a fresh start.
        """
        ...

    def load_agent(self, checkpoints: Path) -> int:
        """Build the agent of a run's newest checkpoint, to play with; gives the environment steps it learned from.

        Raises:
            ValueError: there is no checkpoint that can be used.
        """
        ...

    def train(self, should_stop: Callable[[], bool], is_due: IsDue = never_due) -> Iterator[TrainReport]:
        """Train until the schedule's end, or until `should_stop`, reporting about once a second.

        Args:
            should_stop: asked many times a second.
            is_due: whether an evaluation or a checkpoint is due; one process reports then, whatever the clock says,
                so that they come at the same steps in every run of a seed.
        """
        ...

    def play(self, player: Player, seeds: Sequence[int], should_stop: Callable[[], bool]) -> Iterator[EpisodeSummary]:
        """Play episodes on held-out seeds; fewer once `should_stop`.

        Raises:
            EvaluationFailedError: the episodes cannot be played.
        """
        ...

    def record(self, player: Player, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        """Play one episode and write its video and film strip."""
        ...

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        """Write a checkpoint, numbered or as `best`, and replay beside it; gives its size in bytes."""
        ...

    def close(self) -> None:
        """Stop everything."""
        ...
