"""Closed surfaces are solids: for slicers, which join vertices at one place, and for another library."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_surfaces import PLAIN, QUICK, ball, discs, needs_extra, open_edges, volume

from meshsplats import BaseMesh, load_mesh, make_surface, save_base, save_gaussians
from meshsplats.cli import main
from meshsplats.errors import DataWarning, OptionsError
from meshsplats.surfaces.files import SurfaceFileOptions
from meshsplats.surfaces.fusion import isosurface, parts_of
from meshsplats.surfaces.manifold import apart, simplified, solid
from meshsplats.surfaces.options import SurfaceOptions


def box(low) -> tuple[np.ndarray, np.ndarray]:
    """A unit cube, facing out."""
    points = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return points + low, np.array(faces, np.int32)


def uses_of_edges(faces) -> list[int]:
    """How many triangles the edges have, each number once."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return sorted(set(np.unique(edges, axis=0, return_counts=True)[1].tolist()))


def joined(parts) -> tuple[np.ndarray, np.ndarray]:
    """Meshes as one, with vertices at one place as one."""
    points = np.concatenate([p for p, _ in parts])
    counts = np.cumsum([0, *(len(p) for p, _ in parts)])
    faces = np.concatenate([f + n for (_, f), n in zip(parts, counts, strict=False)])
    places, index = np.unique(points, axis=0, return_inverse=True)
    return places, index.reshape(-1)[faces].astype(np.int32)


def welded(vertices, faces) -> np.ndarray:
    """The triangles with vertices at one place in float32 as one."""
    index = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)[1]
    return index.reshape(-1)[faces]


def assert_solid(vertices, faces):
    """As slicers see it: edges of two triangles in opposite directions, and no part is inside out."""
    assert len(faces)
    joined_faces = welded(vertices, faces)
    assert uses_of_edges(joined_faces) == [2]
    assert open_edges(joined_faces) == 0
    assert len(np.unique(np.sort(joined_faces, axis=1), axis=0)) == len(faces)
    assert len(np.unique(joined_faces)) == len(np.unique(faces)), "no vertices at one place"
    part = parts_of(faces, len(vertices))
    assert (np.bincount(part, np.linalg.det(vertices[faces].astype(float))) > 0).all()


def noise(seed: int, side: int = 14) -> np.ndarray:
    """A field with handles, pockets and necks."""
    field = np.random.default_rng(seed).normal(size=(side, side, side))
    for axis in range(3):
        field = (np.roll(field, 1, axis) + field + np.roll(field, -1, axis)) / 3
        sides = np.moveaxis(field, axis, 0)
        sides[0] = sides[-1] = 0.5
    return field.astype(np.float32)


@needs_extra
@pytest.mark.parametrize(
    "lows",
    [
        [(0, 0, 0), (1, 1, 0)],  # an edge
        [(0, 0, 0), (1, 1, 1)],  # a corner
        [(0, 0, 0), (1, 1, 0), (0, 0, 1), (1, 1, 1), (0, 1, 2)],  # a ring that closes at an edge
    ],
)
def test_cubes_that_touch_move_apart(lows):
    points, faces = joined([box(low) for low in lows])
    made, apart_faces = solid(points, faces)
    assert_solid(made, apart_faces)
    assert volume(made, apart_faces) == pytest.approx(len(lows), rel=0.03)
    away = np.linalg.norm(made[:, None] - points[None], axis=2).min(axis=1)
    assert 0 < np.sort(away)[-1] < 0.03 or len(lows) > 2, "a little"


@needs_extra
def test_two_hollows_that_touch_are_filled():
    block, bottom = box((0, 0, 0)), [box((0.2, 0.2, 0.2)), box((0.5, 0.5, 0.2))]
    hollow = [(0.3 * (p - p.min(axis=0)) + p.min(axis=0), f[:, ::-1]) for p, f in bottom]
    points, faces = joined([block, *((np.round(p, 6), f) for p, f in hollow)])
    assert uses_of_edges(faces) == [2, 4]
    # As parts they face inwards: nobody sees them, and they are filled.
    made, left = solid(points, faces)
    assert_solid(made, left)
    assert volume(made, left) == pytest.approx(1)


@needs_extra
def test_triangles_back_to_back_are_left_out():
    # Two triangles and their backs: a square without thickness, that touches a cube.
    square = np.array([(0, 0, 5), (1, 0, 5), (1, 1, 5), (0, 1, 5)], float)
    both = np.array([(0, 1, 2), (0, 2, 3), (0, 2, 1), (0, 3, 2)], np.int32)
    points, faces = joined([(square, both), box((0, 0, 4)), box((3, 0, 0))])
    made, left = solid(points, faces)
    assert_solid(made, left)
    assert len(left) == 24
    assert [len(part) for part in solid(square, both)] == [0, 0]
    assert [len(part) for part in solid(points, faces[:, ::-1])] == [0, 0], "inside out"
    assert volume(made, left) == pytest.approx(2)


@needs_extra
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [0, 300, 60])
def test_collapsed_surfaces_are_solids(seed, count):
    vertices, faces = isosurface(noise(seed))
    made, left = simplified(vertices, faces, count, closed=True)
    assert_solid(made, left)
    if not count:
        assert volume(made, left) == pytest.approx(volume(vertices, faces), rel=1e-3)
    elif count == 300:
        assert len(left) <= count


@needs_extra
@pytest.mark.parametrize("seed", range(3))
def test_a_surface_of_too_few_triangles_for_a_solid_has_some_more(seed):
    made, left = simplified(*isosurface(noise(seed)), 4, closed=True)
    assert_solid(made, left)
    assert len(left) < 40


@needs_extra
def test_flat_sides_that_touch_in_their_middle_move_apart():
    angles = np.arange(4) * np.pi / 2
    parts = []
    for turn, tip in ((0.0, -1.0), (0.4, 1.0)):
        ring = np.stack([np.cos(angles + turn), np.sin(angles + turn), 0 * angles], axis=1)
        points = np.concatenate([ring, [(0, 0, 0), (0, 0, tip)]])
        sides = [(a, (a + 1) % 4) for a in range(4)]
        faces = np.array([(4, a, b) for a, b in sides] + [(5, b, a) for a, b in sides], np.int32)
        parts.append((points, faces if tip < 0 else faces[:, ::-1]))
    points, faces = joined(parts)
    assert len(points) == 11
    made, left = solid(points, faces)
    assert_solid(made, left)
    heights = np.sort(made[np.linalg.norm(made, axis=1) < 0.1, 2])
    assert (heights[0], heights[1]) != (0, 0)
    assert -0.01 < heights[0] <= 0 <= heights[1] < 0.01, "each into its own solid"


@needs_extra
def test_vertices_far_from_the_origin_keep_places_of_their_own():
    points, faces = joined([box((0, 0, 0)), box((1, 1, 0))])
    made, left = solid(points, faces)
    far = made + 1e5  # float32 has steps of 0.008 there: more than vertices were moved
    assert len(np.unique(welded(far, left))) < len(far)
    moved = apart(far, left)
    assert_solid(moved, left)
    assert np.abs(moved - far).max() < 0.5


@needs_extra
def test_hollows_that_nobody_sees_are_filled():
    x = np.linalg.norm(np.stack(np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij"), -1) - 11.5, axis=-1)
    shell = np.maximum(x - 9, 5 - x).astype(np.float32)
    vertices, faces = isosurface(shell)
    assert np.linalg.norm(vertices - 11.5, axis=1).min() > 8
    assert volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 9**3, rel=0.05)
    shell[11:13, 11:13, :12] = 1  # a shaft from outside: now it is no hollow
    assert np.linalg.norm(isosurface(shell)[0] - 11.5, axis=1).min() < 6


def test_a_print_that_is_no_solid_is_said(tmp_path):
    points, faces = box((0, 0, 0))
    for suffix in (".stl", ".3mf"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            save_base(BaseMesh(points, faces), tmp_path / f"a{suffix}")
        with pytest.warns(DataWarning, match="no solid: 3 of 18 edges do not have two triangles"):
            save_base(BaseMesh(points, faces[1:]), tmp_path / f"b{suffix}")
        points_of_two, two = joined([box((0, 0, 0)), box((1, 1, 0))])
        with pytest.warns(DataWarning, match="no solid: 1 of 35 edges"):
            save_base(BaseMesh(points_of_two, two), tmp_path / f"c{suffix}")


@needs_extra
@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".glb"])
def test_another_library_takes_a_coarse_surface_for_a_solid(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    mesh = ball()
    x, y, z = np.split(12 * mesh.vertices, 3, axis=1)
    spiky = replace(mesh, vertices=mesh.vertices * (1 + 0.9 * np.sin(x) * np.cos(y + 1) * np.sin(z + 0.5)))
    save_base(make_surface(spiky, faces=150, **QUICK), tmp_path / f"a{suffix}")
    found = trimesh.load(tmp_path / f"a{suffix}", force="mesh", process=False)
    found.merge_vertices(merge_tex=True, merge_norm=True)
    assert found.is_watertight
    assert found.is_winding_consistent
    assert all(part.volume > 0 for part in found.split())


@needs_extra
def test_the_size_of_a_print_is_said(tmp_path, capsys):
    save_gaussians(discs(), tmp_path / "scene.ply")
    command = ["surface", str(tmp_path / "scene.ply"), *PLAIN[2:], "--resolution", "24", "--faces", "200"]
    assert main([*command, "-o", str(tmp_path / "a.stl")]) == 0
    said = capsys.readouterr().err
    assert re.search(r"(1\.9|2|2\.)\S* x \S+ x \S+ mm; --scale (4\d|5\d)\S* makes it 100 mm\n", said), said
    assert main([*command, "-o", str(tmp_path / "b.3mf"), "--scale", "50", "--json"]) == 0
    told = capsys.readouterr()
    found = json.loads(told.out)
    assert found["millimetres"] == pytest.approx([100, 100, 100], rel=0.1)
    assert found["solids"] == 1
    assert "makes it" not in told.err
    assert main([*command, "-o", str(tmp_path / "c.ply"), "--texture", "0", "--json"]) == 0
    assert "solids" not in json.loads(capsys.readouterr().out)
    assert len(load_mesh(tmp_path / "c.ply").faces) <= 200


def test_formats_without_a_texture_compute_none():
    for name in ("a.stl", "a.3mf", "a.npz"):
        assert SurfaceFileOptions().checked(Path(name)).texture == 0
        with pytest.raises(OptionsError, match=r"texture is for formats that hold one, not for \."):
            SurfaceFileOptions(SurfaceOptions(texture=512)).checked(Path(name))
        with pytest.raises(OptionsError, match="image is the file of a texture, and there is none"):
            SurfaceFileOptions(image="png").checked(Path(name))
    assert SurfaceFileOptions().checked(Path("a.glb")).texture is None
