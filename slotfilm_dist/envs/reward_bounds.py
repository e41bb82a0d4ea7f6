"""How large PickBanana's reward can become, from its config alone: no simulator, no torch."""

import dataclasses
import math

from slotfilm_dist.config import RewardConfig


def largest_terms(config: RewardConfig) -> dict[str, float]:
    """What each component adds to a step's reward at most."""
    return {name: value / config.divisor for name, value in _undivided(config).items()}


def max_reward(config: RewardConfig) -> float:
    """Upper bound of one step's reward, the divisor of ManiSkill's normalised dense reward."""
    return sum(_undivided(config).values()) / config.divisor


def _undivided(config: RewardConfig) -> dict[str, float]:
    """The components' weights; reach and place also reach the cap of the near form that has one, if no less far off."""
    far = math.exp(-config.alpha * config.delta_m)
    near = max(config.near_cap, far) if config.near_form == "inverse" else 1.0
    largest = {"reach": near, "place": near}
    return {name: weight * largest.get(name, 1.0) for name, weight in dataclasses.asdict(config.weights).items()}
