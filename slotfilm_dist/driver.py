"""Drives one run to its end, and turns the ways in which it can end into exit codes."""

import os
import shlex
from collections.abc import Callable
from pathlib import Path

from slotfilm_dist.backend import Backend, RunFailedError
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.config import RunConfig, check
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
    _require_episodes(config)
    _require_folders(path, artifacts)
    again = f"slotfilm train --resume {shlex.quote(str(path))}"
    if artifacts != Path("artifacts"):
        again += f" --artifacts {shlex.quote(str(artifacts))}"
    progress, stop = Progress(), StopFlag()
    backend = make_backend(path, config)
    try:
        backend.prepare()
        with stop.listening(), RunDirectory(path, config) as run:
            progress.say(f"slotfilm  {config.variant} on {config.env.task}, seed {config.seed}: {run.path}")
            page = Pipeline(run, backend, artifacts, progress, stop).execute()
    except Interrupted as interruption:
        progress.say(f"{interruption}; go on with: {again}")
        return interruption.exit_code
    except RunFailedError as failure:
        progress.say(f"slotfilm: {failure}")
        return 1
    except (RoleLostError, RoleSilentError) as failure:
        progress.say(f"slotfilm: {failure}; go on with: {again}")
        return 1
    finally:
        progress.end()
        backend.close()
    progress.say(f"  report  {page}")
    return 0


def _require_episodes(config: RunConfig) -> None:
    """Pre-training is judged on episodes that it has not seen: a single collector must get beyond its first one."""
    collectors = config.runtime.num_workers if config.runtime.mode == "ray" else 1
    check(
        config.schedule.random_steps > config.random_episode_length or collectors > 1 or not config.pretrains,
        "schedule.random_steps",
        config.schedule.random_steps,
        f"must be more than one episode of the random policy, {config.random_episode_length} steps, to pre-train on "
        "one and judge by another; or set --pretrain.steps 0",
    )


def _require_folders(*paths: Path) -> None:
    """Find out before anything starts whether these folders can be made, or written to where they are there."""
    for path in paths:
        there = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
        if not there.is_dir():
            raise ValueError(f"{path}: {there} is a file, not a folder")
        if not os.access(there, os.W_OK | os.X_OK):
            raise ValueError(f"{path}: {there} cannot be written to by this user")
