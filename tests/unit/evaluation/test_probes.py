"""Probes on latents that hold, or do not hold, what is asked for."""

import numpy as np
import pytest

from slotfilm_dist.evaluation.labelled_frames import LabelledFrames
from slotfilm_dist.evaluation.probes import contact_scores, label_balance, probe

EPISODES, STEPS = 8, 40


def make_frames(*, contact: np.ndarray | None = None, still: bool = False) -> LabelledFrames:
    """Labels that vary freely; pictures of one pixel, for no encoder looks at them."""
    rng = np.random.default_rng(1)
    count = EPISODES * STEPS
    return LabelledFrames(
        rgb=np.zeros((count, 1, 1, 3), np.uint8),
        proprio=np.zeros((count, 1), np.float32),
        goal=np.zeros((count, 3), np.float32),
        uv=np.zeros((count, 1, 2), np.float32),
        visible=np.ones((count, 1), bool),
        contact=rng.random(count) < 0.4 if contact is None else contact,
        distance_m=rng.random(count).astype(np.float32),
        object_m=np.zeros((count, 3), np.float32) if still else rng.normal(size=(count, 3)).astype(np.float32),
        episode=np.repeat(np.arange(EPISODES), STEPS).astype(np.int32),
        step=np.tile(np.arange(STEPS), EPISODES).astype(np.int32),
    )


def informed(frames: LabelledFrames) -> np.ndarray:
    """Latents that hold contact, the coming change of distance and displacement, on scales far apart."""
    rng = np.random.default_rng(2)
    following = np.append(np.arange(1, len(frames.step)), 0)
    return np.concatenate(
        (
            (frames.contact + rng.normal(0, 0.1, len(frames.step)))[:, None],
            1000 * (frames.distance_m[following] - frames.distance_m)[:, None],
            0.001 * (frames.object_m[following] - frames.object_m),
            rng.normal(size=(len(frames.step), 4)),
        ),
        axis=1,
    ).astype(np.float32)


def test_what_the_latent_holds_is_found_and_chance_is_not() -> None:
    frames = make_frames()
    clean = informed(frames)
    blind = clean.copy()
    blind[:, 0] = np.random.default_rng(3).normal(size=len(clean))
    result = probe(clean, {"same": clean, "blind": blind}, frames, np.random.default_rng(0))
    assert result.contact_auroc.value > 0.99
    assert result.contact_auroc.interval[0] > 0.98
    assert result.contact_auroc.null == pytest.approx(0.5, abs=0.1)
    assert result.delta_dist_r2.value > 0.95
    assert result.delta_obj_r2.value > 0.95
    assert result.delta_dist_r2.null <= 0
    assert result.delta_obj_r2.null <= 0
    assert result.auroc_change["same"].value == 0
    assert result.auroc_change["same"].interval == (0, 0)
    assert result.auroc_change["blind"].value == pytest.approx(-0.5, abs=0.1)
    assert result.num_features == clean.shape[1]
    assert set(result.delta_obj_r2_by_axis) == {"x", "y", "z"}


def test_noise_tells_nothing() -> None:
    frames = make_frames()
    noise = np.random.default_rng(4).normal(size=(len(frames.step), 6)).astype(np.float32)
    result = probe(noise, {}, frames, np.random.default_rng(0))
    assert result.contact_auroc.value == pytest.approx(0.5, abs=0.1)
    assert result.delta_dist_r2.value < 0.05


def test_what_only_marks_the_episode_does_not_help() -> None:
    """Split by frames, a latent that names its episode would tell an episode's label; split by episode it cannot."""
    contact = np.repeat(np.arange(EPISODES) % 2 == 0, STEPS)
    frames = make_frames(contact=contact)
    names = np.repeat(np.eye(EPISODES), STEPS, axis=0).astype(np.float32)
    result = probe(names, {}, frames, np.random.default_rng(0))
    assert result.contact_auroc.value <= 0.5


def test_labels_that_never_vary_leave_the_score_undefined() -> None:
    frames = make_frames(contact=np.zeros(EPISODES * STEPS, bool), still=True)
    result = probe(informed(frames), {"same": informed(frames)}, frames, np.random.default_rng(0))
    assert np.isnan(result.contact_auroc.value)
    assert np.isnan(result.contact_auroc.interval).all()
    assert np.isnan(result.delta_obj_r2.value)
    assert np.isnan(result.auroc_change["same"].value)
    assert result.delta_dist_r2.value > 0.9


def test_corrupted_latents_train_no_probe() -> None:
    frames = make_frames()
    clean = informed(frames)
    folds = [(np.arange(160), np.arange(160, 320)), (np.arange(160, 320), np.arange(160))]
    alone = contact_scores({"clean": clean}, frames.contact, folds)
    beside = contact_scores({"clean": clean, "zero": np.zeros_like(clean)}, frames.contact, folds)
    assert (alone["clean"] == beside["clean"]).all()
    for _, test in folds:  # a constant latent has a constant score
        assert len(set(beside["zero"][test].tolist())) == 1


def test_label_balance_counts_within_episodes() -> None:
    frames = make_frames()
    balance = label_balance(frames)
    assert (balance.num_frames, balance.num_episodes) == (320, 8)
    assert balance.contact_share == pytest.approx(float(frames.contact.mean()))
    jumps = np.diff(frames.distance_m.reshape(EPISODES, STEPS), axis=1)
    assert balance.delta_dist_std_m == pytest.approx(float(jumps.std()), rel=1e-5)


def test_one_episode_is_refused() -> None:
    frames = make_frames()
    alone = LabelledFrames(**{name: getattr(frames, name)[:STEPS] for name in LabelledFrames.__dataclass_fields__})
    with pytest.raises(ValueError, match="at least two episodes"):
        probe(informed(frames)[:STEPS], {}, alone, np.random.default_rng(0))
