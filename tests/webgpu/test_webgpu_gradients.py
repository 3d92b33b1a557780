"""Gradients on the GPU: those of the core, with the same bits every time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _gpu import need_gpu
from _rendering import camera, fan, layers, seen_by, soup, turned
from test_webgpu_render import crossing_planes, nearly_coplanar, random_fans

from meshsplats import Camera, SplatMesh, render
from meshsplats.errors import DeviceError
from meshsplats.rendering.backward import ExpectedError, OpacityRamp, TapeOptions
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import Engine, Taped, visible_pixels
from meshsplats.rendering.gpu import CANNOT, gpu_engine
from meshsplats.webgpu import gradients, kernels
from meshsplats.webgpu.device import open_device
from meshsplats.webgpu.gradients import GradientRenderer
from meshsplats.webgpu.settings import DrawSettings

TOLERANCE = 1e-4
"""Of ||g - g_core|| / ||g_core||, for each array."""


@pytest.fixture(autouse=True)
def _gpu():
    need_gpu()


def varied(mesh: SplatMesh, alpha: float) -> SplatMesh:
    """The mesh with vertices of many colours and opacities of about ``alpha``."""
    return replace(mesh, colors=np.random.default_rng(2).random(mesh.colors.shape) * [1, 1, 1, 2 * alpha])


def with_opacity(mesh: SplatMesh, alpha: float) -> SplatMesh:
    colors = mesh.colors.copy()
    colors[:, 3] = alpha
    return replace(mesh, colors=colors)


def scene(name: str) -> tuple[SplatMesh, Camera, dict]:
    view = camera(48, 40)
    groups = np.random.default_rng(0).integers(-1, 6, 60)
    return {
        "piercing": lambda: (soup(0), view, {}),
        "turned camera": lambda: (soup(1, view=turned(view, 3)), turned(view, 3), {}),
        "samples": lambda: (soup(2), view, {"samples": 3}),
        "depth groups": lambda: (replace(soup(3), depth_group=groups), view, {}),
        "equal depths": lambda: (varied(layers([2.0] * 8 + [2.5] * 8, 0.2), 0.2), view, {}),
        "saturated": lambda: (varied(layers(np.linspace(1, 2, 60), 0.5), 0.5), view, {}),
        "terminated early": lambda: (soup(5, 300), view, {"min_transmittance": 1e-3}),
        "many layers": lambda: (varied(layers(np.linspace(1, 2, 300), 0.02), 0.02), view, {}),
        "across tiles": lambda: (soup(4, 40, spread=(3, 3, 1)), camera(70, 50), {}),
        "a fan": lambda: (fan(5, 8, 0.6), camera(60, 50, fx=60, fy=50), {}),
        "far smaller than a pixel": lambda: (soup(6, 400, spread=(0.05, 0.05, 0.05)), view, {}),
        "near plane": lambda: (soup(7, z=0.6), view, {}),
        "opaque": lambda: (with_opacity(soup(0), 1), view, {}),
        "transparent": lambda: (with_opacity(soup(0), 0), view, {}),
        "one pixel": lambda: (soup(8), camera(1, 1), {"samples": 16}),
        "edges through samples": lambda: (*crossing_planes(), {}),
        "nearly equal depths": lambda: (varied(nearly_coplanar(), 0.4), view, {}),
    }[name]()


SCENES = [
    *("piercing", "turned camera", "samples", "depth groups", "equal depths", "saturated"),
    *("terminated early", "many layers", "across tiles", "a fan", "far smaller than a pixel"),
    *("near plane", "opaque", "transparent", "one pixel", "edges through samples", "nearly equal depths"),
]


GPU, CPU = gpu_engine(), CpuEngine()


def of_mesh(engine: Engine, mesh: SplatMesh, view: Camera, *, filter_px2: float = 0.0, **options) -> Taped:
    return engine.tape(mesh.triangles._replace(filter_px2=filter_px2), view, TapeOptions(**options))


def random_gradient(view: Camera, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (view.height, view.width)
    return rng.normal(size=(*shape, 3)).astype(np.float32), rng.normal(size=shape).astype(np.float32)


def descend(rendering, gradient) -> tuple[np.ndarray, np.ndarray]:
    count = rendering.vertex_count
    vertices, colors = np.zeros((count, 3), np.float32), np.zeros((count, 4), np.float32)
    rendering.backward(*gradient, None, vertices=vertices, colors=colors)
    return vertices, colors


def error(found: np.ndarray, expected: np.ndarray) -> float:
    size = float(np.linalg.norm(expected.astype(np.float64)))
    return float(np.linalg.norm(found.astype(np.float64) - expected)) / (size or 1.0)


def assert_same_gradients(mesh: SplatMesh, view: Camera, **options) -> None:
    options["background"] = np.random.default_rng(1).random((view.height, view.width, 3)).astype(np.float32)
    gpu, core = of_mesh(GPU, mesh, view, **options), of_mesh(CPU, mesh, view, **options)
    assert np.abs(gpu.color - core.color).max() < 1e-4
    assert np.abs(gpu.alpha - core.alpha).max() < 1e-4
    gradient = random_gradient(view)
    (vertices, colors), (known_vertices, known_colors) = descend(gpu, gradient), descend(core, gradient)
    assert np.isfinite(vertices).all()
    assert np.isfinite(colors).all()
    for name, found, expected in (
        ("positions", vertices, known_vertices),
        ("RGB", colors[:, :3], known_colors[:, :3]),
        ("opacities", colors[:, 3], known_colors[:, 3]),
    ):
        assert error(found, expected) < TOLERANCE, name


def bits(arrays) -> list[bytes]:
    return [array.tobytes() for array in arrays]


@pytest.mark.slow(keep=8)
@pytest.mark.parametrize("name", SCENES)
def test_equal_to_the_core(name):
    mesh, view, options = scene(name)
    assert_same_gradients(mesh, view, **options)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("radius", "samples", "near"), [(0.002, 1, 0.5), (0.12, 1, 0.5), (0.05, 2, 0.5), (0.3, 1, 2.0)]
)
def test_through_the_low_pass_filter(radius, samples, near):
    view = turned(camera(60, 50, near=near), 3)
    mesh = random_fans(radius=radius)
    mesh = replace(mesh, vertices=seen_by(view, mesh.vertices.astype(float)))
    assert_same_gradients(mesh, view, filter_px2=0.3, samples=samples)
    gradient = random_gradient(view)
    without = descend(of_mesh(GPU, mesh, view, samples=samples), gradient)
    filtered = descend(of_mesh(GPU, mesh, view, samples=samples, filter_px2=0.3), gradient)
    assert all(error(a, b) > 0.1 for a, b in zip(without, filtered, strict=True))  # it matters here


def test_through_the_filter_of_needles_and_of_fans_seen_edge_on():
    mesh = random_fans(60)
    fans = mesh.vertices.reshape(-1, 7, 3)
    stretch = np.array([4, 4, 0.001]) @ np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    points = fans[:, :1] + (fans - fans[:, :1]) * stretch
    assert_same_gradients(replace(mesh, vertices=points.reshape(-1, 3)), camera(60, 50), filter_px2=0.3)


def large_fan(triangles: int) -> SplatMesh:
    angles = np.arange(triangles) * 2 * np.pi / triangles
    rim = np.stack([np.cos(angles), np.sin(angles), 2 + 0.3 * np.cos(angles)], axis=1)
    faces = [(0, 1 + i, 1 + (i + 1) % triangles) for i in range(triangles)]
    colors = np.random.default_rng(0).random((triangles + 1, 4))
    splat = np.zeros(triangles, int)
    return SplatMesh(np.concatenate([[[0, 0, 2.0]], rim]), faces, colors, face_splat=splat)


def test_through_the_filter_of_the_largest_fan():
    mesh, view = large_fan(gradients.MAX_FAN), camera(60, 50)
    gradient = random_gradient(view)
    found = descend(of_mesh(GPU, mesh, view, filter_px2=0.3), gradient)
    expected = descend(of_mesh(CPU, mesh, view, filter_px2=0.3), gradient)
    assert all(error(a, b) < 1e-3 for a, b in zip(found, expected, strict=True))  # slivers, by rounding
    with pytest.raises(DeviceError, match="up to 4,096 triangles; one has 4,097"):
        of_mesh(GPU, large_fan(gradients.MAX_FAN + 1), view, filter_px2=0.3)


def test_the_image_is_that_of_render():
    mesh, view, _ = scene("terminated early")
    taped = of_mesh(GPU, mesh, view, min_transmittance=1e-3)
    image = render(mesh, view, min_transmittance=1e-3, device="gpu")
    assert taped.color.tobytes() == image.color.tobytes()
    assert taped.alpha.tobytes() == image.alpha.tobytes()
    assert taped.fragments == image.fragments


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", ["piercing", "many layers"])
def test_the_same_bits_every_time(name):
    mesh, view, options = scene(name)
    gradient = random_gradient(view)
    first = of_mesh(GPU, mesh, view, **options)
    found = bits(descend(first, gradient))
    assert bits(descend(first, gradient)) == found
    other = of_mesh(GPU, replace(mesh, vertices=mesh.vertices + 0.1), view, **options)
    assert bits(descend(other, gradient)) != found
    assert bits(descend(first, gradient)) == found  # rendered again: the GPU holds one tape
    of_mesh(GPU, soup(9), view)
    assert bits(descend(of_mesh(GPU, mesh, view, **options), gradient)) == found


def renderer_of(mesh: SplatMesh) -> GradientRenderer:
    return GPU.gradients_of(mesh.triangles)


@pytest.mark.slow
@pytest.mark.parametrize("queues", [(4, 4), (24, 8)])
def test_the_length_of_the_queue_does_not_change_a_bit(queues):
    mesh, view, _ = scene("many layers")
    renderer = renderer_of(mesh)
    gradient = np.concatenate([random_gradient(view)[0], np.zeros((view.height, view.width, 1))], axis=2)

    def found(settings: DrawSettings) -> tuple[bytes, bytes]:
        images, tape = renderer.forward(mesh.triangles, view, settings)
        return images.color.tobytes(), renderer.backward(tape, gradient.astype(np.float32))[0].tobytes()

    usual = found(DrawSettings())
    assert found(DrawSettings(queue=queues[0], long_queue=queues[1])) == usual


@pytest.mark.slow
def test_in_windows_where_a_tape_does_not_fit(monkeypatch):
    mesh, view, _ = scene("across tiles")
    gradient = random_gradient(view)
    whole = of_mesh(GPU, mesh, view)
    expected = descend(whole, gradient)
    monkeypatch.setattr(gradients, "FRAGMENT_BYTES", 16 * 4000)  # as if there were more fragments
    monkeypatch.setattr(renderer_of(mesh).device, "binding_limit", 64 << 20)
    parts = of_mesh(GPU, mesh, view)
    assert len(parts.tape.windows) >= 4
    # The corner of each window is another origin for rounding.
    assert np.abs(parts.color - whole.color).max() < 1e-4
    found = descend(parts, gradient)
    assert all(error(a, b) < TOLERANCE for a, b in zip(found, expected, strict=True))
    assert bits(descend(parts, gradient)) == bits(found)
    GPU.forget()


@pytest.mark.slow
def test_lists_grow():
    mesh, view, _ = scene("piercing")
    mesh = replace(mesh, faces=np.tile(mesh.faces, (40, 1)))
    GPU.forget()
    renderer = renderer_of(mesh)
    renderer.frames.capacity = 300
    assert_same_gradients(mesh, view)
    assert renderer.frames.capacity > 300


def test_no_triangles_and_none_in_view():
    view = camera()
    empty = SplatMesh(np.zeros((3, 3)), np.zeros((0, 3), int), np.zeros((3, 4)))
    for mesh in (empty, soup(1, z=-50)):
        rendering = of_mesh(GPU, mesh, view, background=(0.1, 0.2, 0.3))
        assert not rendering.alpha.any()
        assert np.allclose(rendering.color, (0.1, 0.2, 0.3))
        assert not any(part.any() for part in descend(rendering, random_gradient(view)))


def test_splats_that_share_vertices_have_no_filter():
    mesh = replace(soup(3), face_splat=np.arange(60))
    with pytest.raises(ValueError, match="share a vertex"):
        of_mesh(GPU, mesh, camera(), filter_px2=0.3)


def test_a_walk_that_cannot_end_is_an_error():
    mesh, view = soup(1, 500, spread=(2, 2, 2)), camera(70, 50, near=0.3)
    renderer = renderer_of(mesh)
    with pytest.raises(DeviceError, match="did not finish"):
        renderer.forward(mesh.triangles, view, DrawSettings(budget=1))


def test_walks_that_exceed_their_budget_go_on_where_they_ended():
    mesh, view = random_fans(1000, radius=0.05), camera()
    renderer = renderer_of(mesh)
    gradient = np.ones((view.height, view.width, 4), np.float32)

    def found(settings: DrawSettings) -> tuple[int, bytes]:
        images, tape = renderer.forward(mesh.triangles, view, settings)
        return images.work.walks, renderer.backward(tape, gradient)[0].tobytes()

    usual, short = found(DrawSettings()), found(DrawSettings(budget=400))
    assert short[0] > usual[0]
    assert short[1] == usual[1]


COUNTING = ("find_behind", "tape")
"""The kernel that follows the fragments of a sample, and the text that it is in."""


@pytest.mark.slow
def test_a_sample_with_too_many_fragments_is_an_error(monkeypatch):
    source = kernels.gradients_source()
    monkeypatch.setattr(
        kernels,
        "gradients_source",
        lambda queue, **options: source.replace("MOST_FRAGMENTS = 60000u", "MOST_FRAGMENTS = 20u"),
    )
    for name in ("_pipelines", "_modules"):  # the kernel that counts them is compiled anew
        kept = {key: made for key, made in getattr(open_device(), name).items() if key[0] not in COUNTING}
        monkeypatch.setattr(open_device(), name, kept)
    mesh, view, _ = scene("many layers")
    rendering = of_mesh(GPU, mesh, view)
    with pytest.raises(DeviceError, match="too many fragments"):
        descend(rendering, random_gradient(view))


def test_what_needs_the_cpu_is_an_error(monkeypatch):
    mesh, view, _ = scene("a fan")
    with pytest.raises(ValueError, match=CANNOT["cutoff"]):
        of_mesh(GPU, mesh, view, ramp=OpacityRamp(0.5))
    rendering = of_mesh(GPU, mesh, view)
    color, alpha = random_gradient(view)
    with pytest.raises(ValueError, match=CANNOT["cutoff"]):
        rendering.backward(
            color,
            None,
            None,
            vertices=np.zeros_like(mesh.vertices),
            colors=np.zeros_like(mesh.colors),
            expected=ExpectedError(color, alpha),
        )
    monkeypatch.setattr(gradients, "MAX_VALENCE", 7)
    GPU.forget()
    with pytest.raises(DeviceError, match="up to 7 triangles; one has 8"):
        of_mesh(GPU, mesh, view)


def test_visible_pixels_are_those_of_the_core():
    mesh, view, _ = scene("piercing")
    found, expected = (visible_pixels(engine, mesh.triangles, view) for engine in (GPU, CPU))
    assert expected.sum() > 10
    assert error(found, expected) < TOLERANCE


def test_rasterize_with_further_attributes_background_and_poses():
    torch = pytest.importorskip("torch", reason="rasterize needs torch")
    from test_rasterize import gradients as of_inputs

    from meshsplats.rendering.autograd import rasterize

    view = camera(48, 40)
    mesh = soup(1, view=turned(view, 3))
    views = [turned(view, 3), view]
    for extra in (0, 2, 4):
        found = of_inputs(rasterize, torch.float32, mesh, views, extra=extra, device="gpu")
        known = of_inputs(rasterize, torch.float32, mesh, views, extra=extra)
        for name, a, b in zip(("vertices", "attributes", "background", "poses"), found, known, strict=True):
            assert error(a.numpy(), b.numpy()) < TOLERANCE, name
    inputs = [torch.from_numpy(part) for part in (mesh.vertices, np.pad(mesh.colors, ((0, 0), (0, 4))))]
    inputs[1][:, 4:] = torch.arange(4)
    image = rasterize(inputs[0], mesh.faces, inputs[1], views, device="gpu")
    expected = rasterize(inputs[0], mesh.faces, inputs[1], views)
    for a, b in zip(image, expected, strict=True):
        assert (a - b).abs().max() < 1e-4
    with pytest.raises(ValueError, match="device must be 'cpu' or 'gpu', got 'cuda'"):
        rasterize(inputs[0], mesh.faces, inputs[1], views, device="cuda")  # type: ignore[arg-type]
