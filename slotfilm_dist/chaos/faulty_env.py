"""An environment around the toy one or the simulator that fails when it is told to."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from slotfilm_dist.chaos.switches import Switches
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import AdjustableEnv
from slotfilm_dist.envs.toy import make_toy_env
from slotfilm_dist.local_envs import make_wrist_env
from slotfilm_dist.messages import Observation, StepResult

BROKEN_STEPS = 11
"""Steps in a row that break an environment for good: one more than `rejection.MAX_REJECTED`."""


class FaultyEnv:
    """Passes everything through, except what its switches say; implements `AdjustableEnv`.

    Switches: `hang_step` and `hang_reset` block for so many seconds, as native code does; `slow` makes every step take
    so many times as long while it lasts; `nan_reward`, `nan_state` and `black_picture` spoil one step each.

    Args:
        env: the real one.
        switches: what happens.
    """

    def __init__(self, env: AdjustableEnv, switches: Switches) -> None:
        self._env, self._switches = env, switches
        self.num_envs, self.action_dim = env.num_envs, env.action_dim
        self.reward_term_names, self.has_camera = env.reward_term_names, env.has_camera
        self._stepped_at = time.monotonic()

    @property
    def episode_steps(self) -> int:
        """Steps after which an episode is truncated."""
        return self._env.episode_steps

    @episode_steps.setter
    def episode_steps(self, steps: int) -> None:
        self._env.episode_steps = steps

    @property
    def fresh_episodes(self) -> bool:
        """Whether the simulator is built anew for every episode."""
        return self._env.fresh_episodes

    @fresh_episodes.setter
    def fresh_episodes(self, fresh: bool) -> None:
        self._env.fresh_episodes = fresh

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Start an episode."""
        time.sleep(self._switches.take("hang_reset") or 0.0)
        return self._env.reset(seeds)

    def step(self, action: Float32[np.ndarray, "envs action"], next_seeds: Sequence[int]) -> StepResult:
        """Execute one control step, well or badly."""
        self._hold_up()
        result = self._env.step(action, next_seeds)
        return self._spoil(result)

    def _spoil(self, result: StepResult) -> StepResult:
        """The step with one thing wrong, if anything is to be."""
        final = result.final
        if self._switches.take("nan_reward") is not None:
            return dataclasses.replace(result, reward=np.full_like(result.reward, np.nan))
        if self._switches.take("nan_state") is not None:
            spoilt = dataclasses.replace(final, proprio=np.full_like(final.proprio, np.inf))
            return dataclasses.replace(result, final=spoilt)
        if final.rgb is not None and self._switches.take("black_picture") is not None:
            return dataclasses.replace(result, final=dataclasses.replace(final, rgb=np.zeros_like(final.rgb)))
        return result

    def close(self) -> None:
        """Release the simulator."""
        self._env.close()

    def _hold_up(self) -> None:
        """Hang, or make this step's whole round take a multiple of its time."""
        time.sleep(self._switches.take("hang_step") or 0.0)
        factor = self._switches.lasting("slow")
        if factor is not None:
            time.sleep((factor - 1) * min(1.0, time.monotonic() - self._stepped_at))
        self._stepped_at = time.monotonic()


def make_faulty_env(
    config: RunConfig, camera: bool, *, folder: Path, make_env: Callable[[RunConfig, bool], AdjustableEnv]
) -> FaultyEnv:
    """A faulty environment as a backend asks for one, once folder and environment are bound."""
    return FaultyEnv(make_env(config, camera), Switches(folder))


MAKERS: dict[str, Callable[[RunConfig, bool], AdjustableEnv]] = {"toy": make_toy_env, "simulator": make_wrist_env}
"""What a chaos run trains in."""
