"""Drives one run to its end, and turns the ways in which it can end into exit codes."""

from collections.abc import Callable
from pathlib import Path

from slotfilm_dist.backend import Backend, RunFailedError
from slotfilm_dist.config import RunConfig
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.progress import Progress
from slotfilm_dist.runs import RunDirectory, refuse_if_held
from slotfilm_dist.stopping import Interrupted, StopFlag


def drive(path: Path, config: RunConfig, artifacts: Path, make_backend: Callable[[Path, RunConfig], Backend]) -> int:
    """Train in a run's directory; gives the exit code: 0 done, 1 failed, 128 + n stopped by signal n.

    Args:
        path: the run's directory.
        config: of the run.
        artifacts: folder of data and encoders that runs share.
        make_backend: decides where the roles live.

    Raises:
        ValueError: the user's mistake; nothing has been written.
    """
    refuse_if_held(path)
    progress, stop = Progress(), StopFlag()
    backend = make_backend(path, config)
    try:
        backend.prepare()
        with stop.listening(), RunDirectory(path, config) as run:
            progress.say(f"slotfilm  {config.variant} on {config.env.task}, seed {config.seed}: {run.path}")
            page = Pipeline(run, backend, artifacts, progress, stop).execute()
    except Interrupted as interruption:
        progress.say(f"{interruption}; go on with: slotfilm train --resume {path}")
        return interruption.exit_code
    except RunFailedError as failure:
        progress.say(f"slotfilm: {failure}")
        return 1
    finally:
        progress.end()
        backend.close()
    progress.say(f"  report  {page}")
    return 0
