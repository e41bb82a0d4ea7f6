"""Rollouts in an environment whose numbers say which episode and step they belong to."""

import dataclasses
from collections.abc import Container, Sequence

import numpy as np
import pytest

from slotfilm_dist.evaluation.rollouts import play_episodes
from slotfilm_dist.messages import Observation, StepResult, TransitionBlock
from slotfilm_dist.policy import RandomPolicy
from slotfilm_dist.rejection import MAX_REJECTED, BrokenEnvironmentError
from slotfilm_dist.rollout import TRAINING_SEEDS, RolloutLoop

LENGTH = 5


class CountingEnv:
    """Episodes of `LENGTH` steps: the state is (seed, step), every pixel the step + 1, the reward 10 x step."""

    action_dim = 2
    reward_term_names: tuple[str, ...] = ("count",)

    def __init__(self, num_envs: int = 1, *, terminates: bool = False, gives_inputs: bool = False) -> None:
        self.num_envs = num_envs
        self._gives_inputs = gives_inputs
        self.executed: list[np.ndarray] = []
        self.started: list[int] = []
        self._terminates = terminates

    def reset(self, seeds: Sequence[int]) -> Observation:
        self._seeds, self._step = list(seeds), np.arange(self.num_envs) % LENGTH
        self.started += seeds
        return self._observe()

    def step(self, action: np.ndarray, next_seeds: Sequence[int]) -> StepResult:
        self.executed.append(action.copy())
        reward = (10 * self._step).astype(np.float32)
        self._step = self._step + 1
        over = self._step >= LENGTH
        final = self._observe()
        for i in np.flatnonzero(over):
            self._seeds[i], self._step[i] = next_seeds[i], 0
            self.started.append(next_seeds[i])
        none = np.zeros(self.num_envs, bool)
        return StepResult(
            observation=self._observe(),
            final=final,
            reward=reward,
            terminated=over if self._terminates else none,
            truncated=none if self._terminates else over,
            success=over,
            placed=none,
            grasped=reward == 20,
            contact=none,
            reward_terms=reward[:, None],
            reward_inputs=np.stack((reward, reward + 1), axis=1) if self._gives_inputs else None,
        )

    def close(self) -> None:
        pass

    def _observe(self) -> Observation:
        count = self.num_envs
        proprio = np.stack((np.array(self._seeds), self._step), axis=1).astype(np.float32)
        return Observation(
            rgb=np.broadcast_to(self._step[:, None, None, None] + 1, (count, 4, 4, 3)).astype(np.uint8),
            proprio=proprio,
            uv=np.full((count, 1, 2), 0.5, np.float32),
            visible=np.ones((count, 1), bool),
            goal=np.zeros((count, 3), np.float32),
        )


def loop_in(env: CountingEnv, seed: int = 0) -> RolloutLoop:
    return RolloutLoop(env, RandomPolicy(2, np.random.SeedSequence(seed)), np.random.SeedSequence(seed + 1))


def next_rows(block: TransitionBlock) -> np.ndarray:
    return np.flatnonzero(block.is_step) + 1


@pytest.mark.parametrize("terminates", [False, True])
def test_next_frame_of_the_last_step_is_the_true_final_one_and_not_the_reset_one(terminates: bool) -> None:
    env = CountingEnv(terminates=terminates)
    block = loop_in(env).collect(100)
    assert block.num_steps == LENGTH
    assert block.proprio[:, 1].tolist() == [0, 1, 2, 3, 4, 5]
    assert block.visual[:, 0, 0, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert set(block.proprio[:, 0]) == {np.float32(env.started[0])}
    assert block.is_step.tolist() == [True] * 5 + [False]
    ended = block.terminated if terminates else block.truncated
    other = block.truncated if terminates else block.terminated
    assert ended.tolist() == [False] * 4 + [True, False]
    assert not other.any()


@pytest.mark.parametrize("num_envs", [1, 3])
def test_every_steps_next_frame_lies_in_its_own_block(num_envs: int) -> None:
    loop = loop_in(CountingEnv(num_envs))
    for _ in range(12):
        block = loop.collect(3)
        steps = np.flatnonzero(block.is_step)
        assert (block.proprio[next_rows(block), 1] == block.proprio[steps, 1] + 1).all()
        assert (block.proprio[next_rows(block), 0] == block.proprio[steps, 0]).all()
        assert (block.reward[steps] == 10 * block.proprio[steps, 1]).all()


@pytest.mark.parametrize("num_envs", [1, 3])
def test_rewards_inputs_stay_with_their_step_and_are_zero_without_one(num_envs: int) -> None:
    loop = loop_in(CountingEnv(num_envs, gives_inputs=True))
    for _ in range(4):
        block = loop.collect(3)
        assert block.reward_inputs is not None
        steps = block.is_step
        assert np.array_equal(block.reward_inputs[steps], np.stack((block.reward, block.reward + 1), axis=1)[steps])
        assert not block.reward_inputs[~steps].any()
    assert loop_in(CountingEnv(num_envs)).collect(3).reward_inputs is None


def test_action_stored_is_the_action_executed() -> None:
    env = CountingEnv(2)
    loop = loop_in(env)
    block = loop.collect(4)
    rows = block.action[block.is_step].reshape(2, 4, 2)
    assert np.array_equal(rows.swapaxes(0, 1), np.stack(env.executed))
    assert np.abs(rows).max() <= 1
    assert np.ptp(rows) > 1


def test_pictures_are_kept_as_uint8() -> None:
    block = loop_in(CountingEnv()).collect(3)
    assert block.visual.dtype == np.uint8
    assert block.visual.shape == (4, 4, 4, 3)


def test_blocks_are_numbered_and_a_single_environment_stops_where_its_episode_ends() -> None:
    loop = loop_in(CountingEnv())
    blocks = [loop.collect(3) for _ in range(4)]
    assert [block.sequence for block in blocks] == [0, 1, 2, 3]
    assert [block.num_steps for block in blocks] == [3, 2, 3, 2]
    assert [len(block.episodes) for block in blocks] == [0, 1, 0, 1]
    assert {block.policy_version for block in blocks} == {-1}


def test_episode_is_summed_up_once() -> None:
    env = CountingEnv()
    block = loop_in(env).collect(100)
    (episode,) = block.episodes
    assert (episode.seed, episode.length, episode.episode_return) == (env.started[0], LENGTH, 100.0)
    assert (episode.success_at_end, episode.grasped_once, episode.reward_terms) == (True, True, (100.0,))


def test_training_seeds_differ_and_stay_below_the_held_out_range() -> None:
    env = CountingEnv(2)
    loop = loop_in(env)
    loop.collect(40)
    assert len(set(env.started)) == len(env.started) > 10
    assert max(env.started) < TRAINING_SEEDS


def test_loop_loaded_at_an_episodes_start_goes_on_with_the_same_episodes() -> None:
    env = CountingEnv()
    loop = loop_in(env)
    assert loop.at_episode_start
    loop.collect(3)
    assert not loop.at_episode_start
    loop.collect(3)
    assert loop.at_episode_start
    saved = loop.save()
    other_env = CountingEnv()
    other = loop_in(other_env, seed=50)
    other.load(saved)
    first, second = [loop.collect(9) for _ in range(3)], [other.collect(9) for _ in range(3)]
    for a, b in zip(first, second, strict=True):
        assert a.sequence == b.sequence
        assert np.array_equal(a.proprio, b.proprio)
        assert a.episodes == b.episodes


def test_evaluation_plays_each_seed_once_to_its_end_without_a_block() -> None:
    env = CountingEnv()
    policy = RandomPolicy(2, np.random.SeedSequence(0))
    episodes = list(play_episodes(env, policy, [7, 8, 9]))
    assert [(e.seed, e.length) for e in episodes] == [(7, LENGTH), (8, LENGTH), (9, LENGTH)]
    assert len(env.executed) == 3 * LENGTH


class BreakingEnv(CountingEnv):
    """Breaks one thing in the first environment at some calls of `step`, numbered from 0."""

    def __init__(self, what: str, when: Container[int], num_envs: int = 1) -> None:
        super().__init__(num_envs)
        self._what, self._when = what, when

    def step(self, action: np.ndarray, next_seeds: Sequence[int]) -> StepResult:
        result = super().step(action, next_seeds)
        if len(self.executed) - 1 not in self._when:
            return result
        if self._what == "reward":
            return dataclasses.replace(result, reward=np.where(np.arange(self.num_envs) == 0, np.nan, result.reward))
        spoilt = result.final.proprio.copy(), result.final.rgb.copy()
        spoilt[0][0, 1] = np.inf if self._what == "state" else spoilt[0][0, 1]
        spoilt[1][0] *= self._what != "picture"
        return dataclasses.replace(result, final=dataclasses.replace(result.final, proprio=spoilt[0], rgb=spoilt[1]))


@pytest.mark.parametrize("what", ["reward", "state", "picture"])
def test_broken_step_is_left_out_and_its_episode_ends_without_a_summary(what: str) -> None:
    env = BreakingEnv(what, {2})
    loop = loop_in(env)
    first, second = loop.collect(100), loop.collect(100)
    assert first.proprio[:, 1].tolist() == [0, 1, 2]
    assert first.is_step.tolist() == [True, True, False]
    assert not first.truncated.any()
    assert not first.terminated.any()
    assert first.episodes == ()
    assert second.proprio[:, 1].tolist() == [0, 1, 2, 3, 4, 5]
    assert (loop.num_rejected, loop.num_cut_episodes) == (1, 1)


def test_block_whose_first_step_is_broken_is_not_empty() -> None:
    block = loop_in(BreakingEnv("reward", {0})).collect(1)
    assert block.proprio[:, 1].tolist() == [0, 1]


def test_other_environments_keep_their_steps_when_one_breaks() -> None:
    loop = loop_in(BreakingEnv("reward", {1}, num_envs=3))
    block = loop.collect(4)
    assert np.isfinite(block.reward).all()
    steps = np.flatnonzero(block.is_step)
    assert len(steps) == 3 * 4 - 1
    assert (block.proprio[next_rows(block), 0] == block.proprio[steps, 0]).all()
    assert (block.proprio[next_rows(block), 1] == block.proprio[steps, 1] + 1).all()
    assert loop.num_cut_episodes == 3


def test_environment_that_breaks_too_often_is_given_up() -> None:
    loop = loop_in(BreakingEnv("reward", range(1000)))
    with pytest.raises(BrokenEnvironmentError, match=f"{MAX_REJECTED + 1} of the environment's last"):
        loop.collect(100)
    assert loop.num_rejected == MAX_REJECTED + 1
