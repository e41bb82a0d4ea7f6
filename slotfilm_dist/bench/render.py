"""Environment steps with the wrist camera's picture, against the whole robot and against ManiSkill's own task."""

from contextlib import ExitStack
from typing import Any

from slotfilm_dist.bench.contender import Contender, ContenderError, missing
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least, for_information
from slotfilm_dist.bench.rounds import interleave

GOAL = 10.0
STOCK = "stock PickCube-v1"
_OURS = {"camera": True, "profile": "wrist"}
_FULL = {"camera": True, "profile": "full"}


def run(options: BenchOptions) -> list[BenchResult]:
    """Ours with both render profiles and ManiSkill's PickCube-v1, in one process each, then in two at once."""
    return [row for processes in (1, 2) for row in _measured(options, processes)]


def _measured(options: BenchOptions, processes: int) -> list[BenchResult]:
    suffix = f"{processes} process" + "es" * (processes > 1)
    goal_name = f"render/against stock ManiSkill, {suffix}"
    try:
        with ExitStack() as stack:
            kinds: dict[str, tuple[str, dict[str, Any], int]] = {
                "wrist": ("own_env", _OURS, 200),
                "full": ("own_env", _FULL, 30),
                STOCK: ("peers.stock_maniskill", {"camera": True}, 20),
            }
            if processes == 1:
                kinds["stock without its second camera"] = (
                    "peers.stock_maniskill",
                    {"camera": True, "wrist_only": True},
                    20,
                )
            children = {
                name: [stack.enter_context(Contender(module, arguments)) for _ in range(processes)]
                for name, (module, arguments, _) in kinds.items()
            }
            rounds = interleave(
                {
                    name: lambda name=name: _together(children[name], options.scaled(kinds[name][2]))
                    for name in children
                },
                options.rounds,
            )
    except ContenderError as error:
        return [missing(goal_name, GOAL, "times", error)]
    how = f"PickBanana-v1 against PickCube-v1 (panda_wristcam, 128 x 128, obs_mode rgb), CPU physics, {suffix}: "
    rows = [
        at_least(
            goal_name,
            rounds.ratio("wrist", STOCK).median,
            GOAL,
            "times",
            how + rounds.describe("wrist", STOCK, "steps/s"),
        ),
        for_information(
            f"render/profile wrist against full, {suffix}",
            rounds.ratio("wrist", "full").median,
            "times",
            "env steps of PickBanana-v1: " + rounds.describe("wrist", "full", "steps/s"),
        ),
    ]
    if processes == 1:
        other = "stock without its second camera"
        described = rounds.describe("wrist", other, "steps/s")
        rows.append(
            for_information(f"render/against {other}", rounds.ratio("wrist", other).median, "times", how + described)
        )
    return rows


def _together(children: list[Contender], num_steps: int) -> float:
    """Steps a second of all processes, working at the same time."""
    for child in children:
        child.begin(num_steps=num_steps)
    return sum(child.result() for child in children)
