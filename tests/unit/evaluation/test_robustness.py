"""A policy under corrupted pictures: it sees them corrupted, and nothing else is different."""

import numpy as np
import pytest

from slotfilm_dist.envs.toy import ToyEnv
from slotfilm_dist.evaluation.record import summarize
from slotfilm_dist.evaluation.robustness import CorruptedPolicy, play_corrupted, robustness_rows
from slotfilm_dist.evaluation.rollouts import play_episodes
from slotfilm_dist.messages import Observation
from slotfilm_dist.presets import smoke


class Watcher:
    """Acts by the picture's mean colour and remembers what it saw."""

    version, backbone_hash = 7, "abc"

    def __init__(self) -> None:
        self.pictures: list[np.ndarray] = []
        self.states: list[np.ndarray] = []

    def visual(self, observation: Observation) -> np.ndarray:
        assert observation.rgb is not None
        self.pictures.append(observation.rgb[0])
        self.states.append(observation.proprio[0])
        return observation.rgb

    def act(self, observation: Observation, visual: np.ndarray) -> np.ndarray:
        action = np.zeros((1, 7), np.float32)
        action[0, :3] = 1 - visual.reshape(-1, 3).mean(axis=0) / 127.5
        return action


def play(name: str, hold: str = "frame", seeds: tuple[int, ...] = (10_000_000,)) -> tuple[Watcher, list]:
    watcher = Watcher()
    episodes = list(play_corrupted(ToyEnv(smoke(), camera=True), watcher, seeds, name, hold))
    return watcher, episodes


def test_clean_is_the_policy_itself() -> None:
    watcher, episodes = play("clean")
    assert episodes == list(play_episodes(ToyEnv(smoke(), camera=True), Watcher(), [10_000_000]))
    assert (watcher.pictures[0] == watcher.pictures[0][0, 0]).all()  # the toy's pictures are of one colour


def test_occlusion_hides_15_percent_and_leaves_the_state() -> None:
    watcher, _ = play("occlusion")
    hidden = [float((picture == 0).all(axis=2).mean()) for picture in watcher.pictures]
    assert hidden == pytest.approx([0.1526] * len(hidden), abs=1e-3)
    assert (watcher.states[0] == play("clean")[0].states[0]).all()


def test_corruption_reaches_the_actions_and_is_reproducible() -> None:
    first, again, clean = play("occlusion")[1], play("occlusion")[1], play("clean")[1]
    assert first == again
    assert first != clean


def test_hold_decides_whether_the_square_stays() -> None:
    def places(watcher: Watcher) -> set[bytes]:
        return {(picture == 0).all(axis=2).tobytes() for picture in watcher.pictures}

    assert len(places(play("occlusion", "episode")[0])) == 1
    assert len(places(play("occlusion", "frame")[0])) > 20
    assert len(places(play("occlusion", "episode", (10_000_000, 10_000_001))[0])) == 2


def test_rows_compare_the_same_seeds_with_clean() -> None:
    seeds = tuple(range(10_000_000, 10_000_004))
    played = {
        name: summarize(name, name, 0, tuple(play(name, seeds=seeds)[1]), ("reach",))
        for name in ("clean", "noise", "occlusion")
    }
    rows = {row["corruption"]: row for row in robustness_rows(played, np.random.default_rng(0))}
    assert rows["clean"]["return_change"] == 0
    expected = played["occlusion"].mean_return - played["clean"].mean_return
    assert rows["occlusion"]["return_change"] == pytest.approx(expected)
    assert rows["occlusion"]["return_change_low"] <= expected <= rows["occlusion"]["return_change_high"]
    assert rows["noise"]["num_episodes"] == 4


def test_unknown_corruption_and_policy_attributes() -> None:
    with pytest.raises(ValueError, match="corruption = 'fog'"):
        CorruptedPolicy(Watcher(), "fog", 0)
    wrapped = CorruptedPolicy(Watcher(), "noise", 0)
    assert (wrapped.version, wrapped.backbone_hash) == (7, "abc")
