"""Whole splats in the order of their centres: by hand, against float64, and by what must change nothing."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from _rendering import (
    EXTRAS,
    TOLERANCE,
    assert_close,
    assert_mesh_is_exact,
    assert_same_bits,
    camera,
    layers,
    soup,
    splats,
    turned,
)
from test_rendering_variants import in_another_process

from meshsplats import Camera, SplatMesh, convert
from meshsplats._core import library
from meshsplats.rendering import reference, render
from meshsplats.rendering.backward import OpacityRamp, TapedRendering, TapeOptions

DEEP = "more layers than a chunk"


def view_of(name: str, width: int = 37, height: int = 29) -> Camera:
    """For a scene. All of the layers of ``DEEP`` are in every pixel: blocks of two sizes are enough."""
    return camera(7, 5) if name == DEEP else camera(width, height)


def scenes() -> dict[str, tuple[SplatMesh, dict]]:
    """Meshes in the order of their splats, each with options, that take the core's ways."""

    def fans(seed: int, n: int, mode: str = "3d", **options) -> SplatMesh:
        mesh = convert(splats(seed, n, degree=0, sizes=(0.05, 0.6)), mode=mode, min_opacity=0, **options)
        rng = np.random.default_rng(seed)
        # Tuned meshes have colours that vary.
        colors = (mesh.colors + rng.normal(0, 0.1, mesh.colors.shape)).clip(0, 1)
        attributes = {"heat": rng.normal(size=len(colors)), "flow": rng.normal(size=(len(colors), 2))}
        return replace(mesh, order="splat", colors=colors, attributes=attributes)

    def numbered(mesh: SplatMesh, per: int, **fields) -> SplatMesh:
        return replace(mesh, face_splat=np.arange(len(mesh.faces)) // per, order="splat", **fields)

    stack = layers(np.linspace(1, 2, 300), 0.02)
    long = soup(3, 400, spread=(0.7, 0.7, 0.5), z=3.5)
    return {
        "planes of splats": (fans(0, 60), {}),
        "flat splats": (fans(1, 80, "flat"), {}),
        "samples": (fans(2, 40), {"samples": 3}),
        "a filter": (fans(3, 40, footprint="filter"), {}),
        "splats of one to three triangles": (
            replace(
                numbered(soup(4, 90), 1), face_splat=np.sort(np.random.default_rng(0).integers(0, 45, 90))
            ),
            {},
        ),
        "splats of more triangles than a group": (numbered(long, 150), {}),
        "one splat": (numbered(long, 400), {}),
        "near plane": (numbered(soup(7, z=0.6), 4), {}),
        "opaque": (replace(fans(8, 60), colors=np.ones((len(fans(8, 60).colors), 4))), {}),
        "equal depths": (numbered(layers([2.0] * 12, 0.3), 2), {}),
        "many layers": (numbered(stack, 1), {}),
        DEEP: (numbered(layers(np.linspace(1, 2, 2500), 0.002), 3), {}),
        "depth groups": (numbered(soup(9), 3, depth_group=np.arange(60) // 10), {}),
    }


SCENES = scenes()


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("extras", [{}, EXTRAS], ids=["color", "all outputs"])
def test_equal_to_float64(name, extras):
    mesh, options = SCENES[name]
    if extras and not mesh.attributes:
        extras = {"depth": True, "normals": True}
    assert_mesh_is_exact(mesh, view_of(name), **options, **extras)


@pytest.mark.parametrize("most", [1, 3])
def test_nearest_layers_alone(most):
    assert_mesh_is_exact(SCENES["planes of splats"][0], camera(), max_layers=most, depth=True)


def test_the_order_is_another():
    """Else nothing here would tell one order from the other."""
    mesh, view = SCENES["planes of splats"][0], camera()
    difference = render(mesh, view).color - render(mesh, view, order="fragment").color
    assert np.abs(difference).max() > 1000 * TOLERANCE


def test_order_of_the_mesh_and_of_the_call():
    mesh, view = SCENES["planes of splats"][0], camera()
    exact = replace(mesh, order="fragment")
    assert_same_bits(render(mesh, view), render(exact, view, order="splat"))
    assert_same_bits(render(exact, view), render(mesh, view, order="fragment"))


def crossed(first: float, second: float) -> SplatMesh:
    """Two opaque splats that cover the image: red tilted about depth ``first``, green at ``second``."""
    mesh = layers([1.0, 1.0], 1, [(1, 0, 0), (0, 1, 0)])
    corners = mesh.vertices.reshape(2, 3, 3).copy()
    corners[..., :2] -= corners[..., :2].mean(axis=1, keepdims=True)
    corners[0, :, 2] = first + np.array([-0.5, 0.25, 0.25])
    corners[1, :, 2] = second
    return replace(mesh, vertices=corners.reshape(-1, 3), face_splat=[0, 1], order="splat")


@pytest.mark.parametrize(
    ("second", "nearer"), [(2.01, 0), (1.99, 1), (2.0, 1)], ids=["behind", "before", "of two the later"]
)
def test_centres_decide_and_not_the_depth_at_the_pixel(second, nearer):
    """Each is in front of the other somewhere in the image, sample by sample."""
    mesh, view = crossed(2.0, second), camera(8, 8, fx=8, fy=8, cx=4, cy=4)
    exact = render(mesh, view, order="fragment").color
    drawn = render(mesh, view).color
    assert (exact[..., 0] > 0.5).any()
    assert (exact[..., 1] > 0.5).any()
    np.testing.assert_array_equal(drawn, np.broadcast_to(np.eye(3)[nearer], drawn.shape))


def test_later_triangles_of_a_splat_are_in_front():
    mesh = replace(layers([1, 2, 3], 1), face_splat=[0, 0, 0], order="splat")
    color = render(mesh, camera(1, 1)).color[0, 0]
    np.testing.assert_array_equal(color, mesh.colors[6, :3])
    np.testing.assert_array_equal(
        render(mesh, camera(1, 1), order="fragment").color[0, 0], mesh.colors[0, :3]
    )


def test_splats_that_do_not_overlap_look_as_by_the_fragment():
    mesh = replace(layers(np.linspace(1, 3, 20), 0.3), face_splat=np.arange(20), order="splat")
    assert_close(render(mesh, camera()), render(mesh, camera(), order="fragment"), flips=0)


@pytest.mark.parametrize(
    "name", ["planes of splats", "splats of more triangles than a group", "equal depths"]
)
def test_threads_change_nothing(name):
    mesh, options = SCENES[name]
    assert_same_bits(*(render(mesh, camera(90, 70), threads=n, **options, depth=True) for n in (1, 3)))


def digest() -> str:
    found = hashlib.sha256()
    for name in ("planes of splats", "a filter", "near plane"):
        image = render(SCENES[name][0], camera(50, 40), depth=True)
        for part in (image.color, image.alpha, image.depth):
            found.update(part.tobytes())
    return found.hexdigest()


@pytest.mark.slow
@pytest.mark.parametrize("variant", library.available_variants())
def test_every_instruction_set_draws_the_same_bits(variant):
    code = "import test_splat_order; print(test_splat_order.digest())"
    assert in_another_process(code, MESHSPLATS_VARIANT=variant, MESHSPLATS_LIBRARY="") == digest()


def test_what_has_no_order_by_the_splat():
    mesh, view = soup(0), camera()
    for refused in (lambda: render(mesh, view, order="splat"), lambda: replace(mesh, order="splat")):
        with pytest.raises(ValueError, match=r"order='splat' .*no face_splat: .* or order='fragment'"):
            refused()
    with pytest.raises(ValueError, match="order must be 'fragment' or 'splat', got 'file'"):
        render(mesh, view, order="file")
    known = SCENES["planes of splats"][0]
    with pytest.raises(ValueError, match="order='splat' blends splats, and a cutoff"):
        render(known, view, order="splat", cutoff=0.5)
    with pytest.raises(ValueError, match=r"ramp .*order='fragment'"):
        TapedRendering(known.triangles, view, TapeOptions(ramp=OpacityRamp(0.5)))


def test_cut_triangles_have_a_depth_buffer():
    mesh, view = SCENES["planes of splats"][0], camera()
    assert_same_bits(
        render(mesh, view, cutoff=0.3), render(replace(mesh, order="fragment"), view, cutoff=0.3)
    )
    assert_close(render(mesh, view, cutoff=0.3), reference.render(mesh, view, cutoff=0.3))


# ---- Gradients


def gradients(mesh: SplatMesh, *, view=None, threads=None, tape_bytes=1 << 27, extra=True):
    """Of positions, colours and attributes, for random gradients of an image."""
    view = view or camera(48, 40)
    rng = np.random.default_rng(0)
    values = rng.normal(size=(len(mesh.vertices), 2)).astype(np.float32) if extra else None
    triangles = mesh.triangles._replace(values=values)
    image = TapedRendering(triangles, view, threads=threads, tape_bytes=tape_bytes)
    towards = [rng.normal(size=(view.height, view.width, n)).astype(np.float32) for n in (3, 1, 2)]
    found = [np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)]
    more = np.zeros_like(values) if extra else None
    image.backward(
        towards[0],
        towards[1][..., 0].copy(),
        towards[2] if extra else None,
        vertices=found[0],
        colors=found[1],
        vertex_attributes=more,
    )
    return [*found, more] if extra else found


def test_one_picture_with_a_tape_and_without():
    for name in ("planes of splats", "opaque", "a filter"):
        mesh, view = SCENES[name][0], camera(48, 40)
        image = TapedRendering(mesh.triangles, view)
        np.testing.assert_array_equal(image.color, render(mesh, view).color)


@pytest.mark.parametrize("name", ["planes of splats", "opaque", "near plane", DEEP])
def test_threads_and_tapes_change_no_gradient(name):
    mesh = SCENES[name][0]
    one = gradients(mesh, threads=1)
    for options in ({"threads": 3}, {"tape_bytes": 0}, {"tape_bytes": 20_000, "threads": 2}):
        for a, b in zip(one, gradients(mesh, **options), strict=True):
            np.testing.assert_array_equal(a, b)


torch_scenes = [name for name in SCENES if name != "opaque"]


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", torch_scenes)
def test_gradients_equal_to_float64(name):
    torch = pytest.importorskip("torch", reason="rasterize needs torch: pip install 'meshsplats[torch]'")
    import test_rasterize

    from meshsplats.rendering import reference_autograd
    from meshsplats.rendering.autograd import rasterize

    mesh, options = SCENES[name]
    options = options | {"face_splat": mesh.face_splat, "filter_px2": mesh.filter_px2, "order": "splat"}
    views = [view_of(name, 48, 40)]
    if name == "planes of splats":
        views.append(turned(views[0], 3))
    found = test_rasterize.gradients(rasterize, torch.float32, mesh, views, **options)
    truth = test_rasterize.gradients(reference_autograd.rasterize, torch.float64, mesh, views, **options)
    for array, a, b in zip(("vertices", "attributes", "background", "poses"), found, truth, strict=True):
        least = 0.1 if array == "background" else 0
        assert test_rasterize.error(a, b, least) < test_rasterize.TOLERANCE, array


def test_an_opaque_splat_knows_what_is_behind():
    mesh = replace(layers([1, 2, 3], 1, np.eye(3)), face_splat=[0, 1, 2], order="splat")
    _, colors = gradients(mesh, view=camera(1, 1), extra=False)
    found = colors.reshape(3, 3, 4).sum(axis=1)
    rng = np.random.default_rng(0)
    color = rng.normal(size=(1, 1, 3))[0, 0]  # as in gradients()
    np.testing.assert_allclose(found[0, :3], color, rtol=1e-6)
    np.testing.assert_allclose(found[0, 3], color[0] - color[1], rtol=1e-5)
    np.testing.assert_array_equal(found[1:], 0)
