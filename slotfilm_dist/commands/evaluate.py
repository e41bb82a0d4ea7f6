"""`slotfilm evaluate`: a trained agent, the scripted expert or the random policy on held-out seeds."""

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from slotfilm_dist.commands.options import (
    Parser,
    add_device_option,
    build_config,
    episode_seeds,
    parse_with_fields,
    placed_on,
)
from slotfilm_dist.config_files import load_config

EPISODES = 50
"""Plain episodes, unless `--episodes` says otherwise."""
PARTS: dict[str, set[str]] = {
    "policy": {"policy", "episodes"},
    "perception": {"episodes", "steps", "frames", "checkpoint"},
    "robustness": {"episodes", "hold", "checkpoint"},
    "film_strips": {"policy", "episodes", "checkpoint"},
    "reward_windows": set(),
}
"""What `--what` takes, and the options that each part reads beside those of all."""


def main(arguments: Sequence[str]) -> int:
    """Evaluate; gives the exit code."""
    parser = _parser()
    options, fields = parse_with_fields(parser, arguments)
    if options.episodes is not None and options.episodes < 1:
        raise ValueError(f"--episodes {options.episodes}: must be 1 or more")
    episode_seeds(options.seed, options.episodes or EPISODES)
    for name in sorted(set().union(*PARTS.values()) - PARTS[options.what]):
        if getattr(options, name) != parser.get_default(name):
            raise ValueError(f"--{name}: --what {options.what} does not read it; leave it away")
    if options.run and fields:
        raise ValueError(f"{fields[0]}: a run's own config decides; leave the fields away")
    if options.what == "policy":
        return _play(options, fields)
    if not options.run:
        raise ValueError(f"--what {options.what} measures a trained agent: give the directory of its run")
    load_config(Path(options.run) / "config.json")

    from slotfilm_dist.commands.evaluate_parts import measure
    from slotfilm_dist.evaluation.result_files import plain

    values = measure(options.what, options)
    if options.json:
        json.dump(plain(values), sys.stdout)
        print()
    return 0


def _parser() -> Parser:
    parser = Parser(
        prog="slotfilm evaluate",
        description="Deterministic episodes on seeds that training never sees, and measurements on them.",
    )
    parser.add_argument("run", nargs="?", help="directory of the run whose checkpoint is measured")
    parser.add_argument(
        "--what",
        choices=PARTS,
        default="policy",
        help="policy: return and success; perception: errors, attention, visibility, slot swaps, clean and corrupted; "
        "robustness: success with a corrupted camera; film_strips: pictures of episodes; reward_windows: components "
        "of the reward over training (default: %(default)s)",
    )
    parser.add_argument("--policy", choices=("agent", "expert", "random"), help="who acts (default: agent with a run)")
    parser.add_argument(
        "--episodes", type=int, help="number of episodes (default: 50; perception 20 and film strips 2)"
    )
    parser.add_argument("--steps", type=int, help="perception: frames of an episode, 0 for all (default: 50)")
    parser.add_argument(
        "--frames",
        default="",
        metavar="WHO",
        help="perception: who acts in the frames: random, expert, agent or the directory of another run "
        "(default: random)",
    )
    parser.add_argument(
        "--checkpoint",
        choices=("last", "best", "pretrained"),
        default="last",
        help="perception, robustness, film strips: newest, best during training, or the pre-trained encoder "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--hold",
        choices=("frame", "episode"),
        default="frame",
        help="robustness: draw a corruption for every picture, or once an episode (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=10_000_000, help="first seed (default: %(default)s)")
    add_device_option(parser)
    parser.add_argument("--artifacts", default="artifacts", metavar="DIR", help="data and encoders that runs share")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    return parser


def _play(options: argparse.Namespace, fields: Sequence[str]) -> int:
    """Episodes of a policy: return and success."""
    num_episodes = options.episodes or EPISODES
    seeds = episode_seeds(options.seed, num_episodes)
    player = options.policy or ("agent" if options.run else "")
    if not player or (player == "agent" and not options.run):
        raise ValueError("give the directory of a run, or --policy expert or --policy random")
    config = load_config(Path(options.run) / "config.json") if options.run else build_config("paper", "", fields)
    config = placed_on(config, options.device)

    from slotfilm_dist.evaluation.record import save_evaluation, summarize
    from slotfilm_dist.local import LocalBackend, learner_device
    from slotfilm_dist.pipeline import POLICY_NAMES
    from slotfilm_dist.progress import Progress

    learner_device(config, "--device")
    progress = Progress()
    backend = LocalBackend(config)
    try:
        env_steps = backend.load_agent(Path(options.run) / "checkpoints") if player == "agent" else 0
        episodes = []
        progress.begin("evaluate", f"{num_episodes} episodes of the {POLICY_NAMES[player]} policy")
        for episode in backend.play(player, seeds, lambda: False):
            episodes.append(episode)
            solved = sum(e.success_at_end for e in episodes) / len(episodes)
            progress.show(len(episodes), len(seeds), {"success": f"{solved:.0%}"})
    finally:
        progress.end()
        backend.close()
    result = summarize(
        f"{player}-{options.seed}-{num_episodes}",
        POLICY_NAMES[player],
        env_steps,
        tuple(episodes),
        backend.reward_term_names,
    )
    if options.run:
        save_evaluation(result, Path(options.run))
    low, high = result.success_interval
    progress.say(
        f"return {result.mean_return:.1f} +- {result.std_return:.1f}; "
        f"success {result.success_rate:.1%}, 95 % interval [{low:.1%}, {high:.1%}]"
    )
    if options.json:
        json.dump(dataclasses.asdict(result), sys.stdout)
        print()
    return 0
