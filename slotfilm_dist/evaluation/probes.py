"""Linear probes on a frozen agent's latents (Section 6.4, Table 3).

The paper: "linear probes are trained on frozen encoder outputs collected from 10 rollout episodes ... on identical
rollout frames". It names neither who acts, nor the split, nor the probes' regularisation, nor what exactly is read.
Read here as:

latent        `policy_input` is the latent after fusion, the paper's z-tilde. `visual` is the same before the state
              enters. Both are reported: Table 3 gives late concatenation a contact AUROC (.531) below that of the state
              alone (.852), though its policy input contains the state, so the paper may have probed the visual part.
contact       any finger presses on the first object with at least 0.5 N while the picture is taken. Logistic
              regression (L2, C = 1, balanced classes); AUROC.
delta_dist    d(t+1) - d(t), d the distance from the tool centre point to the object's centre, from the latent of t
              alone, without the action. Ridge regression (penalty 1); R2.
delta_obj     object(t+1) - object(t) in the world, one ridge regression for each of x, y, z; the mean of the three R2.
split         folds of whole episodes, every frame predicted by a probe that saw no frame of its episode. Latents are
              standardised with the training folds' mean and deviation. AUROC and R2 are taken over all frames of
              all episodes at once, R2 against the labels' overall mean.
changes       the contact probe, trained on clean latents, scores corrupted latents of the held-out frames; AUROC of
              those minus AUROC of the clean ones. Occlusion and noise are in the table; affine is described
              (Section 5.1) but missing there; `together` is an addition.
nulls         contact with labels shuffled between frames, the probe trained anew: the AUROC that chance gives. For R2,
              predicting the training folds' mean: at most 0.
intervals     95 %, bootstrap over episodes: the predictions of resampled episodes, without training the probes anew.
              They are narrower than the truth in so far as another data set would also have given other probes.

A label that never varies leaves its score undefined: NaN here, null in JSON.
"""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.model_selection import GroupKFold
from sklearn.preprocessing import StandardScaler

from slotfilm_dist.evaluation.labelled_frames import LabelledFrames
from slotfilm_dist.learning.auroc import auroc

NUM_FOLDS = 5
_RESAMPLES = 1000
_AXES = ("x", "y", "z")

Features = Float[np.ndarray, "frames features"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """A probe's score."""

    value: float
    """AUROC, R2, or a difference of two AUROCs."""
    interval: tuple[float, float]
    """95 % bootstrap interval over episodes; NaN where it is undefined."""
    null: float
    """The same score without any information; 0 for a difference."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ProbeResult:
    """Table 3's row of one latent."""

    contact_auroc: Score
    delta_dist_r2: Score
    delta_obj_r2: Score
    delta_obj_r2_by_axis: dict[str, float]
    auroc_change: dict[str, Score]
    """By corruption."""
    num_features: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Balance:
    """What the labels are like, without which no score can be read."""

    num_frames: int
    num_episodes: int
    contact_share: float
    delta_dist_std_m: float
    delta_obj_std_m: tuple[float, ...]


def probe(
    clean: Features, corrupted: Mapping[str, Features], frames: LabelledFrames, rng: np.random.Generator
) -> ProbeResult:
    """Train and score the probes of one kind of latent.

    Args:
        clean: latents of the frames.
        corrupted: latents of the corrupted frames, by corruption.
        frames: labels and episodes.
        rng: shuffles labels and resamples episodes.

    Raises:
        ValueError: fewer than two episodes, which cannot be split.
    """
    episode = frames.episode
    folds = _folds(episode)
    scores = contact_scores({"clean": clean, **corrupted}, frames.contact, folds)
    shuffled = rng.permutation(frames.contact)
    contact = Score(
        value=auroc(scores["clean"], frames.contact),
        interval=_interval(lambda rows: auroc(scores["clean"][rows], frames.contact[rows]), episode, rng),
        null=auroc(contact_scores({"clean": clean}, shuffled, folds)["clean"], shuffled),
    )
    changes = {}
    for name in corrupted:

        def change(rows: Int[np.ndarray, " rows"], name: str = name) -> float:
            labels = frames.contact[rows]
            return auroc(scores[name][rows], labels) - auroc(scores["clean"][rows], labels)

        everything = np.arange(len(episode))
        changes[name] = Score(value=change(everything), interval=_interval(change, episode, rng), null=0.0)
    moving = frames.has_next
    before, after = np.flatnonzero(moving), np.flatnonzero(moving) + 1
    distance = (frames.distance_m[after] - frames.distance_m[before])[:, None].astype(np.float64)
    displacement = (frames.object_m[after] - frames.object_m[before]).astype(np.float64)
    by_axis = _regressions(clean[before], displacement, episode[before], rng)
    return ProbeResult(
        contact_auroc=contact,
        delta_dist_r2=_regressions(clean[before], distance, episode[before], rng)[0],
        delta_obj_r2=by_axis[0],
        delta_obj_r2_by_axis=dict(zip(_AXES, by_axis[1], strict=True)),
        auroc_change=changes,
        num_features=clean.shape[1],
    )


def label_balance(frames: LabelledFrames) -> Balance:
    """Shares and deviations of the labels."""
    before = np.flatnonzero(frames.has_next)
    displacement = frames.object_m[before + 1] - frames.object_m[before]
    return Balance(
        num_frames=len(frames.episode),
        num_episodes=len(np.unique(frames.episode)),
        contact_share=float(frames.contact.mean()),
        delta_dist_std_m=float((frames.distance_m[before + 1] - frames.distance_m[before]).std()),
        delta_obj_std_m=tuple(displacement.std(axis=0).tolist()),
    )


Folds = list[tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]]


def _folds(episode: Int[np.ndarray, " frames"]) -> Folds:
    count = len(np.unique(episode))
    if count < 2:
        raise ValueError(f"probes need frames of at least two episodes, to test on one, and got {count}: --episodes 10")
    splitter = GroupKFold(min(NUM_FOLDS, count))
    return [(train, test) for train, test in splitter.split(episode, groups=episode)]


def contact_scores(
    latents: Mapping[str, Features], labels: Bool[np.ndarray, " frames"], folds: Folds
) -> dict[str, Float[np.ndarray, " frames"]]:
    """Log-odds of contact of every held-out frame, by kind of latent; the probes are trained on `clean` alone.

    A fold whose training frames are all of one class scores its frames 0.
    """
    out = {name: np.zeros(len(labels)) for name in latents}
    for train, test in folds:
        if labels[train].all() or not labels[train].any():
            continue
        scaler = StandardScaler().fit(latents["clean"][train])
        classifier = LogisticRegression(max_iter=1000, class_weight="balanced")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # separable labels; the ranking no longer changes
            classifier.fit(scaler.transform(latents["clean"][train]), labels[train])
        for name, features in latents.items():
            out[name][test] = classifier.decision_function(scaler.transform(features[test]))
    return out


def _regressions(
    features: Features,
    targets: Float[np.ndarray, "frames targets"],
    episode: Int[np.ndarray, " frames"],
    rng: np.random.Generator,
) -> tuple[Score, list[float]]:
    """Mean R2 over the targets' columns, and each column's."""
    predicted, null = np.zeros_like(targets), np.zeros_like(targets)
    for train, test in _folds(episode):
        scaler = StandardScaler().fit(features[train])
        scale = targets[train].std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        model = Ridge(alpha=1.0).fit(scaler.transform(features[train]), targets[train] / scale)
        predicted[test] = model.predict(scaler.transform(features[test])).reshape(-1, targets.shape[1]) * scale
        null[test] = targets[train].mean(axis=0)
    by_column = _r2(predicted, targets)
    score = Score(
        value=float(np.mean(by_column)),
        interval=_interval(lambda rows: float(np.mean(_r2(predicted[rows], targets[rows]))), episode, rng),
        null=float(np.mean(_r2(null, targets))),
    )
    return score, by_column


def _r2(predicted: Float[np.ndarray, "frames targets"], targets: Float[np.ndarray, "frames targets"]) -> list[float]:
    """Share of each column's variance that is explained; NaN where it has none."""
    error = ((targets - predicted) ** 2).sum(axis=0)
    spread = ((targets - targets.mean(axis=0)) ** 2).sum(axis=0)
    return [float(1 - e / s) if s > 0 else math.nan for e, s in zip(error, spread, strict=True)]


def _interval(score: Any, episode: Int[np.ndarray, " frames"], rng: np.random.Generator) -> tuple[float, float]:
    """Quantiles of the score over resampled episodes; resamples that leave it undefined are left out."""
    groups = [np.flatnonzero(episode == e) for e in np.unique(episode)]
    values = []
    for _ in range(_RESAMPLES):
        picks = rng.integers(len(groups), size=len(groups))
        value = score(np.concatenate([groups[i] for i in picks]))
        if math.isfinite(value):
            values.append(value)
    if not values:
        return math.nan, math.nan
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)
