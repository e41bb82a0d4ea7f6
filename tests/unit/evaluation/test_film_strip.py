"""Which moments of an episode a film strip shows."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from slotfilm_dist.config import RunConfig
from slotfilm_dist.evaluation.film_strip import Moment, MomentRecorder, key_steps, moment_rows, write_moments
from slotfilm_dist.evaluation.rollouts import play_episodes
from slotfilm_dist.policy import RandomPolicy
from slotfilm_dist.presets import smoke


def episode(length: int, grasped: range | list[int] = range(0), placed: range | list[int] = range(0)) -> list[Moment]:
    return [
        Moment(
            rgb=np.full((32, 32, 3), i, np.uint8),
            contact=i in grasped,
            grasped=i in grasped,
            placed=i in placed,
            success=i in placed,
            reward=1.0,
        )
        for i in range(length)
    ]


def test_solved_episode_shows_the_five_phases_in_order() -> None:
    moments = episode(101, grasped=range(20, 101), placed=range(60, 101))
    assert key_steps(moments) == [(10, "reach"), (20, "grasp"), (40, "transport"), (60, "place"), (100, "hold")]


def test_grasp_that_slipped_is_not_the_one_shown() -> None:
    moments = episode(101, grasped=[5, 6, *range(30, 101)], placed=range(60, 101))
    assert dict((name, step) for step, name in key_steps(moments))["grasp"] == 30


def test_object_pushed_into_place_without_a_grasp_is_no_placement() -> None:
    moments = episode(101, grasped=range(40, 60), placed=range(0, 30))
    names = [name for _, name in key_steps(moments)]
    assert names == ["reach", "grasp", "transport", "step 75", "step 100"]


def test_dropped_object_is_not_called_held() -> None:
    moments = episode(101, grasped=range(20, 80), placed=range(60, 80))
    assert key_steps(moments)[-1] == (100, "step 100")


@pytest.mark.parametrize(
    ("grasped", "placed", "expected"),
    [
        ([10], [], [(5, "reach"), (10, "grasp"), (32, "step 32"), (55, "step 55"), (100, "step 100")]),
        (range(50, 101), range(51, 101), [(0, "step 0"), (25, "reach"), (50, "grasp"), (51, "place"), (100, "hold")]),
        ([100], [], [(0, "step 0"), (25, "step 25"), (50, "reach"), (75, "step 75"), (100, "grasp")]),
        ([50], [50], [(0, "step 0"), (25, "reach"), (50, "grasp"), (75, "step 75"), (100, "step 100")]),
        (range(20, 101), [100], [(10, "reach"), (20, "grasp"), (40, "step 40"), (60, "transport"), (100, "place")]),
    ],
    ids=["dropped at once", "placed at once", "grasped at the end", "grasped and placed at once", "placed at the end"],
)
def test_moments_that_coincide_or_are_missing_leave_five_panels(grasped, placed, expected) -> None:
    assert key_steps(episode(101, grasped, placed)) == expected


def test_transport_shows_the_object_held() -> None:
    moments = episode(101, grasped=[*range(10, 20), *range(80, 90)])
    steps = {name: step for step, name in key_steps(moments)}
    assert steps["grasp"] == 10
    assert moments[steps["transport"]].grasped


def test_episode_without_grasp_is_evenly_spaced_and_named_by_step() -> None:
    assert key_steps(episode(41)) == [(i, f"step {i}") for i in (0, 10, 20, 30, 40)]
    assert key_steps(episode(2)) == [(0, "step 0"), (1, "step 1")]
    with pytest.raises(ValueError, match="record an episode first"):
        key_steps([])


def test_strip_shows_these_pictures_and_the_table_says_so(tmp_path: Path) -> None:
    moments = episode(101, grasped=range(20, 101), placed=range(60, 101))
    strip = np.asarray(Image.open(write_moments(moments, tmp_path / "a" / "strip.png", panel_px=64)))
    assert strip.shape[1] == 5 * 64 + 4 * 4
    assert [int(strip[20, 30 + i * 68, 0]) for i in range(5)] == [10, 20, 40, 60, 100]
    rows = moment_rows(moments)
    assert {row["step"]: row["panel"] for row in rows if row["panel"]} == dict(key_steps(moments))
    assert [rows[i]["grasped"] for i in (19, 20)] == [0, 1]


def test_recorder_takes_the_reset_and_every_step_of_a_played_episode() -> None:
    from slotfilm_dist.envs.toy import ToyEnv

    config: RunConfig = smoke()
    env = ToyEnv(config, camera=True)
    recorder = MomentRecorder()
    seen = []

    def watch(observation, visual, step):  # the last picture is the episode's own, not the next one's
        recorder(observation, visual, step)
        seen.append((observation.rgb[0], step.final.rgb[0], float(step.reward[0])))

    next(play_episodes(env, RandomPolicy(7, np.random.SeedSequence(0)), [10_000_000], watch))
    assert len(recorder.moments) == config.env.max_steps + 1
    assert (recorder.moments[0].rgb == seen[0][0]).all()
    assert (recorder.moments[-1].rgb == seen[-1][1]).all()
    assert [m.reward for m in recorder.moments[1:]] == [reward for _, _, reward in seen]
