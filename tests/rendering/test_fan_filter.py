"""The filter for the triangles of a splat: by hand, by what it does to the opacity on the image, by what
must not change it, and against float64."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from _rendering import (
    EXTRAS,
    assert_close,
    assert_mesh_is_exact,
    assert_same_bits,
    camera,
    soup,
    splats,
    turned,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from test_rendering_variants import VIEWS, assert_image, in_another_process, scaled

from meshsplats import Camera, SplatMesh, convert
from meshsplats._core import library
from meshsplats.rendering import reference, render
from meshsplats.rendering.backward import TapedRendering, TapeOptions
from meshsplats.rendering.reference_samples import to_camera

MODES = ("flat", "crossed", "3d")
STARS = {"detail": "cameras", "sides": 60, "cameras": [camera()]}
"""Splats of many triangles: stars where they are thick, three rings where they are not."""
SHAPES = [("flat", {}), ("flat", {"sides": 3}), ("flat", {"rings": 3}), ("crossed", {}), ("3d", {})]


def fans(
    seed: int, n: int, mode: str = "flat", *, sizes=(0.005, 0.3), z: float = 3.0, **options
) -> SplatMesh:
    """Fans of splats much smaller and larger than a pixel; some reach nearer than the near plane, some are
    behind it."""
    cloud = splats(seed, n, degree=0, sizes=sizes, z=z)
    return convert(cloud, footprint="filter", mode=mode, min_opacity=0, **options)


def irregular(seed: int, n: int) -> SplatMesh:
    """Fans of which some triangles are missing: of different numbers of them, some not joined to the one
    before, some vertices of no triangle."""
    mesh = fans(seed, n, "3d")
    kept = np.random.default_rng(seed).random(len(mesh.faces)) < 0.6
    return replace(mesh, faces=mesh.faces[kept], face_splat=mesh.face_splat[kept])


def diamond(center, radii, angle: float = 0.0, *, alpha: float = 1.0) -> SplatMesh:
    """Four triangles at depth 2 with opacity ``alpha`` at the centre and 0 at corners ``radii`` px away, for
    a camera of focal length 1 px."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rim = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]) * radii @ turn.T
    points = np.vstack([center, center + rim])
    vertices = 2 * np.column_stack([points, np.ones(5)])
    colors = np.zeros((5, 4))
    colors[0, 3] = alpha
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1)]
    return SplatMesh(vertices, faces, colors, face_splat=[0] * 4)


def plain_camera(width: int = 41, height: int = 37, **changes):
    return camera(width, height, **{"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, **changes})


# By hand


def test_radius_grows_by_the_variance():
    """Over the square |x| + |y| < r the opacity 1 - (|x| + |y|) / r has the variance r^2 / 10, so a filter of
    s makes it r sqrt(1 + 10 s / r^2), but for the least variance."""
    view = plain_camera()
    for r, s in [(8.0, 3.0), (3.0, 0.3), (0.3, 2.0)]:
        before = r**2 / 10 + 1e-4 * s
        grown = r * np.sqrt(1 + s / before)
        found = render(diamond((20.3, 18.1), (r, r)), view, filter_px2=s)
        assert_close(found, render(diamond((20.3, 18.1), (grown, grown)), view), flips=0)


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_each_axis_grows_by_itself(angle):
    radii, s = np.array([12.0, 1.5]), 2.0
    grown = radii * np.sqrt(1 + s / (radii**2 / 10 + 1e-4 * s))
    found = render(diamond((20, 18), radii, angle), plain_camera(), filter_px2=s)
    assert_close(found, render(diamond((20, 18), grown, angle), plain_camera()), tolerance=1e-4, flips=2e-3)


def test_a_splat_that_is_nearly_edge_on_gets_the_width_of_the_filter():
    """As seen by a viewer of splats: its standard deviation across is that of the filter."""
    s = 2.0
    thin = render(diamond((20, 18), (10.0, 0.3)), plain_camera(), filter_px2=s)
    # The square of variance s has corners sqrt(10 s) from its centre.
    wide = render(diamond((20, 18), (np.sqrt(100 + 10 * s), np.sqrt(0.09 + 10 * s))), plain_camera())
    assert np.abs(thin.alpha - wide.alpha).max() < 0.02
    assert thin.alpha[18, 17] > 0.5


# What it does to the opacity on the image


def covariance(alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: alpha.shape[0], : alpha.shape[1]] + 0.5
    points = np.stack([x.ravel(), y.ravel()], 1)
    weights = alpha.ravel().astype(np.float64) / alpha.sum(dtype=np.float64)
    mean = weights @ points
    return mean, np.einsum("n,ni,nj->ij", weights, points - mean, points - mean)


@pytest.mark.parametrize(
    ("mode", "options", "tolerance"), [*((*shape, 0.02) for shape in SHAPES), ("flat", STARS, 0.025)]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_covariance_on_the_image_grows_by_the_filter(mode, options, tolerance, seed):
    """For all patterns, in all positions: what is drawn of one splat has its mean and its covariance + s.
    Faint, for opacities of layers to add up; far, for perspective to be small."""
    cloud = splats(seed, 1, degree=0, sizes=(0.4, 1.2), opacity=0.01)
    cloud = replace(cloud, means=np.array([[0.2, -0.1, 60.0]], np.float32))
    mesh = convert(cloud, footprint="none", mode=mode, min_opacity=0, shrink_faint=False, **options)
    view = camera(160, 160, fx=600.0, fy=600.0)
    for samples in (1, 2):
        mean, before = covariance(render(mesh, view, samples=2).alpha)
        for s in (4.0, 60.0):
            moved, after = covariance(render(mesh, view, samples=samples, filter_px2=s).alpha)
            np.testing.assert_allclose(moved, mean, atol=0.1)
            np.testing.assert_allclose(after, before + s * np.eye(2), atol=tolerance * (s + before.max()))


# What must not change it


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), mode=st.sampled_from(MODES))
def test_rigid_motion(seed, mode):
    mesh, view = fans(seed, 12, mode), camera()
    other = turned(view, seed)
    there = (mesh.vertices - other.world_to_camera[:3, 3]) @ other.world_to_camera[:3, :3]
    moved = render(replace(mesh, vertices=there), other)
    assert_close(moved, render(mesh, view), tolerance=3e-4, flips=5e-3)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), power=st.integers(-12, 12))
def test_scale_of_the_scene(seed, power):
    """A power of two rounds nothing."""
    mesh, factor = fans(seed, 12), 2.0**power
    scaled_mesh = replace(mesh, vertices=mesh.vertices * np.float32(factor))
    assert_same_bits(render(scaled_mesh, camera(near=0.5 * factor)), render(mesh, camera()))


def test_renumbered_vertices_and_other_splats():
    """A splat is widened by itself, whatever the numbers of its vertices and wherever its triangles are."""
    mesh, view = fans(3, 40, "crossed"), camera()
    image = render(mesh, view)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(mesh.vertices))
    place = np.argsort(order)
    renumbered = replace(
        mesh, vertices=mesh.vertices[order], colors=mesh.colors[order], faces=place[mesh.faces]
    )
    assert_same_bits(image, render(renumbered, view))
    alone = mesh.take(mesh.face_splat == 7)
    assert alone.filter_px2 == mesh.filter_px2
    without = replace(
        mesh,
        colors=np.where(
            np.isin(np.arange(len(mesh.vertices)), mesh.faces[mesh.face_splat == 7])[:, None], mesh.colors, 0
        ),
    )
    assert_close(render(alone, view), render(without, view), flips=0)


def test_order_of_the_splats():
    """A splat's vertices and gradients have the same bits whatever splats are beside it."""
    mesh, view = irregular(7, 60), camera(70, 50)
    assert len(set(np.bincount(mesh.face_splat))) > 4
    renamed = np.random.default_rng(1).permutation(60)[mesh.face_splat]
    order = np.argsort(renamed, kind="stable")
    shuffled = replace(mesh, faces=mesh.faces[order], face_splat=renamed[order])
    assert_same_bits(render(mesh, view), render(shuffled, view))
    for a, b in zip(back(mesh), back(shuffled), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("unused", [1, 1000], ids=["a few", "many"])
def test_vertices_of_no_face(unused):
    """They change nothing, wherever they are: behind the camera, too, or far away."""
    mesh, view = diamond((20, 18), (2.0, 3.0)), plain_camera()
    for place in ((0, 0, -1), (40, 36, 2), (0, 0, 3e38)):
        more = replace(
            mesh,
            vertices=np.vstack([np.tile(np.array(place, np.float32), (unused, 1)), mesh.vertices]),
            colors=np.vstack([np.ones((unused, 4), np.float32), mesh.colors]),
            faces=mesh.faces + unused,
        )
        assert_same_bits(render(mesh, view, filter_px2=1.0), render(more, view, filter_px2=1.0))
        for a, b in zip(back(mesh, view=view), back(more, view=view), strict=True):
            assert a.tobytes() == b[unused:].tobytes()
            assert not b[:unused].any()


def test_no_filter_changes_no_bit():
    mesh = fans(4, 60)
    plain = replace(mesh, filter_px2=0)
    assert_same_bits(
        render(mesh, camera(), filter_px2=0, **EXTRAS | {"attributes": ()}),
        render(plain, camera(), **EXTRAS | {"attributes": ()}),
    )
    assert_same_bits(render(plain, camera(), filter_px2=0.3), render(mesh, camera()))
    assert np.abs(render(mesh, camera()).alpha - render(plain, camera()).alpha).max() > 0.01


def test_what_stays_as_it_is():
    """Splats across the near plane; those without area, and single points and lines."""
    for vertices in (
        [(0, 0, 0.4), (1, 0, 2), (0, 1, 2)],  # across the near plane
        [(0, 0, 2), (0, 0, 2), (0, 1, 2)],
        [(0, 0, 2), (0.5, 0.5, 2), (1, 1, 2)],
        [(0, 0, 2)] * 3,
    ):
        mesh = SplatMesh(vertices, [(0, 1, 2)], np.full((3, 4), 0.5), face_splat=[0])
        assert_same_bits(render(mesh, camera(), filter_px2=5), render(mesh, camera()))
    # Just in front of it, a large triangle is moved by next to nothing.
    mesh = SplatMesh(
        [(-1, -1, 0.5000001), (3, -1, 2), (-1, 3, 2)], [(0, 1, 2)], np.full((3, 4), 0.5), face_splat=[0]
    )
    assert_close(render(mesh, camera(), filter_px2=0.3), render(mesh, camera()), tolerance=0.02, flips=0.1)


def test_an_invisible_splat_has_a_shape():
    """Its gradient is that of its contribution, at the position that its filter gives it."""
    mesh, view = diamond((20, 18), (2.0, 2.0), alpha=0.0), plain_camera()
    image = TapedRendering(mesh.triangles._replace(filter_px2=8.0), view, TapeOptions(samples=8))
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)
    nothing, all_pixels = np.zeros_like(image.color), np.ones_like(image.alpha)
    image.backward(nothing, all_pixels, None, vertices=points, colors=colors)
    # Of uniform density, the square has a variance of r^2 / 6: its area grows by 1 + 48 / 4.
    np.testing.assert_allclose(colors[:, 3].sum(), 2 * 4 * 13, rtol=0.01)
    np.testing.assert_array_equal(points, 0)


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())
def test_hostile(view):
    mesh = soup(3)
    own = SplatMesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(180).reshape(-1, 3),
        mesh.colors[mesh.faces].reshape(-1, 4),
        face_splat=np.repeat(np.arange(20), 3),
        depth_group=np.random.default_rng(4).integers(-1, 9, 60),
    )
    rng = np.random.default_rng(5)
    options = {"depth": True, "normals": True}
    for size in (1e-42, 1e-30, 1e-6, 1, 1e6, 1e18, 1e30, 3e38):
        assert_image(
            render(replace(own, vertices=scaled(own.vertices, size)), view, filter_px2=0.3, **options)
        )
        mixed = replace(own, vertices=scaled(own.vertices, 10 ** rng.uniform(-40, 38, (180, 1))))
        assert_image(render(mixed, view, filter_px2=100, samples=3, **options))
        image = TapedRendering(mixed.triangles._replace(face_splat=own.face_splat, filter_px2=0.3), view)
        points, colors = np.zeros_like(mixed.vertices), np.zeros_like(mixed.colors)
        with np.errstate(all="ignore"):
            image.backward(np.ones_like(image.color), None, None, vertices=points, colors=colors)


# Against float64


@pytest.mark.parametrize(("mode", "options"), [*SHAPES, ("flat", STARS)])
def test_equal_to_the_reference(mode, options):
    mesh, view = fans(1, 25, mode, **options), camera()
    assert_mesh_is_exact(mesh, view, depth=True, normals=True)
    for px2 in (0.05, 5.0):
        assert_mesh_is_exact(mesh, view, samples=2, filter_px2=px2)


def test_equal_to_the_reference_in_other_ways():
    near, view = fans(2, 30, z=0.8), camera()
    assert_mesh_is_exact(near, view, filter_px2=1.0)
    assert_mesh_is_exact(replace(near, depth_group=near.face_splat), view, filter_px2=1.0, max_layers=3)
    mesh = fans(3, 20)
    assert_mesh_is_exact(mesh, turned(view, 0), filter_px2=1.0)


def gradient_of(mesh: SplatMesh, view, function, dtype, **options):
    torch = pytest.importorskip("torch", reason="rasterize needs torch: pip install 'meshsplats[torch]'")
    from test_rasterize import gradients

    return gradients(function, getattr(torch, dtype), mesh, [view], face_splat=mesh.face_splat, **options)


@pytest.mark.parametrize(
    ("mesh", "options"),
    [
        (lambda: fans(1, 25), {}),
        (lambda: fans(1, 25), {"filter_px2": 8.0, "samples": 2}),
        (lambda: fans(2, 25, "crossed"), {"filter_px2": 8.0}),
        (lambda: fans(3, 15, "flat", rings=2, sides=5), {"filter_px2": 1.0}),
        (lambda: fans(2, 30, z=0.8), {"filter_px2": 1.0}),
        (lambda: irregular(4, 25), {"filter_px2": 1.0}),
        (lambda: fans(1, 8, **STARS), {"filter_px2": 1.0}),
    ],
    ids=["flat", "samples", "crossed", "rings", "near plane", "irregular", "stars"],
)
def test_gradients_equal_to_float64(mesh, options):
    pytest.importorskip("torch", reason="rasterize needs torch: pip install 'meshsplats[torch]'")
    from test_rasterize import TOLERANCE, error

    from meshsplats.rendering import reference_autograd
    from meshsplats.rendering.autograd import rasterize

    made, view = mesh(), camera(33, 26)
    options = {"filter_px2": 0.3, **options}
    found = gradient_of(made, view, rasterize, "float32", **options)
    truth = gradient_of(made, view, reference_autograd.rasterize, "float64", **options)
    for a, b in zip(found, truth, strict=True):
        assert error(a, b, 1e-3) < TOLERANCE


def test_gradients_by_finite_differences():
    """gradcheck moves every number of the float64 filter: A depends on positions, opacities and pose."""
    torch = pytest.importorskip("torch", reason="rasterize needs torch: pip install 'meshsplats[torch]'")
    from meshsplats.rendering import reference_autograd

    mesh, view = fans(6, 3, "crossed", sizes=(0.05, 0.5)), camera()
    points = torch.from_numpy(to_camera(mesh.vertices, view)).requires_grad_()
    opacity = torch.from_numpy(mesh.colors[:, 3].astype(np.float64)).requires_grad_()

    def places(points, opacity):
        moved = reference_autograd.filtered(points, mesh.faces, opacity, view, mesh.face_splat, 0.7)
        return moved[:, :2] / moved[:, 2:]

    assert torch.autograd.gradcheck(places, (points, opacity), eps=1e-6, atol=1e-6)
    same = reference.filtered(points.detach().numpy(), mesh, view, 0.7)
    moved = reference_autograd.filtered(points, mesh.faces, opacity, view, mesh.face_splat, 0.7)
    np.testing.assert_allclose(moved.detach().numpy(), same, rtol=1e-9, atol=1e-12)


# Threads and variants


def many() -> SplatMesh:
    """More than one thread's share, of fans with different numbers of triangles."""
    mesh = fans(0, 5_000, "crossed", sizes=(0.005, 0.1))
    kept = np.random.default_rng(0).random(len(mesh.faces)) < 0.8
    return replace(mesh, faces=mesh.faces[kept], face_splat=mesh.face_splat[kept])


def back(
    mesh: SplatMesh, threads: int | None = None, view: Camera | None = None
) -> tuple[np.ndarray, np.ndarray]:
    view = view or camera(70, 50)
    image = TapedRendering(mesh.triangles._replace(filter_px2=0.3), view, threads=threads)
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)
    towards = np.random.default_rng(0).normal(size=image.color.shape).astype(np.float32)
    image.backward(towards, None, None, vertices=points, colors=colors)
    return points, colors


def digest() -> str:
    image = render(many(), camera(70, 50), samples=2)
    return hashlib.sha256(image.color.tobytes() + image.alpha.tobytes()).hexdigest()


def test_threads_and_variants_do_not_change_a_bit():
    mesh = many()
    one, gradients = render(mesh, camera(70, 50), threads=1), back(mesh, 1)
    for threads in (2, 7):
        assert_same_bits(one, render(mesh, camera(70, 50), threads=threads))
        assert all(a.tobytes() == b.tobytes() for a, b in zip(gradients, back(mesh, threads), strict=True))
    assert np.isfinite(gradients[0]).all()
    code = "import test_fan_filter as t; from meshsplats._core import library\n"
    code += "print(library.load_core().ms_variant().decode(), t.digest())"
    expected = digest()
    for variant in library.available_variants():
        assert in_another_process(code, MESHSPLATS_VARIANT=variant) == f"{variant} {expected}"


# What is refused


def test_what_cannot_be_filtered():
    mesh = fans(6, 5)
    for px2 in (-0.1, 101, float("nan"), float("inf"), "0.3", True):
        with pytest.raises(ValueError, match="filter_px2 must be a variance in square pixels"):
            replace(mesh, filter_px2=px2)
        with pytest.raises(ValueError, match="filter_px2 must be a variance in square pixels"):
            render(mesh, camera(), filter_px2=px2)
    assert replace(mesh, filter_px2=np.float32(0.5)).filter_px2 == 0.5
    with pytest.raises(ValueError, match="the mesh has no face_splat"):
        replace(mesh, face_splat=None)
    nameless = replace(mesh, filter_px2=0, face_splat=None)
    with pytest.raises(ValueError, match="the mesh has no face_splat"):
        render(nameless, camera(), filter_px2=0.3)
    faces = mesh.faces.copy()
    faces[-1, 0] = faces[0, 0]
    shared = replace(mesh, faces=faces)
    with pytest.raises(ValueError, match="two splats share a vertex"):
        render(shared, camera())
    render(shared, camera(), filter_px2=0)


# Conversion


def test_conversion_for_a_filter():
    cloud = splats(0, 30, degree=0)
    mesh = convert(cloud, footprint="filter")
    plain = convert(cloud, footprint="none")
    assert (mesh.filter_px2, plain.filter_px2) == (0.3, 0)
    assert mesh.vertices.tobytes() == plain.vertices.tobytes()
    assert convert(cloud, footprint="filter", footprint_px2=0.1).filter_px2 == 0.1
    for kernel in ("antialiased", "2dgs"):
        with pytest.raises(ValueError, match=f"kernel '{kernel}', which filters in another way"):
            convert(replace(cloud, kernel=kernel), footprint="filter")


def test_splats_of_any_size_look_as_their_viewer_shows_them():
    """One splat of 0.1 to 2.5 pixels: against the splat's own image, the filter is right where the plain
    conversion is not."""
    from meshsplats import render_splats

    view = camera(64, 64, fx=100.0, fy=100.0)
    for size in (0.002, 0.01, 0.05):
        cloud = replace(
            splats(1, 1, degree=0, opacity=0.8),
            means=np.array([[0.01, 0.02, 2.0]], np.float32),
            scales=np.array([[size, 0.6 * size, 0.01 * size]], np.float32),
        )
        truth = render_splats(cloud, view, background=(0, 0, 0)).alpha
        mesh = convert(cloud, footprint="filter", mode="flat", sides=16, rings=3, shrink_faint=False)
        found = render(mesh, view, background=(0, 0, 0)).alpha
        assert np.abs(found - truth).max() < 0.06, size
        if size < 0.02:
            assert np.abs(render(mesh, view, filter_px2=0).alpha - truth).max() > 0.2
