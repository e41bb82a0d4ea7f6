"""Area under the ROC curve."""

import math

import numpy as np
from jaxtyping import Bool, Float


def auroc(scores: Float[np.ndarray, " samples"], labels: Bool[np.ndarray, " samples"]) -> float:
    """Chance that a positive sample scores above a negative one, ties counting half.

    NaN if a class is missing or a score is NaN.
    """
    num_positive = int(labels.sum())
    num_negative = len(labels) - num_positive
    if num_positive == 0 or num_negative == 0 or np.isnan(scores).any():
        return math.nan
    # Ranks by numpy: SciPy's `rankdata` costs every process 0.7 s of import.
    _, places, counts = np.unique(scores, return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - (counts - 1) / 2
    rank_sum = float(ranks[places[labels]].sum())
    return (rank_sum - num_positive * (num_positive + 1) / 2) / (num_positive * num_negative)
