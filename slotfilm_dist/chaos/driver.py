"""A training run of its own on the toy environment: `python -m slotfilm_dist.chaos.driver RUN`; RUN holds a config."""

import sys
from collections.abc import Sequence
from pathlib import Path

from slotfilm_dist.cluster.backend import RayBackend
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import load_config
from slotfilm_dist.driver import drive
from slotfilm_dist.envs.toy import make_toy_env


def main(arguments: Sequence[str]) -> int:
    """Train as `slotfilm train` does; gives the exit code."""
    run = Path(arguments[0])
    try:
        return drive(run, load_config(run / "config.json"), run.parent / "artifacts", _backend)
    except ValueError as error:
        print(f"slotfilm: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def _backend(run: Path, config: RunConfig) -> RayBackend:
    return RayBackend(config, run, make_toy_env)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
