"""An environment worker: steps its environment with the newest policy and gets rid of blocks. Plain, without Ray."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32

from slotfilm_dist.cluster.acting import ActingPolicy, FollowingPolicy, WeightLink
from slotfilm_dist.cluster.central_policy import CentralPolicy, InferenceLink
from slotfilm_dist.cluster.messages import AgentSetup, WorkerBeat
from slotfilm_dist.cluster.outlet import Mailbox, Outlet
from slotfilm_dist.cluster.sender import BlockSender, HubLink, StoreLink
from slotfilm_dist.config import RunConfig
from slotfilm_dist.contracts import AdjustableEnv, VectorEnv
from slotfilm_dist.machine import used_memory_share
from slotfilm_dist.messages import Observation, StepResult, TransitionBlock
from slotfilm_dist.nets.agent import build_actor, build_encoder
from slotfilm_dist.policy import AgentPolicy, Policy, RandomPolicy
from slotfilm_dist.rollout import RolloutLoop
from slotfilm_dist.seeds import Role, role_seed

EnvFactory = Callable[[RunConfig, bool], AdjustableEnv]
"""Builds the environment of a run, with a camera or without; a function at the top of a module."""

BUILD_LIMIT_S = 180.0
"""Longest time to build a simulator and its first episode."""
STEP_LIMIT_S = 30.0
"""Longest time of one environment step, and between two signs of life while waiting."""
CPU = torch.device("cpu")
SLICE_S = 0.25
"""Waits are cut in slices of this length, so that a stop is noticed."""


@runtime_checkable
class WorkerHubLink(HubLink, WeightLink, Protocol):
    """What a worker asks of the hub: that its blocks are admitted, and weights."""


class Stopped(Exception):
    """The loop was asked to stop in the middle of a block."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """How long a worker may go without progress."""

    build_s: float = BUILD_LIMIT_S
    step_s: float = STEP_LIMIT_S


def build_policy(
    config: RunConfig,
    setup: AgentSetup,
    seed: np.random.SeedSequence,
    *,
    deterministic: bool = False,
    device: torch.device = CPU,
) -> AgentPolicy:
    """The agent's policy, with the learner's own encoder; `load` gives it the newest weights."""
    encoder = build_encoder(config, fetch_weights=False)
    encoder.load_state_dict({name: torch.tensor(value) for name, value in setup.encoder.items()})
    if not config.sac.end_to_end:
        encoder.freeze_backbone()
    encoder.eval()
    actor = build_actor(config, encoder, setup.action_dim)
    return AgentPolicy(encoder.to(device), actor.to(device), seed, deterministic=deterministic)


class WorkerLoop:
    """Steps one environment in a thread of its own.

    Consumes weights, which its policy follows by itself; produces blocks of `runtime.block_steps` steps. Waits for its
    outlet to take a block: the limiter
    and a shard in training, the driver while the random policy collects. Stops between two environment steps when told
    to (`stop`), when its outlet is finished, or on an error, which `beat` then names.

    Args:
        config: the run.
        worker_id: number of this worker.
        make_env: builds the environment, in the loop's own thread.
        limits: how long it may go without progress.
    """

    def __init__(self, config: RunConfig, worker_id: int, make_env: EnvFactory, limits: Limits | None = None) -> None:
        self._config = config
        self._worker_id = worker_id
        self._make_env = make_env
        self._limits = limits or Limits()
        self._env: AdjustableEnv | None = None
        self._built = threading.Event()
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._mailbox: Mailbox | None = None
        self._sender: BlockSender | None = None
        self._rollout: RolloutLoop | None = None
        self._incarnation, self._ended = 0, -1
        self._activity, self._limit_s, self._pulse_at = "nothing", self._limits.step_s, time.monotonic()
        self._num_steps = self._num_blocks = 0
        self._acting: ActingPolicy | None = None
        self._waited_s = self._step_s = 0.0
        self._error = self._error_reason = ""

    def collect_randomly(self, incarnation: int, already: int) -> None:
        """Start collecting with the random policy, after `already` steps; `take_random_blocks` fetches the blocks."""
        mailbox = self._mailbox = Mailbox(2)

        def policy(action_dim: int) -> Policy:
            return RandomPolicy(action_dim, self._seed(Role.RANDOM_ACTIONS, incarnation, already))

        episodes = self._seed(Role.RANDOM_EPISODES, incarnation, already)
        self._start(incarnation, mailbox, policy, episodes, self._config.random_episode_length)

    def take_random_blocks(self, timeout_s: float) -> list[TransitionBlock]:
        """Blocks of the random policy, at least one unless time runs out."""
        assert self._mailbox is not None, "collect_randomly comes first"
        return self._mailbox.take(timeout_s)

    def train(self, incarnation: int, hub: WorkerHubLink, store: StoreLink, agent: AgentSetup | InferenceLink) -> None:
        """Start collecting with the trained agent for replay.

        Args:
            incarnation: of this worker.
            hub: admits its blocks, has the weights.
            store: takes its blocks.
            agent: to act with, here, or the process that acts for it.
        """
        sender = self._sender = BlockSender(hub, store)
        seed = self._seed(Role.ACTIONS, incarnation)
        max_staleness_s = self._config.runtime.max_staleness_s

        def policy(action_dim: int) -> Policy:
            acting = self._acting = (
                FollowingPolicy(build_policy(self._config, agent, seed), hub, self._note_wait, max_staleness_s)
                if isinstance(agent, AgentSetup)
                else CentralPolicy(agent, self._worker_id, action_dim, seed, self._note_wait)
            )
            return acting

        episodes = self._seed(Role.EPISODES, incarnation)
        self._start(incarnation, sender, policy, episodes, self._config.env.max_steps)

    def describe(self, timeout_s: float) -> tuple[int, tuple[str, ...]] | None:
        """Size of an action and names of the reward's terms, or None while the environment is being built."""
        if not self._built.wait(timeout_s) or self._env is None:
            return None
        return self._env.action_dim, self._env.reward_term_names

    def stop(self, timeout_s: float) -> bool:
        """Stop the loop after the running step; False if it still runs when time is up."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout_s)
            return not self._thread.is_alive()
        return True

    def beat(self) -> WorkerBeat:
        """How it does."""
        activity = self._activity
        return WorkerBeat(
            worker_id=self._worker_id,
            incarnation=self._incarnation,
            activity=activity,
            limit_s=self._limit_s,
            idle_s=time.monotonic() - self._pulse_at,
            num_steps=self._num_steps,
            num_blocks=self._num_blocks,
            policy_version=self._acting.version if self._acting else -1,
            waited_s=self._waited_s,
            step_s=self._step_s,
            weights_lags_s=self._acting.take_lags_s() if self._acting else (),
            num_rejected=self._rollout.num_rejected if self._rollout else 0,
            num_cut_episodes=self._rollout.num_cut_episodes if self._rollout else 0,
            memory_share=used_memory_share(),
            error=self._error,
            error_reason=self._error_reason,
            running=self._thread is not None and self._thread.is_alive(),
            ended=self._ended == self._incarnation,
        )

    def _seed(self, role: Role, incarnation: int, already: int = 0) -> np.random.SeedSequence:
        return role_seed(self._config.seed, role, self._worker_id, incarnation, already)

    def _start(
        self,
        incarnation: int,
        outlet: Outlet,
        make_policy: Callable[[int], Policy],
        episodes: np.random.SeedSequence,
        episode_steps: int,
    ) -> None:
        assert self._thread is None or not self._thread.is_alive(), "stop comes first"
        self._stopping = threading.Event()
        self._incarnation = incarnation
        self._num_steps = self._num_blocks = 0
        self._rollout = None
        self._error = self._error_reason = ""
        self._note("starting", self._limits.build_s)
        self._thread = threading.Thread(
            target=self._run,
            args=(outlet, make_policy, episodes, episode_steps),
            name=f"worker-{self._worker_id}",
            daemon=True,
        )
        self._thread.start()

    def _run(
        self,
        outlet: Outlet,
        make_policy: Callable[[int], Policy],
        seed: np.random.SeedSequence,
        episode_steps: int,
    ) -> None:
        incarnation = self._incarnation
        try:
            rollout = self._rollout = self._build(make_policy, seed, episode_steps)
            self._await_weights()
            while not (self._stopping.is_set() or outlet.finished):
                began = time.monotonic()
                block = rollout.collect(self._config.runtime.block_steps)
                self._step_s = (time.monotonic() - began) / max(1, block.num_steps)
                _require_finite_actions(block)
                self._hand_over(outlet, block)
        except Stopped:
            pass
        except Exception as error:  # told to the supervisor, which replaces this worker and counts it
            self._error = f"{type(error).__name__}: {error}".splitlines()[0]
            self._error_reason = "nonfinite" if isinstance(error, FloatingPointError) else "crash"
        finally:
            self._note("ending", self._limits.step_s)
            if self._acting is not None:
                self._acting.close()
            outlet.close()
            self._ended = incarnation

    def _build(
        self, make_policy: Callable[[int], Policy], seed: np.random.SeedSequence, episode_steps: int
    ) -> RolloutLoop:
        if self._env is None:
            self._note("building the simulator", self._limits.build_s)
            self._env = self._make_env(self._config, self._config.encoder.uses_image)
            self._built.set()
        self._env.episode_steps = episode_steps
        policy = make_policy(self._env.action_dim)
        self._note("starting the first episode", self._limits.build_s)
        watched = _WatchedEnv(self._env, self._note_reset, self._note_step)
        return RolloutLoop(watched, policy, seed, self._worker_id, self._incarnation)

    def _await_weights(self) -> None:
        """The trained agent does not act before its first weights; newer ones come by themselves."""
        while self._acting is not None and not self._acting.await_weights(SLICE_S):
            self._note("waiting for the first weights", self._limits.step_s)
            if self._stopping.is_set():
                raise Stopped

    def _hand_over(self, outlet: Outlet, block: TransitionBlock) -> None:
        began = time.monotonic()
        while not outlet.finished:
            self._note(f"waiting for {outlet.waiting_for()}", self._limits.step_s)
            if outlet.offer(block, SLICE_S):
                self._num_steps += block.num_steps
                self._num_blocks += 1
                break
            if self._stopping.is_set():
                raise Stopped
        self._waited_s += time.monotonic() - began

    def _note(self, activity: str, limit_s: float) -> None:
        self._activity, self._limit_s, self._pulse_at = activity, limit_s, time.monotonic()

    def _note_wait(self, waiting_for: str) -> None:
        self._note(f"waiting for {waiting_for}", self._limits.step_s)
        if self._stopping.is_set():
            raise Stopped

    def _note_reset(self) -> None:
        first = self._num_blocks == 0
        self._note("starting an episode", self._limits.build_s if first else self._limits.step_s)

    def _note_step(self) -> None:
        self._note("stepping the environment", self._limits.step_s)
        if self._stopping.is_set():
            raise Stopped


class _WatchedEnv:
    """An environment that says when it begins a reset or a step."""

    def __init__(self, env: VectorEnv, note_reset: Callable[[], None], note_step: Callable[[], None]) -> None:
        self._env = env
        self._note_reset, self._note_step = note_reset, note_step
        self.num_envs = env.num_envs
        self.action_dim = env.action_dim
        self.reward_term_names = env.reward_term_names

    def reset(self, seeds: Sequence[int]) -> Observation:
        self._note_reset()
        return self._env.reset(seeds)

    def step(self, action: Float32[np.ndarray, "envs action"], next_seeds: Sequence[int]) -> StepResult:
        self._note_step()
        return self._env.step(action, next_seeds)

    def close(self) -> None:
        self._env.close()


def _require_finite_actions(block: TransitionBlock) -> None:
    """The rollout leaves out what the environment breaks; actions that are not finite come from the weights."""
    if not np.isfinite(block.action).all():
        raise FloatingPointError(f"the policy of version {block.policy_version} acts in numbers that are not finite")
