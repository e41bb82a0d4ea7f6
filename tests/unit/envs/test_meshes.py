import inspect
import multiprocessing
from pathlib import Path

import numpy as np
import pytest
import trimesh

from slotfilm_dist.envs.meshes import BANANA_LENGTH_M, BOWL_HEIGHT_M, BOWL_RADIUS_M, ObjectFiles, object_files

KINDS = ("banana", "bowl")
GRIPPER_OPENING_M = 0.08


def pieces(files: ObjectFiles) -> list[trimesh.Trimesh]:
    return [trimesh.load(path, force="mesh") for path in files.collisions]


def picture(files: ObjectFiles) -> trimesh.Trimesh:
    return trimesh.load(files.visual, force="mesh")


def inside(solids: list[trimesh.Trimesh], *point: float) -> bool:
    """Whether some convex piece holds the point: on the inner side of all of its faces."""
    return any(
        bool((((np.array(point) - solid.triangles_center) * solid.face_normals).sum(axis=1) < 1e-7).all())
        for solid in solids
    )


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("kind", KINDS)
def test_two_caches_hold_the_same_bytes(kind, tmp_path):
    object_files(kind, tmp_path / "one")
    object_files(kind, tmp_path / "two")
    assert content(tmp_path / "one") == content(tmp_path / "two") != {}


def test_second_call_writes_nothing(tmp_path):
    first = object_files("bowl", tmp_path)
    stamps = [path.stat().st_mtime_ns for path in (first.visual, *first.collisions)]
    second = object_files("bowl", tmp_path)
    assert second == first
    assert [path.stat().st_mtime_ns for path in (second.visual, *second.collisions)] == stamps


def test_cut_short_file_is_written_again(tmp_path):
    files = object_files("banana", tmp_path)
    whole = files.visual.read_bytes()
    files.visual.write_bytes(whole[:100])
    object_files("banana", tmp_path)
    assert files.visual.read_bytes() == whole


def test_processes_starting_together_leave_whole_files_and_nothing_else(tmp_path):
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        found = pool.starmap(object_files, [("banana", tmp_path)] * 3)
    object_files("banana", tmp_path / "alone")
    alone = content(tmp_path / "alone")
    assert found[0] == found[1] == found[2]
    assert {name: data for name, data in content(tmp_path).items() if not name.startswith("alone")} == alone


def test_unknown_kind_is_named(tmp_path):
    with pytest.raises(ValueError, match="'apple': must be banana or bowl"):
        inspect.unwrap(object_files)("apple", tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_pieces_are_convex_and_give_the_mass(kind, tmp_path):
    files = object_files(kind, tmp_path)
    assert all(piece.is_convex and piece.is_watertight for piece in pieces(files))
    assert sum(piece.volume for piece in pieces(files)) * files.density_kg_m3 == pytest.approx(files.mass_kg, rel=1e-4)


@pytest.mark.parametrize(("kind", "most"), [("banana", 1500), ("bowl", 2500)])
def test_picture_mesh_is_light_and_faces_outwards(kind, most, tmp_path):
    mesh = picture(object_files(kind, tmp_path))
    assert len(mesh.faces) < most
    assert mesh.volume > 0
    outward = (mesh.face_normals[:, None] * mesh.vertex_normals[mesh.faces]).sum(axis=-1)
    assert (outward > 0).mean() > 0.98


@pytest.mark.parametrize("kind", KINDS)
def test_picture_and_pieces_agree_within_the_chords_of_the_pieces(kind, tmp_path):
    files = object_files(kind, tmp_path)
    solid = trimesh.util.concatenate(pieces(files)).bounds
    np.testing.assert_allclose(picture(files).bounds, solid, atol=0.0025)


@pytest.mark.parametrize("kind", KINDS)
def test_rests_with_its_lowest_point_on_the_table(kind, tmp_path):
    files = object_files(kind, tmp_path)
    lowest = min(piece.bounds[0, 2] for piece in pieces(files))
    assert lowest + files.rest_height_m == pytest.approx(0, abs=1e-6)


def test_banana_rests_on_its_flat_face_without_rolling(tmp_path):
    files = object_files("banana", tmp_path)
    solids = pieces(files)
    volumes = np.array([solid.volume for solid in solids])
    centre = volumes @ np.array([solid.center_mass for solid in solids]) / volumes.sum()
    points = np.concatenate([solid.vertices for solid in solids])
    touching = points[points[:, 2] < -files.rest_height_m + 1e-4][:, :2]
    support = trimesh.convex.convex_hull(np.pad(np.tile(touching, (2, 1)), ((0, 0), (0, 1))) + slab(len(touching)))
    margin = ((np.append(centre[:2], 0.5) - support.triangles_center) * support.face_normals).sum(axis=1).max()
    assert margin < -0.004


def slab(count: int) -> np.ndarray:
    """Heights 0 and 1 for two copies of points, so that their outline is the side of a prism."""
    return np.repeat([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], count, axis=0)


def test_gripper_fits_across_the_banana_at_its_origin(tmp_path):
    files = object_files("banana", tmp_path)
    assert inside(pieces(files), 0, 0, 0)
    vertices = picture(files).vertices
    across = np.ptp(vertices[np.abs(vertices[:, 0]) < 0.004][:, 1])
    assert 0.035 < across < 0.042 < GRIPPER_OPENING_M
    assert np.ptp(vertices[:, 0]) < BANANA_LENGTH_M < 2.2 * files.footprint_radius_m


def test_banana_is_yellow_with_dark_ends(tmp_path):
    skin = np.asarray(picture(object_files("banana", tmp_path)).visual.material.baseColorTexture, dtype=float)
    red, green, blue = skin[:, 100:160].mean(axis=(0, 1))
    assert min(red, green) > 170
    assert blue < 80
    assert skin[:, :4].mean() < 70 > skin[:, -4:].mean()


def test_bowl_is_open_at_the_top_and_closed_at_the_bottom(tmp_path):
    files = object_files("bowl", tmp_path)
    solids = pieces(files)
    bottom, half = -files.rest_height_m, BOWL_HEIGHT_M / 2
    assert inside(solids, 0, 0, bottom + 0.002)
    for height in (bottom + 0.006, 0.0, half):
        assert not inside(solids, 0, 0, height)
    assert not inside(solids, 0.055, 0, half - 0.002)
    radius = BOWL_RADIUS_M - 0.0035
    for angle in np.linspace(0, 2 * np.pi, 37):
        assert inside(solids, radius * np.cos(angle), radius * np.sin(angle), half - 0.002)
