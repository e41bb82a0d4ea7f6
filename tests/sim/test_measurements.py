"""Perception, probes, robustness and film strips of an untrained agent in the real simulator."""

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slotfilm_dist.__main__ import main
from slotfilm_dist.config import RunConfig
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant

pytestmark = [pytest.mark.sim, pytest.mark.render]


def small(variant: str) -> RunConfig:
    base = apply_variant(variant, smoke())
    return dataclasses.replace(
        base,
        env=dataclasses.replace(base.env, image_size=32, max_steps=40),
        runtime=dataclasses.replace(base.runtime, learner_threads=1, device="cpu"),
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("measurements")


@pytest.fixture(scope="module")
def run(place: Path, write_agent_run: Callable[..., Path]) -> Path:
    return write_agent_run(place / "slotfilm", small("slotfilm"))


def result(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_perception_writes_its_folder(run: Path, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--what", "perception", "--episodes", "2", "--steps", "5", "--artifacts", str(place / "artifacts"))
    values = result(capsys, "evaluate", str(run), *words)
    assert list(values["quality"]) == ["clean", "occlusion", "noise", "affine", "together"]
    folder = run / "perception" / "random-last"
    assert json.loads((folder / "quality.json").read_text()) == values
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 5 * 2
    shown = [row for row in rows if row["visible"] == "1"]
    errors = [
        32 * np.hypot(float(r["u"]) - float(r["u_predicted"]), float(r["v"]) - float(r["v_predicted"])) for r in shown
    ]
    assert np.mean(errors) == pytest.approx(values["quality"]["clean"]["position_error_px"], rel=1e-3)
    for name in ("attention.png", "positions.png", "corruptions.png"):
        assert (folder / name).stat().st_size > 5_000


def test_probes_of_two_variants_read_identical_frames(
    run: Path, place: Path, write_agent_run: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--episodes", "2", "--artifacts", str(place / "artifacts"))
    blind = write_agent_run(place / "state_only", small("state_only"))
    first = result(capsys, "probe", str(run), *words)
    frames = sorted((place / "artifacts").glob("frames-*.npz"), key=lambda path: path.stat().st_mtime_ns)
    second = result(capsys, "probe", str(blind), *words)
    assert sorted((place / "artifacts").glob("frames-*.npz"), key=lambda path: path.stat().st_mtime_ns) == frames
    assert first["labels"] == second["labels"]
    # The expert grasps within 40 steps, so there is contact, but not from the first step on.
    assert 0.1 < first["labels"]["contact_share"] < 0.9
    assert second["probes"]["visual"] is None
    changes = second["probes"]["policy_input"]["auroc_change"]
    assert [changes[name]["value"] for name in ("occlusion", "noise", "affine")] == [0, 0, 0]
    assert second["probes"]["policy_input"]["contact_auroc"]["value"] > 0.5  # the fingers' positions tell
    assert (run / "probe" / "expert-last" / "table.csv").exists()


def test_robustness_plays_every_corruption_on_the_same_seeds(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = result(capsys, "evaluate", str(run), "--what", "robustness", "--episodes", "1")
    assert [row["corruption"] for row in values["rows"]] == ["clean", "occlusion", "noise", "affine", "together"]
    written = json.loads((run / "robustness" / "policy.json").read_text())["episodes"]
    assert {episodes[0]["seed"] for episodes in written.values()} == {10_000_000}
    assert written["together"][0]["episode_return"] != written["clean"][0]["episode_return"]


def test_run_of_a_gpu_is_evaluated_on_a_cpu(
    place: Path, write_agent_run: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    config = small("state_only")
    trained = dataclasses.replace(config, runtime=dataclasses.replace(config.runtime, device="cuda"))
    path = write_agent_run(place / "gpu", trained)
    assert len(result(capsys, "evaluate", str(path), "--episodes", "1", "--device", "cpu")["episodes"]) == 1


def test_film_strip_of_the_expert_shows_the_papers_phases(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--what", "film_strips", "--policy", "expert", "--episodes", "1")
    strip = result(capsys, "evaluate", str(run), *words)["strips"][0]
    phases = [name for name in strip["panels"] if not name.startswith("step ")]
    assert phases[:3] == ["reach", "grasp", "transport"]
    assert strip["grasped_once"]
    assert (run / "film_strips" / "expert-10000000.png").stat().st_size > 5_000
