"""Area under the ROC curve."""

import math

import numpy as np
import pytest

from slotfilm_dist.learning.auroc import auroc


def test_auroc_is_the_share_of_pairs_in_the_right_order() -> None:
    rng = np.random.default_rng(0)
    scores, labels = rng.integers(0, 6, 60).astype(np.float64), rng.random(60) < 0.4
    above = [(p > n) + 0.5 * (p == n) for p in scores[labels] for n in scores[~labels]]
    assert auroc(scores, labels) == pytest.approx(np.mean(above))


def test_auroc_without_a_class_or_with_an_undefined_score_is_undefined() -> None:
    assert math.isnan(auroc(np.arange(3.0), np.ones(3, dtype=bool)))
    assert math.isnan(auroc(np.array([0.0, math.nan]), np.array([True, False])))
