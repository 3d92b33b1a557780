"""Blending in the order of a file: image and gradients against float64, and that against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _rendering import TOLERANCE, camera, layers, soup
from _splats import few_splats

from meshsplats import SplatMesh, convert, drawing_order, look_at, orbit
from meshsplats.rendering import reference_listed
from meshsplats.rendering.backward import OpacityRamp, TapedRendering, TapeOptions
from meshsplats.rendering.viewers import ordered_image
from meshsplats.scene.draw_order import DrawOrder


def shuffled(mesh: SplatMesh, nodes: int = 1, seed: int = 0) -> DrawOrder:
    """Any order, of nodes by the numbers of the triangles."""
    f = len(mesh.faces)
    copies = np.random.default_rng(seed).permutation(2 * f)
    node = copies % f * nodes // f
    copies = copies[np.argsort(node, kind="stable")]
    return DrawOrder(copies, np.searchsorted(np.sort(node), np.arange(nodes + 1)))


def fans() -> SplatMesh:
    mesh = convert(few_splats())
    colors = mesh.colors + np.random.default_rng(1).normal(0, 0.1, mesh.colors.shape)
    return replace(mesh, colors=colors.clip(0, 1))


def uneven(mesh: SplatMesh) -> SplatMesh:
    """The same with other colours at every vertex."""
    rng = np.random.default_rng(2)
    return replace(mesh, colors=(mesh.colors * rng.uniform(0.5, 1, mesh.colors.shape)))


SCENES = {
    "triangles": (soup(1), 1),
    "nodes": (soup(2, 90), 4),
    "near plane": (soup(7, z=0.6), 2),
    "opaque": (replace(soup(3), colors=soup(3).colors.clip([0, 0, 0, 1], 1)), 1),
    "many layers": (uneven(layers(np.linspace(1, 2, 300), 0.02)), 3),
    "numbered splats": (replace(soup(4, 90), face_splat=np.arange(90) // 7), 2),
}


def painted(mesh, order, view, towards, samples=1, **options):
    image = TapedRendering(
        mesh.triangles,
        view,
        TapeOptions((0.2, 0.5, 0.9), samples, 0.0, listing=order),
        **options,
    )
    found = [np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)]
    image.backward(towards, None, None, vertices=found[0], colors=found[1])
    return image.color, *found


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("samples", [1, 2])
def test_equal_to_float64(name, samples):
    mesh, nodes = SCENES[name]
    order, view = shuffled(mesh, nodes), camera()
    towards = np.random.default_rng(0).normal(size=(view.height, view.width, 3)).astype(np.float32)
    color, *found = painted(mesh, order, view, towards, samples)
    truth = reference_listed.paint(mesh, order, view, towards, background=(0.2, 0.5, 0.9), samples=samples)
    assert (np.abs(color - truth.color) > TOLERANCE).mean() < 1e-3
    for a, b in zip(found, truth[1:], strict=True):
        assert np.abs(b).max() > 1e-3
        assert np.linalg.norm(a - b) < 2e-3 * np.linalg.norm(b), np.linalg.norm(a - b) / np.linalg.norm(b)


@pytest.mark.slow
def test_the_reference_agrees_with_differences():
    mesh, view = fans(), orbit(fans(), 1, width=24, height=20)[0]
    order = drawing_order(mesh, nodes=2)
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(20, 24, 3))

    def loss(vertices, colors):
        moved = replace(mesh, vertices=vertices, colors=colors)
        return (reference_listed.paint(moved, order, view, towards).color * towards).sum()

    _, of_vertices, of_colors = reference_listed.paint(mesh, order, view, towards)
    step = rng.normal(size=mesh.colors.shape) * ((mesh.colors > 0.01) & (mesh.colors < 0.99)) * 1e-3
    difference = loss(mesh.vertices, mesh.colors + step) - loss(mesh.vertices, mesh.colors - step)
    assert difference / 2 == pytest.approx((of_colors * step).sum(), rel=1e-3)
    # Rims are transparent, so that what a sample sees does not jump where vertices move.
    step = rng.normal(size=mesh.vertices.shape) * 2e-5
    difference = loss(mesh.vertices + step, mesh.colors) - loss(mesh.vertices - step, mesh.colors)
    assert difference / 2 == pytest.approx((of_vertices * step).sum(), rel=0.02)


def test_threads_and_tapes_change_nothing():
    mesh = fans()
    order, view = drawing_order(mesh, nodes=4), orbit(mesh, 1, width=90, height=70)[0]
    towards = np.random.default_rng(0).normal(size=(70, 90, 3)).astype(np.float32)
    one = painted(mesh, order, view, towards, threads=1)
    for options in ({"threads": 3}, {"tape_bytes": 0}, {"tape_bytes": 20_000, "threads": 2}):
        for a, b in zip(one, painted(mesh, order, view, towards, **options), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("nodes", [1, 5])
def test_what_is_tuned_is_what_viewers_show(nodes):
    mesh = fans()
    order = drawing_order(mesh, nodes=nodes)
    for view in orbit(mesh, 3, elevation=20, width=64, height=64):
        shown = ordered_image(mesh, order, view, multisample=False)
        image = TapedRendering(mesh.triangles, view, TapeOptions(listing=order)).color
        np.testing.assert_allclose(image, shown, atol=0.03)  # viewers round after each fragment


def test_each_side_has_its_own_order():
    """Red is listed last for the eye at z < 0, green for the one at z > 0."""
    corners = np.array([(-4, -4), (12, -4), (-4, 12)], float)
    vertices = np.concatenate([np.column_stack([corners, np.full(3, z)]) for z in (-0.1, 0.1)])
    colors = np.repeat([(1, 0, 0, 1), (0, 1, 0, 1)], 3, axis=0)
    mesh = SplatMesh(vertices, np.arange(6).reshape(2, 3), colors)
    order = DrawOrder(np.array([3, 2, 0, 1]), np.array([0, 4]))  # as they are, they face z > 0
    for z, expected in ((5, (0, 1, 0)), (-5, (1, 0, 0))):
        view = look_at((0, 0, z), (0, 0, 0), up=(0, 1, 0), width=8, height=8, fov=20)
        image = TapedRendering(mesh.triangles, view, TapeOptions(listing=order)).color
        np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape))


def test_kept_triangles_keep_their_order():
    mesh = soup(5, 40)
    order, keep = shuffled(mesh, 3), np.random.default_rng(0).random(40) < 0.5
    keep[:14] = False  # the first node goes
    kept = order.take(keep)
    part = mesh.take(keep)
    np.testing.assert_array_equal(
        kept.listed(part.vertices[part.faces]),
        np.array([face for face in order.listed(mesh.vertices[mesh.faces]) if _is_in(face, part)]),
    )
    assert kept.node_count == 2
    assert (order.take(np.ones(40, bool)).copies == order.copies).all()


def _is_in(face: np.ndarray, mesh: SplatMesh) -> bool:
    corners = mesh.vertices[mesh.faces]
    return bool(
        (corners == face).all(axis=(1, 2)).any() or (corners[:, [0, 2, 1]] == face).all(axis=(1, 2)).any()
    )


def test_wrong_options_are_named():
    mesh, view = soup(0), camera()
    order = shuffled(mesh)
    with pytest.raises(ValueError, match="the order is of 60 triangles, the mesh has 90"):
        TapedRendering(soup(0, 90).triangles, view, TapeOptions(listing=order))
    with pytest.raises(ValueError, match="needs filter_px2=0"):
        TapedRendering(mesh.triangles._replace(filter_px2=0.3), view, TapeOptions(listing=order))
    with pytest.raises(ValueError, match="ramp"):
        TapedRendering(mesh.triangles, view, TapeOptions(listing=order, ramp=OpacityRamp(0.5)))
