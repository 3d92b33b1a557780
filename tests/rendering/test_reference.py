"""The float64 reference for meshes against images worked out by hand and the laws of blending."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats.rendering.reference import render
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

BLACK = (0, 0, 0)
seeds = st.integers(0, 10_000)
FEW = settings(max_examples=20)


def flat_camera(width: int, height: int, *, near: float = 0.01) -> Camera:
    """Sees the point (X, Y, Z) at (X / Z, Y / Z) pixels."""
    return Camera(np.eye(4), 1, 1, 0, 0, width, height, near)


def triangles(*corners, colors=None) -> SplatMesh:
    """Triangles of their own three (x, y, z) vertices each, with one RGBA a triangle."""
    colors = [(1, 1, 1, 1)] * len(corners) if colors is None else colors
    return SplatMesh(
        np.reshape(corners, (-1, 3)), np.arange(3 * len(corners)).reshape(-1, 3), np.repeat(colors, 3, axis=0)
    )


def layer(z: float, size: float = 100.0) -> list[tuple[float, float, float]]:
    """A triangle that faces ``flat_camera`` and covers its image."""
    return [(-size * z, -size * z, z), (3 * size * z, -size * z, z), (-size * z, 3 * size * z, z)]


def pattern(text: str) -> np.ndarray:
    return np.array([[mark == "#" for mark in row] for row in text.split()])


def random_mesh(seed: int, faces: int = 14) -> SplatMesh:
    """Triangles that share vertices, some across or behind the near plane of ``random_camera``."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(faces, 3)) * [1.2, 1.2, 1.5] + [0, 0, 2.5]
    vertices = np.round(vertices * 256) / 256  # exact in float32 also after a move by whole numbers
    numbers = np.array([rng.permutation(faces)[:3] for _ in range(faces)])
    return SplatMesh(
        vertices,
        numbers,
        rng.random((faces, 4)),
        attributes={"heat": rng.normal(size=faces), "flow": rng.normal(size=(faces, 2))},
    )


def random_camera() -> Camera:
    return Camera(np.eye(4), 11, 12, 6.3, 4.9, 13, 11, near=0.5)


def same(a, b, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a.color, b.color, rtol=0, atol=tolerance)
    np.testing.assert_allclose(a.alpha, b.alpha, rtol=0, atol=tolerance)


# Coverage


def test_triangle_on_a_grid_by_hand():
    # Corners (1, 1), (9, 2), (3, 8). The right edge x = 11 - y passes through the centre of one pixel in each
    # of the rows 2 to 7: they belong to the triangle on the other side.
    left = pattern("""
        ..........
        .####.....
        .#######..
        ..#####...
        ..####....
        ..###.....
        ...#......
        ..........
        ..........
        ..........""")
    right = pattern("""
        ..........
        ..........
        ........#.
        .......##.
        ......###.
        .....####.
        ....#####.
        ...######.
        ..........
        ..........""")
    a, b, c, d = (1, 1, 1), (9, 2, 1), (3, 8, 1), (9, 8, 1)
    camera = flat_camera(10, 10)
    for corners in ([a, b, c], [c, b, a], [b, c, a]):
        assert (render(triangles(corners), camera).alpha == left).all()
    assert (render(triangles([b, c, d]), camera).alpha == right).all()


def test_left_and_top_edges_belong_to_the_triangle():
    # A square with its corners on pixel centres: the left column and the top row are in, the others out.
    a, b, c, d = (1.5, 1.5, 1), (4.5, 1.5, 1), (4.5, 3.5, 1), (1.5, 3.5, 1)
    square = pattern("...... .###.. .###.. ...... ......")
    for faces in ([[a, b, c], [a, c, d]], [[a, b, d], [b, c, d]]):
        result = render(triangles(*faces), flat_camera(6, 5))
        assert (result.alpha == square).all()
        assert result.fragments == 6


@FEW
@given(seed=seeds)
def test_a_fan_on_pixel_centres_shows_no_seam(seed):
    # All vertices are seen exactly at pixel centres, at depths that keep this exact.
    rng = np.random.default_rng(seed)
    z = 2.0 ** rng.integers(-2, 4, 9)
    rim = [(9, 5), (8, 8), (5, 9), (2, 8), (1, 5), (2, 2), (5, 1), (8, 2)]
    seen = np.array([(5, 5), *rim]) + 0.5
    vertices = np.column_stack([seen * z[:, None], z])
    faces = [(0, 1 + i, 1 + (i + 1) % 8) for i in range(8)]
    mesh = SplatMesh(vertices, faces, np.tile([1, 1, 1, 0.5], (9, 1)))
    octagon = pattern("""
        ...........
        ...........
        ..######...
        ..#######..
        ..#######..
        .########..
        ..#######..
        ..#######..
        ..######...
        ...........
        ...........""")
    result = render(mesh, flat_camera(11, 11))
    assert (result.alpha == 0.5 * octagon).all()
    assert result.fragments == np.count_nonzero(octagon)


def test_a_triangle_across_the_near_plane_is_the_clipped_one():
    camera = Camera(np.eye(4), 8, 8, 8, 8, 16, 16, near=1)
    a, b, c = np.array([0, -1, -1.0]), np.array([-2, 1, 3.0]), np.array([2, 1, 3.0])
    red, green, blue = np.array([1, 0, 0, 0.25]), np.array([0, 1, 0, 0.5]), np.array([0, 0, 1, 1])
    whole = SplatMesh([a, b, c], [(0, 1, 2)], [red, green, blue])
    # z = 1 lies half way between z = -1 and z = 3.
    p, q = (a + b) / 2, (a + c) / 2
    clipped = SplatMesh(
        [p, b, c, q], [(0, 1, 2), (0, 2, 3)], [(red + green) / 2, green, blue, (red + blue) / 2]
    )
    result = render(whole, camera, depth=True)
    assert result.fragments == render(clipped, camera).fragments > 30
    same(result, render(clipped, camera))
    np.testing.assert_allclose(result.depth, render(clipped, camera, depth=True).depth, atol=1e-12)
    # Without a plane in the way it would reach further up the image.
    assert render(whole, replace(camera, near=0.1)).fragments > result.fragments


def test_nothing_is_seen_behind_the_camera_or_nearer_than_the_near_plane():
    camera = flat_camera(4, 4, near=1)
    for z, fragments in ((-2, 0), (0.75, 0), (1, 16), (1.25, 16)):
        corners = np.array(layer(abs(z))) * [1, 1, np.sign(z)]
        assert render(triangles(corners), camera).fragments == fragments


def test_triangles_without_area_are_not_drawn():
    camera = flat_camera(6, 6)
    a, b, c = (0.5, 0.5, 1), (2.5, 2.5, 1), (5.5, 5.5, 1)
    through_the_camera = [(-3, -3, -2), (1, 2, 1), (2, 1, 1)]
    along_a_ray = [(0, 0, 1), (0, 0, 2), (0, 0, 3)]
    for corners in ([a, a, a], [a, b, b], [a, a, b], [a, b, c], along_a_ray, through_the_camera):
        result = render(triangles(corners), camera, depth=True, normals=True)
        assert result.fragments == 0
        assert (result.color == 1).all()


# Interpolation


def test_interpolation_is_perspective_correct():
    # The middle of the image of an edge from z = 1 to z = 3 lies a quarter of the way along it:
    # x / z of (1 - t) (0, 1) + t (12, 3) is 2 where 12 t = 2 (1 + 2 t), t = 1 / 4.
    mesh = SplatMesh(
        [(0, 0, 1), (12, 0, 3), (0, 8, 1)],
        [(0, 1, 2)],
        [(0, 0, 0, 1), (1, 0, 0, 1), (0, 0, 0, 1)],
        attributes={"t": [0, 1, 0]},
    )
    camera = Camera(np.eye(4), 1, 1, 0.5, 0.5, 4, 4)  # the centre of pixel (0, 2) sees (2, 0)
    result = render(mesh, camera, depth=True, attributes=["t"])
    np.testing.assert_allclose(result.color[0, 2], [0.25, 0, 0], atol=1e-15)
    np.testing.assert_allclose(result.attributes["t"][0, 2], 0.25, atol=1e-15)
    np.testing.assert_allclose(result.depth[0, 2], 1.5, atol=1e-15)


def test_normals_by_hand():
    # A plane that rises to the right: z = 4 + x, so the normal towards the camera is (1, 0, -1) / sqrt 2.
    corners = [(-2, -3, 2), (2, -3, 6), (0, 3, 4)]
    turn = np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    turn[:3, 3] = [0.1, 0.2, 0.3]
    expected = np.array([1, 0, -1]) / math.sqrt(2)
    for pose, order in ((np.eye(4), (0, 1, 2)), (np.eye(4), (0, 2, 1)), (turn, (0, 1, 2))):
        mesh = triangles([corners[i] for i in order], colors=[(1, 1, 1, 0.5)])
        camera = Camera(pose, 8, 8, 4, 4, 8, 8)
        np.testing.assert_allclose(
            render(mesh, camera, normals=True).normals[4, 4], 0.5 * expected, atol=1e-7
        )
        # Given normals are interpolated, made unit length, and turned to the camera.
        given_normals = replace(mesh, normals=np.tile([0, 0, 3.0], (3, 1)))
        result = render(given_normals, camera, normals=True)
        np.testing.assert_allclose(result.normals[4, 4], [0, 0, -0.5], atol=1e-12)
        nothing = render(replace(mesh, normals=np.zeros((3, 3))), camera, normals=True)
        assert (nothing.normals == 0).all()


# Blending


def test_two_layers_by_hand():
    front, back = (1, 0.5, 0, 0.25), (0, 0.25, 1, 0.5)
    mesh = triangles(layer(2), layer(1), colors=[back, front])
    result = render(mesh, flat_camera(3, 2), background=(0.5, 1, 0.125), depth=True)
    # 0.25 of the front, 0.75 * 0.5 of the back, 0.75 * 0.5 of the background.
    color = [0.25 + 0 + 0.1875, 0.125 + 0.09375 + 0.375, 0 + 0.375 + 0.046875]
    np.testing.assert_allclose(result.color, np.broadcast_to(color, (2, 3, 3)), atol=1e-15)
    np.testing.assert_allclose(result.alpha, np.full((2, 3), 0.625), atol=1e-15)
    np.testing.assert_allclose(result.depth, np.full((2, 3), 0.25 * 1 + 0.375 * 2), atol=1e-15)
    assert result.fragments == 12
    nearest = render(mesh, flat_camera(3, 2), background=(0.5, 1, 0.125), max_layers=1)
    np.testing.assert_allclose(nearest.color[0, 0], [0.625, 0.875, 0.09375], atol=1e-15)


def test_equal_depths_go_by_face_number():
    # Triangles of one constant depth whose weights round differently.
    rng = np.random.default_rng(4)
    for _ in range(20):
        z = rng.uniform(1, 3)
        corners = [np.roll(np.array(layer(z, size)), i, axis=0) for i, size in enumerate((20, 33.3, 57.7))]
        colors = [(1, 0, 0, 1), (0, 1, 0, 1), (0, 0, 1, 1)]
        result = render(triangles(*corners, colors=colors), flat_camera(5, 5))
        assert (result.color == [1, 0, 0]).all()


def test_transparent_fragments_do_not_count_as_layers():
    mesh = triangles(layer(1), layer(2), layer(3), colors=[(1, 0, 0, 0), (0, 1, 0, 0.5), (0, 0, 1, 1)])
    result = render(mesh, flat_camera(2, 2), background=BLACK, max_layers=1)
    np.testing.assert_allclose(result.color[0, 0], [0, 0.5, 0])
    assert result.fragments == 4


def test_a_sample_stops_once_too_little_light_comes_through():
    mesh = triangles(*(layer(z) for z in (1, 2, 3, 4)), colors=[(1, 1, 1, 0.5)] * 4)
    for limit, layers in ((0, 4), (0.2, 3), (0.25, 3), (0.26, 2), (0.6, 1)):
        result = render(mesh, flat_camera(1, 1), min_transmittance=limit)
        assert result.fragments == layers
        assert result.alpha[0, 0] == 1 - 0.5**layers


def test_coplanar_layers_of_a_depth_group():
    # Layers on one slope, cut differently, so that their depths differ by rounding only.
    camera = Camera(np.eye(4), 20, 20, 10, 10, 20, 20)
    corners = [(-7, -5, 3), (7, -5, 4), (0, 7, 5)]
    rng = np.random.default_rng(0)
    corners = np.array(corners, float)
    weights = rng.dirichlet((1, 1, 1), (40, 3))
    colors = np.column_stack([rng.random((40, 3)), np.full(40, 0.5)])
    for order in (np.arange(40), np.arange(40)[::-1]):
        layers = triangles(*(weights[order] @ corners), colors=colors[order])
        mesh = replace(layers, depth_group=np.zeros(40, int))
        result = render(mesh, camera, background=BLACK)
        # The truth: one face after the other painted over, from the last to the first.
        painted = np.zeros((20, 20, 3))
        for face in range(39, -1, -1):
            single = mesh.take(np.arange(40) == face)
            painted = render(single, camera, background=painted).color
        np.testing.assert_allclose(result.color, painted, atol=1e-12)


def test_a_depth_group_lies_where_its_largest_triangle_lies():
    camera = flat_camera(3, 3)
    red, green, blue = (1, 0, 0, 1), (0, 1, 0, 1), (0, 0, 1, 1)
    # Red is nearest but shares the plane z = 2 with blue, so green at 1.75 is in front; red goes before blue.
    mesh = triangles(layer(1.5, 50), layer(1.75), layer(2, 100), colors=[red, green, blue])
    assert (render(mesh, camera).color == [1, 0, 0]).all()
    grouped = replace(mesh, depth_group=[7, -1, 7])
    result = render(grouped, camera, depth=True)
    assert (result.color == [0, 1, 0]).all()
    assert (result.depth == 1.75).all()
    assert (render(grouped.take([True, False, True]), camera).color == [1, 0, 0]).all()
    # What is reported is a triangle's own depth.
    np.testing.assert_allclose(render(grouped.take([True, False, True]), camera, depth=True).depth, 1.5)


def test_a_depth_group_stays_within_its_vertices():
    # Blue, outside the image, is the largest. Its plane z = 1 + x / 2 is 1 / z = 1 - u / 2 at u = x / z:
    # z is 4 / 3 at u = 0.5, 4 at 1.5, and behind the camera from 2 on. The farthest vertex limits it to 2.
    slope = [(0, -800, 1), (2, -800, 2), (0, -100, 1)]
    red, green = (1, 0, 0, 1), (0, 1, 0, 1)
    for z, seen in ((2.25, [red] * 4), (1.75, [red, green, green, green]), (1.25, [green] * 4)):
        mesh = triangles(slope, layer(1.5, 3), layer(z, 3), colors=[(0, 0, 1, 1), red, green])
        result = render(replace(mesh, depth_group=[0, 0, -1]), flat_camera(4, 1))
        np.testing.assert_array_equal(result.color[0], np.array(seen)[:, :3])
    # At u = 0 the plane is at z = 1; with the near plane at 1.25 it counts as there: a tie, by face number.
    mesh = triangles(layer(1.25, 3), slope, layer(1.5, 3), colors=[green, (0, 0, 1, 1), red])
    camera = Camera(np.eye(4), 1, 1, 0.5, 0.5, 1, 1, near=1.25)
    assert (render(replace(mesh, depth_group=[-1, 0, 0]), camera).color == green[:3]).all()


def test_a_depth_group_seen_edge_on_stands_at_its_nearest_vertex():
    edge_on = [(0, 0, 1), (0, 0, 300), (0, 300, 300)]
    mesh = triangles(edge_on, layer(2, 20), layer(1.5, 20), colors=[(0, 0, 1, 1), (1, 0, 0, 1), (0, 1, 0, 1)])
    assert (render(mesh, flat_camera(2, 2)).color == [0, 1, 0]).all()
    assert (render(replace(mesh, depth_group=[3, 3, -1]), flat_camera(2, 2)).color == [1, 0, 0]).all()


def test_backgrounds():
    camera = random_camera()
    rng = np.random.default_rng(0)
    image = rng.random((11, 13, 3))
    empty = SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 4)))
    result = render(empty, camera, background=image, samples=2, depth=True, normals=True)
    np.testing.assert_allclose(result.color, image)
    assert result.fragments == 0
    assert (result.alpha == 0).all()
    assert (result.depth == 0).all()
    assert (result.normals == 0).all()
    for background in (0.5, np.zeros(4), np.zeros((13, 11, 3))):
        with pytest.raises(ValueError, match=r"background must have shape \(3,\) or \(11, 13, 3\)"):
            render(empty, camera, background=background)


def test_bad_options_are_refused():
    mesh, camera = random_mesh(0), random_camera()
    for value in (0, 1.5, -1):
        with pytest.raises(ValueError, match="samples must be a whole number from 1 on"):
            render(mesh, camera, samples=value)
        with pytest.raises(ValueError, match="max_layers must be a whole number from 1 on, or None"):
            render(mesh, camera, max_layers=value)
    with pytest.raises(ValueError, match="no attribute 'cold'; it has heat, flow"):
        render(mesh, camera, attributes=["cold"])


# Laws


@FEW
@given(seed=seeds)
def test_the_order_of_faces_and_vertices_does_not_matter(seed):
    mesh, camera = random_mesh(seed), random_camera()
    rng = np.random.default_rng(seed)
    expected = render(mesh, camera)
    same(render(replace(mesh, faces=rng.permutation(mesh.faces)), camera), expected)
    order = rng.permutation(len(mesh.vertices))
    renumbered = SplatMesh(mesh.vertices[order], np.argsort(order)[mesh.faces], mesh.colors[order])
    same(render(renumbered, camera), expected)
    rolled = np.array([np.roll(face, rng.integers(3))[:: rng.choice([-1, 1])] for face in mesh.faces])
    same(render(replace(mesh, faces=rolled), camera), expected)


@FEW
@given(seed=seeds, signs=st.tuples(*[st.sampled_from([-1, 1])] * 3), axes=st.permutations([0, 1, 2]))
def test_moving_mesh_and_camera_together_changes_nothing(seed, signs, axes):
    mesh, camera = random_mesh(seed), random_camera()
    rotation = np.eye(3)[list(axes)] * np.array(signs)[:, None]
    rotation *= np.linalg.det(rotation)
    move = np.eye(4)
    move[:3, :3] = rotation
    move[:3, 3] = np.random.default_rng(seed).integers(-20, 20, 3)
    moved = replace(mesh, vertices=mesh.vertices @ rotation.T.astype(np.float32) + move[:3, 3])
    moved_camera = replace(camera, world_to_camera=camera.world_to_camera @ np.linalg.inv(move))
    expected = render(mesh, camera, depth=True, normals=True)
    result = render(moved, moved_camera, depth=True, normals=True)
    same(result, expected)
    np.testing.assert_allclose(result.depth, expected.depth, atol=1e-12)
    np.testing.assert_allclose(result.normals, expected.normals @ rotation.T, atol=1e-12)


@FEW
@given(seed=seeds, layers=st.sampled_from([None, 1, 2, 3]))
def test_a_triangle_of_alpha_0_is_no_triangle(seed, layers):
    mesh, camera = random_mesh(seed), random_camera()
    rng = np.random.default_rng(seed)
    clear = SplatMesh(
        rng.normal((0, 0, 2), 1, (9, 3)), np.arange(9).reshape(3, 3), np.tile([1, 0, 1, 0], (9, 1))
    )
    both = SplatMesh(
        np.concatenate([clear.vertices, mesh.vertices]),
        np.concatenate([clear.faces, mesh.faces + 9]),
        np.concatenate([clear.colors, mesh.colors]),
    )
    expected, result = render(mesh, camera, max_layers=layers), render(both, camera, max_layers=layers)
    same(result, expected)
    assert result.fragments == expected.fragments


@FEW
@given(seed=seeds)
def test_the_image_is_affine_in_the_background(seed):
    mesh, camera = random_mesh(seed), random_camera()
    image = np.random.default_rng(seed).random((11, 13, 3))
    on_black = render(mesh, camera, background=BLACK)
    on_picture = render(mesh, camera, background=image)
    np.testing.assert_allclose(
        on_picture.color, on_black.color + (1 - on_black.alpha)[..., None] * image, atol=1e-12
    )


@FEW
@given(seed=seeds)
def test_attributes_are_blended_as_colours_are(seed):
    mesh, camera = random_mesh(seed), random_camera()
    mesh = replace(mesh, attributes={**mesh.attributes, "rgb": mesh.colors[:, :3], "one": np.ones(14)})
    result = render(mesh, camera, background=BLACK, attributes=["rgb", "one", "flow"])
    np.testing.assert_allclose(result.attributes["rgb"], result.color, atol=1e-12)
    np.testing.assert_allclose(result.attributes["one"], result.alpha, atol=1e-12)
    assert result.attributes["flow"].shape == (11, 13, 2)
    assert set(result.attributes) == {"rgb", "one", "flow"}


@FEW
@given(seed=seeds)
def test_layers_add_up(seed):
    mesh, camera = random_mesh(seed), random_camera()
    images = [render(mesh, camera, max_layers=k) for k in (1, 2, 4, 14)]
    for fewer, more in pairwise(images):
        assert fewer.fragments <= more.fragments
        assert (fewer.alpha <= more.alpha + 1e-12).all()
    same(images[-1], render(mesh, camera))
    limit = 0.05
    stopped = render(mesh, camera, min_transmittance=limit)
    assert np.abs(stopped.color - images[-1].color).max() <= limit


@FEW
@given(seed=seeds, samples=st.sampled_from([2, 3, 4]))
def test_samples_are_the_pixels_of_a_larger_image(seed, samples):
    camera = random_camera()
    names = ("fx", "fy", "cx", "cy", "width", "height")
    large = replace(camera, **{name: samples * getattr(camera, name) for name in names})
    mesh = random_mesh(seed)
    result, expected = render(mesh, camera, samples=samples, depth=True), render(mesh, large, depth=True)
    for name in ("color", "alpha", "depth"):
        fine = getattr(expected, name).reshape(11, samples, 13, samples, -1)
        coarse = getattr(result, name).reshape(11, 13, -1)
        np.testing.assert_allclose(coarse, fine.mean(axis=(1, 3)), atol=1e-12)
