"""Random shifts of pictures, the augmentation of DrQ (Kostrikov et al. 2020, Section 3.1) and DrQ-v2.

Padding a picture by repeating its border and cropping it at a random place is the same as moving every pixel and
repeating the border where nothing is left: neither padding nor cropping is formed.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor


def random_shift(
    pictures: UInt8[Tensor, "batch height width channels"], largest_px: int, generator: torch.Generator
) -> UInt8[Tensor, "batch height width channels"]:
    """Every picture moved by whole pixels, up to `largest_px` each way and all equally likely.

    Args:
        pictures: what to move.
        largest_px: DrQ pads by 4.
        generator: source of the shifts, on the pictures' device.
    """
    shifts = torch.randint(
        -largest_px, largest_px + 1, (2, len(pictures), 1), generator=generator, device=pictures.device
    )
    rows, columns = (
        (torch.arange(size, device=pictures.device) + shift).clamp(0, size - 1)
        for size, shift in zip(pictures.shape[1:3], shifts, strict=True)
    )
    sample = torch.arange(len(pictures), device=pictures.device).view(-1, 1, 1)
    return pictures[sample, rows.unsqueeze(2), columns.unsqueeze(1)]


def random_shift_bilinear(
    pictures: UInt8[Tensor, "batch height width channels"], largest_px: int, generator: torch.Generator
) -> Float[Tensor, "batch height width channels"]:
    """Every picture moved by any distance up to `largest_px` each way, each new pixel a mean of the four around it.

    This is the text of DrQ-v2 ("bilinear interpolation on top of the shifted image", Section 3.1). Its released code
    draws whole pixels, at which the interpolation returns the pixels as they are: that is `random_shift`.

    Args:
        pictures: what to move.
        largest_px: DrQ-v2 pads by 4.
        generator: source of the shifts, on the pictures' device.
    """
    count, height, width, _ = pictures.shape
    shifts = (torch.rand(2, count, 1, generator=generator, device=pictures.device) * 2 - 1) * largest_px
    # In grid_sample's coordinates pixel i of n has its centre at (2 i + 1) / n - 1.
    rows, columns = (
        (2 * (torch.arange(size, device=pictures.device) + shift) + 1) / size - 1
        for size, shift in zip((height, width), shifts, strict=True)
    )
    grid = torch.stack(
        (columns.unsqueeze(1).expand(count, height, width), rows.unsqueeze(2).expand(count, height, width)), dim=-1
    )
    channels_first = pictures.permute(0, 3, 1, 2).float()
    moved = F.grid_sample(channels_first, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return moved.permute(0, 2, 3, 1)
