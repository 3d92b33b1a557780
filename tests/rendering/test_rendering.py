"""The compiled renderer of meshes: equal to the float64 reference, and the laws that need no reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data
from _rendering import (
    EXTRAS,
    assert_close,
    assert_mesh_is_exact,
    assert_same_bits,
    camera,
    fan,
    grid_faces,
    layers,
    seen_by,
    soup,
    splats,
    turned,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st

from meshsplats import Camera, SplatMesh, convert, load_cameras, load_gaussians
from meshsplats.rendering import api, reference, render, render_splats
from meshsplats.rendering.backward import TapedRendering, TapeOptions

BLACK = (0, 0, 0)
seeds = st.integers(0, 10_000)
FEW = settings(max_examples=12)

# Against the reference


@FEW
@given(seed=seeds)
def test_random_triangles(seed):
    view = turned(camera(), seed)
    assert_mesh_is_exact(soup(seed, view=view), view, **EXTRAS)


@FEW
@given(seed=seeds, near=st.sampled_from([1.0, 0.05, 1e-4]))
def test_triangles_across_and_behind_the_near_plane(seed, near):
    # About half of all vertices are behind; what is just in front is huge on the image.
    mesh = soup(seed, spread=(2, 2, 3), z=0.5)
    assert (mesh.vertices[:, 2] < near).sum() > 10
    assert_mesh_is_exact(mesh, camera(near=near), tolerance=5e-5, **EXTRAS)


@pytest.mark.parametrize("samples", [1, 2, 3, 5, 16])
@pytest.mark.parametrize("size", [(13, 11), (1, 1), (1, 20), (17, 2)])
def test_samples_and_odd_images(samples, size):
    mesh = soup(5, 20, spread=(0.5, 0.5, 1.5))
    assert_mesh_is_exact(mesh, camera(*size), samples=samples, **(EXTRAS if samples < 16 else {}))


@pytest.mark.parametrize("samples", range(1, 17))
def test_pixels_that_nothing_covers_are_empty_with_any_number_of_samples(samples):
    """The mean of equal samples is any of them: their sum times 1 / 121 is less."""
    image = render(soup(5, 20, spread=(0.2, 0.2, 0.2)), camera(13, 11), samples=samples, depth=True)
    assert image.alpha[0, 0] == 0
    assert image.mean_depth()[0, 0] == np.inf
    assert (image.color[0, 0] == 1).all()
    splats_alone = render_splats(splats(1, 5, sizes=(0.01, 0.02)), camera(13, 11), samples=samples)
    assert splats_alone.alpha[0, 0] == 0
    assert (splats_alone.color[0, 0] == 1).all()


@pytest.mark.parametrize("max_layers", [1, 2, 7, 10**6])
def test_layers_as_depth_peeling(max_layers):
    mesh = soup(7)
    mesh = replace(mesh, colors=mesh.colors * np.where(np.arange(60) % 5, 1, 0)[:, None])  # some have alpha 0
    assert_mesh_is_exact(mesh, camera(), max_layers=max_layers, **EXTRAS)
    assert_mesh_is_exact(layers(np.full(50, 2.0), 0.1), camera(20, 20), max_layers=max_layers)


@FEW
@given(seed=seeds, thickness=st.sampled_from([1e-1, 1e-2, 1e-3, 1e-5]))
def test_slivers(seed, thickness):
    rng = np.random.default_rng(seed)
    middle = rng.normal(size=(300, 1, 3)) * [1, 1, 0.3] + [0, 0, 2.5]
    ends = rng.normal(size=(300, 1, 3))
    corners = np.concatenate(
        [middle - ends, middle + ends, middle + rng.normal(size=(300, 1, 3)) * thickness], 1
    )
    mesh = SplatMesh(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3), rng.random((900, 4)))
    # Colours change over the thickness of a sliver: rounding within a tile, in pixels, against that.
    assert_mesh_is_exact(mesh, camera(), tolerance=max(2e-5, 2e-6 / thickness), depth=True)


def test_triangles_seen_edge_on():
    rng = np.random.default_rng(0)
    middle = np.column_stack([np.zeros((200, 2)), rng.uniform(1, 5, 200)])
    across = rng.normal(size=(200, 2, 1)) * [0.1, 0.1, 0.0] + [0, 0, 1]
    # All planes contain the ray through the image's centre or miss it by 1e-9.
    side = np.concatenate([middle[:, None], middle[:, None] + across * [1, 1, 0.1]], 1)
    side[:, :, 0] += rng.choice([0, 1e-9, -1e-9], (200, 1))
    view = camera(33, 33, cx=16.5, cy=16.5)
    mesh = SplatMesh(side.reshape(-1, 3), np.arange(600).reshape(-1, 3), rng.random((600, 4)))
    assert np.isfinite(render(mesh, view, **{**EXTRAS, "attributes": ()}).color).all()


@pytest.mark.parametrize("grouped", [False, True])
def test_coplanar_layers(grouped):
    rng = np.random.default_rng(3)
    planes, copies = 6, 5
    corners = rng.normal(size=(planes, 1, 3, 3)) * [1.5, 1.5, 0.6] + [0, 0, 3]
    # Copies of each triangle, shrunk within its plane; without groups, the very same triangle.
    shrink = rng.uniform(0.3, 1, (planes, copies, 1, 1)) if grouped else np.ones((planes, copies, 1, 1))
    middle = corners.mean(axis=2, keepdims=True)
    corners = middle + (corners - middle) * shrink
    order = rng.permutation(planes * copies)
    mesh = SplatMesh(
        corners.reshape(-1, 3, 3)[order].reshape(-1, 3),
        np.arange(3 * planes * copies).reshape(-1, 3),
        rng.random((3 * planes * copies, 4)),
        depth_group=10**9 + np.repeat(np.arange(planes), copies)[order] if grouped else None,
    )
    image = assert_mesh_is_exact(mesh, camera(near=2.5), depth=True, normals=True)
    # Group numbers are names only.
    if grouped:
        renamed = replace(mesh, depth_group=mesh.depth_group - 10**9)
        assert_same_bits(image, render(renamed, camera(near=2.5), depth=True, normals=True))


@FEW
@given(seed=seeds)
def test_depth_groups_that_cross_each_other_and_the_near_plane(seed):
    mesh = soup(seed, spread=(2, 2, 2), z=1.5)
    groups = np.random.default_rng(seed).integers(-1, 8, len(mesh.faces))
    assert_mesh_is_exact(replace(mesh, depth_group=groups), camera(), tolerance=5e-5, **EXTRAS)


def test_vertices_on_pixel_centres():
    # Depths are powers of 2, so projected vertices are exact. No sample may flip: vertices and many edges
    # lie on samples, and belong to the same triangles in float32 and float64.
    rng = np.random.default_rng(2)
    view = Camera(np.eye(4), 1, 1, 0, 0, 24, 20, near=0.01)
    seen = rng.integers(-4, 30, (80, 2)) + 0.5
    faces = np.array([rng.permutation(80)[:3] for _ in range(120)])
    # Of one colour, as tilted triangles meet at equal depths on samples, which rounding orders.
    z = 2.0 ** rng.integers(-3, 4, 80)
    tilted = SplatMesh(np.column_stack([seen * z[:, None], z]), faces, np.full((80, 4), 0.25))
    # Of all colours and at few depths: ties go by face number.
    z = np.repeat(2.0 ** rng.integers(-3, 4, 120), 3)
    upright = SplatMesh(
        np.column_stack([seen[faces.ravel()] * z[:, None], z]),
        np.arange(360).reshape(-1, 3),
        rng.random((360, 4)),
    )
    for mesh in (tilted, upright):
        image = assert_mesh_is_exact(mesh, view, flips=0)
        truth = reference.render(mesh, view, min_transmittance=api.MIN_TRANSMITTANCE)
        assert image.fragments == truth.fragments > 2000
        # Triangles of one origin are taken together, those of the nearest first.
        origins = np.sort(rng.integers(0, 20, 120))
        assert_same_bits(image, render(replace(mesh, face_splat=origins), view))


def test_ties_go_by_face_number():
    mesh = layers([2.0] * 40, 0.3)
    image = assert_mesh_is_exact(mesh, camera(20, 18), flips=0)
    one = layers([2.0, 2.0], [1, 0.5], [(1, 0, 0), (0, 1, 0)])
    assert (render(one, camera(4, 4)).color == (1, 0, 0)).all()
    other = layers([2.0, 2.0], [0.5, 1], [(0, 1, 0), (1, 0, 0)])
    assert (render(other, camera(4, 4)).color == (0.5, 0.5, 0)).all()
    swapped = replace(mesh, faces=mesh.faces[::-1])
    assert np.abs(render(swapped, camera(20, 18)).color - image.color).max() > 0.01


@pytest.mark.parametrize("count", [3, 5, 7, 11, 15, 30, 200, 600])
def test_ties_where_planes_cross(count):
    """Planes that face the camera, and in turn others that cross them exactly at the samples of a column."""
    view = Camera(np.eye(4), 16, 16, 8, 8, 16, 16)
    pixels = np.array([(-23.5, -24), (72.5, -24), (-23.5, 104)])
    facing, tilted = np.full(3, 2.0), np.array([4.0, 1, 4])  # 1 / depth is 1/2 where x is 8.5
    depths = np.array([tilted if k % 2 else facing for k in range(count)])
    points = np.concatenate([(pixels - 8) / 16 * depths[..., None], depths[..., None]], axis=2)
    rgba = np.random.default_rng(1).random((count, 4)) * (1, 1, 1, 3 / count)
    mesh = SplatMesh(
        points.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), np.clip(np.repeat(rgba, 3, axis=0), 0, 1)
    )
    image = assert_mesh_is_exact(mesh, view, flips=0)
    backwards = render(replace(mesh, faces=mesh.faces[::-1]), view)
    differs = np.abs(backwards.color - image.color).max(axis=(0, 2)) > 1e-4
    assert differs[8]


@pytest.mark.slow
@pytest.mark.parametrize("depths", ["apart", "the same", "nearly the same"])
def test_five_thousand_layers(depths):
    rng = np.random.default_rng(2)
    # Depths that float32 distinguishes as 1 / z.
    close = 2 - 2.0**-21 * rng.permutation(5000)
    z = {"apart": rng.uniform(1, 20, 5000), "the same": np.full(5000, 2.0), "nearly the same": close}[depths]
    image = assert_mesh_is_exact(layers(z, 0.001), camera(7, 5), tolerance=1e-5)
    assert image.alpha == pytest.approx(1 - 0.999**5000, abs=1e-5)


@pytest.mark.parametrize("alpha", [0, 1e-30, 1])
def test_invisible_and_opaque_layers(alpha):
    image = assert_mesh_is_exact(layers(np.linspace(5, 1, 30), alpha), camera(9, 9), flips=0, depth=True)
    assert (image.alpha == (alpha == 1)).all()
    assert image.fragments == (81 if alpha == 1 else 0 if alpha == 0 else 81 * 30)


def test_nothing_to_draw():
    empty = SplatMesh(
        np.zeros((0, 3)),
        np.zeros((0, 3), int),
        np.zeros((0, 4)),
        face_splat=np.zeros(0, int),
        depth_group=np.zeros(0, int),
        attributes={"heat": np.zeros(0), "flow": np.zeros((0, 2))},
    )
    for mesh in (
        empty,
        replace(soup(1), faces=np.zeros((0, 3), int)),
        replace(soup(1), vertices=soup(1).vertices * -1),
    ):
        image = render(mesh, camera(near=9), background=(0.2, 0.4, 0.6), **EXTRAS)
        assert (image.color == np.float32([0.2, 0.4, 0.6])).all()
        assert image.fragments == 0
        assert image.attributes["flow"].shape == (29, 37, 2)
        assert not any(value.any() for value in (image.alpha, image.depth, image.normals))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("splats", "cameras", "factor"), [("playbot_lod6_2k_sh2.ply", "playbot_far.json", 0.12)]
)
def test_real_meshes(splats, cameras, factor):
    cloud = load_gaussians(shared_data(f"splats/{splats}"))
    view = load_cameras(shared_data(f"cameras/{cameras}"))[1].scaled(factor)
    mesh = convert(cloud)
    image = assert_mesh_is_exact(mesh, view, depth=True, normals=True)
    assert image.alpha.max() > 0.9


# Laws


@FEW
@given(seed=seeds)
def test_order_of_faces_and_vertices_and_origins_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    mesh, view = soup(seed, 300, spread=(1.5, 1.5, 2)), camera(60, 50)
    image = render(mesh, view, **EXTRAS)
    # Where two depths are the same float32, the face number decides.
    permuted = render(replace(mesh, faces=mesh.faces[rng.permutation(300)]), view, **EXTRAS)
    assert_close(image, permuted, tolerance=0)
    assert image.fragments == permuted.fragments
    for origin in (np.arange(300), np.zeros(300, int), np.sort(rng.integers(0, 40, 300))):
        assert_same_bits(image, render(replace(mesh, face_splat=origin), view, **EXTRAS))
    order = rng.permutation(300)
    renumbered = SplatMesh(
        mesh.vertices[order],
        np.argsort(order)[mesh.faces],
        mesh.colors[order],
        attributes={name: value[order] for name, value in mesh.attributes.items()},
    )
    assert_same_bits(image, render(renumbered, view, **EXTRAS))


@FEW
@given(seed=seeds)
def test_everything_moved_far_away(seed):
    view = turned(camera(), seed)
    mesh = soup(seed, view=view)
    # Multiples of 1/256 are exact in float32 before and after the move.
    mesh = replace(mesh, vertices=np.round(mesh.vertices * 256) / 256)
    shift = np.array([1e4, -1e4, 1e4])
    matrix = view.world_to_camera.copy()
    matrix[:3, 3] -= matrix[:3, :3] @ shift
    moved = render(
        replace(mesh, vertices=mesh.vertices + np.float32(shift)), replace(view, world_to_camera=matrix)
    )
    assert_close(moved, render(mesh, view))


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20, 1e-6, 1e6])
def test_size_of_the_scene_does_not_matter(factor):
    mesh = soup(8, spread=(2, 2, 3), z=2)
    image = render(mesh, camera(), normals=True)
    scaled = replace(mesh, vertices=mesh.vertices * np.float32(factor))
    other = render(scaled, camera(near=0.5 * factor), normals=True)
    if np.log2(factor) == round(np.log2(factor)):
        assert_same_bits(image, other)
    else:
        assert_close(image, other)


@FEW
@given(seed=seeds, triangles=st.integers(3, 40), alpha=st.sampled_from([0.5, 0.1, 1.0, 1 / 255]))
@example(seed=0, triangles=8, alpha=0.3)
def test_a_fan_shows_no_seam(seed, triangles, alpha):
    image = render(fan(seed, triangles, alpha), camera(200, 160, fx=150, fy=160))
    covered = image.alpha > 0
    assert len(np.unique(image.alpha[covered])) <= 1
    assert np.abs(image.alpha[covered] - np.float32(alpha)).max(initial=0) <= 6e-8
    # A sample on an edge is drawn once; and in no row of a convex fan is a hole.
    assert image.fragments == covered.sum()
    assert (np.abs(np.diff(covered.astype(int), axis=1)).sum(axis=1) <= 2).all()


@FEW
@given(seed=seeds, samples=st.sampled_from([1, 3]))
def test_a_surface_covers_every_sample_once(seed, samples):
    # Vertices of any depth on a grid of rays, crumpled without folds: some cells are smaller than a pixel.
    rng = np.random.default_rng(seed)
    steps = np.sort(rng.choice(np.arange(-50, 90), 40, replace=False)) + 0.5
    x, y = np.meshgrid(steps, np.sort(rng.uniform(-50, 90, 30)))
    x, y = x + rng.uniform(-0.2, 0.2, x.shape), y + np.zeros_like(x)
    x[:, [0, -1]], y[0], y[-1] = (-60, 100), -60, 100
    z = np.exp(rng.uniform(-3, 5, x.shape))
    points = np.stack([x * z, y * z, z], axis=-1).reshape(-1, 3)
    mesh = SplatMesh(points, grid_faces(*x.shape), np.tile([1, 0, 0, 0.25], (x.size, 1)))
    image = render(mesh, Camera(np.eye(4), 1, 1, 0, 0, 37, 29, near=0.01), samples=samples)
    assert image.fragments == 37 * 29 * samples**2
    assert (image.alpha == 0.25).all()


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_the_ground_below_the_camera_covers_every_sample_once(tilt):
    # From behind the camera to the horizon: most triangles near the camera cross the near plane.
    rng = np.random.default_rng(0)
    z, x = np.meshgrid(np.r_[-20, np.linspace(-3, 3, 23), 50, 1e5], np.r_[-1e6, np.linspace(-9, 9, 31), 1e6])
    points = np.stack([x, 1 + tilt * z, z], axis=-1).reshape(-1, 3)
    mesh = SplatMesh(
        points, grid_faces(*z.shape), np.column_stack([rng.random((z.size, 3)), np.full(z.size, 0.5)])
    )
    view = camera(near=1e-3)
    # The ray (u, v, 1) meets the plane at z = 1 / (v - tilt).
    v = (np.arange(29) + 0.5 - view.cy) / view.fy
    below = (v > tilt + 1e-4).sum()
    image = render(mesh, view)
    assert image.fragments == 37 * below
    assert set(np.unique(image.alpha)) == {0, np.float32(0.5)}


def test_background():
    rng = np.random.default_rng(0)
    mesh, view = soup(2), camera()
    one, two = rng.random((2, 29, 37, 3)).astype(np.float32)
    image = assert_mesh_is_exact(mesh, view, background=one)
    assert_mesh_is_exact(mesh, view, background=(3.0, -1.0, 0.25))
    black = render(mesh, view, background=BLACK)
    expected = black.color + (1 - black.alpha[..., None]) * one
    np.testing.assert_allclose(image.color, expected, atol=1e-6)
    mixed = render(mesh, view, background=0.25 * one + 0.75 * two).color
    np.testing.assert_allclose(
        mixed, 0.25 * image.color + 0.75 * render(mesh, view, background=two).color, atol=1e-6
    )


def test_an_attribute_without_columns_is_drawn_alone():
    mesh = replace(soup(1), attributes={"none": np.zeros((60, 0))})
    assert render(mesh, camera(), attributes=["none"]).attributes["none"].shape == (29, 37, 0)


@pytest.mark.parametrize("samples", [1, 2])
def test_attributes_are_blended_as_colours_are(samples):
    mesh = soup(4)
    mesh = replace(
        mesh, attributes={"rgb": mesh.colors[:, :3], "red": mesh.colors[:, 0], "none": np.zeros((60, 0))}
    )
    image = render(mesh, camera(), background=BLACK, samples=samples, attributes=("red", "rgb", "none"))
    np.testing.assert_allclose(image.attributes["rgb"], image.color, atol=2e-6)
    assert (image.attributes["red"] == image.attributes["rgb"][..., 0]).all()
    assert image.attributes["none"].shape == (29, 37, 0)


def test_depth_and_normals_of_an_opaque_plane():
    view = turned(camera(), 3)
    corners = np.array([(-20, -20, 2), (60, -20, 4), (-20, 60, 6.0)])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    rays = np.stack(
        np.meshgrid((np.arange(37) + 0.5 - view.cx) / 31, (np.arange(29) + 0.5 - view.cy) / 27), -1
    )
    expected = (normal @ corners[0]) / (rays @ normal[:2] + normal[2])
    world = normal @ view.world_to_camera[:3, :3] / np.linalg.norm(normal)
    flat = SplatMesh(seen_by(view, corners), [(0, 1, 2)], np.ones((3, 4)))
    smooth = replace(flat, normals=np.tile(-3 * world, (3, 1)))
    for mesh in (flat, smooth, replace(flat, faces=[(1, 0, 2)])):
        image = render(mesh, view, depth=True, normals=True)
        np.testing.assert_allclose(image.depth, expected, rtol=2e-6)
        facing = world if (normal @ corners[0]) < 0 else -world
        np.testing.assert_allclose(image.normals, np.broadcast_to(facing, (29, 37, 3)), atol=1e-6)


def test_mean_depth_is_that_of_what_is_seen():
    """Half opaque at depth 2 before opaque at 6: 4 in the mean; alone, its own."""
    view = camera()
    both = render(layers([2.0, 6.0], [0.5, 1.0]), view, depth=True)
    np.testing.assert_allclose(both.mean_depth(), 4, rtol=1e-6)
    alone = render(layers([2.0], 0.5), view, depth=True)
    np.testing.assert_allclose(alone.mean_depth(), 2, rtol=1e-6)
    assert np.isinf(alone.mean_depth(min_alpha=0.5)).all()
    assert (alone.mean_depth(min_alpha=0.5, empty=0) == 0).all()
    assert alone.mean_depth().dtype == np.float32
    with pytest.raises(ValueError, match="render with depth=True"):
        render(layers([2.0], 0.5), view).mean_depth()


def test_vertex_normals():
    mesh = soup(6)
    normals = np.random.default_rng(6).normal(size=(60, 3))
    normals[:5] = 0
    assert_mesh_is_exact(replace(mesh, normals=normals), camera(), normals=True, tolerance=5e-5)


def test_light_left_out_by_stopping_early():
    for mesh in (layers(np.linspace(1, 9, 3000), 0.01), soup(9, 400)):
        exact = render(mesh, camera(30, 20), min_transmittance=0)
        stopped = render(mesh, camera(30, 20))
        assert np.abs(exact.color - stopped.color).max() < api.MIN_TRANSMITTANCE + 1e-7
        assert stopped.fragments <= exact.fragments
    half = layers([1, 2, 3, 4], 0.5)
    assert render(half, camera(1, 1), min_transmittance=0.3).fragments == 2
    assert render(half, camera(1, 1), min_transmittance=0.25).fragments == 3


def test_the_near_plane_is_measured_from_the_pose():
    mesh = fan(5, 8, 0.6)
    view = replace(camera(40, 30), near=None)
    pose = view.world_to_camera.copy()
    far = pose.copy()
    far[2, 3] += 1e4  # from there, the near plane would lie behind the mesh
    image = TapedRendering(mesh.triangles, replace(view, world_to_camera=far), TapeOptions(pose=pose))
    assert np.array_equal(image.color, render(mesh, view).color)
    assert image.alpha.any()


def test_a_taped_rendering_of_a_mesh_has_its_groups_and_its_filter():
    """Each of which changes the image."""
    view = camera(48, 40)
    groups = np.random.default_rng(0).integers(0, 6, 60)
    for whole, without in (
        (replace(soup(3), depth_group=groups), soup(3)),
        (replace(fan(5, 8, 0.6), face_splat=np.zeros(8, np.int32), filter_px2=9.0), fan(5, 8, 0.6)),
    ):
        image = TapedRendering(whole.triangles, view, TapeOptions((0, 0, 1))).color
        assert np.array_equal(image, render(whole, view, background=(0, 0, 1)).color)
        assert not np.array_equal(image, render(without, view, background=(0, 0, 1)).color)
    black = np.zeros_like(whole.colors)
    image = TapedRendering(whole.triangles._replace(colors=black), view, TapeOptions((0, 0, 1))).color
    assert np.array_equal(image, render(replace(whole, colors=black), view, background=(0, 0, 1)).color)
