"""New ground: nobody falls through it, it goes on as that around it, and there is no more than needed."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.surfaces.floor import CELL, TUCKED, missing_ground

pytest.importorskip("scipy", reason="install meshsplats[base]")
needs_extra = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("skimage", "fast_simplification")),
    reason="install meshsplats[base]",
)
VOXEL = 0.1
EYE = 1.6
SLOPE = np.array([0.05, -0.1])


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return SLOPE[0] * x + SLOPE[1] * y


def sheet(holes: tuple[tuple[float, ...], ...], height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """An inclined ground, 8 x 8, z up, in squares of 0.25, without those in ``holes`` (x0, y0, x1, y1)."""
    n = 33
    x, y = np.meshgrid(np.linspace(-4, 4, n), np.linspace(-4, 4, n), indexing="ij")
    points = np.stack([x, y, ground(x, y) + height], axis=-1).reshape(-1, 3)
    i, j = (index.ravel() for index in np.indices((n - 1, n - 1)))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    middle = points[faces].mean(axis=1)
    gone = np.zeros(len(faces), bool)
    for x0, y0, x1, y1 in holes:
        gone |= (middle[:, 0] > x0) & (middle[:, 0] < x1) & (middle[:, 1] > y0) & (middle[:, 1] < y1)
    return points, faces[~gone]


def walkers(radius: float = 2.0, count: int = 8) -> list[ms.Camera]:
    """Cameras on a ring above the ground, that look at its middle."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = radius * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return [
        ms.look_at([x, y, EYE + ground(x, y)], [0, 0, EYE], up=(0, 0, 1), width=32, height=32)
        for x, y in places
    ]


def cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Twice the area between level directions."""
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def fall(points: np.ndarray, faces: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n,) heights at which balls that fall from the eye at (x, y) land; NaN: never. Every ball is compared
    with every triangle (Moeller and Trumbore)."""
    a, b, c = points[faces].transpose(1, 0, 2)
    area = cross(b - a, c - a)
    a, b, c, area = (part[np.abs(area) > 1e-12] for part in (a, b, c, area))
    place = np.stack([x, y, x], axis=1)[:, None]
    v = cross(place - a, c - a) / area
    w = cross(b - a, place - a) / area
    height = a[:, 2] + v * (b[:, 2] - a[:, 2]) + w * (c[:, 2] - a[:, 2])
    edge = 1e-9
    met = (v >= -edge) & (w >= -edge) & (v + w <= 1 + edge) & (height < (ground(x, y) + EYE)[:, None])
    land = np.where(met, height, -np.inf).max(axis=1)
    return np.where(np.isfinite(land), land, np.nan)


def both(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    ends = np.cumsum([0, *(len(points) for points, _ in parts)])
    faces = [own + end for (_, own), end in zip(parts, ends, strict=False)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(faces)


HOLES = ((-1.0, -1.0, 1.0, 1.0), (1.5, -2.5, 2.75, -0.75), (-4.0, 1.0, -2.0, 2.0))


def test_nobody_falls_through():
    points, faces = sheet(HOLES)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-2, 2, (2, 500))
    assert np.isnan(fall(points, faces, x, y)).mean() > 0.2
    more = missing_ground(points, faces, walkers(), np.array([0, 0, 1.0]), VOXEL)
    landed = fall(*both([(points, faces), more]), x, y)
    # A membrane over holes in a plane is that plane; where both lie, the old ground is above.
    np.testing.assert_allclose(landed, ground(x, y), atol=TUCKED * VOXEL + 1e-6)
    corners = more[0][more[1]]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()


def test_only_what_is_missing_below_and_between_the_views_is_added():
    points, faces = sheet(((-1.0, -1.0, 1.0, 1.0),))
    more, _ = missing_ground(points, faces, walkers(), np.array([0, 0, 1.0]), VOXEL)
    margin = 2 * CELL * VOXEL
    assert np.abs(more[:, :2]).max() < 1 + margin
    assert len(missing_ground(*sheet(()), walkers(), np.array([0, 0, 1.0]), VOXEL)[1]) == 0
    # Far outside of the ring of cameras, the ground stays open.
    points, faces = sheet(((-4.0, -4.0, 4.0, -3.9), (3.75, -4.0, 4.0, 4.0)))
    assert len(missing_ground(points, faces, walkers(0.5), np.array([0, 0, 1.0]), VOXEL)[1]) == 0


def test_the_rim_of_new_ground_lies_below_the_old():
    """Where both lie at one height, they would flicker."""
    more, _ = missing_ground(*sheet(((-1.0, -1.0, 1.0, 1.0),)), walkers(), np.array([0, 0, 1.0]), VOXEL)
    below = ground(more[:, 0], more[:, 1]) - more[:, 2]
    rim = np.abs(more[:, :2]).max(axis=1) > 1 + CELL * VOXEL
    assert 0 < rim.sum() < len(more)
    np.testing.assert_allclose(below[rim], TUCKED * VOXEL, atol=1e-6)
    np.testing.assert_allclose(below[np.abs(more[:, :2]).max(axis=1) < 1], 0, atol=1e-6)


def test_a_far_background_costs_nothing():
    """Mountains within the plan of the ground would have 10^11 cells."""
    points, faces = sheet(((-1.0, -1.0, 1.0, 1.0),))
    up = np.array([0, 0, 1.0])
    alone = missing_ground(points, faces, walkers(), up, VOXEL, margin=8.0)
    far = np.array([(3e4, -3e4, -5), (3e4, 3e4, 80), (-3e4, 3e4, 2)]), np.array([(0, 1, 2)], np.int32)
    with_mountains = missing_ground(*both([(points, faces), far]), walkers(), up, VOXEL, margin=8.0)
    x, y = np.random.default_rng(4).uniform(-2, 2, (2, 100))
    for more in (alone, with_mountains):
        landed = fall(*both([(points, faces), more]), x, y)
        np.testing.assert_allclose(landed, ground(x, y), atol=TUCKED * VOXEL + 1e-6)


def test_furniture_and_noise_below_are_no_ground():
    points, faces = sheet(((-1.0, -1.0, 1.0, 1.0),))
    table, deep = sheet((), height=0.8), sheet((), height=-1.0)
    inside = [
        np.abs(p[f].mean(axis=1)[:, :2]).max(axis=1) < side for (p, f), side in ((table, 0.4), (deep, 0.9))
    ]
    scene = both([(points, faces), (table[0], table[1][inside[0]]), (deep[0], deep[1][inside[1]])])
    more = missing_ground(*scene, walkers(), np.array([0, 0, 1.0]), VOXEL)
    x, y = np.random.default_rng(1).uniform(-0.9, 0.9, (2, 300))
    free = np.maximum(np.abs(x), np.abs(y)) > 0.6  # beside the table
    landed = fall(*both([scene, more]), x, y)
    np.testing.assert_allclose(landed[free], ground(x, y)[free], atol=TUCKED * VOXEL + 1e-6)
    on = np.maximum(np.abs(x), np.abs(y)) < 0.3
    np.testing.assert_allclose(landed[on], ground(x, y)[on] + 0.8, atol=1e-6)


@pytest.mark.parametrize("up", [(0, -1, 0), (0.6, 0, 0.8)])
def test_any_direction_is_up(up):
    """The same ground, turned with its cameras, gets the same new ground."""
    up = np.array(up, np.float64)
    axis = np.cross([0, 0, 1.0], up)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + k + k @ k / (1 + up[2])
    np.testing.assert_allclose(turn @ [0, 0, 1], up, atol=1e-12)
    points, faces = sheet(HOLES)
    cameras = [
        ms.look_at(list(turn @ camera.center), [0, 0, 0], up=tuple(up), width=8, height=8)
        for camera in walkers()
    ]
    more, triangles = missing_ground(points @ turn.T, faces, cameras, up, VOXEL)
    x, y = np.random.default_rng(2).uniform(-2, 2, (2, 200))
    landed = fall(*both([(points, faces), (more @ turn, triangles)]), x, y)
    np.testing.assert_allclose(landed, ground(x, y), atol=TUCKED * VOXEL + 1e-6)


def test_without_ground_there_is_nothing_to_go_on():
    points, faces = sheet(())
    up = np.array([0, 0, 1.0])
    assert len(missing_ground(points, faces[:, ::-1], walkers(), up, VOXEL)[1]) == 0  # it faces down
    assert len(missing_ground(points, faces[:0], walkers(), up, VOXEL)[1]) == 0


@needs_extra
def test_a_place_gets_its_floor_on_request(tmp_path):
    """Ground with a hole, seen by cameras around it: open by default, whole with the shape 'floor'."""
    points, faces = sheet(((-0.8, -0.8, 0.8, 0.8),))
    colors = np.tile([0.2, 0.6, 0.3, 1.0], (len(points), 1))
    mesh = ms.SplatMesh(points, faces, colors, up=(0, 0, 1))
    cameras = [camera.scaled(4) for camera in walkers(2.5)]
    quick = {"texture": 0, "rounds": 0, "resolution": 64, "faces": 2000, "cameras": cameras, "threads": 1}
    x, y = np.random.default_rng(3).uniform(-0.7, 0.7, (2, 200))
    found = {shape: ms.make_surface(mesh, shape=shape, **quick) for shape in ("open", "floor")}
    lands = {shape: fall(base.vertices, base.faces, x, y) for shape, base in found.items()}
    assert np.isnan(lands["open"]).mean() > 0.5
    voxel = 8 / 60
    np.testing.assert_allclose(lands["floor"], ground(x, y), atol=2 * voxel)
    assert len(found["floor"].faces) <= 1.25 * len(found["open"].faces)
    command = ["surface", "scene.ply", "-o", str(tmp_path / "floor.stl"), "--shape", "floor"]
    assert main(command) == 2
