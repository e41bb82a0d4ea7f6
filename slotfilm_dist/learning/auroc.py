"""Area under the ROC curve."""

import math

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import rankdata


def auroc(scores: Float[np.ndarray, " samples"], labels: Bool[np.ndarray, " samples"]) -> float:
    """Chance that a positive sample scores above a negative one, ties counting half; NaN if a class is missing."""
    num_positive = int(labels.sum())
    num_negative = len(labels) - num_positive
    if num_positive == 0 or num_negative == 0:
        return math.nan
    rank_sum = float(rankdata(scores)[labels].sum())
    return (rank_sum - num_positive * (num_positive + 1) / 2) / (num_positive * num_negative)
