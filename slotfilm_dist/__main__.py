"""The command line: `slotfilm COMMAND`, also `python -m slotfilm_dist COMMAND`."""

import importlib
import itertools
import os
import sys
import traceback
from collections.abc import Callable, Sequence

from slotfilm_dist import __version__

COMMANDS: dict[str, tuple[str, str]] = {
    "doctor": ("commands.doctor:main", "what this machine can do, and a fix for each lack"),
    "train": ("commands.train:main", "a run from nothing to its report, or on with --resume"),
    "grid": ("commands.grid:main", "every variant and seed of the study as trials; the same command goes on"),
    "scale": ("commands.scale:main", "more or fewer workers for a run that is under way on Ray"),
    "evaluate": ("commands.evaluate:main", "episodes on held-out seeds: trained agent, expert or random policy"),
    "probe": ("commands.probe:main", "what a frozen agent's latent tells linearly: contact, progress (Table 3)"),
    "perceive": ("commands.perceive:main", "attention, positions and visibility on an image, video, webcam or stream"),
    "watch": ("commands.watch:main", "the metrics of a run, live in a terminal"),
    "chaos": ("commands.chaos:main", "damage a real run on purpose: what should follow, what does"),
    "report": ("commands.report:main", "the page of a run; of many, every figure and table beside the paper's"),
    "export": ("commands.export:main", "the trained policy as files that need neither simulator nor Ray"),
    "variants": ("commands.listing:variants", "the agents of the study, the tasks, the presets"),
    "cost": ("commands.listing:cost", "parameters, latency and memory of every variant"),
    "bench": ("commands.bench:main", "speed against what one would pick instead, as ratios"),
}


USERS_MISTAKES = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
"""Errors of the system that a path which was given brings about."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; gives its exit code: 0 done, 1 failed, 2 the user's mistake, 128 + n stopped by signal n."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        return 0
    if words[0] == "--version":
        print(f"slotfilm {__version__}")
        return 0
    try:
        _refuse_empty(words)
        return _command(words[0])(words[1:])
    except ValueError as error:
        if debug:
            traceback.print_exc()
        print(f"slotfilm: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # whoever read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if debug:
            traceback.print_exc()
        print(f"slotfilm: {error}", file=sys.stderr)
        return 2 if isinstance(error, USERS_MISTAKES) else 1
    except KeyboardInterrupt:
        print("slotfilm: stopped", file=sys.stderr)
        return 130


def _refuse_empty(words: Sequence[str]) -> None:
    """A word that is empty stands for a variable that was not set; to go on would do something else than was meant."""
    for before, word in itertools.pairwise(("", *words)):
        if word == "" or (word.startswith("--") and word.endswith("=")):
            what = word.removesuffix("=") or (before if before.startswith("--") else "a word")
            raise ValueError(f"{what}: its value is missing; was it an empty variable?")


def _command(name: str) -> Callable[[Sequence[str]], int]:
    if name not in COMMANDS:
        import difflib

        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else "see `slotfilm --help`"
        raise ValueError(f"{name!r} is no command; {hint}")
    module, _, function = COMMANDS[name][0].partition(":")
    return getattr(importlib.import_module(f"slotfilm_dist.{module}"), function)


def _help() -> str:
    lines = [f"  {name:<10} {text}" for name, (_, text) in COMMANDS.items()]
    return "\n".join(
        [
            f"slotfilm {__version__}: egocentric manipulation with state-guided slots",
            "",
            "usage: slotfilm COMMAND [OPTIONS]     (each command has --help; --debug shows where an error came from)",
            "",
            *lines,
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
