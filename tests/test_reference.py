"""The float64 reference against pictures worked out by hand and the laws of blending."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshsplats.camera import Camera
from meshsplats.gaussians import SH_C0, GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.reference import render, render_splats, sh_basis, splat_colors

BLACK = (0, 0, 0)
seeds = st.integers(0, 10_000)


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
    """A triangle that faces ``flat_camera`` and covers its picture."""
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
    # Without a plane in the way it would reach further up the picture.
    assert render(whole, replace(camera, near=0.1)).fragments > result.fragments


def test_nothing_is_seen_behind_the_camera_or_nearer_than_the_near_plane():
    camera = flat_camera(4, 4, near=1)
    for z, fragments in ((-2, 0), (0.75, 0), (1, 16), (1.25, 16)):
        corners = np.array(layer(abs(z))) * [1, 1, np.sign(z)]
        assert render(triangles(corners), camera).fragments == fragments


def test_triangles_without_area_are_not_drawn():
    camera = flat_camera(6, 6)
    a, b, c = (0.5, 0.5, 1), (2.5, 2.5, 1), (5.5, 5.5, 1)
    for corners in ([a, a, a], [a, b, b], [a, a, b], [a, b, c], [(0, 0, 1), (0, 0, 2), (0, 0, 3)]):
        result = render(triangles(corners), camera, depth=True, normals=True)
        assert result.fragments == 0
        assert (result.color == 1).all()


# Interpolation


def test_interpolation_is_perspective_correct():
    # The middle of the picture of an edge from z = 1 to z = 3 lies a quarter of the way along it:
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
            single = mesh.keep_faces(np.arange(40) == face)
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
    assert (render(grouped.keep_faces([True, False, True]), camera).color == [1, 0, 0]).all()
    # What is reported is a triangle's own depth.
    np.testing.assert_allclose(render(grouped.keep_faces([True, False, True]), camera, depth=True).depth, 1.5)


def test_a_depth_group_stays_within_its_vertices():
    # Blue, outside the picture, is the largest. Its plane z = 1 + x / 2 is 1 / z = 1 - u / 2 at u = x / z:
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
    picture = rng.random((11, 13, 3))
    empty = SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 4)))
    result = render(empty, camera, background=picture, samples=2, depth=True, normals=True)
    np.testing.assert_allclose(result.color, picture)
    assert result.fragments == 0
    assert (result.alpha == 0).all()
    assert (result.depth == 0).all()
    assert (result.normals == 0).all()
    for background in (0.5, np.zeros(4), np.zeros((13, 11, 3))):
        for draw, thing in ((render, empty), (render_splats, one_splat())):
            with pytest.raises(ValueError, match=r"background must have shape \(3,\) or \(11, 13, 3\)"):
                draw(thing, camera, background=background)


def test_bad_options_are_refused():
    mesh, camera = random_mesh(0), random_camera()
    for value in (0, 1.5, -1):
        with pytest.raises(ValueError, match="samples must be a whole number from 1 on"):
            render(mesh, camera, samples=value)
        with pytest.raises(ValueError, match="max_layers must be a whole number from 1 on, or None"):
            render(mesh, camera, max_layers=value)
    with pytest.raises(ValueError, match="no attribute 'cold'; it has heat, flow"):
        render(mesh, camera, attributes=["cold"])
    with pytest.raises(ValueError, match="dilation must be >= 0"):
        render_splats(one_splat(), camera, dilation=-1)
    with pytest.raises(ValueError, match="sh_degree must be a whole number from 0 on"):
        render_splats(one_splat(), camera, sh_degree=-1)


# Laws


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


@given(seed=seeds)
def test_the_picture_is_affine_in_the_background(seed):
    mesh, camera = random_mesh(seed), random_camera()
    picture = np.random.default_rng(seed).random((11, 13, 3))
    on_black = render(mesh, camera, background=BLACK)
    on_picture = render(mesh, camera, background=picture)
    np.testing.assert_allclose(
        on_picture.color, on_black.color + (1 - on_black.alpha)[..., None] * picture, atol=1e-12
    )


@given(seed=seeds)
def test_attributes_are_blended_as_colours_are(seed):
    mesh, camera = random_mesh(seed), random_camera()
    mesh = replace(mesh, attributes={**mesh.attributes, "rgb": mesh.colors[:, :3], "one": np.ones(14)})
    result = render(mesh, camera, background=BLACK, attributes=["rgb", "one", "flow"])
    np.testing.assert_allclose(result.attributes["rgb"], result.color, atol=1e-12)
    np.testing.assert_allclose(result.attributes["one"], result.alpha, atol=1e-12)
    assert result.attributes["flow"].shape == (11, 13, 2)
    assert set(result.attributes) == {"rgb", "one", "flow"}


@given(seed=seeds)
def test_layers_add_up(seed):
    mesh, camera = random_mesh(seed), random_camera()
    pictures = [render(mesh, camera, max_layers=k) for k in (1, 2, 4, 14)]
    for fewer, more in pairwise(pictures):
        assert fewer.fragments <= more.fragments
        assert (fewer.alpha <= more.alpha + 1e-12).all()
    same(pictures[-1], render(mesh, camera))
    limit = 0.05
    stopped = render(mesh, camera, min_transmittance=limit)
    assert np.abs(stopped.color - pictures[-1].color).max() <= limit


@given(seed=seeds, samples=st.sampled_from([2, 3, 4]))
def test_samples_are_the_pixels_of_a_larger_picture(seed, samples):
    camera = random_camera()
    large = replace(
        camera,
        **{name: getattr(camera, name) * samples for name in ("fx", "fy", "cx", "cy", "width", "height")},
    )

    def reduced(picture):
        return picture.reshape(11, samples, 13, samples, -1).mean(axis=(1, 3)).squeeze()

    mesh = random_mesh(seed)
    result, expected = render(mesh, camera, samples=samples), render(mesh, large)
    np.testing.assert_allclose(result.color, reduced(expected.color), atol=1e-12)
    np.testing.assert_allclose(result.alpha, reduced(expected.alpha), atol=1e-12)
    # The dilation of splats is in pixels of the picture.
    splats = random_splats(seed)
    result = render_splats(splats, camera, samples=samples)
    expected = render_splats(splats, large, dilation=0.3 * samples**2)
    np.testing.assert_allclose(result.color, reduced(expected.color), atol=1e-12)


# Splats


def one_splat(mean=(0, 0, 2), scales=(0.1, 0.1, 0.1), opacity=0.8, **options) -> GaussianCloud:
    """One splat of RGB (1, 0.5, 0)."""
    sh = options.pop("sh", [[(0.5 / SH_C0, 0, -0.5 / SH_C0)]])
    quaternion = options.pop("quaternion", (1, 0, 0, 0))
    return GaussianCloud([mean], [quaternion], [scales], [opacity], sh, **options)


def random_splats(seed: int, n: int = 10, kernel: str = "3dgs") -> GaussianCloud:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    means = np.round(rng.normal((0, 0, 3), 1, (n, 3)) * 256) / 256
    sh = rng.normal(size=(n, 9, 3)) * 0.5
    return GaussianCloud(means, quaternions, rng.uniform(0.01, 0.5, (n, 3)), rng.random(n), sh, kernel)


def splat_camera() -> Camera:
    """At z = 2, 0.1 in the scene is one pixel; the axis meets the middle of pixel (2, 2)."""
    return Camera(np.eye(4), 20, 20, 2.5, 2.5, 5, 5)


def test_one_splat_by_hand():
    result = render_splats(one_splat(), splat_camera(), background=(0, 0, 1))
    # Standard deviation 1 px, so the covariance is 1 + 0.3 px^2 both ways.
    for row, col, squared_distance in ((2, 2, 0), (2, 3, 1), (3, 4, 5), (0, 2, 4)):
        alpha = 0.8 * math.exp(-0.5 * squared_distance / 1.3)
        assert result.alpha[row, col] == pytest.approx(alpha, abs=1e-7)
        np.testing.assert_allclose(result.color[row, col], [alpha, 0.5 * alpha, 1 - alpha], atol=2e-7)
    assert result.fragments == 25
    wide = render_splats(one_splat(), splat_camera(), dilation=1)
    assert wide.alpha[2, 3] == pytest.approx(0.8 * math.exp(-0.5 / 2), abs=1e-7)


def test_a_turned_splat_by_hand():
    # Axes of 2 and 1 px turned by 30 degrees: variances 4 and 1 along (c, s) and (-s, c).
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    half = math.pi / 12
    splat = one_splat(scales=(0.2, 0.1, 0.7), quaternion=(math.cos(half), 0, 0, math.sin(half)))
    along, across = 1 * c + 2 * s, -1 * s + 2 * c  # of the pixel one to the right and two down
    alpha = 0.8 * math.exp(-0.5 * (along**2 / 4.3 + across**2 / 1.3))
    assert render_splats(splat, splat_camera()).alpha[4, 3] == pytest.approx(alpha, abs=1e-7)


def test_a_splat_off_the_axis_by_hand():
    # At (0.2, 0, 2) the Jacobian is (10, 0, -1; 0, 10, 0): depth shows as a shift to the left.
    splat = one_splat(mean=(0.2, 0, 2), scales=(0.1, 0.1, 1))
    alpha = 0.8 * math.exp(-0.5 * 1 / (1 + 1 + 0.3))
    assert render_splats(splat, splat_camera()).alpha[2, 3] == pytest.approx(alpha, abs=1e-7)


def test_the_jacobian_of_a_splat_far_outside_is_limited():
    # tan x of the picture: -0.2 to 0.8, half field of view 0.5, so limits -0.35 and 0.95.
    camera = Camera(np.eye(4), 10, 10, 2, 5, 10, 10)
    for tan, limit, pixel in ((2.0, 0.95, 9), (-1.5, -0.35, 0)):
        splat = one_splat(mean=(2 * tan, 0, 2), scales=(0.01, 0.01, 3))
        variance = (5 * 0.01) ** 2 + (5 * limit * 3) ** 2 + 0.3
        distance = pixel + 0.5 - (2 + 10 * tan)
        # Half a pixel down; there the covariance has no slant, as y / z is 0.
        power = distance**2 / variance + 0.25 / ((5 * 0.01) ** 2 + 0.3)
        alpha = 0.8 * math.exp(-0.5 * power)
        result = render_splats(splat, camera)
        assert result.alpha[5, pixel] == pytest.approx(alpha if alpha >= 1 / 255 else 0, rel=1e-5)
        turned = Camera(np.eye(4), 10, 10, 5, 2, 10, 10)
        upright = one_splat(mean=(0, 2 * tan, 2), scales=(0.01, 0.01, 3))
        np.testing.assert_allclose(render_splats(upright, turned).alpha, result.alpha.T, atol=1e-12)
    assert render_splats(one_splat(mean=(4, 0, 2), scales=(0.01, 0.01, 3)), camera).alpha[5, 9] > 0.1


@given(seed=seeds)
def test_projected_covariance_follows_from_the_projection(seed):
    # The falloff read back from the picture, against a Jacobian by differences and a rotation by quaternions.
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    q = np.float32(q / np.linalg.norm(q)).astype(float)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = [0, 0, 3]
    mean, scales = rng.uniform(-0.3, 0.3, 3), rng.uniform(0.3, 0.6, 3)
    mean, scales = np.float32(mean).astype(float), np.float32(scales).astype(float)
    camera = Camera(pose, 9, 10, 4.2, 3.4, 8, 7)
    splat = GaussianCloud([mean], [q], [scales], [0.9], np.ones((1, 1, 3)))

    def project(p):
        x = pose[:3, :3] @ p + pose[:3, 3]
        return np.array([9 * x[0] / x[2] + 4.2, 10 * x[1] / x[2] + 3.4])

    def turn(v):
        return v + 2 * np.cross(q[1:], np.cross(q[1:], v) + q[0] * v)

    step = 1e-5
    axes = [turn(axis) * s for axis, s in zip(np.eye(3), scales, strict=True)]
    shifts = np.array([(project(mean + step * a) - project(mean - step * a)) / (2 * step) for a in axes]).T
    inverse = np.linalg.inv(shifts @ shifts.T + 0.3 * np.eye(2))
    result = render_splats(splat, camera)
    for row, col in np.ndindex(7, 8):
        d = np.array([col + 0.5, row + 0.5]) - project(mean)
        alpha = np.float32(0.9) * math.exp(-0.5 * d @ inverse @ d)
        if abs(alpha - 1 / 255) > 1e-6:
            assert result.alpha[row, col] == pytest.approx(alpha if alpha > 1 / 255 else 0, abs=1e-6)


def test_faint_and_opaque_limits():
    # The 1 / 255 limit is met at a distance of sqrt(2 * 1.3 * ln(0.8 * 255)) = 3.72 px.
    camera = Camera(np.eye(4), 20, 20, 2.5, 0.5, 12, 1)
    alpha = render_splats(one_splat(), camera).alpha[0]
    assert (alpha[:6] >= 1 / 255).all()
    assert alpha[5] == pytest.approx(0.8 * math.exp(-0.5 * 9 / 1.3), abs=1e-7)
    assert (alpha[6:] == 0).all()
    assert render_splats(one_splat(opacity=1), camera).alpha[0, 2] == pytest.approx(0.99, abs=1e-12)


def test_a_sample_stops_before_the_splat_that_would_darken_it():
    # T: 1, 0.02, 0.0004; the third would leave 0.000008 and ends the sample, even for the faint fourth.
    stack = GaussianCloud(
        [(0, 0, z) for z in (2, 3, 4, 5)],
        [(1, 0, 0, 0)] * 4,
        [(9, 9, 9)] * 4,
        [0.98, 0.98, 0.98, 0.1],
        np.zeros((4, 1, 3)),
    )
    camera = Camera(np.eye(4), 1, 1, 0.5, 0.5, 1, 1)
    result = render_splats(stack, camera)
    assert result.fragments == 2
    assert result.alpha[0, 0] == pytest.approx(1 - 0.0004, abs=1e-7)
    without = render_splats(stack.select(np.array([0, 1, 3])), camera)
    assert without.fragments == 3
    assert without.alpha[0, 0] == pytest.approx(1 - 0.00036, abs=1e-7)


def test_splats_go_by_the_depth_of_their_centres():
    rgb = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    sh = (np.array(rgb)[:, None] - 0.5) / SH_C0
    cloud = GaussianCloud(
        [(0, 0, 3), (0, 0, 2), (0, 0, 2)], [(1, 0, 0, 0)] * 3, [(9, 9, 9)] * 3, [0.5] * 3, sh
    )
    result = render_splats(cloud, splat_camera(), background=BLACK)
    np.testing.assert_allclose(result.color[2, 2], [0.125, 0.5, 0.25], atol=1e-7)
    for near, fragments in ((2, 75), (2.5, 25), (3.5, 0)):
        assert render_splats(cloud, replace(splat_camera(), near=near)).fragments == fragments


def test_antialiased_splats_by_hand():
    # The integral of the falloff is 2 pi sqrt(det): 1 before and 1.3 after the dilation.
    plain, kept = (one_splat(kernel=k) for k in ("3dgs", "antialiased"))
    factor = math.sqrt(1 / 1.3**2)
    alpha = render_splats(kept, splat_camera()).alpha
    assert alpha[2, 2] == pytest.approx(0.8 * factor, abs=1e-7)
    assert alpha[2, 3] == pytest.approx(0.8 * factor * math.exp(-0.5 / 1.3), abs=1e-7)
    sharp = (render_splats(s, splat_camera(), dilation=0).alpha for s in (plain, kept))
    np.testing.assert_allclose(*sharp, atol=1e-12)
    edge_on = one_splat(scales=(0, 0.1, 0.1), kernel="antialiased")
    assert render_splats(edge_on, splat_camera()).fragments == 0


def test_flat_splats_by_hand():
    def alpha(**options):
        return render_splats(one_splat(kernel="2dgs", **options), splat_camera()).alpha

    # Facing the camera, of 1 px; the third scale has no part in it.
    facing = alpha(scales=(0.1, 0.2, 5))
    assert facing[2, 3] == pytest.approx(0.8 * math.exp(-0.5), abs=1e-7)
    assert facing[4, 2] == pytest.approx(0.8 * math.exp(-0.5 * 4 / 4), abs=1e-7)
    # Of 0.1 px the low-pass filter is left, sigma sqrt(1 / 2) px.
    for scales in ((0.01, 0.01, 0), (0, 0, 0), (0, 0.1, 0)):
        assert alpha(scales=scales)[2, 3] == pytest.approx(0.8 * math.exp(-0.5 * 2), abs=1e-7)
    assert alpha(scales=(0, 0.1, 0))[2, 2] == pytest.approx(0.8, abs=1e-7)


def test_a_slanted_flat_splat_is_met_by_the_ray():
    # Turned by 60 degrees about y: first axis (cos, 0, -sin), normal (sin, 0, cos), through (0, 0, 2).
    c, s = 0.5, math.sqrt(3) / 2
    splat = one_splat(scales=(1, 1, 0), quaternion=(math.cos(math.pi / 6), 0, math.sin(math.pi / 6), 0))
    splat = replace(splat, kernel="2dgs")
    result = render_splats(splat, Camera(np.eye(4), 4, 4, 4.5, 0.5, 9, 1))
    for col in range(9):
        tan = (col - 4) / 4
        z = 2 * c / (tan * s + c)  # where normal . z (tan, 0, 1) = normal . (0, 0, 2)
        u = z * tan * c - (z - 2) * s
        # On the far left the ray meets the plane behind the camera: the low-pass filter alone is left.
        rho = min(u * u, 2 * (col - 4) ** 2) if z > 0 else 2 * (col - 4) ** 2
        alpha = 0.8 * math.exp(-0.5 * rho)
        assert result.alpha[0, col] == pytest.approx(alpha if alpha >= 1 / 255 else 0, abs=1e-6)
    assert 2 * c / (-1 * s + c) < 0
    assert 0 < result.alpha[0, 3] != result.alpha[0, 5] > 0
    # An intersection nearer than the near plane does not count either: at column 8 it is at z = 0.73.
    near = render_splats(splat, Camera(np.eye(4), 4, 4, 4.5, 0.5, 9, 1, near=0.8))
    assert result.alpha[0, 8] > 0.1
    assert near.alpha[0, 8] == 0


def test_spherical_harmonics_are_the_standard_ones():
    special = pytest.importorskip("scipy.special")
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phi = np.arctan2(directions[:, 1], directions[:, 0])
    basis = sh_basis(directions, 3)
    for degree in range(4):
        assert (sh_basis(directions, degree) == basis[:, : (degree + 1) ** 2]).all()
        for m in range(-degree, degree + 1):
            k = abs(m)
            norm = (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - k) / math.factorial(degree + k)
            # lpmv carries the Condon-Shortley sign.
            value = math.sqrt(norm) * special.lpmv(k, degree, directions[:, 2])
            if m:
                value = value * math.sqrt(2) * (np.cos(k * phi) if m > 0 else np.sin(k * phi))
            np.testing.assert_allclose(basis[:, degree * (degree + 1) + m], value, atol=1e-12)
    with pytest.raises(ValueError, match="degree must be 0, 1, 2 or 3, got 4"):
        sh_basis(directions, 4)


def test_colour_depends_on_the_direction_from_the_camera_to_the_splat():
    sh = np.zeros((1, 4, 3))
    sh[0, 2] = (0.2, 0, 0)  # along +z
    sh[0, 3] = (0, 0.3, 0)  # along -x
    sh[0, 0] = (0, 0, -9)
    c1 = math.sqrt(3 / (4 * math.pi))
    cloud = one_splat(mean=(3, 0, 4), sh=sh)
    pose = np.eye(4)
    np.testing.assert_allclose(
        splat_colors(cloud, Camera(pose, 1, 1, 0, 0, 1, 1), 3),
        [(0.5 + 0.2 * c1 * 0.8, 0.5 - 0.3 * c1 * 0.6, 0)],
        atol=1e-7,
    )
    pose = np.eye(4)
    pose[:3, 3] = (-3, 0, -8)  # the camera at (3, 0, 8) looks along +z; the splat is behind it, towards -z
    np.testing.assert_allclose(
        splat_colors(cloud, Camera(pose, 1, 1, 0, 0, 1, 1), 1), [(0.5 - 0.2 * c1, 0.5, 0)], atol=1e-7
    )
    np.testing.assert_allclose(
        splat_colors(cloud, Camera(pose, 1, 1, 0, 0, 1, 1), 0), [(0.5, 0.5, 0)], atol=1e-7
    )
    bright = render_splats(one_splat(sh=np.full((1, 1, 3), 9.0)), splat_camera(), background=BLACK)
    np.testing.assert_allclose(bright.color[2, 2], 0.8 * (0.5 + 9 * SH_C0), rtol=1e-6)


@pytest.mark.parametrize("kernel", ["3dgs", "antialiased", "2dgs"])
@given(seed=seeds)
def test_splat_laws(kernel, seed):
    cloud, camera = random_splats(seed, kernel=kernel), random_camera()
    rng = np.random.default_rng(seed)
    expected = render_splats(cloud, camera)
    if len(np.unique(cloud.means[:, 2])) == len(cloud):
        same(render_splats(cloud.select(rng.permutation(len(cloud))), camera), expected)
    on_black = render_splats(cloud, camera, background=BLACK)
    np.testing.assert_allclose(
        expected.color, on_black.color + (1 - on_black.alpha)[..., None], rtol=0, atol=1e-12
    )
    # The signs of a quaternion, and of an axis with its scale, are free.
    same(render_splats(replace(cloud, quaternions=-cloud.quaternions), camera), expected)
    move = rng.integers(-20, 20, 3)
    pose = np.eye(4)
    pose[:3, 3] = -move
    moved = replace(camera, world_to_camera=camera.world_to_camera @ pose)
    same(render_splats(replace(cloud, means=cloud.means + move), moved), expected)
    limited = render_splats(cloud, camera, sh_degree=1)
    same(limited, render_splats(replace(cloud, sh=cloud.sh[:, :4]), camera, sh_degree=3))
