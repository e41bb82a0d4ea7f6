"""Environment steps without a picture, against ManiSkill's own task."""

from slotfilm_dist.bench.contender import Contender, ContenderError, missing
from slotfilm_dist.bench.results import BenchOptions, BenchResult, at_least
from slotfilm_dist.bench.rounds import interleave

GOAL = 2.0
NAME = "env/step without picture against stock ManiSkill"


def run(options: BenchOptions) -> list[BenchResult]:
    """PickBanana-v1 against PickCube-v1 with state observations, one process each."""
    try:
        with (
            Contender("own_env", {"camera": False, "profile": "wrist"}) as ours,
            Contender("peers.stock_maniskill", {"camera": False}) as stock,
        ):
            rounds = interleave(
                {
                    "ours": lambda: ours.ask(num_steps=options.scaled(600)),
                    "stock": lambda: stock.ask(num_steps=options.scaled(200)),
                },
                options.rounds,
            )
    except ContenderError as error:
        return [missing(NAME, GOAL, "times", error)]
    how = (
        "one control step with observation, reward and success, pd_ee_delta_pose, CPU physics, one process and one "
        "thread each; PickBanana-v1 against PickCube-v1 (obs_mode state): "
    )
    described = rounds.describe("ours", "stock", "steps/s")
    return [at_least(NAME, rounds.ratio("ours", "stock").median, GOAL, "times", how + described)]
