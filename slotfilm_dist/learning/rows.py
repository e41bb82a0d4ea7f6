"""Where the rows lie that training batches are drawn from: in memory, in a file, or on the GPU."""

import numpy as np
import torch
from jaxtyping import Int, Shaped
from torch import Tensor

SHARE_OF_GPU = 0.4
"""Of the GPU's free memory that the rows may take."""
ROWS_AT_ONCE = 1024
"""Rows copied to the GPU at once."""


class Rows:
    """Rows of an array that batches are drawn from: on a GPU with room for them they are all kept there.

    Args:
        array: the rows; may be a memory-mapped file.
        device: where batches are needed.
    """

    def __init__(self, array: Shaped[np.ndarray, "rows ..."], device: torch.device) -> None:
        self._array = array
        self._there: Tensor | None = None
        if device.type == "cuda" and array.nbytes < SHARE_OF_GPU * torch.cuda.mem_get_info(device)[0]:
            self._there = torch.empty(array.shape, dtype=torch.from_numpy(array[:0].copy()).dtype, device=device)
            for start in range(0, len(array), ROWS_AT_ONCE):
                rows = torch.from_numpy(np.array(array[start : start + ROWS_AT_ONCE]))
                self._there[start : start + len(rows)] = rows

    def take(self, chosen: Int[np.ndarray, " batch"]) -> Shaped[np.ndarray, "batch ..."]:
        """What has to go to the device: their numbers, or the rows themselves."""
        return np.asarray(self._array[chosen]) if self._there is None else chosen.astype(np.int64)

    def on_device(self, taken: Shaped[Tensor, "batch ..."]) -> Shaped[Tensor, "batch ..."]:
        """The rows, given what `take` gave, on the device."""
        return taken if self._there is None else self._there.index_select(0, taken)
