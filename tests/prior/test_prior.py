"""Mesh priors: what binding lays on a base, and what posing does with it."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data
from _priors import CUBE, CUBE_FACES, bumpy, cube, rotation
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import Camera, SplatMesh, load_base, load_mesh, orbit, psnr, render
from meshsplats._common.geometry import vertex_normals
from meshsplats.datasets.views import View, ViewImage
from meshsplats.errors import DataWarning
from meshsplats.prior import BaseMesh, MeshPrior, bind
from meshsplats.prior.laying import SHELLS_DEPTH
from meshsplats.prior.matching import exchanged_axes, in_words
from meshsplats.prior.options import LAYERS
from meshsplats.prior.pattern import MAX_PER_FACE, counts_by_area, face_pattern
from meshsplats.scene.binding import Binding


def base_picture(base, camera, **options):
    mesh = SplatMesh(base.vertices, base.faces, base.colors, up=base.up)
    return render(mesh, camera, **options).color


# ---- Dividing a face


@pytest.mark.parametrize("count", [*range(1, 26), 100, MAX_PER_FACE])
def test_a_pattern_covers_the_face_once(count):
    pattern = face_pattern(count).astype(np.float64)
    assert pattern.shape == (count, 3, 3)
    assert pattern.min() >= 0
    np.testing.assert_allclose(pattern.sum(axis=2), 1, atol=2e-7)
    # Determinants are shares of the area; positive ones wind as the face does.
    shares = np.linalg.det(pattern)
    assert shares.min() > 0
    assert shares.sum() == pytest.approx(1, abs=1e-6)
    # A point strictly inside some triangle is inside no other.
    points = np.random.default_rng(count).dirichlet((1, 1, 1), 200)
    inside = (np.einsum("pc,tcj->ptj", points, np.linalg.inv(pattern)) > 1e-9).all(axis=2)
    assert (inside.sum(axis=1) == 1).all()


def test_a_square_number_cuts_all_edges_evenly():
    n = 4
    corners = face_pattern(n * n).reshape(-1, 3)
    np.testing.assert_array_equal(corners * n, np.rint(corners * n))
    assert np.linalg.det(face_pattern(n * n).astype(float)) == pytest.approx(
        np.full(n * n, 1 / n**2), rel=1e-5
    )


def test_one_triangle_is_the_face_itself():
    np.testing.assert_array_equal(face_pattern(1), np.eye(3, dtype=np.float32)[None])


@given(st.integers(0, 10**6), st.floats(1, 40))
def test_counts_follow_areas(seed, mean):
    areas = np.random.default_rng(seed).lognormal(size=300)
    counts = counts_by_area(areas, mean)
    assert (np.sqrt(counts) % 1 == 0).all()
    assert counts.min() >= 1
    assert counts.max() <= MAX_PER_FACE
    order = np.argsort(areas)
    assert (np.diff(counts[order]) >= 0).all()
    assert counts.mean() == pytest.approx(mean, rel=0.15)


# ---- Binding


@pytest.mark.parametrize("triangles", [1, 4, 6, 9])
def test_identity_the_image_is_the_base(triangles):
    base = bumpy()
    mesh = bind(base, triangles=triangles, layers=1).mesh
    assert len(mesh.faces) == triangles * len(base.faces)
    for camera in orbit(mesh, 3, width=96, height=96, elevation=40):
        drawn, wanted = render(mesh, camera).color, base_picture(base, camera)
        if triangles == 1:
            np.testing.assert_array_equal(drawn, wanted)
        else:  # vertices on edges are rounded to float32
            assert psnr(drawn, wanted) > 60


@pytest.mark.parametrize("inside_out", [False, True])
def test_identity_by_default_shells_are_hidden_in_the_base(inside_out):
    base = cube()
    if inside_out:
        base = replace(base, faces=base.faces[:, ::-1])
    prior = bind(base)
    mesh = prior.mesh
    layers = mesh.binding.layers
    assert layers.max() + 1 == LAYERS
    np.testing.assert_array_equal(mesh.colors[layers == 0, 3], 1)
    assert (mesh.colors[layers > 0, 3] < 0.5).all()
    assert abs(prior.lift) * (LAYERS - 1) == pytest.approx(SHELLS_DEPTH * 3**0.5)
    away = np.linalg.norm(mesh.vertices - prior.pose(lift=0).vertices, axis=1)
    np.testing.assert_allclose(away, abs(prior.lift) * layers, atol=1e-6)
    assert (np.abs(mesh.vertices[layers > 0]) < 0.5).all()
    for camera in orbit(mesh, 3, width=96, height=96, elevation=40):
        np.testing.assert_array_equal(render(mesh, camera).color, base_picture(base, camera))


def test_shells_of_a_thin_base_do_not_stand_out():
    base = replace(cube(), vertices=CUBE * np.float32([1, 1, 0.02]))
    mesh = bind(base).mesh
    layers, out = mesh.binding.layers, np.abs(mesh.vertices[:, 2]) > 0.012
    assert out[layers == LAYERS - 1].all()
    assert (mesh.colors[out, 3] > 0).all()
    assert (mesh.colors[out, 3] < 0.01).all()
    for camera in orbit(mesh, 3, width=96, height=96, elevation=40):
        assert psnr(render(mesh, camera).color, base_picture(base, camera)) > 45


def test_shells_lie_behind_what_the_views_see():
    """A room: cameras inside it, and normals that point away from them."""
    views = []
    for turn in (np.eye(3), np.diag([-1.0, 1, -1])):
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        views.append(
            View(Camera(matrix, 16, 16, 16, 16, 32, 32), ViewImage(np.full((32, 32, 3), 0.5, np.float32)))
        )
    prior = bind(cube(), layers=2, views=views)
    assert prior.lift > 0
    for view in views:
        drawn, wanted = render(prior.mesh, view.camera).color, base_picture(cube(), view.camera)
        np.testing.assert_array_equal(drawn, wanted)


def test_one_triangle_a_face_has_the_bases_corners_to_the_last_bit():
    base = bumpy()
    mesh = bind(base, layers=1).mesh
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], base.vertices[base.faces])
    np.testing.assert_array_equal(mesh.colors[mesh.faces], base.colors[base.faces])


def test_layers_come_from_the_highest_down_in_one_depth_group_a_face():
    base = cube()
    mesh = bind(base, triangles=4, layers=3, spacing=0).mesh
    layer = mesh.binding.layers[mesh.faces]
    assert (layer == layer[:, :1]).all()
    np.testing.assert_array_equal(layer[:, 0].reshape(12, 3, 4), np.tile([[[2], [1], [0]]], (12, 1, 4)))
    np.testing.assert_array_equal(mesh.depth_group, np.repeat(np.arange(12), 12))
    np.testing.assert_array_equal(mesh.face_splat, mesh.depth_group)
    np.testing.assert_array_equal(mesh.binding.vertex_face[mesh.faces[:, 0]], mesh.depth_group)
    # The layers above have the same colour: what is drawn does not change.
    camera = orbit(mesh, 1, width=64, height=64)[0]
    assert psnr(render(mesh, camera).color, base_picture(base, camera)) > 60


def test_by_area_large_faces_carry_more():
    base = bumpy()
    stretched = replace(base, vertices=base.vertices * np.where(base.vertices[:, :1] > 0, 5, 1))
    mesh = bind(stretched, triangles=8, by_area=True, layers=1).mesh
    counts = np.bincount(mesh.depth_group, minlength=len(base.faces))
    assert counts.mean() == pytest.approx(8, rel=0.2)
    corners = stretched.vertices[stretched.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (np.diff(counts[np.argsort(areas)]) >= 0).all()
    assert (np.diff(mesh.face_splat) >= 0).all()


def test_colors_come_from_the_views_that_see_a_place():
    """Six cameras before the sides of a cube, each of which sees one colour."""
    base = replace(cube(), colors=None)
    rng = np.random.default_rng(1)
    wanted = rng.random((6, 3)).astype(np.float32)
    views = []
    for side, axis in enumerate([v for k in range(3) for v in (np.eye(3)[k], -np.eye(3)[k])]):
        other = np.roll(axis, 1)
        turn = np.stack([np.cross(other, -axis), other, -axis])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, -turn @ (axis * 4)
        camera = Camera(matrix, 60, 60, 16, 16, 32, 32)
        views.append(View(camera, ViewImage(np.tile(wanted[side], (32, 32, 1)))))
    mesh = bind(base, triangles=4, layers=1, views=views).mesh
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    axis = np.abs(middle).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(middle, axis[:, None], 1)[:, 0] < 0)
    inner = np.abs(np.sort(np.abs(mesh.vertices), axis=1)[:, 1] - 0.5) > 1e-3  # corners and edges see several
    color = mesh.colors[mesh.faces, :3]
    rows, corners = np.nonzero(inner[mesh.faces])
    assert len(rows)
    np.testing.assert_allclose(color[rows, corners], wanted[side[rows]], atol=1e-6)


def test_shells_take_the_colours_that_views_show_behind_the_base():
    """A base that floats above the sheet in the images, with a shell where the sheet is."""
    n, height = 24, 0.3
    sheet = bumpy(n)
    flat = sheet.vertices * np.float32([1, 1, 0])
    shade = np.repeat(0.5 + 0.5 * np.sin(5 * flat[:, :1]), 3, axis=1)
    truth = SplatMesh(flat, sheet.faces, np.column_stack([shade, np.ones(len(flat))]), up=sheet.up)
    cameras = orbit(truth, 12, width=160, height=160, elevation=50)
    views = [View(camera, ViewImage(render(truth, camera, background=(0, 0, 0)).color)) for camera in cameras]
    above = BaseMesh(flat + np.float32([0, 0, height]), sheet.faces, up=sheet.up)
    mesh = bind(above, layers=2, spacing=-height, views=views).mesh
    middle = np.abs(mesh.vertices[:, :2]).max(axis=1) < 0.5
    wanted = 0.5 + 0.5 * np.sin(5 * mesh.vertices[:, 0])
    error = np.abs(mesh.colors[:, 0] - wanted)
    assert error[middle & (mesh.binding.layers == 1)].max() < 0.05
    assert error[middle & (mesh.binding.layers == 0)].max() > 0.2


def test_what_no_view_sees_takes_the_colours_next_to_it():
    base = replace(cube(), colors=None)
    matrix = np.eye(4)
    matrix[2, 3] = 5
    camera = Camera(matrix, 60, 60, 16, 16, 32, 32)
    seen = View(camera, ViewImage(np.full((32, 32, 3), 0.25, np.float32)))
    np.testing.assert_allclose(bind(base, triangles=4, views=[seen]).mesh.colors[:, :3], 0.25, atol=1e-6)
    empty = View(camera, ViewImage(np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.uint8)))
    np.testing.assert_array_equal(bind(base, views=[empty]).mesh.colors[:, :3], 0.5)


def test_colours_that_are_not_there_are_an_error():
    bare = replace(cube(), colors=None)
    np.testing.assert_array_equal(bind(bare).mesh.colors[:, :3], 0.5)
    for source, message in [
        ("texture", "no texture"),
        ("vertices", "no vertex colours"),
        ("views", "no views"),
    ]:
        with pytest.raises(ValueError, match=message):
            bind(bare, colors=source)
    with pytest.raises(ValueError, match="colors must be one of"):
        bind(bare, colors="rainbow")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"triangles": 0}, "triangles must be"),
        ({"triangles": MAX_PER_FACE + 1}, "triangles must be"),
        ({"layers": 0}, "layers must be"),
        ({"layers": 17}, "layers must be"),
    ],
)
def test_options_out_of_range(options, message):
    with pytest.raises(ValueError, match=message):
        bind(cube(), **options)


# ---- Bases that are not as they should be


def test_faces_without_area_carry_nothing_and_are_counted():
    base = cube()
    faces = np.concatenate([base.faces, [[0, 0, 1], [2, 2, 2]]])
    with pytest.warns(DataWarning, match="2 of 14 faces of the base have no area"):
        mesh = bind(replace(base, faces=faces), triangles=4, layers=1).mesh
    assert len(mesh.faces) == 48
    np.testing.assert_array_equal(MeshPrior(mesh).base_faces, faces)  # it stays the base that it was
    with pytest.raises(ValueError, match="none of the base's 2 faces has an area"):
        bind(replace(base, faces=faces[12:]))
    with pytest.raises(ValueError, match="none of the base's 0 faces"):
        bind(replace(base, faces=faces[:0]))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("kind", ["one face", "non-manifold", "parts", "seams", "flipped", "unused vertices"])
def test_any_base_will_do(kind):
    vertices, faces = CUBE, CUBE_FACES
    if kind == "one face":
        faces = faces[:1]
    elif kind == "non-manifold":  # three fins on one edge, and a face twice
        vertices = np.concatenate([CUBE, [[2, 0, 0], [0, 2, 0]]])
        faces = np.concatenate([faces, [[0, 1, 8], [0, 1, 9]], faces[:1]])
    elif kind == "parts":
        vertices = np.concatenate([CUBE, CUBE + 3])
        faces = np.concatenate([faces, faces + 8])
    elif kind == "seams":
        vertices, faces = CUBE[CUBE_FACES].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    elif kind == "flipped":
        faces = np.where(np.arange(12)[:, None] % 2 == 0, faces, faces[:, ::-1])
    else:
        vertices = np.concatenate([CUBE, [[9, 9, 9]]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prior = bind(BaseMesh(vertices, faces), triangles=5, layers=2, spacing=0)
        shells = bind(BaseMesh(vertices, faces), layers=3)
    assert len(prior.mesh.faces) == 10 * len(faces)
    normals = prior.mesh.normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert len(shells.mesh.faces) == 3 * len(faces)
    assert np.isfinite(shells.mesh.vertices).all()
    moved = prior.pose(vertices * 2 + 1)
    np.testing.assert_allclose(moved.vertices, prior.mesh.vertices * 2 + 1, atol=1e-6)
    if kind == "seams":  # what a seam has split is one surface: normals of a cube's corners point outwards
        at_corner = np.abs(np.abs(prior.mesh.vertices) - 0.5).max(axis=1) < 1e-6
        assert (np.einsum("ij,ij->i", normals, prior.mesh.vertices)[at_corner] > 0.8).all()


@pytest.mark.slow
def test_a_million_faces():
    n = 708
    x, y = np.meshgrid(np.arange(n + 1, dtype=np.float32), np.arange(n + 1, dtype=np.float32))
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    corners = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    faces = np.concatenate(
        [np.stack([corners[i] for i in t], -1).reshape(-1, 3) for t in ((0, 1, 2), (0, 2, 3))]
    )
    base = BaseMesh(np.stack([x, y, 0 * x], -1).reshape(-1, 3), faces)
    prior = bind(base, layers=1)
    assert len(prior.mesh.faces) == 2 * n * n > 10**6
    np.testing.assert_array_equal(prior.pose(base.vertices).vertices, prior.mesh.vertices)


# ---- Posing


def trained_looking(base, triangles=4, layers=2, seed=0) -> MeshPrior:
    """As if training had moved everything: random weights, some on edges and in corners, random RGBA."""
    rng = np.random.default_rng(seed)
    mesh = bind(base, triangles=triangles, layers=layers, spacing=0).mesh
    v = len(mesh.vertices)
    weights = rng.dirichlet((1, 1, 1), v).astype(np.float32)
    weights[::7] = np.eye(3, dtype=np.float32)[rng.integers(0, 3, len(weights[::7]))]
    binding = replace(mesh.binding, weights=weights)
    return MeshPrior(MeshPrior(replace(mesh, colors=rng.random((v, 4)), binding=binding)).pose())


@given(st.integers(0, 10**6))
def test_every_vertex_is_the_weighted_sum_of_the_new_corners(seed):
    rng = np.random.default_rng(seed)
    base = bumpy(3, seed % 5)
    prior = trained_looking(base, seed=seed)
    vertices = base.vertices + rng.normal(size=base.vertices.shape).astype(np.float32)
    posed = prior.pose(vertices)
    binding = prior.mesh.binding
    for i in range(0, len(posed.vertices), 17):
        corners = vertices[base.faces[binding.vertex_face[i]]].astype(float)
        wanted = sum(float(binding.weights[i, k]) * corners[k] for k in range(3))
        np.testing.assert_allclose(posed.vertices[i], wanted, atol=1e-6)
    np.testing.assert_array_equal(posed.colors, prior.mesh.colors)
    # Normals are the new base's: square to a face where all its corners' normals are.
    flat = prior.pose(base.vertices * (1, 1, 0))
    np.testing.assert_allclose(flat.normals, np.tile([0, 0, 1.0], (len(flat.normals), 1)), atol=1e-6)


@given(st.integers(0, 10**6))
def test_a_rigid_motion_is_that_of_the_camera(seed):
    rng = np.random.default_rng(seed)
    prior = trained_looking(cube(), seed=seed)
    camera = orbit(prior.mesh, 1, width=64, height=64, azimuth=float(rng.random() * 360))[0]
    turn, shift = rotation(rng), rng.normal(size=3) * 2
    moved = prior.pose((prior.base_vertices @ turn.T + shift).astype(np.float32))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    along = replace(camera, world_to_camera=camera.world_to_camera @ np.linalg.inv(motion))
    still, followed = render(prior.mesh, camera, depth=True), render(moved, along, depth=True)
    # A sample on an edge may fall to the other side of it by rounding.
    differ = np.abs(still.color - followed.color).max(axis=2) > 1e-3
    assert differ.mean() < 0.002
    assert psnr(still.color[~differ], followed.color[~differ]) > 60
    np.testing.assert_allclose(moved.normals, prior.mesh.normals @ turn.T, atol=1e-5)


def test_layers_do_not_flicker():
    """Fifty tiny moves of the camera: coplanar layers change no more from image to image than one opaque
    layer does."""
    base = cube()
    opaque = bind(base, layers=1).mesh
    stacked, rng = bind(base, triangles=6, layers=8, spacing=0).mesh, np.random.default_rng(5)
    # Each layer divides the faces in another way, and none is parallel to an axis: depths differ by rounding.
    turned = (np.arange(3) - stacked.binding.layers[:, None]) % 3
    binding = replace(stacked.binding, weights=np.take_along_axis(stacked.binding.weights, turned, 1))
    stacked = replace(stacked, binding=binding, vertices=binding.positions())
    table = rng.random((8, 8, 4)).astype(np.float32)  # layer, corner: continuous inside each layer
    corners = table[binding.layers[:, None], base.faces[binding.vertex_face]]
    stacked = replace(stacked, colors=np.einsum("vk,vkc->vc", binding.weights, corners).clip(0, 1))
    turned_base = (base.vertices @ rotation(rng).T).astype(np.float32)
    opaque, stacked = (MeshPrior(mesh).pose(turned_base) for mesh in (opaque, stacked))
    first = orbit(opaque, 1, width=64, height=64, elevation=25, azimuth=20)[0]

    def noise(mesh) -> float:
        images = []
        for step in range(50):
            matrix = first.world_to_camera.copy()
            matrix[0, 3] += 1e-5 * step
            images.append(render(mesh, replace(first, world_to_camera=matrix)).color)
        return float(np.abs(np.diff(np.stack(images), axis=0)).mean())

    quiet, layered = noise(opaque), noise(stacked)
    assert layered < 1.1 * quiet
    ungrouped = noise(replace(stacked, depth_group=None, face_splat=None))
    assert ungrouped > 100 * layered, "the order is what keeps it quiet"


def test_exported_layers_are_lifted_along_the_normal():
    prior = trained_looking(cube(), layers=3)
    lift = prior.export_lift
    assert lift == pytest.approx(2e-5 * 3**0.5)
    lifted = prior.pose(lift=lift)
    binding = lifted.binding
    # The corners of the base are moved, here of a cube, along its area-weighted normals.
    out = prior.base_vertices + vertex_normals(CUBE.astype(np.float64), CUBE_FACES) * lift
    for layer in range(3):
        rows = binding.layers == layer
        moved = CUBE + layer * (out - CUBE)
        corners = moved[CUBE_FACES[binding.vertex_face[rows]]]
        wanted = np.einsum("ik,ikc->ic", binding.weights[rows], corners)
        np.testing.assert_allclose(lifted.vertices[rows], wanted, atol=1e-7)
    assert binding.lift == lift
    np.testing.assert_array_equal(MeshPrior(lifted).pose(lift=0).vertices, prior.mesh.vertices)
    assert bind(cube(), layers=1).export_lift == 0


def test_shells_of_a_card_with_faces_of_both_windings_lie_along_its_normal():
    """Leaves, hair and fences of games: normals of a place cancel, and each face goes its own way."""
    corners = np.array([(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)], float)
    faces = np.array([(0, 1, 2), (0, 2, 3), (2, 1, 0), (3, 2, 0)])
    mesh = bind(BaseMesh(corners, faces), layers=2, spacing=0.1).mesh
    binding = mesh.binding
    side = np.where(binding.vertex_face < 2, 1, -1)
    np.testing.assert_allclose(mesh.vertices[:, 0], 0.1 * binding.layers * side, atol=1e-7)
    np.testing.assert_allclose(mesh.normals[:, 0], side)
    in_plane = [np.sort(mesh.vertices[binding.layers == layer, 1:], axis=0) for layer in (0, 1)]
    np.testing.assert_allclose(*in_plane, atol=1e-7)


def test_shells_lie_at_their_distance_and_grow_with_the_base():
    """A flat base: its shells are copies, moved down; those of a base of twice the size twice as far."""
    base = bumpy()
    flat = replace(base, vertices=base.vertices * (1, 1, 0))
    prior = bind(flat, triangles=4, layers=3, spacing=-0.05)
    mesh = prior.mesh
    np.testing.assert_allclose(mesh.vertices[:, 2], -0.05 * mesh.binding.layers, atol=1e-7)
    assert prior.export_lift == -0.05
    # One depth group a face and shell.
    number = mesh.binding.vertex_face[mesh.faces[:, 0]] * 3 + mesh.binding.layers[mesh.faces[:, 0]]
    pairs = np.unique(np.stack([number, mesh.depth_group], axis=1), axis=0)
    assert len(pairs) == len(np.unique(number)) == len(np.unique(mesh.depth_group))
    large = prior.pose(flat.vertices * 2)
    np.testing.assert_allclose(large.vertices, 2 * mesh.vertices, atol=1e-6)
    again = MeshPrior(large).pose(flat.vertices)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-6)
    with pytest.raises(ValueError, match="spacing must be a finite"):
        bind(base, layers=2, spacing=float("nan"))


def two_cubes() -> BaseMesh:
    return BaseMesh(np.concatenate([CUBE, CUBE + 5]), np.concatenate([CUBE_FACES, CUBE_FACES + 8]))


def test_shells_follow_the_stretch_around_them():
    base = two_cubes()
    prior = bind(base, triangles=4, layers=3, spacing=-0.05)
    moved = base.vertices.copy()
    moved[8:] = (moved[8:] - 5) * 3 + 5
    posed = prior.pose(moved)
    far = prior.mesh.binding.vertex_face >= len(CUBE_FACES)
    np.testing.assert_array_equal(posed.vertices[~far], prior.mesh.vertices[~far])
    np.testing.assert_allclose(posed.vertices[far], (prior.mesh.vertices[far] - 5) * 3 + 5, atol=1e-5)
    # Posed again, and as a whole.
    back = MeshPrior(posed).pose(base.vertices)
    np.testing.assert_allclose(back.vertices, prior.mesh.vertices, atol=1e-5)
    turn = rotation(np.random.default_rng(5)) * 10
    turned = moved @ turn.T
    whole = MeshPrior(posed).pose(turned).vertices
    np.testing.assert_allclose(whole, posed.vertices @ turn.T, atol=1e-4)
    np.testing.assert_allclose(prior.pose(turned).vertices, whole, atol=1e-4)
    # A posed prior in its own pose.
    np.testing.assert_allclose(
        MeshPrior(posed).pose(lift=posed.binding.lift).vertices, posed.vertices, atol=1e-6
    )


def test_a_vertex_that_flies_off_leaves_the_shells_of_others():
    base = bumpy(8)
    prior = bind(base, triangles=1, layers=6)
    moved = base.vertices.copy()
    moved[40] = 1e6
    posed = prior.pose(moved)
    touched = (base.faces == 40).any(axis=1)
    around = np.isin(base.faces, base.faces[touched]).any(axis=1)[prior.mesh.binding.vertex_face]
    np.testing.assert_array_equal(posed.vertices[~around], prior.mesh.vertices[~around])
    unmoved = ~touched[prior.mesh.binding.vertex_face]
    depth = 5 * abs(prior.lift)
    assert np.linalg.norm(posed.vertices - prior.mesh.vertices, axis=1)[unmoved].max() < 2.5 * depth
    # Stretched along one direction, layers are set apart by what two directions would.
    flat = BaseMesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    long = bind(flat, layers=2, spacing=-0.1).pose(flat.vertices * (10, 1, 1))
    assert np.ptp(long.vertices[:, 2]) == pytest.approx(0.1 * 2**0.5, rel=1e-5)


def test_slivers_keep_the_shells_around_them():
    """However thin, and however large they become."""
    rng = np.random.default_rng(7)
    for _ in range(300):
        start, along = rng.normal(size=(2, 3)).astype(np.float32)
        line = start + along * np.float32([[0], [1], [0.37], [1.7]])
        binding = Binding(line, [[0, 1, 2], [1, 2, 3]], [0] * 3, np.eye(3), [1] * 3, 0.01)
        same = binding.posed(line)
        assert same.stretch is None
        assert same.lift == pytest.approx(0.01, rel=1e-6)
    flat = np.float32([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0], [0, 1, 0]])
    binding = Binding(flat, [[0, 1, 2], [0, 2, 3]], [0] * 3, np.eye(3), [1] * 3, 0.01)
    np.testing.assert_array_equal(binding.posed(flat).positions(), binding.positions())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(replace(binding, base_vertices=flat * 1e-20).posed(flat * 1e20).lift)


@pytest.mark.parametrize("lift", [None, -0.05])
def test_shells_of_a_mirrored_base_stay_on_their_side(lift):
    base, mirror = cube(), np.array([-1, 1, 1], np.float32)
    prior = bind(base, layers=3, spacing=-0.05)
    posed = prior.pose(base.vertices * mirror, lift=lift)
    np.testing.assert_allclose(posed.vertices, prior.mesh.vertices * mirror, atol=1e-6)
    np.testing.assert_allclose(posed.normals, prior.mesh.normals * mirror, atol=1e-6)
    np.testing.assert_allclose(posed.binding.positions(), posed.vertices, atol=1e-6)
    back = MeshPrior(posed).pose(base.vertices)
    np.testing.assert_allclose(back.vertices, prior.mesh.vertices, atol=1e-6)
    turned = prior.pose(base.vertices * (-1, -1, 1), lift=lift)
    np.testing.assert_allclose(turned.vertices, prior.mesh.vertices * (-1, -1, 1), atol=1e-6)


@pytest.mark.parametrize(("name", "value"), [("triangles", 2.5), ("layers", 1.5)])
def test_numbers_of_triangles_and_layers_are_whole(name, value):
    with pytest.raises(ValueError, match=f"{name} must be a whole number, got {value}"):
        bind(cube(), **{name: value})


def test_another_topology_is_refused():
    prior = bind(cube())
    with pytest.raises(ValueError, match="the base has 8 vertices, got positions of 7"):
        prior.pose(CUBE[:7])
    with pytest.raises(ValueError, match="must be finite"):
        prior.pose(np.full((8, 3), np.nan))
    np.testing.assert_array_equal(prior.vertices_of(BaseMesh(CUBE * 3, CUBE_FACES)), CUBE * 3)
    with pytest.raises(ValueError, match=r"8 vertices and 11 triangles.*of 8 and 12.*move its vertices only"):
        prior.vertices_of(BaseMesh(CUBE, CUBE_FACES[1:]))
    with pytest.raises(ValueError, match=r"9 vertices.*in another order"):
        prior.vertices_of(BaseMesh(np.concatenate([CUBE, CUBE[:1]]), CUBE_FACES[::-1]))
    changed = CUBE_FACES.copy()
    changed[5] = changed[5, [1, 0, 2]]
    with pytest.raises(ValueError, match="1 of 12; the first is number 5"):
        prior.vertices_of(BaseMesh(CUBE, changed))
    with pytest.raises(ValueError, match="bound to no base"):
        MeshPrior(replace(prior.mesh, binding=None))


def test_a_pose_whose_polygons_are_cut_along_other_diagonals(tmp_path):
    """A corner of a quad of a cube is drawn in until the quad is concave; the cube is closed, too."""
    lines = [[1, 4, 3, 2], [5, 6, 7, 8], [1, 2, 6, 5], [2, 3, 7, 6], [3, 4, 8, 7], [4, 1, 5, 8]]
    faces = "".join(f"f {' '.join(map(str, face))}\n" for face in lines)

    def write(points):
        text = "".join("v {} {} {}\n".format(*p) for p in points.tolist())
        (tmp_path / "m.obj").write_text(text + faces)
        return load_base(tmp_path / "m.obj", textures=False)

    points = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], float)
    prior = bind(write(points))
    moved = points.copy()
    moved[[1, 5], :2] = 0.2, 0.9  # of four of the six quads
    edited = write(moved)
    assert (edited.faces != prior.base_faces).any()
    np.testing.assert_array_equal(prior.vertices_of(edited), moved.astype(np.float32))
    for shuffled in (np.roll(edited.faces, 2, axis=0), edited.faces[:, ::-1], (edited.faces + 1) % 8):
        with pytest.raises(ValueError, match="other triangles"):
            prior.vertices_of(BaseMesh(moved, shuffled))


def test_exported_bases_are_matched():
    base, prior = bumpy(4), bind(bumpy(4))
    moved = base.vertices * (1, 2, 3)
    split = BaseMesh(moved[base.faces].reshape(-1, 3), np.arange(base.faces.size).reshape(-1, 3))
    turned = BaseMesh(moved, np.roll(base.faces[::-1], 1, axis=1))
    for edited in (split, turned, BaseMesh(moved, base.faces)):
        np.testing.assert_array_equal(prior.vertices_of(edited), moved.astype(np.float32))
    # Split where the prior's base is, and whole again.
    of_split = bind(BaseMesh(base.vertices[base.faces].reshape(-1, 3), split.faces))
    np.testing.assert_array_equal(of_split.vertices_of(BaseMesh(moved, base.faces)), split.vertices)
    other = BaseMesh(split.vertices, split.faces[::-1])
    with pytest.raises(ValueError, match="in another order"):
        prior.vertices_of(other)


def test_exchanged_axes_are_found():
    base = bumpy(4)
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    bent = base.vertices + 0.05 * np.sin(3 * base.vertices[:, [1, 2, 0]])
    same, scale = exchanged_axes(base.vertices, bent)
    assert (same == np.eye(3)).all()
    assert scale == 1
    found, scale = exchanged_axes(base.vertices, 100 * bent @ turn.T)
    np.testing.assert_array_equal(found, turn)
    assert in_words(found, scale) == (
        "its x, y, z are x, -z, y of the base that the splats are bound to and it is 100 times as large"
    )
    for pose in (base.vertices * 2, base.vertices + 3, base.vertices * 0, base.vertices * (-1, 1, 1)):
        assert in_words(*exchanged_axes(base.vertices, pose)) == ""


def test_dropping_faces_keeps_the_binding_of_the_others():
    prior = trained_looking(cube())
    keep = np.random.default_rng(3).random(len(prior.mesh.faces)) < 0.5
    fewer = prior.mesh.take(keep)
    np.testing.assert_array_equal(fewer.binding.positions(), fewer.vertices)
    np.testing.assert_array_equal(fewer.vertices[fewer.faces], prior.mesh.vertices[prior.mesh.faces[keep]])


# ---- What a binding admits


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": [[0.5, 0.6, -0.1]] * 3}, "weights must not be negative"),
        ({"weights": [[0.5, 0.4, 0.0999]] * 3}, "sum 1"),
        ({"weights": [[0.5, 0.5]] * 3}, "shape"),
        ({"vertex_face": [0, 0, 1]}, "vertex_face must be indices of the 1 faces"),
        ({"vertex_face": [0, 0, -1]}, "vertex_face must be indices"),
        ({"base_faces": [[0, 1, 3]]}, "base_faces must be indices of the 3 vertices"),
        ({"layers": [0, 0, -1]}, "layers must be"),
        ({"lift": float("nan")}, "lift must be"),
        ({"stretch": [1, -1, 1]}, "stretch must not be negative"),
        ({"stretch": [1, 1]}, "stretch"),
        ({"base_vertices": [[np.inf, 0, 0]] * 3}, "finite"),
    ],
)
def test_a_binding_checks_itself(changes, message):
    good = dict(
        base_vertices=np.eye(3),
        base_faces=[[0, 1, 2]],
        vertex_face=[0, 0, 0],
        weights=np.eye(3),
        layers=[0, 0, 0],
    )
    Binding(**good)
    with pytest.raises(ValueError, match=message):
        Binding(**good | changes)


def test_a_mesh_checks_its_binding():
    mesh = bind(cube(), layers=1).mesh
    with pytest.raises(ValueError, match="binding must bind 36 vertices"):
        replace(mesh, binding=mesh.binding.take(np.arange(35)))
    with pytest.raises(ValueError, match="bound to one face"):
        replace(mesh, faces=mesh.faces[:, [0, 1, 2]] + np.array([[0, 0, 0]] * 11 + [[-3, 0, 0]]))


def test_the_lego_hull():
    mesh = load_mesh(shared_data("meshes/lego_visual_hull_40k_vertexcolor.ply"))
    base = BaseMesh(mesh.vertices, mesh.faces, mesh.colors, up=mesh.up)
    prior = bind(base, layers=1)
    camera = orbit(mesh, 1, width=160, height=160, up=(0, 0, 1))[0]
    np.testing.assert_array_equal(render(prior.mesh, camera).color, render(mesh, camera).color)
