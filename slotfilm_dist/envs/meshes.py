"""The banana and the bowl as generated meshes, so that the task needs no download.

Each object has one picture mesh (a .glb with its colours) and a set of convex pieces for the physics, because PhysX
only moves convex shapes. Files live in a cache folder under the hash of their content: a changed shape gets new names,
and processes that start together write the same bytes.
"""

import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.interpolate import PchipInterpolator
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

ObjectKind = Literal["banana", "bowl"]

BANANA_LENGTH_M = 0.19
"""Length along the arc, stem included."""
BANANA_BEND_RAD = np.deg2rad(88.0)
"""Angle between the directions of stem and tip."""
BOWL_RADIUS_M = 0.08
BOWL_HEIGHT_M = 0.055
BOWL_FOOT_RADIUS_M = 0.03
BOWL_WALL_M = 0.004

_BANANA_RADIUS_MM = (
    (0, 4.6), (8, 4.1), (20, 4.6), (29, 6.8), (42, 11.8), (58, 16.2), (76, 18.4), (95, 18.9), (114, 18.4), (134, 16.4),
    (152, 12.9), (167, 9.2), (178, 6.4), (184, 4.9), (190, 4.2),
)  # fmt: skip
"""Position along the arc from the stem's cut, and the radius there."""
_BANANA_SKIN = (
    (0, (72, 52, 28)), (5, (104, 84, 36)), (18, (150, 146, 52)), (34, (222, 200, 52)), (52, (253, 215, 52)),
    (140, (254, 217, 54)), (166, (236, 196, 52)), (177, (150, 116, 44)), (183, (70, 48, 26)), (190, (46, 32, 20)),
)  # fmt: skip
"""Position along the arc in millimetres, and the skin's sRGB colour there."""
_PENTAGON = 1 - np.sin(np.deg2rad(72))
"""Amplitude of the five ridges that makes the faces between them flat at the 18 degrees of a ring's points."""
_BANANA_NECK_RADIUS_M = 0.010
"""Sections at least this thick touch the table; the stem and the tip stay above it."""
_BOWL_RGBA = (112, 5, 7, 255)
"""Linear, as glTF has it; a deep red in sRGB."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectFiles:
    """An object's files and physical properties, in the frame in which it rests upright on a table.

    The origin lies inside the banana, in the middle of its body where a gripper closes, with its curve in the x-y plane
    and its body along x; and on the bowl's axis at half its height.
    """

    visual: Path
    """Coloured picture mesh, in metres."""
    collisions: tuple[Path, ...]
    """Convex pieces, in metres."""
    rest_height_m: float
    """Height of the origin above a table on which the object rests."""
    footprint_radius_m: float
    """Largest horizontal distance of the object's surface from its origin."""
    mass_kg: float
    density_kg_m3: float
    """Density of the convex pieces that gives the mass."""
    static_friction: float
    dynamic_friction: float


@dataclass(frozen=True, kw_only=True, slots=True)
class _Shape:
    visual: trimesh.Trimesh
    pieces: tuple[trimesh.Trimesh, ...]
    mass_kg: float
    friction: float


def object_files(kind: ObjectKind, cache: Path) -> ObjectFiles:
    """The object's files in the cache folder, written where they are missing.

    Several processes may call this at once: a file appears whole or not at all.

    Raises:
        ValueError: an unknown kind.
    """
    if kind == "banana":
        shape = _banana()
    elif kind == "bowl":
        shape = _bowl()
    else:
        raise ValueError(f"kind = {kind!r}: must be banana or bowl")
    contents: dict[str, Any] = {"visual.glb": shape.visual.export(file_type="glb")}
    contents |= {f"piece_{i:02d}.ply": piece.export(file_type="ply") for i, piece in enumerate(shape.pieces)}
    digest = hashlib.sha256()
    for name, content in contents.items():
        digest.update(f"{name} {len(content)} ".encode())
        digest.update(content)
    folder = cache / f"{kind}-{digest.hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        _write_once(folder / name, content)
    corners = np.concatenate([piece.vertices for piece in shape.pieces])
    return ObjectFiles(
        visual=folder / "visual.glb",
        collisions=tuple(folder / name for name in contents if name != "visual.glb"),
        rest_height_m=float(-corners[:, 2].min()),
        footprint_radius_m=float(np.linalg.norm(shape.visual.vertices[:, :2], axis=1).max()),
        mass_kg=shape.mass_kg,
        density_kg_m3=shape.mass_kg / float(sum(piece.volume for piece in shape.pieces)),
        static_friction=shape.friction,
        dynamic_friction=shape.friction,
    )


def _write_once(path: Path, content: bytes) -> None:
    if path.exists() and path.stat().st_size == len(content):
        return
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(partial, path)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise


def _banana() -> _Shape:
    """A bent, tapered tube with five soft ridges; mass of the YCB set's 011_banana."""
    visual_s = BANANA_LENGTH_M * np.array([0, 0.002, *np.linspace(0.03, 0.97, 32), 0.998, 1.0])
    rings = _banana_rings(visual_s, num_around=20)
    rings[[0, -1]] = rings[[0, -1]].mean(axis=1, keepdims=True)
    u, v = np.meshgrid(visual_s / BANANA_LENGTH_M, np.linspace(0, 1, rings.shape[1]), indexing="ij")
    skin = PBRMaterial(baseColorTexture=Image.fromarray(_banana_skin()), metallicFactor=0.0, roughnessFactor=0.75)
    visual = _grid_mesh(rings)
    visual.visual = TextureVisuals(uv=np.stack([u, v], axis=-1).reshape(-1, 2), material=skin)
    cuts = _banana_rings(BANANA_LENGTH_M * np.array([0, 0.14, 0.27, 0.4, 0.52, 0.65, 0.8, 1.0]), num_around=20)
    pieces = tuple(_hull(cuts[i : i + 2]) for i in range(len(cuts) - 1))
    return _Shape(visual=visual, pieces=pieces, mass_kg=0.066, friction=1.0)


def _banana_rings(s_m: Float[np.ndarray, " rings"], num_around: int) -> Float[np.ndarray, "rings around 3"]:
    """Cross-sections at positions along the arc; the first point of a ring is repeated at its end.

    Every section turns a flat face down and all of the body's faces lie in one plane, so that the banana rests stably.
    """
    knots = np.array(_BANANA_RADIUS_MM) / 1000
    radius = PchipInterpolator(knots[:, 0], knots[:, 1])(s_m)
    curvature = BANANA_BEND_RAD / BANANA_LENGTH_M
    heading = curvature * (s_m - BANANA_LENGTH_M / 2)
    sag = (1 - _PENTAGON) * (np.maximum(radius, _BANANA_NECK_RADIUS_M) - knots[:, 1].max())
    centre = np.stack([np.sin(heading) / curvature, (1 - np.cos(heading)) / curvature, sag], axis=-1)
    sideways = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=-1)
    around = np.deg2rad(90) + np.linspace(0, 2 * np.pi, num_around + 1)
    distance = radius[:, None] * (1 + _PENTAGON * np.cos(5 * (around - np.deg2rad(90))))
    up = np.array([0.0, 0.0, 1.0])
    offset = np.cos(around)[:, None] * sideways[:, None] + np.sin(around)[:, None] * up
    return centre[:, None] + distance[..., None] * offset


def _banana_skin() -> UInt8[np.ndarray, "64 256 3"]:
    """Texture: length from left to right, once around from top to bottom; darker ridges and a few brown freckles."""
    stations = np.linspace(0, 190, 256)
    marks = np.array([at for at, _ in _BANANA_SKIN])
    colours = np.array([rgb for _, rgb in _BANANA_SKIN], dtype=float)
    along = np.stack([np.interp(stations, marks, colours[:, channel]) for channel in range(3)], axis=-1)
    ridge = np.maximum(0, np.cos(5 * np.linspace(0, 2 * np.pi, 64))) ** 8
    image = along[None] * (1 - 0.16 * ridge[:, None, None])
    freckles = np.random.default_rng(11)
    rows, columns = np.mgrid[0:64, 0:256]
    for _ in range(40):
        row, column, size = freckles.uniform(0, 64), freckles.uniform(60, 220), freckles.uniform(0.5, 1.6)
        inside = ((rows - row) / 1.3) ** 2 + ((columns - column) / 1.8) ** 2 < size**2
        image[inside] = image[inside] * 0.55 + np.array([96, 62, 26]) * 0.45
    return image.round().astype(np.uint8)


def _bowl() -> _Shape:
    """A round bowl with a flat foot, open at the top; mass of the YCB set's 024_bowl."""
    visual = _grid_mesh(_turned(_bowl_profile(9), num_around=48))
    red = PBRMaterial(baseColorFactor=_BOWL_RGBA, metallicFactor=0.0, roughnessFactor=0.5, doubleSided=False)
    visual.visual = TextureVisuals(material=red)
    outer, inner = _bowl_wall(np.deg2rad([0, 50, 90]))
    pieces = []
    for band in range(2):
        corners = np.concatenate([outer[band : band + 2], inner[band : band + 2]])
        turned = _turned(corners, num_around=24)
        pieces += [_hull(turned[:, 2 * i : 2 * i + 3]) for i in range(12)]
    pieces.append(_hull(_turned(np.stack([outer[0], inner[0]]), num_around=24)))
    return _Shape(visual=visual, pieces=tuple(pieces), mass_kg=0.147, friction=0.6)


def _bowl_wall(
    angle: Float[np.ndarray, " points"],
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2"]]:
    """Radius and height of the outer and inner wall, from the foot (0) to the rim (pi / 2)."""
    reach, half = BOWL_RADIUS_M - BOWL_FOOT_RADIUS_M, BOWL_HEIGHT_M / 2
    outer = np.stack([BOWL_FOOT_RADIUS_M + reach * np.sin(angle), BOWL_HEIGHT_M * (1 - np.cos(angle)) - half], axis=-1)
    normal = np.stack([-BOWL_HEIGHT_M * np.sin(angle), reach * np.cos(angle)], axis=-1)
    return outer, outer + BOWL_WALL_M * normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _bowl_profile(num_points: int) -> Float[np.ndarray, "points 2"]:
    """Cut through one side of the bowl: from under the foot, up outside, over the rim, down inside to the axis."""
    outer, inner = _bowl_wall(np.linspace(0, np.pi / 2, num_points))
    rim = (outer[-1] + inner[-1]) / 2 + np.array([0, BOWL_WALL_M / 4])
    axis = np.array([0.0, 1.0])
    return np.concatenate([outer[:1] * axis, outer, rim[None], inner[::-1], inner[:1] * axis])


def _turned(profile: Float[np.ndarray, "points 2"], num_around: int) -> Float[np.ndarray, "points around 3"]:
    """Surface of revolution about z; the first column of points is repeated at the end."""
    around = np.linspace(0, 2 * np.pi, num_around + 1)
    circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
    flat = profile[:, None, :1] * circle
    return np.concatenate([flat, np.broadcast_to(profile[:, None, 1:], (*flat.shape[:2], 1))], axis=-1)


def _grid_mesh(points: Float[np.ndarray, "rows columns 3"]) -> trimesh.Trimesh:
    """Closed, smoothly shaded surface over a grid whose last column repeats the first (texture seam kept apart)."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)])
    vertices = points.reshape(-1, 3)
    crosses = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    solid = np.linalg.norm(crosses, axis=1) > 1e-12
    faces, crosses = faces[solid], crosses[solid]
    if (vertices[faces[:, 0]] * crosses).sum() < 0:
        faces, crosses = faces[:, ::-1], -crosses
    _, same = np.unique(vertices.round(7), axis=0, return_inverse=True)
    sums = np.zeros((same.max() + 1, 3))
    for corner in range(3):
        np.add.at(sums, same[faces[:, corner]], crosses)
    normals = (sums / np.linalg.norm(sums, axis=1, keepdims=True))[same]
    return trimesh.Trimesh(vertices=vertices, faces=faces, vertex_normals=normals, process=False)


def _hull(points: Float[np.ndarray, "... 3"]) -> trimesh.Trimesh:
    hull = trimesh.convex.convex_hull(points.reshape(-1, 3))
    return trimesh.Trimesh(vertices=hull.vertices, faces=hull.faces, process=False)
