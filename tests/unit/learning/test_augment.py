"""Random shifts: what they keep, how far they go, that they follow from their generator."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from slotfilm_dist.learning.augment import random_shift, random_shift_bilinear

SIZE = 24
Shift = Callable[[Tensor, int, torch.Generator], Tensor]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def spots(count: int, row: int = 12, column: int = 9) -> Tensor:
    """Black pictures with one bright pixel."""
    pictures = torch.zeros(count, SIZE, SIZE, 3, dtype=torch.uint8)
    pictures[:, row, column] = torch.tensor([200, 100, 50], dtype=torch.uint8)
    return pictures


def places(pictures: Tensor) -> Tensor:
    """Centre of brightness of every picture, in pixels."""
    weight = pictures[..., 0].float()
    grid = torch.arange(SIZE, dtype=torch.float32)
    total = weight.sum((1, 2))
    return torch.stack(((weight.sum(2) * grid).sum(1) / total, (weight.sum(1) * grid).sum(1) / total), 1)


def test_whole_shifts_move_content_by_up_to_4_pixels_each_way_equally_often() -> None:
    shifted = random_shift(spots(4000), 4, generator())
    assert shifted.dtype == torch.uint8
    assert torch.equal(shifted.sum((1, 2))[:, :3], torch.tensor([[200, 100, 50]]).expand(4000, 3))
    moved = (torch.tensor([12.0, 9.0]) - places(shifted)).long()
    for axis in range(2):
        counts = torch.bincount(moved[:, axis] + 4, minlength=9)
        assert len(counts) == 9
        assert counts.min() > 4000 / 9 * 0.8
        assert counts.max() < 4000 / 9 * 1.2
    assert torch.corrcoef(moved.T.float())[0, 1].abs() < 0.05


def test_whole_shift_is_a_crop_of_the_padded_picture() -> None:
    pictures = torch.randint(0, 256, (50, SIZE, SIZE, 3), dtype=torch.uint8, generator=generator(1))
    shifted = random_shift(pictures, 4, generator())
    padded = torch.nn.functional.pad(pictures.permute(0, 3, 1, 2).float(), (4, 4, 4, 4), mode="replicate")
    for index in range(50):
        crops = [padded[index, :, row : row + SIZE, column : column + SIZE] for row in range(9) for column in range(9)]
        assert any(torch.equal(shifted[index].permute(2, 0, 1).float(), crop) for crop in crops)


def test_bilinear_shifts_move_content_by_any_distance_up_to_4_pixels() -> None:
    shifted = random_shift_bilinear(spots(4000), 4, generator())
    assert shifted.dtype == torch.float32
    assert torch.allclose(shifted.sum((1, 2)), torch.tensor([200.0, 100.0, 50.0]), rtol=1e-3)
    moved = torch.tensor([12.0, 9.0]) - places(shifted)
    assert 3.9 < moved.abs().max() <= 4 + 1e-3
    assert torch.allclose(moved.mean(0), torch.zeros(2), atol=0.15)
    assert torch.allclose(moved.std(0), torch.full((2,), 8 / 12**0.5), rtol=0.05)
    assert ((moved - moved.round()).abs() > 0.1).any(), "only whole pixels"


def test_bilinear_pixels_are_means_of_the_four_around_the_place_they_come_from() -> None:
    ramp = torch.arange(SIZE).view(1, SIZE, 1, 1).expand(6, SIZE, SIZE, 3).to(torch.uint8).contiguous()
    shifted = random_shift_bilinear(ramp, 4, generator())
    inner = shifted[:, 5:-5, 5:-5, 0]
    distance = inner[:, 0, 0] - 5
    assert torch.allclose(inner, torch.arange(5, SIZE - 5).view(1, -1, 1) + distance.view(-1, 1, 1), atol=1e-3)
    assert shifted.min() >= 0
    assert shifted.max() <= SIZE - 1 + 1e-3


@pytest.mark.parametrize("shift", [random_shift, random_shift_bilinear])
def test_shifts_follow_from_the_generator_and_leave_the_pictures_alone(shift: Shift) -> None:
    pictures = spots(8)
    before = pictures.clone()
    first = shift(pictures, 4, generator(3))
    torch.manual_seed(11)
    assert torch.equal(first, shift(pictures, 4, generator(3)))
    assert not torch.equal(first, shift(pictures, 4, generator(4)))
    assert torch.equal(pictures, before)
