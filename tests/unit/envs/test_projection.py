"""Projection into a pinhole camera, against pictures one can compute in the head."""

import math

import pytest
import torch

from slotfilm_dist.envs.projection import project, rotation_matrix

LOOKING_ALONG_X = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]])


def one(
    point: tuple[float, float, float], pose: torch.Tensor = LOOKING_ALONG_X, tan: float = 1.0
) -> tuple[list[float], bool]:
    uv, visible = project(torch.tensor([[point]], dtype=torch.float32), pose, tan, 0.01)
    return uv[0, 0].tolist(), bool(visible[0, 0])


@pytest.mark.parametrize(
    ("point", "uv"),
    [
        ((1, 0, 0), (0.5, 0.5)),
        ((1, 0.5, 0), (0.25, 0.5)),
        ((1, -0.5, 0), (0.75, 0.5)),
        ((1, 0, 0.5), (0.5, 0.25)),
        ((2, 0, -1.0), (0.5, 0.75)),
    ],
)
def test_left_is_small_u_and_up_is_small_v(point: tuple[float, float, float], uv: tuple[float, float]) -> None:
    assert one(point) == (pytest.approx(uv), True)


def test_wider_field_of_view_moves_points_to_the_middle() -> None:
    assert one((1, 0.5, 0), tan=2.0)[0] == pytest.approx([0.375, 0.5])


@pytest.mark.parametrize(
    ("point", "visible"),
    [
        ((-1, 0, 0), False),
        ((0.005, 0, 0), False),
        ((1, 1.01, 0), False),
        ((1, 0.99, 0), True),
        ((1, 0, 1.01), False),
        ((1, 0, -1.01), False),
    ],
)
def test_points_behind_too_near_or_outside_are_not_visible(point: tuple[float, float, float], visible: bool) -> None:
    uv, seen = one(point)
    assert seen == visible
    assert all(math.isfinite(x) and -1 <= x <= 2 for x in uv)


def test_camera_pose_is_taken_into_account() -> None:
    turned_left = [math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]
    pose = torch.tensor([[1.0, 2.0, 3.0, *turned_left]])
    assert one((1.0, 4.0, 3.0), pose) == (pytest.approx([0.5, 0.5]), True)
    assert one((2.0, 4.0, 3.0), pose)[0] == pytest.approx([0.75, 0.5])
    assert not one((1.0, 0.0, 3.0), pose)[1]


def test_each_environment_has_its_own_camera() -> None:
    poses = torch.cat((LOOKING_ALONG_X, LOOKING_ALONG_X + torch.tensor([[0, 0.5, 0, 0, 0, 0, 0]])))
    uv, _ = project(torch.tensor([[[1.0, 0.5, 0]], [[1.0, 0.5, 0]]]), poses, 1.0, 0.01)
    assert uv[:, 0, 0].tolist() == pytest.approx([0.25, 0.5])


def test_rotation_matrix_is_orthonormal_and_turns_the_right_way() -> None:
    quaternions = torch.nn.functional.normalize(torch.randn(20, 4, generator=torch.Generator().manual_seed(0)), dim=-1)
    matrices = rotation_matrix(quaternions)
    assert torch.allclose(matrices @ matrices.mT, torch.eye(3).expand(20, 3, 3), atol=1e-6)
    assert torch.allclose(torch.linalg.det(matrices), torch.ones(20), atol=1e-6)
    quarter = rotation_matrix(torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)]))
    assert torch.allclose(quarter @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6)
