"""Opaque fans as polygons of few triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _rendering import camera
from hypothesis import given
from hypothesis import strategies as st

from meshsplats.finetuning.outlines import BEHIND, MAX_CORNERS, MAX_GROWTH, _fans, fewer_triangles
from meshsplats.rendering import render
from meshsplats.scene.mesh import SplatMesh


def fan(radii, middle=(0.0, 0.0, 5.0), rim=(0.2, 0.4, 0.6), tip=None, splat=0) -> SplatMesh:
    """An opaque fan parallel to the image, with corners at these distances from its centre."""
    n = len(radii)
    angles = 2 * np.pi * (np.arange(n) + 0.1) / n
    corners = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), np.zeros(n)])
    vertices = np.concatenate([[np.zeros(3)], corners]) + middle
    colors = np.full((n + 1, 4), [*rim, 1], np.float32)
    colors[0, :3] = rim if tip is None else tip
    around = np.arange(n)
    faces = np.column_stack([np.zeros(n, int), 1 + around, 1 + (around + 1) % n])
    return SplatMesh(vertices, faces, colors, face_splat=np.full(n, splat, np.int32))


def joined(*fans: SplatMesh) -> SplatMesh:
    return SplatMesh.joined(fans, same_splats=True)


def corners(mesh: SplatMesh, faces=...) -> list:
    """The corners of triangles, each in the order that begins with the least one."""
    points = mesh.vertices[mesh.faces[faces]].tolist()
    return [p[p.index(min(p)) :] + p[: p.index(min(p))] for p in points]


def signed_areas(mesh: SplatMesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return 0.5 * np.cross(b - a, c - a)[:, 2]


def per_splat(mesh: SplatMesh, count: int) -> list[int]:
    return np.bincount(mesh.face_splat, minlength=count).tolist()


def test_fans_that_share_a_vertex_are_single_triangles():
    apart = joined(*(fan(np.ones(4), (3 * k, 0, 5), splat=k) for k in range(3)))
    faces = apart.faces.copy()
    faces[faces == 8] = 3  # a corner of the second fan is one of the first
    order, around = _fans(replace(apart, faces=faces).splats)
    assert order.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 8]
    assert (around[:8, :3] == faces[:8]).all()
    assert len(_fans(apart.splats)[1]) == 3


def test_a_mesh_within_its_budget_stays():
    mesh = fan(np.ones(8))
    found = fewer_triangles(mesh, np.zeros(8), 8)
    assert corners(found) == corners(mesh)


def test_a_fan_of_one_color_becomes_the_polygon_of_its_outline():
    mesh = fan(np.ones(8))
    found = fewer_triangles(mesh, np.ones(8), 7)
    assert len(found.faces) == 6
    assert len(found.vertices) == 8
    view = camera(64, 48)
    before, after = (render(m, view, samples=2).color for m in (mesh, found))
    assert np.abs(after - before).max() < 1e-5
    assert (before != before[0, 0]).any()


@pytest.mark.parametrize("most", [5, 4, 3, 2, 1])
def test_polygons_with_fewer_corners_keep_their_area(most):
    mesh = fan(np.ones(8))
    found = fewer_triangles(mesh, np.ones(8), most)
    assert len(found.faces) == most
    assert len(found.vertices) == most + 2
    # A square in an octagon has 0.71 of its area, a triangle with three of its corners 0.35.
    areas = signed_areas(found)
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(signed_areas(mesh).sum(), rel=1e-5)


def test_what_is_little_visible_loses_corners_first_and_then_goes():
    mesh = joined(*(fan(np.ones(4), (3 * k, 0, 5), splat=k) for k in range(3)))
    hits = np.repeat([1, 100, 10000], 4)
    found = {most: per_splat(fewer_triangles(mesh, hits, most), 3) for most in range(7)}
    assert found[6] == [2, 2, 2]  # outlines cost nothing
    assert found[5] == [1, 2, 2]
    assert found[4] == [0, 2, 2]
    assert found[3] == [0, 1, 2]
    assert found[2] == [0, 0, 2]
    assert found[1] == [0, 0, 1]
    assert found[0] == [0, 0, 0]


def test_a_centre_of_another_color_stays_longer():
    plain = fan(np.ones(4), (-3, 0, 5), rim=(0, 0, 0), splat=0)
    colored = fan(np.ones(4), (3, 0, 5), rim=(0, 0, 0), tip=(1, 1, 1), splat=1)
    mesh = joined(plain, colored)
    assert per_splat(fewer_triangles(mesh, np.ones(8), 6), 2) == [2, 4]
    # A sample of the centre costs 3 / 18, or 1 / 12 for each of two triangles, half of a square BEHIND / 2.
    assert BEHIND / 2 < 1 / 12
    assert per_splat(fewer_triangles(mesh, np.ones(8), 5), 2) == [1, 4]


def test_vertices_without_triangles_and_hidden_fans_change_no_other_fan():
    one, hidden = fan(np.ones(4)), fan(np.ones(4), (9, 0, 5), rim=(1, 0, 1), tip=(0, 1, 0), splat=1)
    alone = fewer_triangles(one, np.ones(4), 3)
    mesh = joined(one, hidden)
    for other, hits in (
        (mesh, np.repeat([1, 0], 4)),
        (replace(mesh, faces=mesh.faces[:4], face_splat=one.face_splat), np.ones(4)),
    ):
        found = fewer_triangles(other, hits, 3, 1)
        assert corners(found) == corners(alone)
        assert np.array_equal(found.colors, alone.colors)
    # Without colours of others inside of it, the outline of the first costs nothing.
    plain = joined(one, fan(np.ones(4), (3, 0, 5), tip=(0.2, 0.4, 0.7), splat=1), hidden)
    hits = np.repeat([1, 1, 0], 4)
    assert per_splat(fewer_triangles(plain, hits, 6, 1), 3) == [2, 4, 0]


def test_reflex_corners_are_not_drawn_inside_out():
    radii = np.array([1, 0.2, 1, 1, 1, 0.2, 1, 1.0])
    mesh = fan(radii)
    for most in range(1, 8):
        found = fewer_triangles(mesh, np.ones(8), most)
        assert 1 <= len(found.faces) <= most
        assert (signed_areas(found) > 0).all()


def test_the_fans_of_a_splat_have_outlines_of_their_own():
    mesh = joined(fan(np.ones(6), (-3, 0, 5)), fan(np.ones(6), (3, 0, 5)))
    mesh = replace(
        mesh, face_splat=np.zeros(12, np.int32), faces=mesh.faces[[0, 6, 1, 7, 2, 8, 3, 9, 4, 10, 5, 11]]
    )
    found = fewer_triangles(mesh, np.ones(12), 8)
    middles = found.vertices[found.faces].mean(axis=1)[:, 0]
    assert (np.sign(middles) == [-1, -1, -1, -1, 1, 1, 1, 1]).all()
    assert signed_areas(found).sum() == pytest.approx(signed_areas(mesh).sum())


def test_hidden_fans_go_in_any_case():
    mesh = joined(*(fan(np.ones(4), (3 * k, 0, 5), splat=k) for k in range(3)))
    hits = np.array([0, 0, 3, 0, 0, 0, 0, 0, 1, 1, 1, 1])
    for fewest, left in ((0, [4, 4, 4]), (1, [4, 0, 4]), (4, [0, 0, 4]), (5, [0, 0, 0])):
        assert per_splat(fewer_triangles(mesh, hits, 12, fewest), 3) == left
    assert per_splat(fewer_triangles(mesh, hits, 4, 1), 3) == [2, 0, 2]


def test_triangles_of_what_has_no_single_outline_go_one_by_one():
    around = fan(np.ones(6))
    sectors = replace(around, faces=around.faces[[0, 1, 3, 4]], face_splat=around.face_splat[:4])
    mesh = joined(sectors, fan(np.ones(4), (0, 4, 5), splat=1))
    for most, left in ((6, [4, 2]), (5, [3, 2]), (4, [2, 2]), (3, [1, 2]), (2, [0, 2]), (1, [0, 1])):
        found = fewer_triangles(mesh, np.array([1, 4, 3, 2, 99, 99, 99, 99]), most)
        assert per_splat(found, 2) == left
        kept = sorted([1, 2, 3, 0][: left[0]])
        assert corners(found, slice(left[0])) == corners(mesh, kept)


def test_triangles_of_splats_with_common_vertices_go_one_by_one():
    mesh = fan(np.ones(6))
    mesh = replace(mesh, face_splat=np.repeat([0, 1], 3).astype(np.int32))
    found = fewer_triangles(mesh, np.array([5, 1, 4, 2, 6, 3]), 4)
    assert corners(found) == corners(mesh, [0, 2, 4, 5])


def test_triangles_in_an_outline_of_too_many_corners_go_one_by_one():
    mesh = fan(np.ones(MAX_CORNERS + 1))
    hits = np.arange(MAX_CORNERS + 1)
    found = fewer_triangles(mesh, hits, 100)
    assert corners(found) == corners(mesh, slice(MAX_CORNERS + 1 - 100, None))
    assert len(fewer_triangles(fan(np.ones(MAX_CORNERS)), hits[1:], 100).vertices) == 102


def test_an_empty_mesh_stays_empty():
    mesh = fan(np.ones(4)).take(np.zeros(4, bool))
    assert len(fewer_triangles(mesh, np.zeros(0), 0).faces) == 0


def test_triangles_without_splats_go_one_by_one():
    mesh = replace(fan(np.ones(6)), face_splat=None)
    found = fewer_triangles(mesh, np.array([5, 1, 4, 2, 6, 3]), 3)
    assert found.face_splat is None
    assert corners(found) == corners(mesh, [0, 2, 4])


def test_splats_keep_their_order_depth_groups_and_corner_colors():
    mesh = joined(*(fan(np.ones(5 + k), (3 * k, 0, 5 + k), splat=7 * k) for k in range(3)))
    rng = np.random.default_rng(0)
    colors = mesh.colors.copy()
    colors[:, :3] = rng.random((len(colors), 3))
    groups = mesh.face_splat // 7
    mesh = replace(
        mesh, colors=colors, depth_group=groups, attributes={"row": np.arange(len(colors))[:, None]}
    )
    found = fewer_triangles(mesh, np.ones(len(mesh.faces)), 6)
    assert (np.diff(found.face_splat) >= 0).all()
    assert np.array_equal(found.depth_group * 7, found.face_splat)
    rows = found.attributes["row"][:, 0].astype(int)
    assert np.array_equal(found.colors, colors[rows])
    assert np.array_equal(found.vertices[:, 2], mesh.vertices[rows, 2])  # fans parallel to the image stay so


@given(st.data())
def test_any_fans_keep_to_any_budget(data):
    counts = data.draw(st.lists(st.integers(3, 9), min_size=1, max_size=5))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    fans = [fan(rng.uniform(0.3, 1, n), (3 * k, 0, 5), splat=k) for k, n in enumerate(counts)]
    mesh = joined(*fans)
    most = data.draw(st.integers(0, sum(counts)))
    found = fewer_triangles(mesh, rng.random(len(mesh.faces)), most)
    assert len(found.faces) <= most
    assert not len(found.faces) or found.faces.max() == len(found.vertices) - 1
    areas = signed_areas(found)
    assert (areas > 0).all()
    hull = np.pi * MAX_GROWTH**2
    assert (np.bincount(found.face_splat, areas, len(counts)) <= hull).all()
