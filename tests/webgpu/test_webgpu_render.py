"""``render(..., device="gpu")``: the image of the core, on whatever adapter is here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _gpu import assert_same_image, both, need_gpu
from _local import shared_data
from _rendering import EXTRAS, camera, fan, grid_faces, layers, soup, turned

from meshsplats import Camera, SplatMesh, convert, load_gaussians, orbit, render
from meshsplats.errors import DeviceError
from meshsplats.rendering.gpu import gpu_engine
from meshsplats.webgpu import frames, kernels, layout, renderer
from meshsplats.webgpu.layout import find_groups, find_runs
from meshsplats.webgpu.renderer import MeshRenderer
from meshsplats.webgpu.settings import DrawSettings


@pytest.fixture(autouse=True)
def _gpu():
    need_gpu()


def many_triangles() -> tuple[SplatMesh, Camera]:
    return soup(1, 500, spread=(2, 2, 2)), camera(70, 50, near=0.3)


def random_fans(count: int = 400, seed: int = 0, *, radius: float = 0.12, alpha=(0.05, 1)) -> SplatMesh:
    """Fans of six triangles, of their own vertices and in any orientation, in front of ``camera``."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    angles = np.arange(6) * np.pi / 3
    rim = np.cos(angles)[:, None] * axes[:, None, 0] + np.sin(angles)[:, None] * 0.6 * axes[:, None, 1]
    size = radius * np.exp(rng.normal(0, 0.5, (count, 1, 1)))
    centers = rng.normal(size=(count, 1, 3)) * [0.8, 0.8, 0.5] + [0, 0, 2.5]
    points = np.concatenate([centers, centers + size * rim], axis=1)
    colors = rng.random((count, 7, 4))
    colors[..., 3] = rng.uniform(*alpha, (count, 1)) * np.array([1] + [0.2] * 6)
    faces = np.array([(0, 1 + i, 1 + (i + 1) % 6) for i in range(6)])
    return SplatMesh(
        points.reshape(-1, 3),
        (faces + 7 * np.arange(count)[:, None, None]).reshape(-1, 3),
        colors.reshape(-1, 4),
        face_splat=np.repeat(np.arange(count), 6),
    )


def nearly_coplanar(count: int = 40, seed: int = 0) -> SplatMesh:
    """Triangles whose corners lie in one tilted plane, but for rounding: 1 / depth differs by about 1e-8."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-1.5, 1.5, (3 * count, 2)), np.ones((3 * count, 1))], axis=1)
    points = rays / (rays @ [0.02, 0.03, 0.12])[:, None]
    colors = np.column_stack([rng.random((count, 3)), np.full(count, 0.4)])
    return SplatMesh(points, np.arange(3 * count).reshape(-1, 3), np.repeat(colors, 3, axis=0))


def crossing_planes(seed: int = 0) -> tuple[SplatMesh, Camera]:
    """Pairs of planes that cross in an edge, each of two triangles; the edges lead, but for rounding, through
    centres of pixels."""
    rng = np.random.default_rng(seed)
    points, faces = [], []
    for i in range(12):
        a, b = np.array([2.5 + i, 2.5]), np.array([22.5, 22.5 - i])
        sides = [(a + b) / 2 + d for d in ((6, -6), (-6, 6), (5, -7), (-7, 5))]
        image = (np.array([a, b, *sides]) - 16) / 32
        depth = rng.uniform(2, 3, (6, 1))
        faces += [(6 * i, 6 * i + 1, 6 * i + k) for k in (2, 3, 4, 5)]
        points.append(np.hstack([image * depth, depth]))
    colors = rng.random((72, 4)) * [1, 1, 1, 0.5]
    return SplatMesh(np.concatenate(points), faces, colors), Camera(
        np.eye(4), 32.0, 32.0, 16.0, 16.0, 32, 32, 0.1
    )


def draw(mesh: SplatMesh, view: Camera, settings: DrawSettings) -> renderer.Images:
    engine = gpu_engine()
    with engine.errors():
        return engine.renderer_of(mesh).draw(view, settings)


def bits(images: renderer.Images) -> bytes:
    return images.color.tobytes() + images.transmittance.tobytes()


# The image of the core


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_triangles_that_pierce_each_other_with_all_outputs(seed):
    view = turned(camera(), seed)
    assert_same_image(*both(soup(seed, view=view), view, **EXTRAS))


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("near", [0.5, 0.05, 1e-4])
def test_triangles_across_and_behind_the_near_plane(near):
    mesh = soup(4, spread=(2, 2, 3), z=0.5)
    assert (mesh.vertices[:, 2] < near).sum() > 10
    assert_same_image(*both(mesh, camera(near=near), **EXTRAS))


@pytest.mark.parametrize("depths", [np.full(60, 2.0), np.linspace(1, 2, 60), np.repeat([1.5, 2, 3], 20)])
def test_equal_depths_are_ordered_by_face_index(depths):
    mesh = layers(depths, 0.1)
    assert_same_image(*both(mesh, camera()), least=130)
    backwards = replace(mesh, colors=mesh.colors[::-1])
    assert np.abs(render(mesh, camera()).color - render(backwards, camera()).color).max() > 0.05


@pytest.mark.parametrize("samples", [1, 2, 4])
def test_layers_within_rounding_of_each_other_have_the_order_of_the_core(samples):
    mesh, view = nearly_coplanar(), camera(60, 50)
    gpu, core = both(mesh, view, samples=samples, depth=True)
    assert_same_image(gpu, core, most=1e-3)
    backwards = replace(mesh, colors=mesh.colors[::-1])
    assert np.abs(core.color - render(backwards, view, samples=samples).color).max() > 0.1


def test_windows_leave_the_order_of_such_layers(monkeypatch):
    monkeypatch.setattr(frames, "WINDOW_SAMPLES", 2500)
    mesh, view = nearly_coplanar(), camera(140, 30)
    assert_same_image(*both(mesh, view), most=1e-3)
    assert draw(mesh, view, DrawSettings()).work.windows == 2


@pytest.mark.parametrize("seed", [0, 1])
def test_samples_within_rounding_of_an_edge_are_on_the_side_that_the_core_sees(seed):
    mesh, view = crossing_planes(seed)
    gpu, core = both(mesh, view)
    assert_same_image(gpu, core)
    assert core.fragments > 1000


def test_depth_groups():
    mesh, view = many_triangles()
    groups = np.random.default_rng(0).integers(-1, 50, len(mesh.faces)) * 1000
    grouped = replace(mesh, depth_group=np.where(groups < 0, -1, groups))
    gpu, core = both(grouped, view, depth=True)
    assert_same_image(gpu, core)
    assert np.abs(core.color - render(mesh, view).color).max() > 0.1  # they matter here


def test_normals_of_vertices():
    rng = np.random.default_rng(1)
    mesh = soup(7)
    normals = rng.normal(size=mesh.vertices.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert_same_image(*both(replace(mesh, normals=normals), camera(), normals=True))


@pytest.mark.parametrize(("samples", "size"), [(2, (13, 11)), (3, (1, 20)), (5, (17, 3)), (16, (1, 1))])
def test_samples_and_odd_images(samples, size):
    mesh = soup(5, 20, spread=(0.5, 0.5, 1.5))
    assert_same_image(*both(mesh, camera(*size), samples=samples, depth=True))


@pytest.mark.parametrize(
    "options",
    [
        {"max_layers": 1},
        {"max_layers": 7},
        {"min_transmittance": 0.0},
        {"min_transmittance": 0.3},
        {"cutoff": 0.5},
        {"cutoff": 0.0},
        {"background": (0.2, 0.5, 1)},
        {"background": np.random.default_rng(0).random((29, 37, 3))},
    ],
    ids=lambda options: next(iter(options)),
)
def test_options(options):
    mesh = soup(7)
    mesh = replace(mesh, colors=mesh.colors * np.where(np.arange(60) % 5, 1, 0)[:, None])
    assert_same_image(*both(mesh, camera(), depth=True, **options))


def test_a_cutoff_at_the_opacity_of_a_whole_triangle_draws_it():
    mesh = layers([2.0, 3.0], 0.3)
    gpu, core = both(mesh, camera(), cutoff=float(np.float32(0.3)))
    assert core.alpha.all()
    assert_same_image(gpu, core)


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("radius", [0.002, 0.12])
def test_the_low_pass_filter(samples, radius):
    mesh = random_fans(radius=radius)
    gpu, core = both(mesh, camera(60, 50), filter_px2=0.3, samples=samples)
    assert_same_image(gpu, core, least=100)
    assert np.abs(core.color - render(mesh, camera(60, 50), samples=samples).color).max() > 0.05


def test_the_filter_widens_fans_that_are_seen_edge_on_or_are_long_needles():
    mesh = random_fans(60)
    centers = mesh.vertices.reshape(-1, 7, 3)[:, :1]
    stretch = np.array([4, 4, 0.001]) @ np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    points = centers + (mesh.vertices.reshape(-1, 7, 3) - centers) * stretch
    needles = replace(mesh, vertices=points.reshape(-1, 3))
    assert_same_image(*both(needles, camera(60, 50), filter_px2=0.3), least=95)


def test_splats_that_share_vertices_have_no_filter():
    mesh = replace(soup(3), face_splat=np.arange(60))
    with pytest.raises(ValueError, match="share a vertex"):
        render(mesh, camera(), filter_px2=0.3, device="gpu")


def test_a_closed_sheet_has_neither_holes_nor_double_samples():
    rng = np.random.default_rng(2)
    n = 40
    y, x = np.mgrid[0:n, 0:n].astype(float)
    points = np.stack([x, y, np.zeros_like(x)], 2).reshape(-1, 3)
    inner = (points[:, 0] > 0) & (points[:, 0] < n - 1) & (points[:, 1] > 0) & (points[:, 1] < n - 1)
    points[inner, :2] += rng.uniform(-0.3, 0.3, (inner.sum(), 2))
    points = points / (n - 1) * 8 - 4
    points[:, 2] = 2 + 0.05 * points[:, 0]
    faces = grid_faces(n, n)
    faces = np.stack(
        [np.roll(face, rng.integers(3))[:: rng.choice([1, -1])] for face in rng.permutation(faces)]
    )
    # Vertices of their own: edges are shared by position, not by index.
    mesh = SplatMesh(
        points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3), np.full((faces.size, 4), 0.5)
    )
    image = render(mesh, camera(61, 51), device="gpu")
    assert (image.alpha == 0.5).all()


def test_a_fan_of_opaque_triangles_has_no_seam():
    image = render(fan(3, 7, 1.0), camera(), device="gpu")
    assert set(np.unique(image.alpha)) == {0.0, 1.0}


@pytest.mark.parametrize("name", ["vertices", "colors", "faces"])
def test_a_mesh_that_was_changed_in_place_is_drawn_as_it_is_now(name):
    mesh = soup(4)
    render(mesh, camera(), device="gpu")
    array = getattr(mesh, name)
    array[:] = np.roll(array, 1)
    assert_same_image(*both(mesh, camera()))


def test_the_mesh_of_the_last_call_stays_on_the_gpu():
    mesh = soup(4)
    assert gpu_engine().renderer_of(mesh) is gpu_engine().renderer_of(mesh)


def test_a_forked_process_says_how_to_start_others(monkeypatch):
    render(soup(4), camera(), device="gpu")
    monkeypatch.setattr("os.getpid", lambda: -1)
    with pytest.raises(DeviceError, match="get_context\\('spawn'\\)"):
        render(soup(4), camera(), device="gpu")


def test_no_triangles_and_none_in_view():
    empty = SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 4)))
    behind = soup(1, z=-50)
    for mesh in (empty, behind):
        gpu, core = both(mesh, camera(), background=(0.1, 0.2, 0.3), depth=True, normals=True)
        assert_same_image(gpu, core)
        assert not gpu.alpha.any()


# Bounded work and memory


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("queues", [(4, 4), (8, 24), (24, 8)])
def test_the_length_of_the_queue_does_not_change_a_bit(queues):
    mesh, view = many_triangles()
    usual = draw(mesh, view, DrawSettings())
    other = draw(mesh, view, DrawSettings(queue=queues[0], long_queue=queues[1]))
    assert bits(other) == bits(usual)
    assert other.work.fragments == usual.work.fragments
    assert usual.work.overflowed < other.work.overflowed if queues[0] < 16 else True
    again = draw(mesh, view, DrawSettings())
    assert bits(again) == bits(usual)
    assert again.work == usual.work


@pytest.mark.slow
def test_hundreds_of_layers_behind_each_other_are_walked_again():
    mesh, view = layers(np.full(700, 2.0), 0.003), camera(11, 9)
    images = draw(mesh, view, DrawSettings(queue=4, long_queue=8))
    assert images.work.most_walks > 70
    assert bits(images) == bits(draw(mesh, view, DrawSettings()))


def test_walks_that_exceed_their_budget_go_on_where_they_ended():
    mesh, view = random_fans(2000, radius=0.05), camera()
    usual = draw(mesh, view, DrawSettings())
    short = draw(mesh, view, DrawSettings(budget=400))
    assert bits(short) == bits(usual)
    assert short.work.walks > usual.work.walks


def test_a_tile_that_cannot_end_is_an_error():
    mesh, view = many_triangles()
    with pytest.raises(DeviceError, match="did not finish"):
        draw(mesh, view, DrawSettings(budget=0))


def test_lists_grow(monkeypatch):
    mesh, view = many_triangles()
    usual = draw(mesh, view, DrawSettings())
    monkeypatch.setattr(frames, "FIRST_PAIRS", 4)
    grown = draw(replace(mesh), view, DrawSettings())
    assert grown.work.frames == 2
    assert bits(grown) == bits(usual)


@pytest.mark.slow
def test_large_images_are_drawn_in_windows(monkeypatch):
    mesh, view = soup(1, 100, spread=(2, 2, 2)), camera(70, 50, near=0.3)
    whole = render(mesh, view, samples=2, device="gpu", **EXTRAS)
    monkeypatch.setattr(frames, "WINDOW_SAMPLES", 5000)
    assert_same_image(render(replace(mesh), view, samples=2, device="gpu", **EXTRAS), whole)
    assert draw(mesh, view, DrawSettings(samples=2)).work.windows == 4


def test_windows_are_halved_while_they_have_too_many_pairs(monkeypatch):
    mesh, view = many_triangles()
    whole = render(mesh, view, device="gpu")
    monkeypatch.setattr(frames, "FIRST_PAIRS", 4)
    monkeypatch.setattr(kernels, "MAX_PAIRS", 6000)
    assert_same_image(render(replace(mesh), view, device="gpu"), whole)
    assert draw(replace(mesh), view, DrawSettings()).work.windows > 1
    monkeypatch.setattr(kernels, "MAX_PAIRS", 2)
    with pytest.raises(MemoryError, match="single pixel"):
        draw(replace(mesh), view, DrawSettings())


def test_what_does_not_fit_is_an_error_before_any_work(monkeypatch):
    mesh = many_triangles()[0]
    monkeypatch.setattr(renderer, "DRAWING", renderer.DRAWING._replace(most_fan=3))
    with pytest.raises(DeviceError, match="splats of up to 3 triangles"):
        render(random_fans(5), camera(), filter_px2=0.3, device="gpu")
    from meshsplats.webgpu.device import Device, find_adapters

    small = Device(find_adapters()[0])
    small.binding_limit = 5000
    with pytest.raises(MemoryError, match="too many vertices for the GPU"):
        MeshRenderer(small, mesh)
    monkeypatch.setattr(layout, "MAX_WORKGROUPS", 1)
    assert len(mesh.vertices) > 256
    with pytest.raises(MemoryError, match=r"too many vertices for the GPU: .* it takes 256"):
        render(mesh, camera(), device="gpu")
    monkeypatch.undo()
    monkeypatch.setattr(frames, "FANS_IN_WORKGROUP", 0)
    with pytest.raises(MemoryError, match="too many splats for the GPU: 5; it takes 0"):
        render(replace(random_fans(5), order="splat"), camera(), device="gpu")


def test_the_kernels_need_core_limits_only():
    import re

    from meshsplats.webgpu.device import find_adapters, open_device

    limits = open_device().device.limits
    assert limits["max-storage-buffers-per-shader-stage"] == 8
    assert limits["max-compute-workgroup-storage-size"] == 16384
    largest = find_adapters()[0].limits["max-storage-buffer-binding-size"]
    assert 128 << 20 <= open_device().binding_limit <= limits["max-storage-buffer-binding-size"] <= largest
    assert not open_device().device.features
    gradients = (kernels.gradients_source(), kernels.filter_source(), kernels.training_source())
    images = (kernels.raster_source(groups=True), kernels.raster_source(order="splat"))
    for text in (kernels.lists_source(), *images, *gradients):
        assert not re.search(r"^\s*(enable|requires)\b", text, re.M)


# Parts


def test_runs_hold_consecutive_triangles_of_one_splat():
    rng = np.random.default_rng(0)
    splat = np.sort(rng.integers(0, 12, 100))
    faces = np.arange(300).reshape(-1, 3)
    runs = find_runs(faces, splat)
    first, count = runs & 0x1FFFFFFF, (runs >> 29) + 1
    assert (
        np.concatenate([np.arange(a, a + n) for a, n in zip(first, count, strict=True)]) == np.arange(100)
    ).all()
    for a, n in zip(first, count, strict=True):
        assert len(set(splat[a : a + n])) == 1
    assert len(runs) == sum(-(-int((splat == s).sum()) // 8) for s in set(splat.tolist()))
    assert len(find_runs(faces, None)) == 100  # no vertex in common
    assert len(find_runs(np.zeros((17, 3), int), None)) == 3


def test_the_plane_of_a_depth_group_is_that_of_its_largest_triangle():
    groups = np.random.default_rng(0).integers(-1, 4, 30)
    mesh = replace(soup(0, 30), depth_group=np.where(groups < 0, -1, 7 * groups))
    of_face, largest = find_groups(mesh)
    assert ((of_face == 0xFFFFFFFF) == (mesh.depth_group < 0)).all()
    corners = mesh.vertices[mesh.faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    for group, face in enumerate(largest):
        members = np.flatnonzero(of_face == group)
        assert len(set(mesh.depth_group[members])) == 1
        assert face == members[area[members].argmax()]


# Real scenes


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["playbot_lod5_3k_sh2.ply", "guitar_sh0.ply"])
def test_real_scenes(name):
    mesh = convert(load_gaussians(shared_data(f"splats/{name}")))
    view = orbit(mesh, 4, width=120, height=120)[1]
    gpu, core = both(mesh, view)
    assert_same_image(gpu, core, least=85, most=1 / 5000)


def test_median_depths_are_refused():
    need_gpu()
    with pytest.raises(ValueError, match="median_depth needs device 'cpu'"):
        render(soup(1), camera(), device="gpu", median_depth=True)
