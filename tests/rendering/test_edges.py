"""Gradients by the motion of the visible edges of opaque triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _meshes import unit_ball
from _rendering import camera, layers, seen_by, turned

from meshsplats import Camera, SplatMesh, look_at
from meshsplats.rendering import render
from meshsplats.rendering.edges import edge_gradients, faces_across, front_faces

VIEW = camera(320, 240, fx=180.0, fy=160.0)
CUTOFF = 0.3
WHITE = (1.0, 1.0, 1.0)


def flat(points, faces, rgb, opacity: float = 1.0) -> SplatMesh:
    """Triangles of one colour each; they share no vertices."""
    faces = np.asarray(faces)
    colors = np.column_stack([np.asarray(rgb, float), np.full(len(faces), opacity)])
    return SplatMesh(
        np.asarray(points, float)[faces.ravel()],
        np.arange(faces.size).reshape(-1, 3),
        np.repeat(colors, 3, 0),
    )


def pile(view: Camera, count: int = 7) -> SplatMesh:
    """Tilted triangles in front of each other, which do not intersect, inside the image."""
    rng = np.random.default_rng(3)
    points = []
    for i in range(count):
        center = np.append(rng.uniform(-0.5, 0.5, 2), 0)
        turn = rng.uniform(0, 2 * np.pi) + np.array([0, 2.1, 4.0])
        corners = np.column_stack([0.5 * np.cos(turn), 0.4 * np.sin(turn), rng.uniform(-0.05, 0.05, 3)])
        points.append(center + corners + [0, 0, 2 + 0.2 * i])
    colors = rng.random((count, 3))
    return flat(seen_by(view, np.concatenate(points)), np.arange(3 * count).reshape(-1, 3), colors)


def waves(view: Camera, seed: int = 0) -> np.ndarray:
    """(h, w, 3) smooth gradient of a loss."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: view.height, : view.width] / 50.0
    phases = rng.uniform(0, 2 * np.pi, (3, 2))
    return np.stack([np.sin(x + a) * np.cos(y + b) for a, b in phases], axis=2).astype(np.float32)


def test_a_larger_area_shows_more_of_the_triangle():
    # The derivative of a triangle's area with respect to a corner is half of the opposite side, turned.
    screen = np.array([(60.0, 40.0), (260.0, 70.0), (140.0, 220.0)])
    depth = 2.0
    points = np.column_stack([(screen - [VIEW.cx, VIEW.cy]) * depth / [VIEW.fx, VIEW.fy], np.full(3, depth)])
    mesh = flat(points, [(0, 1, 2)], [(0.2, 0.5, 0.9)])
    loss = np.zeros((VIEW.height, VIEW.width, 3), np.float32)
    loss[..., 1] = 4.0
    side = np.roll(screen, -2, axis=0) - np.roll(screen, -1, axis=0)
    grown = 0.5 * np.column_stack([-side[:, 1], side[:, 0]])
    sign = np.sign(np.cross(np.append(screen[1] - screen[0], 0), np.append(screen[2] - screen[0], 0))[2])
    expected = sign * 4 * (0.5 - 1.0) * grown * [VIEW.fx / depth, VIEW.fy / depth]
    found = edge_gradients(mesh, VIEW, CUTOFF, loss)
    assert np.abs(found[:, :2] - expected).max() < 0.02 * np.abs(expected).max()
    # Farther away, it is smaller: by 2 / depth of its area, shared by corners that move towards the axis.
    inward = -(expected * points[:, :2]).sum(axis=1) / depth
    assert np.abs(found[:, 2] - inward).max() < 0.02 * np.abs(inward).max()


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("seed", [None, 1, 2])
def test_gradients_are_differences_of_the_area_means(seed):
    view = VIEW if seed is None else turned(VIEW, seed)
    mesh, loss = pile(view), waves(view)
    found = edge_gradients(mesh, view, CUTOFF, loss).astype(float)

    def value(vertices: np.ndarray) -> float:
        image = render(replace(mesh, vertices=vertices), view, samples=8, background=WHITE, cutoff=CUTOFF)
        return float((image.color.astype(float) * loss).sum())

    step = 0.02  # about a pixel
    errors, values = [], []
    for face in range(len(mesh.faces)):
        rows = mesh.faces[face]
        middle = mesh.vertices[rows].mean(axis=0)
        # Shifts along three axes, and growth about the middle.
        for motion in [*np.eye(3)[:, None].repeat(3, axis=1), (mesh.vertices[rows] - middle) * 2]:
            moved = np.zeros_like(mesh.vertices)
            moved[rows] = motion
            ends = [value(mesh.vertices + sign * step * moved) for sign in (1, -1)]
            values.append((ends[0] - ends[1]) / (2 * step))
            errors.append((found * moved).sum() - values[-1])
    assert np.abs(errors).max() < 0.06 * np.abs(values).max()
    # Colours and the loss are taken at samples, up to half a sample from the edge.
    assert np.linalg.norm(errors) < 0.04 * np.linalg.norm(values)


def test_only_the_nearer_of_two_triangles_ends_where_they_meet():
    small = [(-0.5, -0.4, 2), (0.6, -0.3, 2), (0.1, 0.5, 2)]
    large = [(-30, -30, 5), (60, -30, 5), (-30, 60, 5)]
    for near, far in (((1, 0, 0), (0, 0, 1)), ((0, 0, 1), (1, 0, 0))):
        mesh = flat(small + large, [(0, 1, 2), (3, 4, 5)], [near, far])
        found = edge_gradients(mesh, VIEW, CUTOFF, waves(VIEW))
        assert (np.abs(found[:3]).max(axis=1) > 1).all()
        assert not found[3:].any()
        # What is behind is what the edge uncovers: against its own colour, it shows nothing.
        same = flat(small + large, [(0, 1, 2), (3, 4, 5)], [near, near])
        assert np.abs(edge_gradients(same, VIEW, CUTOFF, waves(VIEW))).max() < 1e-3


def test_a_level_set_is_not_an_edge():
    points = [(-0.6, -0.5, 2), (0.6, -0.5, 2), (0, 0.6, 2), (0, -0.1, 2)]
    faces = [(0, 1, 3), (1, 2, 3), (2, 0, 3)]
    fan = SplatMesh(points, faces, [(1, 0, 0, 0)] * 3 + [(1, 0, 0, 1)])
    assert render(fan, VIEW, cutoff=CUTOFF).alpha.sum() > 2000
    assert not edge_gradients(fan, VIEW, CUTOFF, waves(VIEW)).any()
    alone = replace(
        fan,
        vertices=fan.vertices[fan.faces.ravel()],
        faces=np.arange(9).reshape(3, 3),
        colors=fan.colors[fan.faces.ravel()],
    )
    assert edge_gradients(alone, VIEW, CUTOFF, waves(VIEW)).any()
    # At the height of the cutoff, all of it is drawn, and its rim is an edge again.
    rim = replace(fan, colors=np.array([(1, 0, 0, CUTOFF + 0.01)] * 3 + [(1, 0, 0, 1)], np.float32))
    found = edge_gradients(rim, VIEW, CUTOFF, waves(VIEW))
    assert (np.abs(found[:3]).max(axis=1) > 1).all()
    assert np.abs(found[3]).max() < 1e-3


def test_an_edge_just_below_the_cutoff_is_not_what_ends():
    # The level set lies half a sample in front of the lowest edge: to move the edge moves nothing.
    points = [(-0.6, 0.5, 2), (0.6, 0.5, 2), (0, -0.6, 2)]
    loss = np.ones((VIEW.height, VIEW.width, 3), np.float32)
    shares = []
    for opacity in (CUTOFF + 0.001, CUTOFF - 0.001):
        triangle = SplatMesh(points, [(0, 1, 2)], [(1, 0, 0, opacity)] * 2 + [(1, 0, 0, 1)])
        found = edge_gradients(triangle, VIEW, CUTOFF, loss)
        shares.append(abs(found[:, 1].sum()) / np.abs(found[:, 1]).sum())
    # All edges of a triangle together: its area stays where it is shifted.
    assert shares[0] < 0.02
    assert shares[1] > 0.5


def test_a_surface_ends_where_it_turns_back():
    # Two triangles with a common edge, the one in front of the other, and side by side.
    folded = [(-0.4, -0.5, 2), (0.4, -0.5, 2), (0.05, 0.5, 2), (0, 0.6, 3)]
    faces = [(0, 1, 2), (1, 0, 3)]
    colors = [(1, 0, 0, 1)] * 4
    found = edge_gradients(SplatMesh(folded, faces, colors), VIEW, CUTOFF, waves(VIEW))
    assert (np.abs(found[:2]).max(axis=1) > 1).all()
    open_edge = found[:2, 1].sum()
    side_by_side = [*folded[:3], (0, -0.9, 2)]
    found = edge_gradients(SplatMesh(side_by_side, faces, colors), VIEW, CUTOFF, waves(VIEW))
    alone = edge_gradients(SplatMesh(folded[:3], faces[:1], colors[:3]), VIEW, CUTOFF, waves(VIEW))
    assert abs(open_edge - alone[:2, 1].sum()) < 0.3 * abs(alone[:2, 1].sum())
    assert abs(found[2, 0] - alone[2, 0]) < 1e-3 * abs(alone[2, 0])


def test_triangles_across_edges():
    faces = np.array([(0, 1, 2), (2, 1, 3), (4, 5, 6), (0, 2, 7), (7, 2, 8), (2, 7, 9)], np.int32)
    expected = [(-1, 1, 3), (0, -1, -1), (-1, -1, -1), (0, -1, -1), (-1, -1, -1), (-1, -1, -1)]
    assert faces_across(faces).tolist() == [list(row) for row in expected]
    assert faces_across(faces[:0]).shape == (0, 3)


@pytest.mark.parametrize("axis", [0, 1])
def test_outlines_of_small_triangles_move_the_image(axis):
    # At the outline of a finely divided ball, triangles are narrower than a sample.
    points, faces = unit_ball(4)
    view = look_at((0, 0.9, -3), (0, 0, 0), up=(0, 1, 0), width=120, height=120, fov=50)
    weights = np.sin(np.mgrid[:120, :120][axis] / 17)[..., None] * np.ones(3)
    colors = np.tile(np.array([0.3, 0.5, 0.2, 1]), (len(points), 1))

    def loss(step: float, along: int) -> float:
        moved = points + step * np.eye(3)[along]
        return float((render(SplatMesh(moved, faces, colors), view, samples=8).color * weights).sum())

    gradient = edge_gradients(SplatMesh(points, faces, colors), view, CUTOFF, weights.astype(np.float32))
    slopes = [(loss(0.01, k) - loss(-0.01, k)) / 0.02 for k in range(3)]
    assert np.abs(gradient.sum(axis=0) - slopes).max() < 0.04 * np.abs(slopes).max()


def test_triangles_behind_the_near_plane_get_nothing():
    mesh = flat(
        [(-0.5, -0.4, 2), (0.6, -0.3, 2), (0.1, 0.5, 2), (-1, -1, -1), (1, -1, 3), (1, 1, 3)],
        [(0, 1, 2), (3, 4, 5)],
        [(1, 0, 0), (0, 1, 0)],
    )
    found = edge_gradients(mesh, VIEW, CUTOFF, waves(VIEW))
    assert np.isfinite(found).all()
    assert found[:3].any()
    assert not found[3:].any()


def test_threads_and_scale_of_the_loss_do_not_matter():
    mesh, loss = pile(VIEW, 30), waves(VIEW)
    one = edge_gradients(mesh, VIEW, CUTOFF, loss, threads=1)
    for threads in (2, 5):
        np.testing.assert_array_equal(edge_gradients(mesh, VIEW, CUTOFF, loss, threads=threads), one)
    np.testing.assert_allclose(edge_gradients(mesh, VIEW, CUTOFF, 2 * loss), 2 * one, rtol=1e-6)


def test_the_triangle_in_front_is_the_nearest_that_is_drawn():
    view = camera(40, 30)
    rng = np.random.default_rng(0)
    for _ in range(4):
        depths, opacities = rng.uniform(1, 5, 5), rng.random(5)
        mesh = layers(depths, opacities)
        drawn = np.flatnonzero(opacities >= CUTOFF)
        expected = drawn[depths[drawn].argmin()] if len(drawn) else -1
        front = front_faces(mesh, view, CUTOFF)
        assert (front.faces == expected).all()
        np.testing.assert_array_equal(front.color, render(mesh, view, cutoff=CUTOFF).color)
