"""`slotfilm evaluate`: episodes of a trained agent, the scripted expert or the random policy on held-out seeds."""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from slotfilm_dist.commands.options import Parser, build_config, parse_with_fields
from slotfilm_dist.config import load_config


def main(arguments: Sequence[str]) -> int:
    """Evaluate; gives the exit code."""
    parser = Parser(prog="slotfilm evaluate", description="Deterministic episodes on seeds that training never sees.")
    parser.add_argument("run", nargs="?", help="directory of the run whose last checkpoint acts")
    parser.add_argument("--policy", choices=("agent", "expert", "random"), help="who acts (default: agent with a run)")
    parser.add_argument("--episodes", type=int, default=50, help="number of episodes (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=10_000_000, help="first seed (default: %(default)s)")
    parser.add_argument("--artifacts", default="artifacts", metavar="DIR", help="data and encoders that runs share")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    options, fields = parse_with_fields(parser, arguments)
    if options.episodes < 1:
        raise ValueError(f"--episodes {options.episodes}: must be 1 or more")
    player = options.policy or ("agent" if options.run else "")
    if not player or (player == "agent" and not options.run):
        raise ValueError("give the directory of a run, or --policy expert or --policy random")
    config = load_config(Path(options.run) / "config.json") if options.run else build_config("paper", "", fields)
    if options.run and fields:
        raise ValueError(f"{fields[0]}: a run's own config decides; leave the fields away")

    from slotfilm_dist.evaluation.record import save_evaluation, summarize
    from slotfilm_dist.local import LocalBackend
    from slotfilm_dist.pipeline import POLICY_NAMES
    from slotfilm_dist.progress import Progress

    progress = Progress()
    seeds = range(options.seed, options.seed + options.episodes)
    backend = LocalBackend(config)
    try:
        env_steps = backend.load_agent(Path(options.run) / "checkpoints") if player == "agent" else 0
        episodes = []
        progress.begin("evaluate", f"{options.episodes} episodes of the {POLICY_NAMES[player]} policy")
        for episode in backend.play(player, seeds):
            episodes.append(episode)
            solved = sum(e.success_at_end for e in episodes) / len(episodes)
            progress.show(len(episodes), len(seeds), {"success": f"{solved:.0%}"})
    finally:
        progress.end()
        backend.close()
    result = summarize(
        f"{player}-{options.seed}-{options.episodes}",
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
