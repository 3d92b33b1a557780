"""Whole splats in the order of their centres on the GPU: the images and gradients of the core."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _gpu import assert_same_image, both, need_gpu
from _local import shared_data
from _rendering import EXTRAS, camera, layers, turned
from test_splat_order import SCENES, crossed, view_of
from test_webgpu_gradients import CPU, GPU, bits, descend, large_fan, of_mesh, random_gradient, renderer_of
from test_webgpu_gradients import assert_same_gradients as assert_same_gradients_of
from test_webgpu_render import bits as image_bits
from test_webgpu_render import crossing_planes, draw, random_fans

from meshsplats import Camera, SplatMesh, convert, load_gaussians, orbit, render
from meshsplats.errors import DeviceError
from meshsplats.webgpu import frames, gradients
from meshsplats.webgpu.settings import DrawSettings

BY_SPLAT = DrawSettings(order="splat")


@pytest.fixture(autouse=True)
def _gpu():
    need_gpu()


def fans_behind_each_other() -> tuple[SplatMesh, Camera]:
    """Large fans, many at each sample, whose triangles pierce those of others."""
    return replace(random_fans(300, radius=0.5), order="splat"), camera(70, 50, near=0.3)


# Images


@pytest.mark.slow(keep=8)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("extras", [{}, EXTRAS], ids=["color", "all outputs"])
def test_equal_to_the_core(name, extras):
    mesh, options = SCENES[name]
    if extras and not mesh.attributes:
        extras = {"depth": True, "normals": True}
    least = 95 if name == "a filter" else 105
    assert_same_image(*both(mesh, view_of(name), **options, **extras), least=least, most=1e-3)


@pytest.mark.parametrize(
    "options",
    [
        {"max_layers": 1},
        {"max_layers": 4},
        {"min_transmittance": 0.0},
        {"min_transmittance": 0.3},
        {"samples": 2},
        {"filter_px2": 0.3},
    ],
    ids=lambda options: next(iter(options)),
)
def test_options(options):
    mesh, view = fans_behind_each_other()
    gpu, core = both(mesh, view, depth=True, **options)
    assert_same_image(gpu, core, least=95, most=1e-3)
    exact = render(mesh, view, order="fragment", **options)
    assert np.abs(core.color - exact.color).max() > 0.1  # the order matters here


@pytest.mark.parametrize(("second", "nearer"), [(2.01, 0), (1.99, 1), (2.0, 1)])
def test_centres_decide_and_of_equal_ones_the_later(second, nearer):
    mesh, view = crossed(2.0, second), camera(8, 8, fx=8, fy=8, cx=4, cy=4)
    drawn = render(mesh, view, device="gpu").color
    np.testing.assert_allclose(drawn, np.broadcast_to(np.eye(3)[nearer], drawn.shape), atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_samples_within_rounding_of_an_edge_are_on_the_side_that_the_core_sees(seed):
    """The core's tiles are larger than in the exact order, and so rounding is another."""
    mesh, view = crossing_planes(seed)
    mesh = replace(mesh, face_splat=np.arange(len(mesh.faces)), order="splat")
    assert_same_image(*both(mesh, view))


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_depths_that_differ_in_the_last_bit_are_two(steps):
    """float32 of the core's double precision: the earlier splat is in front by the least there is."""
    mesh = layers([2.0, 2.0], 0.9, [(1, 0, 0), (0, 1, 0)])
    vertices = mesh.vertices.copy()
    for _ in range(steps):
        vertices[3:, 2] = np.nextafter(vertices[3:, 2], np.float32(3))
    mesh = replace(mesh, vertices=vertices, face_splat=[0, 1], order="splat")
    gpu, core = both(mesh, camera())
    assert_same_image(gpu, core)
    assert (gpu.color[..., 0] > gpu.color[..., 1]).all()


def test_centres_behind_the_camera_are_the_nearest():
    """Of splats that reach before the camera; the nearer its centre, the earlier one is blended."""
    mesh = layers([4.0, 3.0, 3.0], 0.5, np.eye(3))
    vertices = mesh.vertices.copy()
    vertices[3] = -99, -99, -9  # of the second splat, whose centre is at a depth of -1
    mesh = replace(mesh, vertices=vertices, face_splat=[0, 1, 2], order="splat")
    gpu, core = both(mesh, camera())
    assert_same_image(gpu, core)
    seen = core.color[core.alpha > 0.8] - 0.125  # less the background
    assert len(seen) > 100
    np.testing.assert_allclose(seen, np.broadcast_to([0.125, 0.5, 0.25], seen.shape), atol=1e-6)


def test_a_turned_camera_far_from_the_origin():
    mesh, view = fans_behind_each_other()
    moved = replace(mesh, vertices=mesh.vertices + np.float32(4096))
    matrix = view.world_to_camera.copy()
    matrix[:3, 3] -= matrix[:3, :3] @ np.full(3, 4096.0)
    assert_same_image(*both(moved, replace(view, world_to_camera=matrix)))
    assert_same_image(*both(mesh, turned(view, 3)))


def test_both_orders_of_one_mesh_by_turns():
    mesh, view = fans_behind_each_other()
    first = [draw(mesh, view, DrawSettings()), draw(mesh, view, BY_SPLAT)]
    again = [draw(mesh, view, DrawSettings()), draw(mesh, view, BY_SPLAT)]
    assert list(map(image_bits, again)) == list(map(image_bits, first))
    assert image_bits(first[0]) != image_bits(first[1])


def test_the_cutoff_of_a_mesh_in_the_order_of_splats_has_a_depth_buffer():
    mesh, view = fans_behind_each_other()
    assert_same_image(*both(mesh, view, cutoff=0.3))


def test_one_walk_blends_all_however_many_layers():
    mesh = replace(layers(np.full(700, 2.0), 0.003), face_splat=np.arange(700) // 2, order="splat")
    images = draw(mesh, camera(20, 9), BY_SPLAT)
    assert images.work.walks == images.work.tiles
    assert draw(mesh, camera(20, 9), DrawSettings()).work.walks > images.work.tiles


def test_walks_that_exceed_their_budget_go_on_where_they_ended():
    mesh, view = fans_behind_each_other()
    usual, short = draw(mesh, view, BY_SPLAT), draw(mesh, view, replace(BY_SPLAT, budget=250))
    assert image_bits(short) == image_bits(usual)
    assert short.work.walks > usual.work.walks


def test_lists_grow_from_less_than_the_runs(monkeypatch):
    mesh, view = fans_behind_each_other()
    usual = draw(mesh, view, BY_SPLAT)
    monkeypatch.setattr(frames, "FIRST_PAIRS", 4)
    grown = draw(replace(mesh), view, BY_SPLAT)
    assert grown.work.frames == 2
    assert image_bits(grown) == image_bits(usual)


def test_large_images_are_drawn_in_windows(monkeypatch):
    mesh, view = fans_behind_each_other()
    whole = render(mesh, view, samples=2, device="gpu", depth=True)
    monkeypatch.setattr(frames, "WINDOW_SAMPLES", 5000)
    assert_same_image(render(replace(mesh), view, samples=2, device="gpu", depth=True), whole)


def test_splats_with_too_many_triangles_are_an_error():
    mesh = replace(large_fan(frames.MAX_FAN + 1), order="splat")
    with pytest.raises(DeviceError, match=r"order of the splats .* up to 8,192 triangles; one has 8,193"):
        render(mesh, camera(), device="gpu")
    with pytest.raises(DeviceError, match="order of the splats"):
        of_mesh(GPU, mesh, camera())
    largest = replace(large_fan(frames.MAX_FAN), order="splat")
    assert_same_image(*both(largest, camera()), least=80)  # slivers, by rounding


@pytest.mark.slow
@pytest.mark.parametrize("name", ["playbot_lod5_3k_sh2.ply", "guitar_sh0.ply"])
def test_real_scenes(name):
    mesh = replace(convert(load_gaussians(shared_data(f"splats/{name}"))), order="splat")
    view = orbit(mesh, 4, width=120, height=120)[1]
    gpu, core = both(mesh, view)
    assert_same_image(gpu, core, least=85, most=1 / 5000)
    assert np.abs(core.color - render(mesh, view, order="fragment").color).max() > 0.05


# Gradients


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("name", SCENES)
def test_gradients_equal_to_those_of_the_core(name):
    mesh, options = SCENES[name]
    assert_same_gradients_of(mesh, view_of(name, 48, 40), **options, filter_px2=mesh.filter_px2)


def test_gradients_of_samples_that_end_early():
    mesh, view = fans_behind_each_other()
    assert_same_gradients_of(mesh, view, min_transmittance=1e-2, samples=2)
    gradient = random_gradient(view)
    exact = descend(of_mesh(GPU, replace(mesh, order="fragment"), view), gradient)
    found = descend(of_mesh(GPU, mesh, view), gradient)
    for a, b in zip(exact, found, strict=True):
        assert np.linalg.norm(a - b) > 0.1 * np.linalg.norm(b)  # the order matters here


def test_the_image_with_a_tape_is_that_of_render():
    mesh, view = fans_behind_each_other()
    taped = of_mesh(GPU, mesh, view, min_transmittance=1e-3)
    image = render(mesh, view, min_transmittance=1e-3, device="gpu")
    assert taped.color.tobytes() == image.color.tobytes()
    assert taped.fragments == image.fragments


def test_gradients_have_the_same_bits_every_time_and_with_any_budget(monkeypatch):
    mesh, view = fans_behind_each_other()
    gradient = random_gradient(view)
    first = of_mesh(GPU, mesh, view)
    found = bits(descend(first, gradient))
    other = of_mesh(GPU, replace(mesh, order="fragment"), view)  # another renderer in its place
    assert bits(descend(other, gradient)) != found
    assert bits(descend(first, gradient)) == found
    renderer = renderer_of(mesh)
    both_ways = np.ones((view.height, view.width, 4), np.float32)
    for settings in (BY_SPLAT, replace(BY_SPLAT, budget=250)):
        images, tape = renderer.forward(mesh.triangles, view, settings)
        result = renderer.backward(tape, both_ways)[0].tobytes()
        if settings is BY_SPLAT:
            usual, walks = result, images.work.walks
    assert images.work.walks > walks
    assert result == usual


@pytest.mark.slow
def test_gradients_in_windows_where_a_tape_does_not_fit(monkeypatch):
    mesh, view = fans_behind_each_other()
    gradient = random_gradient(view)
    expected = descend(of_mesh(CPU, mesh, view), gradient)
    monkeypatch.setattr(gradients, "FRAGMENT_BYTES", 16 * 4000)  # as if there were more fragments
    monkeypatch.setattr(renderer_of(mesh).device, "binding_limit", 64 << 20)
    parts = of_mesh(GPU, mesh, view)
    assert len(parts.tape.windows) >= 4
    for a, b in zip(descend(parts, gradient), expected, strict=True):
        assert np.linalg.norm(a - b) < 1e-4 * np.linalg.norm(b)
    GPU.forget()
