"""Pre-training on pictures of coloured discs."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from slotfilm_dist.config import EncoderConfig, ObsConfig, PretrainConfig
from slotfilm_dist.learning.frames import PretrainFrames, mean_position, split_by_episode
from slotfilm_dist.learning.pretrain import Pretrainer
from slotfilm_dist.metrics import check_names
from slotfilm_dist.nets.encoder import SlotFusionEncoder

SIZE = 64
COLORS = ((220, 40, 30), (30, 60, 230))


@cache
def discs() -> PretrainFrames:
    """A red and a blue disc on grey, each in view in 7 of 10 frames; 10 frames an episode."""
    num_episodes, per_episode = 24, 10
    rng = np.random.default_rng(0)
    num_frames = num_episodes * per_episode
    uv = rng.uniform(0.1, 0.9, (num_frames, 2, 2)).astype(np.float32)
    visible = rng.random((num_frames, 2)) < 0.7
    rows, cols = (np.mgrid[0:SIZE, 0:SIZE] + 0.5) / SIZE
    rgb = np.full((num_frames, SIZE, SIZE, 3), 90, np.uint8)
    for k, color in enumerate(COLORS):
        near = (cols - uv[:, k, 0, None, None]) ** 2 + (rows - uv[:, k, 1, None, None]) ** 2 < 0.01
        rgb[near & visible[:, k, None, None]] = color
    uv[~visible] = np.nan
    return PretrainFrames(rgb=rgb, uv=uv, visible=visible, episode=np.repeat(np.arange(num_episodes), per_episode))


def build(vis_head: str = "pooled", **fields: Any) -> Pretrainer:
    config = PretrainConfig(**{"lr": 3e-3, "batch_size": 32, "train_backbone": "none"} | fields)
    encoder = SlotFusionEncoder(EncoderConfig(backbone="random", vis_head=vis_head), ObsConfig(), SIZE)
    return Pretrainer(encoder, discs(), config, seed=0)


@pytest.mark.parametrize("vis_head", ["pooled", "matched"])
def test_pretraining_beats_predicting_the_mean_on_held_out_episodes(vis_head: str) -> None:
    pretrainer = build(vis_head)
    before = pretrainer.evaluate()
    losses = [pretrainer.step()["pretrain_loss"] for _ in range(150)]
    after = pretrainer.evaluate()
    assert np.mean(losses[-10:]) < 0.4 * np.mean(losses[:10])
    assert before.position_error_px > 0.8 * before.baseline_error_px
    assert after.position_error_px < 0.75 * after.baseline_error_px
    assert after.visibility_auroc > 0.75
    assert after.attention_nll < before.attention_nll / 2
    assert after.attention_share > 0.5 > before.attention_share


def test_whole_backbone_is_trained_and_film_is_not() -> None:
    pretrainer = build(train_backbone="all", batch_size=8)
    before = {name: value.clone() for name, value in pretrainer.encoder.state_dict().items()}
    pretrainer.step()
    pretrainer.step()
    changed = {name for name, value in pretrainer.encoder.state_dict().items() if not torch.equal(value, before[name])}
    assert "perception.backbone.trunk.conv1.weight" in changed
    assert "perception.backbone.trunk.layer3.1.bn2.running_mean" in changed
    assert "perception.projection.weight" in changed
    assert not any(name.startswith(("fusion.", "proprio")) for name in changed)


@pytest.mark.parametrize(("trained", "moves"), [("all", True), ("none", False)])
def test_only_a_trained_backbone_works_in_bfloat16(trained: str, moves: bool) -> None:
    exact, half = (build(train_backbone=trained, batch_size=8, precision=p) for p in ("float32", "bfloat16"))
    wanted, given = exact.step()["pretrain_loss"], half.step()["pretrain_loss"]
    assert (given != wanted) is moves
    assert given == pytest.approx(wanted, rel=0.02)
    weights = half.encoder.state_dict().values()
    assert all(weight.dtype != torch.bfloat16 for weight in weights)


def test_backbone_that_is_not_trained_stays_as_it_was() -> None:
    pretrainer = build()
    before = {name: value.clone() for name, value in pretrainer.encoder.state_dict().items()}
    pretrainer.step()
    changed = {name for name, value in pretrainer.encoder.state_dict().items() if not torch.equal(value, before[name])}
    assert not any(name.startswith(("perception.backbone.", "fusion.")) for name in changed)
    assert {"perception.projection.weight", "perception.slots", "perception.row_code"} <= changed


def test_pretraining_leaves_film_at_zero() -> None:
    pretrainer = build()
    pretrainer.step()
    assert pretrainer.encoder.fusion is not None
    assert pretrainer.encoder.fusion.is_identity()


@pytest.mark.parametrize("train_backbone", ["none", "all"])
def test_resumed_pretraining_continues_bit_for_bit(train_backbone: str) -> None:
    straight = build(train_backbone=train_backbone, batch_size=8)
    first = build(train_backbone=train_backbone, batch_size=8)
    expected = [straight.step() for _ in range(4)]
    assert [first.step(), first.step()] == expected[:2]
    saved = first.save()
    first.step()

    resumed = build(train_backbone=train_backbone, batch_size=8)
    resumed.network.load_state_dict({name: value + 1 for name, value in resumed.network.state_dict().items()})
    resumed.load(saved)
    assert [resumed.step(), resumed.step()] == expected[2:]
    assert resumed.num_steps == 4
    for name, value in straight.encoder.state_dict().items():
        assert torch.equal(resumed.encoder.state_dict()[name], value), name


def test_saved_pretraining_of_another_kind_is_refused() -> None:
    pretrainer = build()
    pretrainer.step()
    saved = pretrainer.save()
    with pytest.raises(ValueError, match="seed"):
        pretrainer.load(saved | {"seed": 1})
    with pytest.raises(ValueError, match="train_backbone"):
        build(train_backbone="all").load(saved)
    with pytest.raises(ValueError, match="another encoder"):
        build("matched").load(saved)


def test_split_keeps_episodes_whole_and_follows_the_seed() -> None:
    episode = np.repeat(np.arange(20), 7)
    train, held_out = split_by_episode(episode, 0.1, seed=3)
    assert len(held_out) == 14
    assert sorted([*train, *held_out]) == list(range(140))
    assert not set(episode[train]) & set(episode[held_out])
    assert np.array_equal(split_by_episode(episode, 0.1, seed=3)[1], held_out)
    splits = {tuple(split_by_episode(episode, 0.1, seed=seed)[1]) for seed in range(5)}
    assert len(splits) > 1


def test_interrupted_pretraining_is_continued_by_a_variant_with_another_fusion() -> None:
    begun, straight = build(batch_size=8), build(batch_size=8)
    begun.step()
    encoder = SlotFusionEncoder(EncoderConfig(backbone="random", fusion="concat_late"), ObsConfig(), SIZE)
    other = Pretrainer(encoder, discs(), begun.config, seed=0)
    other.load(begun.save())
    straight.step()
    assert other.step() == straight.step()


def test_batches_never_hold_frames_of_held_out_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    pretrainer = build(holdout=0.5, train_backbone="all", batch_size=16)
    held_out = set(pretrainer.frames.episode[pretrainer.eval_frames])
    assert len(held_out) == 12
    drawn: list[np.ndarray] = []
    batch = pretrainer._batch
    monkeypatch.setattr(pretrainer, "_batch", lambda chosen: drawn.append(chosen) or batch(chosen))
    monkeypatch.setattr(pretrainer, "_descend", lambda: torch.zeros(4))
    for _ in range(40):
        pretrainer.begin_step()
    seen = set(pretrainer.frames.episode[np.concatenate(drawn)])
    assert seen == set(range(24)) - held_out


def test_mean_position_looks_only_at_frames_that_show_the_object() -> None:
    frames = PretrainFrames(
        rgb=np.zeros((3, 32, 32, 3), np.uint8),
        uv=np.array([[[0.2, 0.4], [np.nan, np.nan]], [[0.4, 0.8], [np.inf, 0]], [[0.9, 0.9], [0, 0]]], np.float32),
        visible=np.array([[True, False], [True, False], [True, False]]),
        episode=np.array([0, 0, 1]),
    )
    np.testing.assert_allclose(mean_position(frames, np.array([0, 1])), [[0.3, 0.6], [0.5, 0.5]], rtol=1e-6)


def test_user_mistakes_in_the_frames_are_explained() -> None:
    one_episode = dataclasses.replace(discs(), episode=np.zeros(len(discs().episode), np.int64))
    encoder = SlotFusionEncoder(EncoderConfig(backbone="random"), ObsConfig(), SIZE)
    with pytest.raises(ValueError, match="two episodes"):
        Pretrainer(encoder, one_episode, PretrainConfig(), seed=0)
    large = SlotFusionEncoder(EncoderConfig(backbone="random"), ObsConfig(), 128)
    with pytest.raises(ValueError, match=r"env\.image_size = 128"):
        Pretrainer(large, discs(), PretrainConfig(), seed=0)


def test_loss_that_is_not_finite_stops_pretraining() -> None:
    pretrainer = build()
    pretrainer.step()
    pretrainer.encoder.state_dict()["perception.slots"].fill_(torch.nan)
    with pytest.raises(ValueError, match=r"pretrain\.lr"):
        pretrainer.step()


def test_every_reported_metric_is_declared() -> None:
    pretrainer = build()
    names = [*pretrainer.step(), *pretrainer.evaluate().metrics()]
    assert len(names) == 8
    check_names(names)
