"""Render profiles: what is left out of the wrist camera's pictures because that camera cannot see it.

A software renderer works through every triangle of the scene, seen or not, and nearly all triangles around a Panda with
a wrist camera belong to what never or seldom comes into view: 425,160 to the camera's own housing, 134,300 to arm and
hand, 20,000 to a floor of 100 m by 100 m. The profile `wrist` leaves out exactly what lies outside the camera's pyramid
of view, so its pictures are those of `full`, pixel by pixel:

- Links that move with the camera (housing, hand, last link) are looked at once, triangle by triangle.
- The other links of the arm are looked at before each picture, by the eight corners of their bounding boxes.
- The floor is cut in a near and a far part; the far one is drawn while any corner of the picture looks that far.

Left out means disabled: what is merely invisible is still worked through.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import sapien
from jaxtyping import Bool, Float, UInt32

RenderProfile = Literal["wrist", "full"]

WRIST_CAMERA = "hand_camera"
HOUSING_LINK = "camera_link"
FLOOR_NEAR_M = 10.0
"""Half the width of the floor that is always drawn."""
_MARGIN_M = 0.001
_MARGIN_SHARE = 0.02
"""Widening of the pyramid of view, so that rounding never drops what touches its border."""

Body = sapien.render.RenderBodyComponent


class PictureCulling:
    """Switches parts of the scene off that the wrist camera cannot see; made by `apply_render_profile`.

    Args:
        camera: the wrist camera, or None to leave the scene whole.
        moving: links to look at before each picture.
        floor_far: the far part of the floor, None where there is none.
        floor_height_m: height of the floor.
    """

    def __init__(
        self,
        camera: Any | None = None,
        moving: list[Any] | None = None,
        floor_far: Any | None = None,
        floor_height_m: float = 0.0,
    ) -> None:
        self._camera = camera
        self._moving = moving or []
        self._floor_far = floor_far
        self._floor_height_m = floor_height_m
        if camera is not None:
            self._view = _View.of(camera)
            self._boxes = np.array([_box_corners(body) for body in self._moving]).reshape(-1, 8, 3)

    def update(self) -> None:
        """Fit the scene to the camera's present pose: call it before every picture, 0.05 ms."""
        if self._camera is None:
            return
        to_world = self._camera.get_global_pose().to_transformation_matrix()
        if self._moving:
            links = np.stack([body.entity.pose.to_transformation_matrix() for body in self._moving])
            to_camera = _inverse(to_world) @ links
            corners = self._boxes @ to_camera[:, :3, :3].transpose(0, 2, 1) + to_camera[:, None, :3, 3]
            for body, hidden in zip(self._moving, self._view.misses(corners), strict=True):
                _switch(body, not hidden)
        if self._floor_far is not None:
            _switch(self._floor_far, self._view.reaches(to_world, self._floor_height_m, FLOOR_NEAR_M))

    @property
    def num_moving_drawn(self) -> int:
        """Links drawn now among those looked at before each picture."""
        return sum(body.is_enabled for body in self._moving)

    @property
    def far_floor_drawn(self) -> bool:
        """Whether the far part of the floor is drawn now."""
        return self._floor_far is not None and self._floor_far.is_enabled


@dataclass(frozen=True, kw_only=True, slots=True)
class _View:
    """A camera's pyramid of view, a little widened; the camera looks along x, y is left and z up."""

    near_m: float
    tan_y: float
    tan_z: float

    @classmethod
    def of(cls, camera: Any) -> "_View":
        half_y = max(camera.cx, camera.width - camera.cx) / camera.fx
        half_z = max(camera.cy, camera.height - camera.cy) / camera.fy
        return cls(near_m=camera.near, tan_y=half_y * (1 + _MARGIN_SHARE), tan_z=half_z * (1 + _MARGIN_SHARE))

    def misses(self, points: Float[np.ndarray, "bodies points 3"]) -> Bool[np.ndarray, " bodies"]:
        """Whether all points of a body lie beyond one and the same side of the pyramid, so that it cannot be seen."""
        x, y, z = np.moveaxis(points, -1, 0)
        reach_y, reach_z = x * self.tan_y + _MARGIN_M, x * self.tan_z + _MARGIN_M
        sides = np.stack([x < self.near_m - _MARGIN_M, y > reach_y, y < -reach_y, z > reach_z, z < -reach_z])
        return np.any(sides.all(axis=-1), axis=0)

    def reaches(self, to_world: Float[np.ndarray, "4 4"], height_m: float, distance_m: float) -> bool:
        """Whether some ray of the picture meets the plane at a height beyond a square about the origin, or never."""
        edges = np.array([(1.0, y, z) for y in (-self.tan_y, self.tan_y) for z in (-self.tan_z, self.tan_z)])
        rays = edges @ to_world[:3, :3].T
        drop = to_world[2, 3] - height_m
        if drop <= 0 or (rays[:, 2] > -1e-3).any():
            return True
        met = to_world[:2, 3] + rays[:, :2] * (drop / -rays[:, 2:])
        return bool((np.abs(met) > distance_m - _MARGIN_M).any())


def apply_render_profile(base_env: Any, profile: RenderProfile) -> PictureCulling:
    """Prepare a built ManiSkill environment's scene for a profile; call it again after every reconfiguration.

    May be called in turn with both profiles. With physics on the GPU all environments share what is drawn, so only the
    links that move with the camera are left out there.

    Args:
        base_env: the unwrapped environment, with a robot that carries `hand_camera`.
        profile: what to leave out.

    Returns:
        What to `update` before each picture.

    Raises:
        ValueError: an unknown profile, or a robot without a wrist camera.
    """
    if profile not in ("wrist", "full"):
        raise ValueError(f"env.render_profile = {profile!r}: must be wrist or full")
    if WRIST_CAMERA not in base_env.scene.sensors:
        raise ValueError(f"the robot has no {WRIST_CAMERA!r}; use panda_wristcam")
    _restore(base_env)
    if profile == "full":
        return PictureCulling()
    carried = _links_carrying_camera(base_env)
    moving = []
    for index, camera in enumerate(base_env.scene.sensors[WRIST_CAMERA].camera._render_cameras):
        for name, body in _link_bodies(base_env, index).items():
            if not all(isinstance(shape, sapien.render.RenderShapeTriangleMesh) for shape in body.render_shapes):
                continue
            if name in carried:
                _switch(body, _in_view(body, camera))
            elif "finger" not in name:
                moving.append(body)
    if base_env.gpu_sim_enabled:
        return PictureCulling()
    floor_far, floor_height_m = _split_floor(base_env)
    return PictureCulling(
        base_env.scene.sensors[WRIST_CAMERA].camera._render_cameras[0], moving, floor_far, floor_height_m
    )


def _switch(body: Any, on: bool) -> None:
    if body.is_enabled != on:
        (body.enable if on else body.disable)()


def _link_bodies(base_env: Any, index: int) -> dict[str, Any]:
    """Drawn part of each link of one environment's robot."""
    found = {
        link.name: link._objs[index].entity.find_component_by_type(Body) for link in base_env.agent.robot.get_links()
    }
    return {name: body for name, body in found.items() if body is not None}


def _links_carrying_camera(base_env: Any) -> set[str]:
    """Names of the links joined to the camera's link by fixed joints only."""
    parents = {}
    for link in base_env.agent.robot.get_links():
        joint = link.joint
        if joint is not None and joint.parent_link is not None and joint.type[0] == "fixed":
            parents[link.name] = joint.parent_link.name

    def root(name: str) -> str:
        while name in parents:
            name = parents[name]
        return name

    mount = root(base_env.scene.sensors[WRIST_CAMERA].entity.name)
    return {link.name for link in base_env.agent.robot.get_links() if root(link.name) == mount}


def _parts(body: Any) -> list[tuple[Any, Float[np.ndarray, "4 4"]]]:
    """Meshes that a body is drawn with, and the transform of their vertices to the entity's frame."""
    found = []
    for shape in body.render_shapes:
        scale = np.diag(np.append(np.asarray(shape.scale, dtype=np.float32), np.float32(1)))
        found += [(part, shape.local_pose.to_transformation_matrix() @ scale) for part in shape.parts]
    return found


def _box_corners(body: Any) -> Float[np.ndarray, "8 3"]:
    """Corners of a box around a body, in its entity's frame."""
    corners = []
    for part, matrix in _parts(body):
        columns = np.ascontiguousarray(np.asarray(part.vertices).T)
        corners.append(_moved(_corners_between(columns.min(axis=1), columns.max(axis=1)), matrix))
    points = np.concatenate(corners)
    return _corners_between(points.min(axis=0), points.max(axis=0))


def _corners_between(low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "8 3"]:
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, 8).T


def _moved(points: Float[np.ndarray, "*shape 3"], matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "*shape 3"]:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _in_view(body: Any, camera: Any) -> bool:
    """Whether any triangle of a body may be seen; the box first, which settles it for the 425,160 of the housing."""
    view = _View.of(camera)
    to_world = camera.get_global_pose().to_transformation_matrix()
    to_camera = _inverse(to_world) @ body.entity.pose.to_transformation_matrix()
    if view.misses(_moved(_box_corners(body), to_camera)[None]).all():
        return False
    for part, matrix in _parts(body):
        vertices = _moved(np.asarray(part.vertices), to_camera @ matrix)
        if not view.misses(vertices[np.asarray(part.triangles)]).all():
            return True
    return False


def _inverse(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    turned = pose[:3, :3].T
    inverse = np.eye(4, dtype=pose.dtype)
    inverse[:3, :3], inverse[:3, 3] = turned, -turned @ pose[:3, 3]
    return inverse


def _floor_entity(base_env: Any) -> Any | None:
    actor = base_env.scene.actors.get("ground")
    return None if actor is None else actor._objs[0]


def _restore(base_env: Any) -> None:
    """The scene as ManiSkill built it."""
    for index in range(base_env.num_envs):
        for body in _link_bodies(base_env, index).values():
            _switch(body, True)
    floor = _floor_entity(base_env)
    if floor is not None:
        whole, *cut = [part for part in floor.components if isinstance(part, Body)]
        for part in cut:
            floor.remove_component(part)
        _switch(whole, True)


def _split_floor(base_env: Any) -> tuple[Any | None, float]:
    """Replace the floor by a near and a far part made of its own triangles; the far part and the floor's height."""
    floor = _floor_entity(base_env)
    if floor is None:
        return None, 0.0
    whole = floor.find_component_by_type(Body)
    (part,) = whole.render_shapes[0].parts
    vertices, triangles = np.asarray(part.vertices), np.asarray(part.triangles)
    near = (np.abs(vertices[triangles, :2]) <= FLOOR_NEAR_M).all(axis=(1, 2))
    parts = []
    for chosen in (near, ~near):
        body = Body()
        body.attach(_submesh(part, triangles[chosen]))
        floor.add_component(body)
        parts.append(body)
    whole.disable()
    return parts[1], float(vertices[:, 2].max())


def _submesh(part: Any, triangles: UInt32[np.ndarray, "triangles 3"]) -> Any:
    used, index = np.unique(triangles, return_inverse=True)
    arrays = (part.vertices, part.get_vertex_normal(), part.get_vertex_uv())
    vertices, normals, uvs = (np.asarray(array)[used] for array in arrays)
    return sapien.render.RenderShapeTriangleMesh(
        vertices, index.reshape(-1, 3).astype(np.uint32), normals, uvs, part.material
    )
