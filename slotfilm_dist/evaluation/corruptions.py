"""Corruptions of the wrist camera's picture (Section 5.1): occlusion, noise, affine, and all three together.

The paper: "random occlusion (15 % of the image), additive Gaussian noise (sigma = 0.05), and camera-like affine
perturbation (3 deg yaw rotation, 3 % translation, 1.05 x scale), applied independently to the input images". Read as:

occlusion  one black square over 15 % of the picture's area, wholly inside, anywhere with equal chance
noise      independent N(0, 0.05^2) on every channel of every pixel in [0, 1], clamped and rounded to 8 bits again
affine     about the centre: turned by exactly 3 degrees to either side, enlarged by exactly 1.05, then moved by exactly
           3 % of the edge in any direction; what comes into view repeats the border. An affine map of a picture has no
           out-of-plane yaw, so the turn lies in the picture's plane.
together   affine, then occlusion, then noise, in the order in which lens, obstacle and sensor come

"Independently" is read as each kind by itself and drawn anew for every picture.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

OCCLUDED_SHARE = 0.15
NOISE_SIGMA = 0.05
ROTATION_DEG = 3.0
TRANSLATION_SHARE = 0.03
SCALE = 1.05

CORRUPTIONS: dict[str, tuple[str, ...]] = {
    "clean": (),
    "occlusion": ("occlusion",),
    "noise": ("noise",),
    "affine": ("affine",),
    "together": ("affine", "occlusion", "noise"),
}
"""What each corruption does, in this order."""

_BATCH = 64


def check_corruption(name: str) -> None:
    """Raise ``ValueError`` with the known names if there is no such corruption."""
    if name not in CORRUPTIONS:
        raise ValueError(f"corruption = {name!r}: must be one of {', '.join(CORRUPTIONS)}")


def corrupt(
    rgb: UInt8[Tensor, "batch height width 3"],
    uv: Float[Tensor, "batch points 2"],
    name: str,
    generator: torch.Generator,
) -> tuple[UInt8[Tensor, "batch height width 3"], Float[Tensor, "batch points 2"]]:
    """Corrupted pictures, and where the points of the scene now are in them.

    Args:
        rgb: square pictures.
        uv: points in image units; only the affine corruption moves them.
        name: one of `CORRUPTIONS`.
        generator: on the CPU; the same state gives the same corruption.
    """
    check_corruption(name)
    for kind in CORRUPTIONS[name]:
        match kind:
            case "occlusion":
                rgb = occlude(rgb, generator)
            case "noise":
                rgb = add_noise(rgb, generator)
            case _:
                affine = draw_affine(len(rgb), generator)
                rgb, uv = warp(rgb, affine), move(uv, affine)
    return rgb, uv


def corrupt_frames(
    rgb: UInt8[np.ndarray, "frames height width 3"],
    uv: Float32[np.ndarray, "frames points 2"],
    name: str,
    seed: int,
) -> tuple[UInt8[np.ndarray, "frames height width 3"], Float32[np.ndarray, "frames points 2"]]:
    """Corrupt a whole set of frames; the same frames, name and seed give the same result."""
    check_corruption(name)
    if name == "clean":
        return rgb, uv
    generator = torch.Generator().manual_seed(seed)
    parts = [
        corrupt(
            torch.from_numpy(np.array(rgb[i : i + _BATCH])),
            torch.from_numpy(np.array(uv[i : i + _BATCH])),
            name,
            generator,
        )
        for i in range(0, len(rgb), _BATCH)
    ]
    return torch.cat([part[0] for part in parts]).numpy(), torch.cat([part[1] for part in parts]).numpy()


def occlude(
    rgb: UInt8[Tensor, "batch height width 3"], generator: torch.Generator, share: float = OCCLUDED_SHARE
) -> UInt8[Tensor, "batch height width 3"]:
    """Black out one square of that share of the area, to the nearest whole edge, at a random place."""
    batch, height, width = rgb.shape[:3]
    edge = round(math.sqrt(share * height * width))
    top = torch.randint(0, height - edge + 1, (batch, 1), generator=generator)
    left = torch.randint(0, width - edge + 1, (batch, 1), generator=generator)
    rows, columns = torch.arange(height), torch.arange(width)
    in_rows = (rows >= top) & (rows < top + edge)
    in_columns = (columns >= left) & (columns < left + edge)
    hidden = (in_rows[:, :, None] & in_columns[:, None, :]).to(rgb.device)
    return rgb.masked_fill(hidden.unsqueeze(3), 0)


def add_noise(
    rgb: UInt8[Tensor, "batch height width 3"], generator: torch.Generator, sigma: float = NOISE_SIGMA
) -> UInt8[Tensor, "batch height width 3"]:
    """Add Gaussian noise of that deviation, in units of the full range, to every channel of every pixel."""
    noise = torch.randn(rgb.shape, generator=generator).to(rgb.device)
    return (rgb.float() + 255.0 * sigma * noise).round().clamp(0, 255).to(torch.uint8)


@dataclass(frozen=True, kw_only=True, slots=True)
class Affine:
    """A map of picture points x' = matrix (x - centre) + centre + shift, in image units."""

    matrix: Float[Tensor, "batch 2 2"]
    """Rotation times scale."""
    shift: Float[Tensor, "batch 2"]


def draw_affine(batch: int, generator: torch.Generator) -> Affine:
    """A turn to either side, the enlargement, and a shift in any direction, for every picture."""
    side = 2.0 * torch.randint(0, 2, (batch,), generator=generator) - 1.0
    turn = math.radians(ROTATION_DEG) * side
    direction = 2 * math.pi * torch.rand(batch, generator=generator)
    cos, sin = SCALE * turn.cos(), SCALE * turn.sin()
    matrix = torch.stack((torch.stack((cos, -sin), dim=1), torch.stack((sin, cos), dim=1)), dim=1)
    return Affine(matrix=matrix, shift=TRANSLATION_SHARE * torch.stack((direction.cos(), direction.sin()), dim=1))


def warp(rgb: UInt8[Tensor, "batch height width 3"], affine: Affine) -> UInt8[Tensor, "batch height width 3"]:
    """Move the picture's content, bilinearly interpolated; beyond its border the border goes on."""
    inverse = torch.linalg.inv(affine.matrix)
    # Where an output pixel comes from; grid coordinates run from -1 to 1, twice the image unit.
    origin = -2.0 * torch.einsum("bij,bj->bi", inverse, affine.shift)
    theta = torch.cat((inverse, origin.unsqueeze(2)), dim=2).to(rgb.device)
    pictures = rgb.permute(0, 3, 1, 2).float()
    grid = F.affine_grid(theta, list(pictures.shape), align_corners=False)
    moved = F.grid_sample(pictures, grid, padding_mode="border", align_corners=False)
    return moved.round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()


def move(uv: Float[Tensor, "batch points 2"], affine: Affine) -> Float[Tensor, "batch points 2"]:
    """Where points of the picture are after `warp`."""
    matrix, shift = affine.matrix.to(uv.device), affine.shift.to(uv.device)
    return torch.einsum("bij,bpj->bpi", matrix, uv - 0.5) + 0.5 + shift.unsqueeze(1)
