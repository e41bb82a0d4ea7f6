"""Projects points into a pinhole camera (Section 4.1): u, v = Pi(K [R | t] X), with a mask of what is in view."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def rotation_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def project(
    points: Float[Tensor, "envs points 3"],
    camera_pose: Float[Tensor, "envs 7"],
    tan_half_fov: float,
    near_m: float,
) -> tuple[Float[Tensor, "envs points 2"], Bool[Tensor, "envs points"]]:
    """Image coordinates of world points in a square picture.

    Args:
        points: in metres, world frame.
        camera_pose: position and quaternion of a SAPIEN camera, which looks along its x axis with y left and z up.
        tan_half_fov: tangent of half the field of view.
        near_m: points nearer than this are not in view.

    Returns:
        u to the right and v down, (0, 0) the top left and (1, 1) the bottom right corner, clamped to [-1, 2] (a point
        at or behind the camera's plane has no finite projection); and whether the point is in front and inside.
    """
    rotation = rotation_matrix(camera_pose[:, 3:])
    local = torch.einsum("epi,eij->epj", points - camera_pose[:, None, :3], rotation)
    depth = local[..., 0]
    safe_depth = depth.clamp(min=near_m)
    u = 0.5 - 0.5 * local[..., 1] / (safe_depth * tan_half_fov)
    v = 0.5 - 0.5 * local[..., 2] / (safe_depth * tan_half_fov)
    uv = torch.stack((u, v), dim=-1)
    inside = ((uv >= 0) & (uv < 1)).all(dim=-1)
    return uv.clamp(-1.0, 2.0), inside & (depth > near_m)
