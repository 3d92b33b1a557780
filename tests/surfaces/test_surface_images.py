"""Images of textured surfaces, their gradients, atlases, and the fit to images."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from _meshes import unit_ball
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats import BaseMesh, Camera, SplatMesh, orbit, psnr, render
from meshsplats._common.arrays import block_means
from meshsplats.datasets.views import View, ViewImage
from meshsplats.scene.base_mesh import Texture
from meshsplats.surfaces import draw_surface
from meshsplats.surfaces.atlas import GUTTER, cells, filled, unwrap
from meshsplats.surfaces.fitting import SMALL, SmoothSteps, fit, mean_colors, target_of
from meshsplats.surfaces.images import Surface, SurfaceImage
from meshsplats.surfaces.views import smaller

needs_atlas = pytest.mark.skipif(
    importlib.util.find_spec("uvunwrap") is None, reason="install meshsplats[base], with Python 3.11 or newer"
)
needs_scipy = pytest.mark.skipif(importlib.util.find_spec("scipy") is None, reason="install meshsplats[base]")
WHITE = np.ones(3, np.float32)


def ball(side: int = 96, times: int = 3) -> Surface:
    """With a texture of smooth colours."""
    points, faces = unit_ball(times)
    uv = cells(len(faces), side)
    y, x = np.mgrid[:side, :side] / side
    texels = np.stack([0.5 + 0.4 * np.sin(9 * x), 0.5 + 0.4 * np.cos(7 * y), 0.3 + 0.5 * x * y], axis=2)
    return Surface(points, faces, uv, texels.astype(np.float32))


def cameras(count: int, side: int = 64) -> list[Camera]:
    points, faces = unit_ball(1)
    shape = SplatMesh(points, faces, np.ones((len(points), 4)))
    return [c.with_near_plane(shape.vertices) for c in orbit(shape, count, width=side, height=side)]


def views_of(surface: Surface, views: list[Camera]) -> list[View]:
    found = []
    for camera in views:
        drawn = SurfaceImage(surface, camera, np.zeros(3, np.float32), gradients=False)
        found.append(View(camera, ViewImage(drawn.color, drawn.coverage)))
    return found


def test_a_constant_texture_is_the_mesh_in_that_colour():
    surface = ball()._replace(texels=np.full((96, 96, 3), [0.2, 0.6, 0.9], np.float32))
    mesh = SplatMesh(surface.vertices, surface.faces, np.tile([0.2, 0.6, 0.9, 1], (len(surface.vertices), 1)))
    for camera in cameras(3):
        image = SurfaceImage(surface, camera, WHITE)
        expected = render(mesh, camera, samples=2)
        np.testing.assert_allclose(image.color, expected.color, atol=2e-3)
        np.testing.assert_allclose(image.coverage, expected.alpha, atol=0)


@pytest.mark.parametrize("colored", [False, True])
def test_gradients_of_a_motion_are_those_of_the_image(colored):
    # A ball that moves as a whole: outlines and texture, over many pixels. The texture has no seams: where
    # two charts meet in different colours, the image jumps without an edge.
    side = 320
    surface, camera = ball(), cameras(4, side)[1]
    flat = 0.5 + 0.4 * surface.vertices[surface.faces][..., :2]
    surface = surface._replace(uv=flat.astype(np.float32))
    if not colored:
        surface = surface._replace(texels=np.full((96, 96, 3), 0.3, np.float32))
    weights = np.array([0.3, 0.6, 0.9]) * np.sin(np.mgrid[:side, :side].sum(axis=0) / 40)[..., None]

    def loss(step: float, axis: int) -> float:
        moved = surface.vertices + step * np.eye(3)[axis]
        image = SurfaceImage(surface._replace(vertices=moved), camera, WHITE, gradients=False)
        return float((image.color * weights).sum())

    found = SurfaceImage(surface, camera, WHITE).vertex_gradients(weights.astype(np.float32)).sum(axis=0)
    step = 0.02  # some pixels, so that the differences are smooth
    slopes = [(loss(step, axis) - loss(-step, axis)) / (2 * step) for axis in range(3)]
    np.testing.assert_allclose(found, slopes, atol=0.05 * np.linalg.norm(slopes))


def test_texels_take_the_colours_of_the_images():
    surface = ball()
    views = views_of(surface, cameras(12, 96))
    grey = surface._replace(texels=np.full_like(surface.texels, 0.5))
    before, after = (
        np.mean([psnr(SurfaceImage(s, v.camera, WHITE).color, v.image) for v in views])
        for s in (grey, mean_colors(grey, views))
    )
    assert before < 20
    assert after > 28


@pytest.mark.nightly
@needs_scipy
def test_a_ball_of_the_wrong_size_is_fitted_to_images():
    truth = ball()
    views = views_of(truth, cameras(12, 64))
    small = truth._replace(vertices=0.9 * truth.vertices)
    fitted = fit(mean_colors(small, views), views, rounds=6, move=0.5, stiffness=2.0)
    radii = [np.linalg.norm(s.vertices, axis=1) for s in (small, fitted)]
    assert abs(np.median(radii[1]) - 1) < 0.25 * abs(np.median(radii[0]) - 1)
    again = fit(mean_colors(small, views), views, rounds=6, move=0.5, stiffness=2.0, threads=1)
    np.testing.assert_array_equal(again.vertices, fitted.vertices)
    np.testing.assert_array_equal(again.texels, fitted.texels)
    still = fit(mean_colors(small, views), views, rounds=1, move=0, stiffness=2.0)
    np.testing.assert_array_equal(still.vertices, small.vertices)


@needs_scipy
def test_a_step_takes_neighbours_along():
    points, faces = unit_ball(2)
    push = np.zeros_like(points)
    push[0, 0] = -1.0
    moved = SmoothSteps(points, faces, 20.0).step(push, 0.1) - points
    near = np.linalg.norm(points - points[0], axis=1) < 0.5
    assert moved[0, 0] > moved[near][1:, 0].max() > moved[~near, 0].max() > 0
    np.testing.assert_allclose(SmoothSteps(points, faces, 20.0).step(0 * push, 0.1), points, atol=1e-12)


@needs_scipy
def test_steps_are_as_long_for_faint_gradients_as_for_large_ones_but_not_for_noise():
    points, faces = unit_ball(2)
    push = np.zeros_like(points)
    push[:3, 0] = 1.0, 0.3, 0.01
    moved = points - SmoothSteps(points, faces, 0.0).step(push, 0.1)
    expected = [g / np.sqrt(g**2 + SMALL**2) for g in (1.0, 0.3, 0.01)]
    np.testing.assert_allclose(moved[:3, 0], 0.1 * np.array(expected), rtol=1e-9)
    assert expected[1] > 0.9
    assert expected[2] < 0.15
    np.testing.assert_array_equal(moved[3:], 0)


def test_what_an_image_is_compared_with():
    camera = cameras(1, 8)[0]
    color, alpha = np.full((8, 8, 3), 0.2, np.float32), np.full((8, 8), 0.5, np.float32)
    for number, background in enumerate((1.0, 0.0, 0.5, 1.0)):
        target, behind, counts, solid = target_of(View(camera, ViewImage(color, alpha)), number)
        assert solid.all()
        np.testing.assert_allclose(target, 0.2 + 0.5 * background)
        np.testing.assert_array_equal(behind, np.full(3, background))
        assert counts.all()
    mask = np.zeros((8, 8), bool)
    assert not target_of(View(camera, ViewImage(color, 0.9 * alpha))).solid.any()
    target, behind, counts, solid = target_of(View(camera, ViewImage(color, mask=mask)))
    assert solid.all()
    np.testing.assert_array_equal(target, behind)
    assert not counts.any()


def test_smaller_views_show_the_same():
    camera = cameras(2, 64)[1]
    view = views_of(ball(), [camera])[0]
    small = smaller(view, 3)
    assert (small.camera.width, small.camera.height) == (21, 21)
    points = ball().vertices
    np.testing.assert_allclose(3 * small.camera.project(points)[0], camera.project(points)[0], atol=1e-9)
    assert small.image[4, 9] == pytest.approx(view.image[12:15, 27:30].mean(axis=(0, 1)), abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 400), st.integers(0, 3))
def test_cells_do_not_overlap(count, more):
    side = 8 * int(np.ceil(np.sqrt(-(-count // 2)))) + more
    uv = cells(count, side).astype(np.float64) * side
    assert uv.min() >= 0.5
    assert uv.max() <= side - 0.5
    (ax, ay), (bx, by) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    area = np.abs(ax * by - ay * bx) / 2
    assert area.min() > 4
    low, high = uv.min(axis=1), uv.max(axis=1)
    for k in range(0, count - 2, 2):  # pairs share a cell, of which nothing sticks out
        apart = (high[k] <= low[k + 2 :] + 1e-4) | (low[k] >= high[k + 2 :] - 1e-4)
        assert apart.any(axis=1).all()


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 3), st.sampled_from(["u1", "f2", "f4", "bool"]))
def test_means_of_blocks_are_means(rows, columns, side, kind):
    values = (255 * np.random.default_rng(0).random((rows, columns, 2))).astype(kind)
    found = block_means(values, side)
    assert found.shape == (rows // side, columns // side, 2)
    for y, x in np.ndindex(found.shape[:2]):
        block = values[y * side : (y + 1) * side, x * side : (x + 1) * side].astype(np.float64)
        np.testing.assert_allclose(found[y, x], block.mean(axis=(0, 1)), rtol=1e-6)


@needs_atlas
def test_charts_of_an_atlas_do_not_overlap():
    points, faces = unit_ball(3)
    side = 256
    uv = unwrap(points, faces, side).astype(np.float64) * side
    assert uv.min() >= 0
    assert uv.max() <= side
    y, x = np.mgrid[:side, :side] + 0.5
    owners = np.zeros((side, side), int)
    for a, b, c in uv:
        inside = [
            (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))
        ]
        owners += np.all([s > 1e-9 for s in inside], axis=0) | np.all([s < -1e-9 for s in inside], axis=0)
    assert owners.max() == 1
    assert (owners > 0).mean() > 0.4
    assert GUTTER >= 2


@needs_atlas
def test_what_the_library_of_atlases_gives_up_with_is_an_error(monkeypatch):
    import uvunwrap

    class PanicException(BaseException):
        pass

    class Other(BaseException):
        pass

    def panic(*arguments, **options):
        raise raised("index out of bounds")

    monkeypatch.setattr(uvunwrap, "generate", panic)
    points, faces = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]])
    raised = PanicException
    with pytest.raises(ValueError, match=r"uvunwrap fails for the 1 triangles .*\(index out of bounds\)"):
        unwrap(points, faces, 64)
    raised = Other
    with pytest.raises(Other):
        unwrap(points, faces, 64)


def test_texels_that_nobody_saw_are_filled_from_near():
    texels = np.zeros((40, 33, 3), np.float32)
    texels[:, :16] = [1, 0, 0]
    texels[:, 17:] = [0, 0, 1]
    weight = np.zeros((40, 33), np.float32)
    weight[5:35, 3:12] = weight[5:35, 20:30] = 1
    result = filled(np.where(weight[..., None] > 0, texels, 7), weight)
    np.testing.assert_array_equal(result[weight > 0], texels[weight > 0])
    assert result.min() >= 0
    assert result.max() <= 1
    assert (result[5:35, 2] == [1, 0, 0]).all()
    assert (result[5:35, 31] == [0, 0, 1]).all()
    np.testing.assert_array_equal(filled(texels, 0 * weight), np.full_like(texels, 0.5))


def test_the_factor_of_a_texture_is_drawn_and_what_cannot_be_is_refused():
    points, faces = unit_ball(2)
    camera = cameras(1)[0]
    pixels = np.full((8, 8, 4), 255, np.uint8)
    red = BaseMesh(
        points,
        faces,
        uv=np.full((len(faces), 3, 2), 0.5),
        face_texture=np.zeros(len(faces), np.int32),
        textures=(Texture(pixels, factor=(1, 0.25, 0, 1)),),
    )
    shown = red.colors_at(np.zeros(1, int), np.full((1, 3), 1 / 3))[0, :3]
    assert draw_surface(red, camera)[32, 32] == pytest.approx(shown, abs=1e-6)
    tints = np.tile(np.float32([1, 0.25, 0, 0.5]), (len(points), 1))
    tinted = replace(red, textures=(Texture(pixels),), tints=tints)
    np.testing.assert_allclose(draw_surface(tinted, camera), draw_surface(red, camera), atol=1e-5)
    some = np.where(np.arange(len(faces)) < 3, -1, 0)
    with pytest.raises(ValueError, match=f"this mesh has 1, on {len(faces) - 3} of {len(faces)} faces"):
        draw_surface(replace(red, face_texture=some), camera)


@pytest.mark.parametrize("wrap", [("repeat", "mirror"), ("mirror", "clamp"), ("clamp", "repeat")])
def test_textures_are_drawn_beyond_their_borders_as_they_wrap(wrap):
    """A square that fills the image, with its texture from -1.25 to 1.75 along each side."""
    points = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    pixels = np.random.default_rng(0).integers(0, 256, (5, 4, 4), np.uint8)
    uv = points[faces, :2] * np.float32(1.5) + np.float32(0.25)
    base = BaseMesh(points, faces, uv=uv, face_texture=[0, 0], textures=(Texture(pixels, wrap),))
    image = draw_surface(base, Camera(np.eye(4), 32, 32, 32, 32, 64, 64))
    at = (np.arange(128) + 0.5) / 64 - 1
    samples = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) * 1.5 + 0.25
    expected = base.textures[0].at(samples)[:, :3].reshape(64, 2, 64, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(image, expected, atol=1e-3)
    with pytest.raises(ValueError, match="repeated too often to be drawn"):
        draw_surface(replace(base, uv=uv * np.float32(1e9)), Camera(np.eye(4), 8, 8, 8, 8, 16, 16))


def test_a_texture_that_repeats_often_is_drawn():
    """A square that fills the image, with 300 x 300 repetitions: side by side, more than a gigabyte."""
    points = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 4), np.uint8)
    uv = points[faces, :2] * np.float32(150)
    base = BaseMesh(points, faces, uv=uv, face_texture=[0, 0], textures=(Texture(pixels),))
    image = draw_surface(base, Camera(np.eye(4), 50, 50, 50, 50, 100, 100))
    at = (np.arange(200) + 0.5) / 100 - 1
    samples = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) * 150
    expected = base.textures[0].at(samples)[:, :3].reshape(100, 2, 100, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(image, expected, atol=0.02)


def test_a_clamped_texture_has_its_own_colour_at_each_border():
    points = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    pixels = np.full((2, 2, 4), 255, np.uint8)
    pixels[:, 0, :3] = 0
    uv = (points[faces, :2] + 1) / 2
    base = BaseMesh(
        points, faces, uv=uv, face_texture=[0, 0], textures=(Texture(pixels, ("clamp", "clamp")),)
    )
    image = draw_surface(base, Camera(np.eye(4), 8, 8, 8, 8, 16, 16))
    np.testing.assert_allclose(image[8, [0, 3, 12, 15], 0], [0, 0, 1, 1], atol=1e-6)


def test_surfaces_without_a_texture_are_drawn():
    points, faces = unit_ball(2)
    camera = cameras(1)[0]
    grey = draw_surface(BaseMesh(points, faces), camera)
    assert np.unique(grey.round(3)).size > 1
    assert grey[32, 32] == pytest.approx([0.5] * 3, abs=1e-6)
    red = draw_surface(BaseMesh(points, faces, np.tile([1, 0, 0, 1], (len(points), 1))), camera)
    assert red[32, 32] == pytest.approx([1, 0, 0], abs=1e-6)
    pixels = np.full((8, 8, 4), [0, 255, 0, 255], np.uint8)
    textured = BaseMesh(
        points,
        faces,
        uv=np.full((len(faces), 3, 2), 0.5),
        face_texture=np.zeros(len(faces), np.int32),
        textures=(Texture(pixels),),
    )
    green = draw_surface(textured, camera, background=(0, 0, 1))
    assert green[32, 32] == pytest.approx([0, 1, 0], abs=1e-6)
    assert green[0, 0] == pytest.approx([0, 0, 1], abs=1e-6)
