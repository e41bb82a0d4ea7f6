"""Corruptions change what they say by as much as they say, and nothing else."""

import math

import numpy as np
import pytest
import torch

from slotfilm_dist.evaluation.corruptions import (
    CORRUPTIONS,
    Affine,
    add_noise,
    corrupt,
    corrupt_frames,
    draw_affine,
    move,
    occlude,
    warp,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def grey(batch: int = 8, level: int = 128) -> torch.Tensor:
    return torch.full((batch, 128, 128, 3), level, dtype=torch.uint8)


def test_occlusion_is_one_whole_square_of_15_percent() -> None:
    hidden = (occlude(grey(64), generator()) == 0).all(dim=3)
    for mask in hidden:
        rows, columns = mask.any(1).nonzero().ravel(), mask.any(0).nonzero().ravel()
        assert len(rows) == len(columns) == 50
        assert mask.sum() == 2500
        assert mask.float().mean() == pytest.approx(0.15, abs=0.003)
    corners = {(int(m.any(1).nonzero()[0]), int(m.any(0).nonzero()[0])) for m in hidden}
    assert len(corners) > 50


def test_occlusion_reaches_every_border() -> None:
    hidden = (occlude(grey(1000), generator()) == 0).all(dim=3)
    assert hidden.any(dim=2).any(dim=0)[[0, 127]].all()
    assert hidden.any(dim=1).any(dim=0)[[0, 127]].all()


def test_noise_has_deviation_of_5_percent_and_no_bias() -> None:
    change = add_noise(grey(4), generator()).float() - 128
    assert float(change.std()) == pytest.approx(0.05 * 255, rel=0.01)
    assert float(change.mean()) == pytest.approx(0, abs=0.1)
    assert abs(float(torch.corrcoef(change.flatten(0, 2).T)[0, 1])) < 0.02


def test_noise_is_clamped_not_wrapped() -> None:
    assert int(add_noise(grey(1, 255), generator()).min()) > 150
    assert int(add_noise(grey(1, 0), generator()).max()) < 100


def test_affine_turns_3_degrees_either_way_scales_and_shifts_exactly() -> None:
    affine = draw_affine(400, generator())
    scale = affine.matrix.det().sqrt()
    angle = torch.rad2deg(torch.atan2(affine.matrix[:, 1, 0], affine.matrix[:, 0, 0]))
    assert torch.allclose(scale, torch.full_like(scale, 1.05), atol=1e-5)
    assert torch.allclose(angle.abs(), torch.full_like(angle, 3.0), atol=1e-4)
    assert 150 < int((angle > 0).sum()) < 250
    assert torch.allclose(affine.shift.norm(dim=1), torch.full((400,), 0.03), atol=1e-6)
    assert affine.shift.mean(0).abs().max() < 0.005


def test_points_move_with_the_pictures_content() -> None:
    uv = torch.tensor([[[0.3, 0.4], [0.7, 0.6]]]).repeat(16, 1, 1)
    pictures = torch.zeros(16, 128, 128, 3, dtype=torch.uint8)
    for channel, (u, v) in enumerate(uv[0].tolist()):
        x, y = round(u * 128), round(v * 128)
        pictures[:, y - 3 : y + 3, x - 3 : x + 3, channel] = 255
    moved, moved_uv = corrupt(pictures, uv, "affine", generator())
    ticks = (torch.arange(128) + 0.5) / 128
    for channel in range(2):
        weight = moved[..., channel].float()
        total = weight.sum((1, 2))
        found = torch.stack(((weight.sum(1) * ticks).sum(1) / total, (weight.sum(2) * ticks).sum(1) / total), dim=1)
        placed = torch.tensor([round(float(x) * 128) / 128 for x in uv[0, channel]])
        expected = moved_uv[:, channel] + (placed - uv[0, channel])
        assert (found - expected).abs().max() < 0.5 / 128


def test_warp_of_a_known_map() -> None:
    picture = torch.arange(16, dtype=torch.uint8).view(1, 4, 4, 1).expand(1, 4, 4, 3).contiguous()
    right = Affine(matrix=torch.eye(2)[None], shift=torch.tensor([[0.25, 0.0]]))
    assert warp(picture, right)[0, 1, :, 0].tolist() == [4, 4, 5, 6]
    assert torch.allclose(move(torch.tensor([[[0.5, 0.5]]]), right), torch.tensor([[[0.75, 0.5]]]))


def test_only_the_affine_corruption_moves_points() -> None:
    uv = torch.rand(8, 2, 2, generator=generator(1))
    for name in ("clean", "occlusion", "noise"):
        assert torch.equal(corrupt(grey(), uv, name, generator())[1], uv)
    for name in ("affine", "together"):
        assert not torch.allclose(corrupt(grey(), uv, name, generator())[1], uv, atol=1e-3)


def test_together_turns_then_hides_then_adds_noise() -> None:
    picture = corrupt(grey(8), torch.zeros(8, 1, 2), "together", generator())[0].float()
    dark = picture.mean(dim=3) < 60
    assert dark.float().mean() == pytest.approx(0.15, abs=0.01)
    # Noise comes last, or the square would be flat; the turn first, or its edges would slant.
    assert float(picture[dark].std()) > 3
    rows = dark[0].sum(dim=1)
    assert math.isclose(float(rows[rows > 10].float().std()), 0, abs_tol=2.0)


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_same_seed_same_pictures_and_originals_untouched(name: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (70, 32, 32, 3), dtype=np.uint8)
    uv = np.full((70, 2, 2), 0.5, np.float32)
    before = rgb.copy()
    first, second, other = (corrupt_frames(rgb, uv, name, seed)[0] for seed in (1, 1, 2))
    assert (first == second).all()
    assert (rgb == before).all()
    assert (first.shape, first.dtype) == (rgb.shape, np.uint8)
    assert (first == other).all() == (name == "clean")


def test_unknown_corruption_is_refused() -> None:
    with pytest.raises(ValueError, match="corruption = 'blur'"):
        corrupt(grey(), torch.zeros(8, 1, 2), "blur", generator())
