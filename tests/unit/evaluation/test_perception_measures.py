"""Perception measured on frames whose answer is known."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from slotfilm_dist.config import RunConfig
from slotfilm_dist.evaluation.labelled_frames import LabelledFrames, load_frames, save_frames
from slotfilm_dist.evaluation.perception import (
    attention_matching,
    frame_rows,
    measure_perception,
    strongest_slots,
    summary,
    swap_rate,
)
from slotfilm_dist.evaluation.perception_figures import draw_attention, draw_corruptions, draw_positions
from slotfilm_dist.evaluation.result_files import plain, write_csv, write_json
from slotfilm_dist.nets.agent import build_encoder
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.nets.perception import Perception


def make_frames(episodes: int = 3, steps: int = 6) -> LabelledFrames:
    """Grey frames with coloured objects at known places."""
    rng = np.random.default_rng(0)
    count = episodes * steps
    uv = rng.uniform(0.2, 0.8, (count, 2, 2)).astype(np.float32)
    rgb = np.full((count, 64, 64, 3), 120, np.uint8)
    for i in range(count):
        for k in range(2):
            x, y = (uv[i, k] * 64).astype(int)
            rgb[i, y - 3 : y + 3, x - 3 : x + 3, k] = 250
    return LabelledFrames(
        rgb=rgb,
        proprio=rng.normal(size=(count, 35)).astype(np.float32),
        goal=np.zeros((count, 3), np.float32),
        uv=uv,
        visible=rng.random((count, 2)) < 0.8,
        contact=rng.random(count) < 0.5,
        distance_m=rng.random(count).astype(np.float32),
        object_m=rng.normal(size=(count, 3)).astype(np.float32),
        episode=np.repeat(np.arange(10_000_000, 10_000_000 + episodes), steps).astype(np.int32),
        step=np.tile(np.arange(steps), episodes).astype(np.int32),
    )


@pytest.fixture(scope="module")
def encoder() -> SlotFusionEncoder:
    base = RunConfig()
    config = dataclasses.replace(
        base,
        env=dataclasses.replace(base.env, image_size=64),
        encoder=dataclasses.replace(base.encoder, backbone="random"),
    )
    built = build_encoder(config)
    assert isinstance(built, SlotFusionEncoder)
    built.freeze_backbone()
    return built.eval()


def test_swaps_are_counted_within_episodes_where_everything_is_visible() -> None:
    matching = np.array([[0, 1], [0, 1], [1, 0], [1, 0], [0, 1], [1, 0], [0, 1]])
    visible = np.ones((7, 2), bool)
    episode = np.array([5, 5, 5, 6, 6, 6, 6], np.int32)
    rate = swap_rate(matching, visible, episode)
    assert (rate.num_swaps, rate.num_pairs) == (4, 5)
    assert rate.by_episode == {5: (1, 2), 6: (3, 3)}
    assert rate.rate == pytest.approx(0.8)
    visible[5, 0] = False  # frame 5 lies in two pairs
    assert swap_rate(matching, visible, episode).by_episode == {5: (1, 2), 6: (1, 1)}


def test_swap_rate_without_pairs_is_undefined() -> None:
    rate = swap_rate(np.array([[0, 1], [1, 0]]), np.ones((2, 2), bool), np.array([1, 2], np.int32))
    assert np.isnan(rate.rate)


def test_attention_decides_the_matching_one_to_one() -> None:
    attention = torch.zeros(1, 3, 16)
    uv = torch.tensor([[[0.1, 0.1], [0.9, 0.9]]])  # tokens 0 and 15
    attention[0, 2, 0], attention[0, 2, 15] = 0.6, 0.5
    attention[0, 0, 15] = 0.4
    assert attention_matching(attention, uv).tolist() == [[2, 0]]


def test_strongest_slots_have_the_highest_peaks() -> None:
    attention = np.full((5, 4, 16), 1 / 16, np.float32)
    attention[:, 3, 2] = 0.9
    attention[:, 1, 7] = 0.8
    assert strongest_slots(attention, 2) == [1, 3]


class Knowing(SlotFusionEncoder):
    """Answers with the labels of the frames, one set after another; its slot k follows object 1 - k."""

    def answer_for(self, frames: LabelledFrames) -> "Knowing":
        uv, visible = torch.from_numpy(frames.uv), torch.from_numpy(frames.visible)
        cells = (uv * 4).floor().long()
        attention = torch.full((len(uv), 2, 16), 1e-3)
        for k in range(2):
            attention[torch.arange(len(uv)), k, cells[:, 1 - k, 1] * 4 + cells[:, 1 - k, 0]] = 0.9
        self.answers = Perception(
            slots=torch.zeros(len(uv), 2, 42),
            attention=attention,
            uv=uv.flip(1),
            visible_logits=torch.where(visible, 5.0, -5.0),
        )
        return self

    def tokens(self, rgb: torch.Tensor) -> torch.Tensor:
        return rgb.float()

    def perceive(self, tokens: torch.Tensor) -> Perception:
        assert len(tokens) == len(self.answers.uv)
        return self.answers


def test_perfect_predictions_have_no_error(encoder: SlotFusionEncoder) -> None:
    frames = make_frames()
    knowing = Knowing(encoder.config, RunConfig().obs, 64, fetch_weights=False).answer_for(frames)
    result = measure_perception(knowing, frames, seed=0)
    clean, affine = result.quality["clean"], result.quality["affine"]
    assert clean.position_error_px == pytest.approx(0, abs=1e-4)
    assert clean.visibility_auroc == 1
    assert clean.attention_nll < 0.2
    assert result.swaps_by_position["clean"].num_swaps == 0
    both = frames.visible.all(axis=1)
    assert (result.matching[both] == [1, 0]).all()
    # The labels move with the turned picture, this encoder's answers do not: 3 % of 64 px, a turn and an enlargement.
    assert 1 < affine.position_error_px < 4
    rows = frame_rows(frames, result, ("banana", "bowl"), matched_visibility=False)
    assert len(rows) == 2 * len(frames.rgb)
    shown = [row for row in rows if row["visible"]]
    assert max(row["error_px"] for row in shown) < 1e-3
    assert {row["slot"] for row in rows if not row["visible"]} == {None}


def test_everything_is_written_for_a_real_encoder(encoder: SlotFusionEncoder, tmp_path: Path) -> None:
    frames = make_frames()
    result = measure_perception(encoder, frames, seed=0, names=("occlusion",))
    low, high = result.intervals["clean"]["position_error_px"]
    assert low <= result.quality["clean"].position_error_px <= high
    write_json(tmp_path / "quality.json", summary(result))
    assert set(json.loads((tmp_path / "quality.json").read_text())["quality"]) == {"clean", "occlusion"}
    for path in (
        draw_attention(frames, result, [0, 3], tmp_path / "a.png"),
        draw_positions(frames, result, [0, 3, 5], ("banana", "bowl"), tmp_path / "p.png"),
        draw_corruptions(result, tmp_path / "c.png"),
    ):
        assert path.stat().st_size > 5_000


def test_frames_survive_the_disk_and_damage_is_named(tmp_path: Path) -> None:
    frames, path = make_frames(), tmp_path / "frames.npz"
    save_frames(frames, path)
    back = load_frames(path)
    for field in dataclasses.fields(frames):
        assert (getattr(back, field.name) == getattr(frames, field.name)).all()
    assert back.has_next.reshape(3, 6).tolist() == [[True] * 5 + [False]] * 3
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"frames\.npz: damaged"):
        load_frames(path)


def test_undefined_numbers_become_empty_cells_and_null(tmp_path: Path) -> None:
    values = {"a": float("nan"), "b": np.float32(1.5), "c": None, "d": (np.inf, 2)}
    assert plain(values) == {"a": None, "b": 1.5, "c": None, "d": [None, 2]}
    write_csv(tmp_path / "t.csv", [{"a": float("nan"), "b": 2}, {"a": 1.0, "b": None}])
    assert (tmp_path / "t.csv").read_text() == "a,b\n,2\n1.0,\n"
    with pytest.raises(ValueError, match="nothing to write"):
        write_csv(tmp_path / "t.csv", [])
