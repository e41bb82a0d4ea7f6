"""Feeds and captured functions: the same values as without them, whatever the batch."""

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from torch import Tensor

from slotfilm_dist.nets.capture import Capture, Feed, SizedCaptures

GPU = pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")])
DEVICES = pytest.mark.parametrize("device", ["cpu", GPU])


def arrays(rng: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
    return {
        "rgb": rng.integers(0, 255, (rows, 3, 5, 3), np.uint8),
        "half": rng.normal(size=(rows, 7)).astype(np.float16),
        "single": rng.normal(size=rows).astype(np.float32),
        "flag": rng.random(rows) < 0.5,
        "number": rng.integers(0, 1 << 40, rows),
        "nothing": np.empty((rows, 0), np.uint8),
    }


@DEVICES
def test_feed_brings_every_array_to_the_same_tensors(device: str) -> None:
    rng = np.random.default_rng(0)
    feed = Feed(arrays(rng, 6), torch.device(device))
    places = {name: tensor.data_ptr() for name, tensor in feed.tensors.items()}
    for rows in (6, 6, 4, 6, 1):
        given = arrays(rng, rows)
        feed.fill(given)
        for name, array in given.items():
            assert feed.tensors[name][:rows].cpu().numpy() == pytest.approx(array, nan_ok=True), name
            assert feed.tensors[name].data_ptr() == places[name]


@DEVICES
def test_captured_function_computes_on_what_is_fed_now(device: str) -> None:
    total = torch.zeros(4, device=device)
    feed = Feed({"x": np.zeros(4, np.float32)}, torch.device(device))
    call = Capture(lambda: total.add_(feed.tensors["x"]) * 2, torch.device(device))
    expected = np.zeros(4, np.float32)
    for i in range(10):
        given = np.full(4, i, np.float32)
        feed.fill({"x": given})
        expected += given
        assert call().cpu().numpy() == pytest.approx(2 * expected)


@DEVICES
def test_batches_of_any_size_give_their_own_rows(device: str) -> None:
    weight = torch.ones(7, 2, device=device)

    def function(batch: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        return batch["half"].float() @ weight, batch["single"] + 1

    call = SizedCaptures(function, torch.device(device))
    rng = np.random.default_rng(1)
    for rows in (3, 1, 4, 2, 3, 5, 300, 3, 4, 4, 4, 3):
        if rows == 5:
            weight.mul_(2)  # in place, as weights are loaded
        given = {name: value for name, value in arrays(rng, rows).items() if name in ("half", "single")}
        product, sums = call(given)
        assert product == pytest.approx(given["half"].astype(np.float32) @ weight.cpu().numpy(), abs=1e-2)
        assert sums == pytest.approx(given["single"] + 1)
