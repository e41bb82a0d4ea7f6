"""`slotfilm probe`: what can be read linearly from a frozen agent's latent (Table 3).

Writes probe/<frames>-<checkpoint>/ of the run: probes.json and table.csv, one row for each latent and score.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slotfilm_dist.commands.options import Parser, add_device_option, episode_seeds
from slotfilm_dist.config_files import load_config

if TYPE_CHECKING:
    from slotfilm_dist.evaluation.probes import ProbeResult


def main(arguments: Sequence[str]) -> int:
    """Probe; gives the exit code."""
    parser = Parser(
        prog="slotfilm probe",
        description="Linear probes on the frozen agent's latent: contact, progress, displacement (Table 3).",
    )
    parser.add_argument("run", help="directory of the run")
    parser.add_argument(
        "--frames",
        default="expert",
        metavar="WHO",
        help="who acts in the frames: expert, random, agent or the directory of another run, so that every variant "
        "is probed on identical frames (default: %(default)s)",
    )
    parser.add_argument("--episodes", type=int, default=10, help="number of episodes (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=0, help="frames of an episode, 0 for all (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=10_000_000, help="first seed (default: %(default)s)")
    parser.add_argument(
        "--checkpoint", choices=("last", "best"), default="last", help="newest, or best during training"
    )
    add_device_option(parser)
    parser.add_argument("--artifacts", default="artifacts", metavar="DIR", help="data and encoders that runs share")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    options = parser.parse_args(arguments)
    if options.episodes < 2:
        raise ValueError(f"--episodes {options.episodes}: must be 2 or more, to test on episodes not trained on")
    episode_seeds(options.seed, options.episodes)
    load_config(Path(options.run) / "config.json")

    from slotfilm_dist.evaluation.result_files import plain

    values = _probe(options)
    if options.json:
        json.dump(plain(values), sys.stdout)
        print()
    return 0


def _probe(options: Any) -> dict[str, Any]:
    import numpy as np

    from slotfilm_dist.commands.evaluate_parts import describe, load
    from slotfilm_dist.commands.heldout_frames import FrameRequest, heldout_frames
    from slotfilm_dist.evaluation.corruptions import CORRUPTIONS, corrupt_frames
    from slotfilm_dist.evaluation.latents import latents_of
    from slotfilm_dist.evaluation.probes import label_balance, probe
    from slotfilm_dist.evaluation.result_files import write_csv, write_json
    from slotfilm_dist.progress import Progress

    progress = Progress()
    agent = load(options)
    request = FrameRequest(
        source=options.frames, first_seed=options.seed, episodes=options.episodes, steps=options.steps
    )
    frames = heldout_frames(request, agent, Path(options.artifacts), progress)
    progress.begin("evaluate", f"probes on {len(frames.step)} frames")
    latents = {}
    for index, name in enumerate(CORRUPTIONS):
        rgb, _ = corrupt_frames(frames.rgb, frames.uv, name, options.seed)
        latents[name] = latents_of(agent.encoder, frames, rgb, agent.actor)
        progress.show(index + 1, len(CORRUPTIONS) + 1, {"pictures": name})
    results = {}
    for kind in ("policy_input", "visual"):
        features = {name: getattr(value, kind) for name, value in latents.items()}
        clean = features.pop("clean")
        results[kind] = None if clean is None else probe(clean, features, frames, np.random.default_rng(options.seed))
    folder = Path(options.run) / "probe" / f"{request.label}-{agent.which}"
    values = describe(agent) | {
        "frames": dataclasses.asdict(request),
        "labels": dataclasses.asdict(label_balance(frames)),
        "probes": {kind: result and dataclasses.asdict(result) for kind, result in results.items()},
    }
    write_json(folder / "probes.json", values)
    write_csv(folder / "table.csv", [row for kind, r in results.items() if r for row in _rows(kind, r)])
    for kind, result in results.items():
        progress.say(f"          {kind}: {_line(result)}")
    progress.end(f"{folder}")
    return values


def _rows(kind: str, result: "ProbeResult") -> list[dict[str, Any]]:
    """One row for each score of a latent."""
    scores = {
        "contact_auroc": result.contact_auroc,
        "delta_dist_r2": result.delta_dist_r2,
        "delta_obj_r2": result.delta_obj_r2,
    } | {f"auroc_change_{name}": score for name, score in result.auroc_change.items()}
    return [
        {
            "latent": kind,
            "score": name,
            "value": score.value,
            "low": score.interval[0],
            "high": score.interval[1],
            "null": score.null,
        }
        for name, score in scores.items()
    ]


def _line(result: "ProbeResult | None") -> str:
    if result is None:
        return "none, the agent has no camera"
    changes = ", ".join(f"{name} {score.value:+.3f}" for name, score in result.auroc_change.items())
    return (
        f"contact AUROC {result.contact_auroc.value:.3f} (shuffled {result.contact_auroc.null:.3f}), "
        f"R2 of distance change {result.delta_dist_r2.value:.3f}, of displacement {result.delta_obj_r2.value:.3f}; "
        f"AUROC change: {changes}"
    )
