"""Surfaces of splats: where they are, in their colours, closed or open."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from _glb import read_glb
from _local import shared_data
from _meshes import unit_ball

from meshsplats import (
    GaussianCloud,
    SplatMesh,
    load_gaussians,
    load_mesh,
    look_at,
    psnr,
    save_base,
    save_cameras,
    save_gaussians,
    save_mesh,
)
from meshsplats._core.surfaces import Grid
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.errors import MissingDependencyError
from meshsplats.formats.gltf.cameras import cameras_in_mesh
from meshsplats.formats.outputs import placed
from meshsplats.prior import bind
from meshsplats.surfaces import files as surface_files
from meshsplats.surfaces import make_surface, making, views
from meshsplats.surfaces.atlas import unwrap
from meshsplats.surfaces.files import SurfaceFileOptions, SurfaceRun
from meshsplats.surfaces.fusion import TRUNCATION, close_gaps, collapsed, grid_of, isosurface
from meshsplats.surfaces.holes import close_holes
from meshsplats.surfaces.manifold import simplified
from meshsplats.surfaces.options import CLOSED, OPEN, SurfaceOptions, level_options
from meshsplats.viewpoints.finding import FoundCameras

_TAGS = {"vertex": "xyz", "triangle": ("v1", "v2", "v3")}
"""Elements of a model in 3MF, and their numbers."""
QUICK = {"texture": 0, "rounds": 0, "views": 24, "size": 96, "resolution": 32, "threads": 1}
needs_extra = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("skimage", "fast_simplification")),
    reason="install meshsplats[base]",
)


def ball(radius=1.0, center=(0.0, 0, 0), n=40) -> SplatMesh:
    """An opaque ball, red above z = 0 and blue below."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, n + 1), np.linspace(0, np.pi, n + 1), indexing="ij")
    points = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], -1).reshape(-1, 3)
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    colors = np.where(points[:, 2:] > 0, [0.9, 0.1, 0.1, 1], [0.1, 0.1, 0.9, 1])
    return SplatMesh(points * radius + center, faces, colors, up=(0, 0, 1))


def open_edges(faces) -> int:
    """Edges that are not passed once in each direction."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    found = {(int(a), int(b)) for a, b in edges}
    return sum((b, a) not in found for a, b in found)


def volume(vertices, faces) -> float:
    return float(np.linalg.det(vertices[faces].astype(float)).sum()) / 6


@needs_extra
def test_the_surface_of_a_plane_and_of_a_ball():
    grid = np.stack(np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij"), -1)
    vertices, faces = isosurface(grid[..., 0] - 4.25)
    np.testing.assert_allclose(vertices[:, 0], 4.25)
    normals = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    assert (normals[:, 0] > 0).all(), "faces look where the field is positive"
    distance = np.linalg.norm(grid - 5.4, axis=-1) - 4
    vertices, faces = isosurface(distance)
    assert open_edges(faces) == 0
    np.testing.assert_array_equal(np.unique(faces), np.arange(len(vertices)))
    np.testing.assert_allclose(np.linalg.norm(vertices - 5.4, axis=1), 4, atol=0.05)
    # Of so few voxels it is a coarse ball, whose chords lie inside.
    assert volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 64, rel=0.05)
    for empty in (np.ones((4, 4, 4)), -np.ones((4, 4, 4))):
        assert len(isosurface(empty)[1]) == 0


@needs_extra
@pytest.mark.parametrize("axis", range(3))
def test_an_open_surface_has_no_second_sheet_behind_the_one_that_is_seen(axis):
    """A wall whose back nobody sees, whichever way it faces."""
    away = np.moveaxis(np.broadcast_to(np.arange(24.0), (24, 24, 24)), 2, axis)
    made = []
    for steps in (away, 23 - away):
        field = np.clip((steps - 12.3) / TRUNCATION, -1, 1).astype(np.float32)
        field[steps < 12 - TRUNCATION] = np.nan
        close_gaps(field)
        vertices, faces = isosurface(field, closed=False)
        made.append((len(faces), np.unique(vertices[:, axis].round(1)).tolist()))
    assert made == [(2 * 23**2, [12.3]), (2 * 23**2, [10.7])]


@needs_extra
def test_an_open_surface_between_no_known_points_is_empty():
    field = np.full((6, 6, 6), np.nan)
    field[2, 2, 2:4] = -0.5, 0.5
    assert len(isosurface(field, closed=False)[1]) == 0


@needs_extra
def test_a_room_that_is_seen_completely_is_one():
    """Its air does not reach the border of the grid: it is no hollow in a solid."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [part for a, b, c, d in sides for part in ((a, b, c), (a, c, d))]
    box = SplatMesh(corners, faces, np.tile([0.5, 0.5, 0.5, 1], (8, 1)))
    cameras = [
        look_at(place, np.add(place, way), up=np.roll(way, 1), width=128, height=128, fov=100)
        for place in ((0.3, 0.2, 0.1), (-0.3, -0.2, -0.1))
        for way in (*np.eye(3), *-np.eye(3))
    ]
    options = {**QUICK, "resolution": 40, "faces": 0}
    room = make_surface(box, shape="open", cameras=cameras, **options)
    away = np.abs(room.vertices).max(axis=1)
    assert np.abs(away - 1).max() < 2 / 36 * 2
    walls = np.histogram((room.vertices / away[:, None]).round(3), [-1.0001, -0.999, 0.999, 1.0001])[0]
    assert walls[0] == pytest.approx(walls[2], rel=0.02)


@needs_extra
def test_as_many_faces_as_asked_for():
    grid = np.stack(np.meshgrid(*[np.arange(40.0)] * 3, indexing="ij"), -1)
    distance = np.linalg.norm(grid - 19.4, axis=-1) - 15
    whole = isosurface(distance)
    vertices, faces = collapsed(*whole, 500)
    assert len(whole[1]) > 5000
    assert len(faces) == pytest.approx(500, abs=2)
    assert open_edges(faces) == 0
    np.testing.assert_array_equal(np.unique(faces), np.arange(len(vertices)))
    np.testing.assert_allclose(np.linalg.norm(vertices - 19.4, axis=1), 15, atol=0.3)
    assert simplified(*whole, 10**6, closed=False)[1] is whole[1]


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    monkeypatch.setattr("meshsplats.surfaces.fusion.render", None)  # refused up front
    with pytest.raises(MissingDependencyError, match=r"extra 'base': pip install scikit-image"):
        make_surface(ball(), resolution=8, views=4)


def test_a_library_that_does_not_load_is_not_said_to_be_missing(tmp_path, monkeypatch):
    """To install it again does not help."""
    (tmp_path / "uvunwrap.py").write_text("raise ImportError('DLL load failed while importing uvunwrap')")
    monkeypatch.delitem(sys.modules, "uvunwrap", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match="DLL load failed while importing uvunwrap") as found:
        unwrap(np.eye(3), np.array([[0, 1, 2]]), 64)
    assert not isinstance(found.value, MissingDependencyError)


@needs_extra
def test_the_surface_of_a_ball():
    center = np.array([3.0, -2, 5])
    base = make_surface(ball(2, center), **QUICK)
    assert open_edges(base.faces) == 0
    away = base.vertices - center
    voxel = 4 * 1.1 / 32
    assert np.abs(np.linalg.norm(away, axis=1) - 2).max() < 1.2 * voxel
    assert volume(away, base.faces) == pytest.approx(4 / 3 * np.pi * 8, rel=0.08)
    upper, lower = away[:, 2] > 0.3, away[:, 2] < -0.3
    assert np.abs(base.colors[upper] - [0.9, 0.1, 0.1, 1]).max() < 0.1
    assert np.abs(base.colors[lower] - [0.1, 0.1, 0.9, 1]).max() < 0.1
    np.testing.assert_allclose(base.up, [0, 0, 1], atol=1e-6)


@needs_extra
@pytest.mark.parametrize("suffix", [".stl", ".3mf"])
def test_a_print_is_a_solid_for_another_library(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    save_base(make_surface(ball(2), **QUICK), tmp_path / f"a{suffix}")
    if suffix == ".stl":
        solid = trimesh.load(tmp_path / "a.stl", force="mesh")
    else:  # its reader needs more packages
        with zipfile.ZipFile(tmp_path / "a.3mf") as package:
            model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
        tags = {tag: [e.attrib for e in model.iter() if e.tag.endswith(f"}}{tag}")] for tag in _TAGS}
        points, faces = ([[float(e[k]) for k in keys] for e in tags[tag]] for tag, keys in _TAGS.items())
        solid = trimesh.Trimesh(points, np.array(faces, int), process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.is_volume
    assert solid.body_count == 1
    assert solid.volume == pytest.approx(4 / 3 * np.pi * 8, rel=0.08)
    assert solid.bounds[0] == pytest.approx([0, 0, 0], abs=1e-5)


@needs_extra
def test_depth_images_of_many_splats_are_of_merged_ones(monkeypatch):
    cloud, counts = make_scene(300), []
    monkeypatch.setattr(
        making, "convert", lambda splats, **how: counts.append(len(splats)) or convert(splats, **how)
    )
    for most in (1000, 100):
        monkeypatch.setattr(making, "MOST_SPLATS", most)
        assert len(make_surface(cloud, shape="closed", **QUICK).faces) > 100
    assert counts == [300, 100]


def test_a_place_is_whole_but_for_strays():
    floor = np.stack(np.meshgrid(np.arange(101.0), np.arange(51.0), [0.0, 1.0]), axis=-1).reshape(-1, 3)
    cameras = [look_at((50, 25, 10), (50, 26, 0))]

    def sides(points):
        grid = grid_of(points, cameras, 128)
        assert max(grid.shape) <= 130
        return grid, grid.low, grid.low + grid.voxel * (np.array(grid.shape) - 1)

    grid, low, high = sides(floor)
    # A hundredth of the points lies on each of the outermost lines.
    assert (low <= grid.contracted(floor)).all()
    assert (high >= grid.contracted(floor)).all()
    strays = np.full((3, 3), 1e4)
    np.testing.assert_allclose(sides(np.concatenate([floor, strays]))[1:], (low, high), atol=2)
    with pytest.raises(ValueError, match="no extent"):
        grid_of(np.ones((9, 3)), cameras, 128)


@needs_extra
def test_crumbs_are_left_out():
    large, crumb = ball(), ball(0.08, (1.4, 0, 0), n=8)
    both = SplatMesh(
        np.concatenate([large.vertices, crumb.vertices]),
        np.concatenate([large.faces, crumb.faces + len(large.vertices)]),
        np.concatenate([large.colors, crumb.colors]),
    )
    base = make_surface(both, **QUICK)
    assert base.vertices[:, 0].max() < 1.2


@needs_extra
def test_what_cannot_be_done():
    mesh = ball()
    for options, message in [
        ({"resolution": 4}, "resolution must be"),
        ({"resolution": 600}, "resolution must be"),
        ({"faces": 3}, "faces must be"),
        ({"sh_degree": 4}, "sh_degree must be a whole number from 0 to 3, got 4"),
        ({"views": 2}, "views must be"),
        ({"texture": 32}, "texture must be 64"),
        ({"shape": "round"}, "shape must be one of"),
        ({"cameras": []}, "at least one camera"),
    ]:
        with pytest.raises(ValueError, match=message):
            make_surface(mesh, **options)
    haze = SplatMesh(mesh.vertices, mesh.faces, mesh.colors * (1, 1, 1, 0.1))
    with pytest.raises(ValueError, match="nothing solid"):
        make_surface(haze, **QUICK)


def discs(count=1500) -> GaussianCloud:
    """Flat splats on a ball of radius 1."""
    heights = 1 - 2 * (np.arange(count) + 0.5) / count
    angles = np.pi * (3 - 5**0.5) * np.arange(count)
    ring = np.sqrt(1 - heights**2)
    normals = np.stack([ring * np.cos(angles), ring * np.sin(angles), heights], axis=1)
    quaternions = np.stack([1 + heights, -normals[:, 1], normals[:, 0], np.zeros(count)], axis=1)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    size = 0.7 * np.sqrt(4 * np.pi / count)
    colors = np.where(heights[:, None] > 0, [0.9, 0.1, 0.1], [0.1, 0.1, 0.9])
    return GaussianCloud(
        normals,
        quaternions,
        np.tile([size, size, 0.02 * size], (count, 1)),
        np.full(count, 0.95),
        ((colors - 0.5) / 0.28209479177387814)[:, None],
    )


PLAIN = ["--texture", "0", "--rounds", "0", "--views", "16", "--size", "96", "--no-preview"]
"""Quick: vertex colours, and the shape as fused."""


@needs_extra
def test_from_a_splat_file_to_a_base_by_command(tmp_path, capsys):
    save_gaussians(discs(), tmp_path / "scene.ply")
    out = tmp_path / "base.obj"
    options = [*PLAIN, "--resolution", "24", "--faces", "600"]
    assert main(["surface", str(tmp_path / "scene.ply"), "-o", str(out), *options]) == 0
    assert "next: meshsplats prior" in capsys.readouterr().out
    # Where base and splats stand apart, the next command would train in the wrong place.
    larger = ["surface", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "large.obj"), *options]
    assert main([*larger, "--scale", "2"]) == 0
    assert "next:" not in capsys.readouterr().out
    base = load_mesh(out)
    assert np.abs(np.linalg.norm(base.vertices, axis=1) - 1).max() < 0.15
    assert open_edges(base.faces) == 0
    assert len(base.faces) == pytest.approx(600, abs=2)
    assert main(["surface", str(tmp_path / "scene.ply"), "-o", str(out)]) == 3
    assert main(["surface", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "b.txt")]) == 2
    assert main(["surface", str(out), "-o", str(out), "--force"]) == 2
    assert "is read by this command" in capsys.readouterr().err


@needs_extra
def test_levels_of_detail_have_a_quarter_of_the_triangles_each(tmp_path, capsys):
    save_gaussians(discs(), tmp_path / "scene.ply")
    out = tmp_path / "ball.glb"
    command = ["surface", str(tmp_path / "scene.ply"), "-o", str(out), *PLAIN, "--resolution", "24"]
    command += ["--faces", "800", "--levels", "3", "--json"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    rows = [found, *found["levels"]]
    assert [row["mesh"] for row in rows] == [str(out), *(str(tmp_path / f"ball_lod{k}.glb") for k in (1, 2))]
    for row, count in zip(rows, (800, 200, 50), strict=True):
        base = load_mesh(row["mesh"])
        assert row["triangles"] == len(base.faces) == pytest.approx(count, abs=2)
        assert open_edges(base.faces) == 0
        assert np.abs(np.linalg.norm(base.vertices, axis=1) - 1).max() < 0.3
    # None of the files is written over by accident, and none is begun that could not be finished.
    out.unlink()
    assert main(command) == 3
    assert main([*command, "--faces", "60", "--force"]) == 1
    assert main([*command, "--levels", "0", "--force"]) == 1
    assert not out.exists()


def test_levels_are_halved_until_they_would_be_too_small():
    options = SurfaceOptions(faces=640, texture=256, size=80).sized(closed=True)
    levels = level_options(options, 3)
    assert [(o.faces, o.texture, o.size) for o in levels] == [(640, 256, 80), (160, 128, 40), (40, 64, 20)]
    assert [o.faces for o in level_options(replace(options, faces=0, texture=0), 3)] == [0, 0, 0]
    for field, value in (("faces", 60), ("texture", 128), ("size", 40)):
        with pytest.raises(ValueError, match="fewer than 3 levels"):
            level_options(replace(options, **{field: value}), 3)
    with pytest.raises(ValueError, match="levels must be 1 or more, got 0"):
        level_options(options, 0)


@pytest.mark.slow
@needs_extra
def test_a_collider_lies_where_the_mesh_is_in_other_programs(tmp_path):
    save_gaussians(discs(), tmp_path / "scene.ply")
    paths = [tmp_path / name for name in ("engine.glb", "collider.glb")]
    assert main(["convert", str(tmp_path / "scene.ply"), "-o", str(paths[0]), "--up", "x"]) == 0
    options = [*PLAIN, "--faces", "200", "--resolution", "24"]
    assert main(["surface", str(paths[0]), "-o", str(paths[1]), *options]) == 0
    documents = [read_glb(path)[0] for path in paths]
    assert [d["nodes"][0]["rotation"] for d in documents] == [documents[0]["nodes"][0]["rotation"]] * 2
    scene, collider = (load_mesh(path) for path in paths)
    for limit in (np.min, np.max):
        assert limit(scene.vertices, axis=0) == pytest.approx(limit(collider.vertices, axis=0), abs=0.2)
    assert open_edges(collider.faces) == 0
    assert len(collider.faces) == pytest.approx(200, abs=2)


@pytest.mark.slow
@needs_extra
def test_the_next_command_of_a_base_takes_what_there_is(tmp_path, capsys):
    save_gaussians(discs(), tmp_path / "scene.ply")
    assert main(["convert", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "mesh.npz")]) == 0
    options = [*PLAIN, "--resolution", "16"]
    printed = []
    for source, more in (("scene.ply", ["--axes", "y-up"]), ("mesh.npz", [])):
        arguments = [str(tmp_path / source), "-o", str(tmp_path / f"{source}.obj"), *options, *more]
        assert main(["surface", *arguments]) == 0
        printed.append(capsys.readouterr().out.splitlines()[-1])
    assert re.search(r"--splats \S*scene.ply --axes y-up -o prior.npz", printed[0])
    assert "--data photos/ -o prior.npz" in printed[1]
    assert (
        main(
            ["prior", str(tmp_path / "scene.ply.obj"), "--splats", str(tmp_path / "mesh.npz"), "-o", "p.npz"]
        )
        == 1
    )
    assert "mesh.npz: a mesh, not splats" in capsys.readouterr().err


@pytest.mark.slow
@needs_extra
def test_a_base_of_real_splats_looks_like_them():
    from meshsplats import orbit, render, render_splats

    cloud = load_gaussians(shared_data("splats/playbot_lod5_3k_sh2.ply"))
    base = make_surface(cloud, resolution=64, views=32, size=192, texture=0, rounds=0, threads=1)
    assert open_edges(base.faces) == 0
    mesh = bind(base).mesh
    for camera in orbit(cloud, 2, width=96, height=96):
        assert psnr(render(mesh, camera).color, render_splats(cloud, camera).color) > 17


def test_small_holes_are_closed_and_the_rim_stays():
    # A plate of 20 x 20 squares, of which some are missing.
    x, y = np.meshgrid(np.arange(21.0), np.arange(21.0), indexing="ij")
    vertices = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3)
    number = np.arange(441).reshape(21, 21)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3).astype(np.int32)
    gone = np.zeros((20, 20), bool)
    gone[5, 5] = gone[10, 4] = gone[15, 15] = True
    kept = faces[~gone.ravel().repeat(2)]
    kept = np.delete(kept, len(kept) // 3, axis=0)  # and a single triangle
    points, whole = close_holes(vertices, kept)
    corners = points[whole]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all(), "all face the same side"
    assert normals[:, 2].sum() / 2 == pytest.approx(400)
    assert open_edges(whole) == 80
    same = close_holes(vertices, faces)
    np.testing.assert_array_equal(same[1], faces)
    far = np.zeros((20, 20), bool)
    far[3:17, 3:17] = True
    large = faces[~far.ravel().repeat(2)]
    assert len(close_holes(vertices, large)[1]) == len(large)


def wall(side: float = 2.0, n: int = 12) -> SplatMesh:
    """An opaque square that looks along -z, with a pattern."""
    x, y = np.meshgrid(np.linspace(-side, side, n + 1), np.linspace(-side, side, n + 1), indexing="ij")
    points = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3)
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (k.ravel() for k in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack(t, 1) for t in ((a, c, b), (a, d, c))])
    colors = np.column_stack([0.5 + 0.4 * np.sin(3 * points[:, :2]), np.full((len(points), 2), [0.3, 1.0])])
    return SplatMesh(points, faces, colors)


@needs_extra
def test_a_wall_that_is_seen_from_one_side_is_open():
    mesh = wall()
    cameras = [
        look_at((x, y, -4), (0, 0, 0), up=(0, -1, 0), width=96, height=96, fov=50)
        for x in (-1.0, 0, 1)
        for y in (-1.0, 0, 1)
    ]
    options = {**QUICK, "resolution": 48}
    base = make_surface(mesh, cameras=cameras, shape="open", **options)
    # At its rim it bends back, as far as distances behind a surface are known.
    assert np.abs(base.vertices[:, 2]).max() <= TRUNCATION * 4 / (48 - 4)
    inner = np.abs(base.vertices[:, :2]).max(axis=1) < 1.3
    assert np.abs(base.vertices[inner, 2]).max() < 0.05
    corners = base.vertices[base.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert open_edges(base.faces) > 0
    facing = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    inside = inner[base.faces].all(axis=1)
    assert (facing[inside] < -0.9).mean() > 0.99, "towards the cameras"
    # Closed, the same is a slab.
    solid = make_surface(mesh, cameras=cameras, shape="closed", **options)
    assert open_edges(solid.faces) == 0


@needs_extra
def test_a_wall_is_where_it_is_behind_a_veil():
    behind, side = wall(), 1.0
    square = np.array([(-side, -side, -1.0), (side, -side, -1), (side, side, -1), (-side, side, -1)])
    mesh = SplatMesh(
        np.concatenate([square, behind.vertices]),
        np.concatenate([[(0, 2, 1), (0, 3, 2)], behind.faces + 4]),
        np.concatenate([np.full((4, 4), 0.4), behind.colors]),
    )
    cameras = [
        look_at((x, 0, -4), (0, 0, 0), up=(0, -1, 0), width=96, height=96, fov=50) for x in (-1.0, 0, 1)
    ]
    base = make_surface(mesh, cameras=cameras, shape="open", **{**QUICK, "resolution": 48})
    inner = np.abs(base.vertices[:, :2]).max(axis=1) < 1.3
    assert inner.sum() > 50
    assert np.abs(base.vertices[inner, 2]).max() < 0.05


def test_surfaces_of_places_have_more_triangles_and_texels_unless_a_number_is_named():
    for closed, size in ((True, CLOSED), (False, OPEN)):
        sized = SurfaceOptions(views=12).sized(closed)
        assert (sized.faces, sized.texture, sized.views) == (*size, 12)
        named = SurfaceOptions(faces=0, texture=0).sized(closed)
        assert (named.faces, named.texture) == (0, 0)
    assert np.greater(OPEN, CLOSED).all()


@needs_extra
@pytest.mark.nightly
def test_the_default_size_of_an_open_surface_is_said(tmp_path):
    save_mesh(wall(), tmp_path / "wall.npz")
    cameras = [look_at((x, 0, -4), (0, 0, 0), up=(0, -1, 0), width=48, height=48) for x in (-1, 0, 1)]
    save_cameras(cameras, tmp_path / "cameras.json")
    for named, said in (
        ({}, ["an open surface: by default at most 60,000 triangles, a texture of 4096 texels"]),
        ({"texture": 64}, ["an open surface: by default at most 60,000 triangles"]),
        ({"faces": 90, "texture": 0}, []),
    ):
        heard: list[str] = []
        options = SurfaceOptions(shape="open", resolution=16, size=48, rounds=0, **named)
        files = SurfaceFileOptions(options, cameras=tmp_path / "cameras.json", no_preview=True)
        run = SurfaceRun(tmp_path / "wall.npz", tmp_path / "wall.glb", files, threads=1, say=heard.append)
        ((_, base),) = run.save(force=True)[1]
        assert heard == said
        side = len(base.textures[0].pixels) if base.textures else 0
        assert side == named.get("texture", 4096)


def seen_from(cameras, kind="place") -> FoundCameras:
    return FoundCameras(kind, 1.0, np.array([0.0, 0, 1]), 1.0, 0.0, 4.0, tuple(cameras))


@needs_extra
def test_the_views_in_a_file_stand_where_its_surface_does(tmp_path, monkeypatch):
    save_mesh(wall(), tmp_path / "wall.npz")
    cameras = [look_at((x, 0, -4), (0, 0, 0), up=(0, -1, 0), width=48, height=48) for x in (-1, 0, 1)]
    save_cameras(cameras, tmp_path / "cameras.json")
    monkeypatch.setattr(surface_files, "place_of", lambda *_: seen_from(cameras))
    surface = SurfaceOptions(shape="open", resolution=16, size=48, rounds=0, texture=0)
    files = SurfaceFileOptions(surface, cameras=tmp_path / "cameras.json", scale=2.0)
    run = SurfaceRun(tmp_path / "wall.npz", tmp_path / "wall.glb", files, threads=1)
    for point in ((0, 0, 0), (5, -3, 1)):
        ((_, base),) = replace(run, place=partial(placed, origin=point)).save(force=True)[1]
        written = load_mesh(run.output).vertices
        for limit in (np.min, np.max):
            wanted = 2 * limit(base.vertices, axis=0) - point
            np.testing.assert_allclose(limit(written, axis=0), wanted, atol=1e-5)
        first = cameras_in_mesh(run.output)[0]
        np.testing.assert_allclose(first.center, 2 * cameras[0].center - point, atol=1e-5)


@needs_extra
def test_the_mesh_of_a_place_is_open(tmp_path, monkeypatch):
    """Its fans were splats, which tell what it is; of other triangles that is said."""
    inside = [look_at((0, 0, 0), way, up=(0, 1, 0.1), width=32, height=32) for way in np.eye(3)]
    for kind in ("place", "object"):
        found = seen_from(inside * 4, kind)
        monkeypatch.setattr(views, "find_cameras", lambda cloud, count, found=found, **_: found)
        sources = views.sources_of(convert(discs()), None, None, SurfaceOptions(views=4, size=32), 1)
        assert sources.closed == (kind == "object")
        if kind == "place":
            assert [camera.center.tolist() for camera in sources.depth] == [[0, 0, 0]] * 4
            assert views.place_of(convert(discs()), sources) is found
    save_mesh(wall(), tmp_path / "wall.npz")
    heard: list[str] = []
    options = SurfaceOptions(resolution=16, size=32, views=4, rounds=0, texture=0)
    run = SurfaceRun(tmp_path / "wall.npz", tmp_path / "w.obj", SurfaceFileOptions(options), say=heard.append)
    run.save()
    assert heard == ["taken for an object, as its triangles are no splats: ``shape`` open is for places"]


def test_a_print_is_closed_by_default():
    for suffix, shape in ((".stl", "closed"), (".3mf", "closed"), (".glb", "auto")):
        assert SurfaceFileOptions().checked(Path(f"place{suffix}")).shape == shape


@needs_extra
def test_every_part_of_the_work_has_a_name(tmp_path):
    save_mesh(wall(), tmp_path / "wall.npz")
    cameras = [look_at((x, 0, -4), (0, 0, 0), up=(0, -1, 0), width=48, height=48) for x in (-1, 0, 1)]
    save_cameras(cameras, tmp_path / "cameras.json")
    options = SurfaceOptions(shape="open", resolution=16, size=48, rounds=1, faces=90, texture=64)
    files = SurfaceFileOptions(options, cameras=tmp_path / "cameras.json", no_preview=True)
    said: list[tuple[str, int, int]] = []
    run = SurfaceRun(tmp_path / "wall.npz", tmp_path / "wall.glb", files, threads=1)
    run.save(progress=lambda *at: said.append(at))
    assert list(dict.fromkeys(name for name, _, _ in said)) == [
        *("reading", "looking for views", "converting", "shape", "triangles"),
        *("texture coordinates", "images", "colors", "fit", "texture", "saving"),
    ]
    for name in ("shape", "images", "colors", "fit", "texture"):
        assert [(done, total) for other, done, total in said if other == name] == [(1, 3), (2, 3), (3, 3)]


@needs_extra
def test_an_atlas_that_fails_has_fewer_triangles_unless_their_number_is_named(monkeypatch):
    counts = []

    def unwrap(vertices, faces, side):
        counts.append(len(faces))
        if len(faces) > 300:
            raise ValueError("too many")
        return np.zeros((len(faces), 3, 2), np.float32)

    monkeypatch.setattr(making, "unwrap", unwrap)
    monkeypatch.setattr(making, "CLOSED", (100, 64))
    points, faces = unit_ball(3)
    even = Grid(np.zeros(3), 1.0, ())
    assert 200 < len(making._blank(points, faces, even, 64).faces) <= 300
    assert counts[0] == len(faces)
    counts.clear()
    with pytest.raises(ValueError, match="too many"):
        making._blank(points, faces, even, 64, least=len(faces))
    assert counts == [len(faces)]


@needs_extra
def test_photographs_from_one_side_are_where_depth_is_taken_from():
    from meshsplats import Dataset, orbit
    from meshsplats.datasets.views import View, ViewImage
    from meshsplats.surfaces.views import from_one_side, sources_of

    mesh = ball()
    front = [
        look_at((x, y, -4), (0, 0, 0), up=(0, -1, 0), width=32, height=32)
        for x in (-2, 0, 2)
        for y in (-2, 2)
    ]
    around = orbit(mesh, 8, width=32, height=32)
    image = ViewImage(np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.uint8))
    options = SurfaceOptions(shape="closed", views=12, size=32)
    for cameras, one_side in ((front, True), (around, False)):
        assert from_one_side(cameras) == one_side
        data = Dataset([View(camera, image) for camera in cameras], [])
        found = sources_of(mesh, data, None, options, 1)
        assert found.closed
        assert len(found.depth) == (len(cameras) if one_side else 12)
    assert len(sources_of(mesh, None, front, options, 1).depth) == len(front)
