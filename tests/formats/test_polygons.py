"""Polygons of files as triangles: concave ones, in every format that has them."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from PIL import Image

from meshsplats import load_base
from meshsplats.formats import _polygons
from meshsplats.formats._polygons import cut_polygons

L = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2]], float)
ARROW = np.array([[0, 0], [2, 1], [0, 2], [0.5, 1]], float)


def areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed, against +z."""
    a, b, c = (points[faces[:, i]].astype(float) for i in range(3))
    return np.cross(b - a, c - a)[:, 2] / 2


def star(n: int) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], 1) * (1 + 0.7 * (np.arange(n) % 2))[:, None]


def spiral(n: int) -> np.ndarray:
    angle = np.linspace(0, 6 * np.pi, n)
    round_ = np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.concatenate([round_ * (1 + angle / 6)[:, None], (round_ * (1.5 + angle / 6)[:, None])[::-1]])


@pytest.mark.parametrize("outline", [L, ARROW, star(40), spiral(30)], ids=["L", "arrow", "star", "spiral"])
def test_triangles_cover_a_concave_polygon_once(outline):
    """From whichever corner and on whichever side it is listed; triangles beside it stay as they are."""
    x, y = outline.T
    area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    for turn in range(len(outline)):
        for side in (1, -1):
            points = np.zeros((len(outline) + 3, 3))
            points[:3] = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
            points[3:, :2] = np.roll(outline, turn, axis=0)[::side]
            cut, owner = cut_polygons(np.array([3, len(outline)]), points)
            assert owner.tolist() == [0] + [1] * (len(outline) - 2)
            assert cut[0].tolist() == [0, 1, 2]
            found = areas(points, cut[1:]) * np.sign(areas(points, cut[1:]).sum())
            assert found.min() > 0
            assert found.sum() == pytest.approx(area)


def test_other_polygons_stay_fans():
    """Convex ones; and those that cross themselves, have no area or no place."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    fan = [[0, 1, 2], [0, 2, 3]]
    for places in (square, square[[0, 2, 1, 3]], 0 * square, np.nan * square, None):
        assert cut_polygons(np.array([4]), places)[0].tolist() == fan
    crossing = np.random.default_rng(0).random((50, 3))
    assert len(cut_polygons(np.array([50]), crossing)[0]) == 48
    assert cut_polygons(np.array([2, 1, 0]), np.zeros((3, 3)))[0].shape == (0, 3)


@pytest.mark.parametrize(("count", "corners"), [(1, 50_000), (1, 2000), (300, 12)])
def test_polygons_that_cross_themselves_take_no_endless_time(monkeypatch, count, corners):
    looks = []
    whole = _polygons._is_ear
    monkeypatch.setattr(_polygons, "_is_ear", lambda *given: looks.append(1) or whole(*given))
    monkeypatch.setattr(_polygons, "_WORK", 1 << 20)
    places = np.random.default_rng(0).random((count * corners, 3))
    cut, owner = cut_polygons(np.full(count, corners), places)
    assert len(cut) == len(owner) == count * (corners - 2)
    assert (np.bincount(cut.ravel(), minlength=len(places)) > 0).all()
    assert len(looks) * corners <= 1 << 20


def test_looking_for_ears_ends_where_there_are_none(monkeypatch):
    looks = []
    monkeypatch.setattr(_polygons, "_is_ear", lambda *_: looks.append(1) and False)
    cut_polygons(np.array([50]), np.random.default_rng(0).random((50, 3)))
    assert len(looks) <= 50


@pytest.mark.parametrize(
    "suffix",
    [
        ".obj",
        ".ply",
        pytest.param(
            ".usda", marks=pytest.mark.skipif(not importlib.util.find_spec("pxr"), reason="usd-core")
        ),
    ],
)
def test_an_l_in_a_file_with_its_texture(tmp_path, suffix):
    points = np.roll(L, 1, axis=0)
    path = tmp_path / f"m{suffix}"
    Image.new("RGB", (2, 2)).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t.png\n")
    rows = [(*p, 0.0) for p in points.tolist()]
    if suffix == ".obj":
        lines = [f"v {x} {y} {z}\nvt {x / 3} {y / 3}" for x, y, z in rows]
        face = " ".join(f"{i}/{i}" for i in range(1, 7))
        path.write_text("mtllib m.mtl\nusemtl a\n" + "\n".join(lines) + f"\nf {face}\n")
    elif suffix == ".ply":
        head = "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 6\n"
        head += "".join(f"property float {name}\n" for name in "xyzst")
        head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        lines = [f"{x} {y} {z} {x / 3} {y / 3}" for x, y, z in rows]
        path.write_text(head + "\n".join(lines) + "\n6 0 1 2 3 4 5\n")
    else:
        corners = ", ".join(map(str, rows))
        st = ", ".join(f"({x / 3}, {y / 3})" for x, y, _ in rows)
        path.write_text(
            f'#usda 1.0\ndef Mesh "M" {{\n point3f[] points = [{corners}]\n int[] faceVertexCounts = [6]\n'
            " int[] faceVertexIndices = [0, 1, 2, 3, 4, 5]\n"
            f' texCoord2f[] primvars:st = [{st}] (interpolation = "vertex")\n}}\n'
        )
    base = load_base(path, texture=tmp_path / "t.png")
    found = areas(base.vertices, base.faces)
    assert found.min() > 0
    assert found.sum() == pytest.approx(4)
    placed = base.vertices[base.faces][..., :2] / 3
    np.testing.assert_allclose(base.uv, placed * [1, -1] + [0, 1], atol=1e-6)


@pytest.mark.parametrize("kind", ["uchar", "ushort", "uint", "char", "short", "int"])
def test_corners_of_a_ply_in_any_integer_type(tmp_path, kind):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 6\n"
    head += "".join(f"property float {name}\n" for name in "xyz")
    head += f"element face 1\nproperty list uchar {kind} vertex_indices\nend_header\n"
    stored = {"char": "i1", "short": "<i2", "int": "<i4", "uchar": "u1", "ushort": "<u2", "uint": "<u4"}[kind]
    points = np.column_stack([np.roll(L, 1, axis=0), np.zeros(6)]).astype("<f4")
    path = tmp_path / "m.ply"
    path.write_bytes(head.encode() + points.tobytes() + b"\6" + np.arange(6).astype(stored).tobytes())
    mesh = load_base(path)
    found = areas(mesh.vertices, mesh.faces)
    assert found.min() > 0
    assert found.sum() == pytest.approx(4)
