"""The renderer's gradients: against float64, by hand, and by what must not change them."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from _rendering import camera, fan, layers, soup, turned

from meshsplats import SplatMesh
from meshsplats._core import library
from meshsplats.rendering import reference, render

torch = pytest.importorskip("torch", reason="rasterize needs torch: pip install 'meshsplats[torch]'")

from meshsplats.rendering import reference_autograd  # noqa: E402
from meshsplats.rendering.autograd import rasterize  # noqa: E402

TOLERANCE = 1e-5
"""Of ||g - g64|| / ||g64||, for each array."""


def stack(depths, alpha) -> SplatMesh:
    """Layers that cover the image, with vertices of many colours and opacities of about ``alpha``."""
    mesh = layers(depths, alpha)
    rng = np.random.default_rng(2)
    return replace(mesh, colors=rng.random(mesh.colors.shape) * [1, 1, 1, 2 * alpha])


def scene(name: str):
    """A mesh, its cameras and options that take one of the core's ways."""
    view = camera(48, 40)
    groups = np.random.default_rng(0).integers(-1, 6, 60)
    return {
        "shared vertices": lambda: (soup(0), [view], {}),
        "several cameras, off axis": lambda: (soup(1, view=turned(view, 3)), [turned(view, 3), view], {}),
        "samples": lambda: (soup(2), [view], {"samples": 3}),
        "depth groups": lambda: (replace(soup(3), depth_group=groups), [view], {}),
        "equal depths": lambda: (stack([2.0] * 8 + [2.5] * 8, 0.2), [view], {}),
        "saturated": lambda: (stack(np.linspace(1, 2, 60), 0.5), [view], {}),
        "many layers": lambda: (stack(np.linspace(1, 2, 300), 0.02), [view], {}),
        "across tiles": lambda: (soup(4, 40, spread=(3, 3, 1)), [camera(70, 50)], {}),
        "a fan": lambda: (fan(5, 8, 0.6), [camera(60, 50, fx=60, fy=50)], {}),
        "far smaller than a pixel": lambda: (soup(6, 400, spread=(0.05, 0.05, 0.05)), [view], {}),
        "near plane": lambda: (soup(7, z=0.6), [view], {}),
    }[name]()


SCENES = [
    "shared vertices",
    "several cameras, off axis",
    "samples",
    "depth groups",
    "equal depths",
    "saturated",
    "many layers",
    "across tiles",
    "a fan",
    "far smaller than a pixel",
    "near plane",
]


def gradients(function, dtype, mesh: SplatMesh, cameras, seed: int = 0, extra: int = 2, **options):
    """For random gradients of an image those of vertices, attributes, background and poses."""
    generator = torch.Generator().manual_seed(seed)
    more = torch.randn(len(mesh.vertices), extra, generator=generator)
    view = cameras[0]
    inputs = [
        torch.from_numpy(mesh.vertices),
        torch.cat([torch.from_numpy(mesh.colors), more], dim=1),
        torch.rand(view.height, view.width, 3, generator=generator),
        torch.from_numpy(np.stack([c.world_to_camera for c in cameras])).float(),
    ]
    inputs = [part.to(dtype).clone().requires_grad_() for part in inputs]
    vertices, attributes, background, poses = inputs
    images = function(
        vertices,
        mesh.faces,
        attributes,
        cameras,
        background=background,
        world_to_camera=poses,
        depth_group=mesh.depth_group,
        **options,
    )
    towards = [torch.randn(part.shape, generator=generator).to(dtype) for part in images]
    torch.autograd.backward(images, towards)
    return [part.grad for part in inputs]


def error(found, truth, least: float = 0) -> float:
    """``least``: what a number of ``truth`` typically is, if it may be next to nothing."""
    return float((found.double() - truth).norm() / max(truth.norm(), least * truth.numel() ** 0.5))


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", SCENES)
def test_equal_to_float64(name):
    mesh, cameras, options = scene(name)
    found = gradients(rasterize, torch.float32, mesh, cameras, **options)
    truth = gradients(reference_autograd.rasterize, torch.float64, mesh, cameras, **options)
    for array, (a, b) in zip(
        ("vertices", "attributes", "background", "poses"), zip(found, truth, strict=True), strict=True
    ):
        # No light reaches the background of a saturated scene: 1e-6 of it is what the renderer may leave out.
        assert error(a, b, 0.1 if array == "background" else 0) < TOLERANCE, array
        assert a.dtype == torch.float32


@pytest.mark.slow
def test_reference_by_finite_differences():
    """gradcheck moves every number of the float64 twin."""
    mesh, view = soup(8, 9), camera(5, 4, cx=2.5, cy=2.0, fx=4, fy=5)
    vertices = torch.from_numpy(mesh.vertices).double().requires_grad_()
    attributes = (
        torch.from_numpy(np.concatenate([mesh.colors, mesh.attributes["flow"]], 1)).double().requires_grad_()
    )
    background = torch.rand(
        3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    ).requires_grad_()
    pose = torch.from_numpy(view.world_to_camera).requires_grad_()

    def images(vertices, attributes, background, pose):
        return tuple(
            reference_autograd.rasterize(
                vertices, mesh.faces, attributes, view, background=background, world_to_camera=pose
            )
        )

    assert torch.autograd.gradcheck(images, (vertices, attributes, background, pose), eps=1e-7, atol=1e-5)


def test_image_moves_as_its_gradient_says():
    """Where no edge is in the image, the reference renderer itself shows what a small move does."""
    mesh, view = layers([1.2, 1.5, 2.0, 2.2], [0.3, 0.6, 0.2, 0.9]), camera(20, 16)
    rng = np.random.default_rng(0)
    mesh = replace(mesh, colors=rng.random(mesh.colors.shape))
    weights = rng.normal(size=(16, 20, 3))
    vertices = torch.from_numpy(mesh.vertices).clone().requires_grad_()
    color = rasterize(vertices, mesh.faces, torch.from_numpy(mesh.colors), view).color
    (color * torch.from_numpy(weights)).sum().backward()
    for step in (1e-3, -1e-3):
        direction = rng.normal(size=mesh.vertices.shape)
        moved = replace(mesh, vertices=mesh.vertices + np.float32(step * direction))
        change = ((reference.render(moved, view).color - reference.render(mesh, view).color) * weights).sum()
        expected = (vertices.grad.numpy() * (moved.vertices - mesh.vertices)).sum()
        np.testing.assert_allclose(change, expected, rtol=0.02)


def one_pixel(colors, **options):
    """Colour (3,) of a pixel under layers of these RGBA, nearest first, and the gradients of its sum."""
    mesh = layers(np.arange(1, len(colors) + 1), 1)
    rgba = torch.tensor(np.repeat(np.array(colors, np.float32), 3, axis=0), requires_grad=True)
    color = rasterize(torch.from_numpy(mesh.vertices), mesh.faces, rgba, camera(1, 1), **options).color[0, 0]
    color.sum().backward()
    return color.detach().numpy(), rgba.grad.reshape(len(colors), 3, 4).sum(dim=1).numpy()


def test_two_layers_by_hand():
    color, found = one_pixel([(0.8, 0.2, 0.1, 0.5), (0.1, 0.6, 0.3, 0.25)], background=(1, 1, 1))
    np.testing.assert_allclose(
        color, [0.5 * 0.8 + 0.125 * 0.1 + 0.375, 0.55, 0.05 + 0.0375 + 0.375], rtol=1e-6
    )
    # Front: T a = 0.5, and c - B summed, with B = 0.25 c + 0.75 of white. Back: T a = 0.125, T (c - white).
    behind = 0.25 * 1.0 + 0.75 * 3
    np.testing.assert_allclose(
        found, [[0.5, 0.5, 0.5, 1.1 - behind], [0.125, 0.125, 0.125, 0.5 * (1 - 3)]], rtol=1e-6
    )


def test_opaque_layer_knows_what_is_behind():
    """Red before green before blue, all opaque: red's opacity changes red into green, nothing else counts."""
    color, found = one_pixel([(1, 0, 0, 1), (0, 0.5, 0, 1), (0, 0, 1, 1)])
    np.testing.assert_array_equal(color, [1, 0, 0])
    np.testing.assert_allclose(found[0], [1, 1, 1, 1 - 0.5], rtol=1e-6)
    np.testing.assert_array_equal(found[1:], 0)


def test_opaque_layer_can_become_translucent():
    mesh = layers([1, 2], 1)
    rgba = np.repeat(np.array([(1, 0, 0, 1), (0, 1, 0, 1)], np.float32), 3, axis=0)
    opacity = torch.ones(3, 1, requires_grad=True)
    truth = torch.tensor([0.0, 1, 0])
    for _ in range(40):
        colors = torch.from_numpy(rgba)
        colors = torch.cat([torch.cat([colors[:3, :3], opacity], dim=1), colors[3:]])
        color = rasterize(torch.from_numpy(mesh.vertices), mesh.faces, colors, camera(4, 4)).color
        loss = ((color - truth) ** 2).mean()
        loss.backward()
        with torch.no_grad():
            opacity -= opacity.grad
            opacity.clamp_(0, 1)
        opacity.grad = None
    assert loss < 1e-3
    assert opacity.max() < 0.05


def test_face_without_opacity_can_appear():
    """Alpha 0: no gradient of colour, but one of alpha, c - B."""
    _, found = one_pixel([(0.2, 0.2, 0.2, 0), (0.5, 0.5, 0.5, 0.5)], background=(0, 0, 0))
    np.testing.assert_allclose(found[0], [0, 0, 0, 0.6 - 0.75], rtol=1e-6)


def test_background_and_alpha():
    mesh, view = soup(9), camera()
    background = torch.rand(3, requires_grad=True, generator=torch.Generator().manual_seed(0))
    image = rasterize(
        torch.from_numpy(mesh.vertices),
        mesh.faces,
        torch.from_numpy(mesh.colors),
        [view, view],
        background=background,
    )
    image.color.sum().backward()
    expected = 2 * (1 - render(mesh, view).alpha).sum()
    np.testing.assert_allclose(background.grad.numpy(), [expected] * 3, rtol=1e-5)


def test_unseen_vertices_have_no_gradient():
    mesh, view = soup(10, 200, spread=(8, 8, 1)), camera()
    found = gradients(rasterize, torch.float32, mesh, [view])
    one_by_one = [render(replace(mesh, faces=mesh.faces[i : i + 1]), view).fragments for i in range(200)]
    seen = np.unique(mesh.faces[np.array(one_by_one) > 0])
    unseen = np.setdiff1d(np.arange(len(mesh.vertices)), seen)
    assert len(unseen) > 20
    for part in found[:2]:
        np.testing.assert_array_equal(part[unseen].numpy(), 0)
        assert (part[seen] != 0).any()


SCENES = "several cameras, off axis", "samples", "depth groups", "many layers", "near plane"


def all_gradients(**options) -> list[np.ndarray]:
    found = []
    for name in SCENES:
        mesh, cameras, others = scene(name)
        found += [g.numpy() for g in gradients(rasterize, torch.float32, mesh, cameras, **others, **options)]
    return found


def digest(**options) -> str:
    total = hashlib.sha256()
    for part in all_gradients(**options):
        total.update(part.tobytes())
    return total.hexdigest()


def test_same_bits_whatever_the_threads_and_the_log():
    expected = digest(threads=1)
    assert digest(threads=1, seed=1) != expected
    for options in ({"threads": 2}, {"threads": 5}, {"tape_bytes": 0}, {"tape_bytes": 3000, "threads": 3}):
        assert digest(**options) == expected, options


def test_calls_at_the_same_time_do_not_disturb_each_other():
    """Meshes whose arrays are large enough to be kept for the next call, of several sizes."""

    def digest_of(number: int) -> bytes:
        rng = np.random.default_rng(number)
        points = rng.normal(size=(3 * (1500 + 900 * number), 3)) * [1, 1, 0.5] + [0, 0, 2.5]
        mesh = SplatMesh(points, np.arange(len(points)).reshape(-1, 3), rng.random((len(points), 4)) * 0.2)
        total = hashlib.sha256()
        for part in gradients(rasterize, torch.float32, mesh, [camera(64, 48)], extra=0, threads=2):
            total.update(part.numpy().tobytes())
        return total.digest()

    numbers = list(range(5)) * 4
    alone = [digest_of(number) for number in range(5)]
    assert len(set(alone)) == 5
    with ThreadPoolExecutor(5) as pool:
        assert list(pool.map(digest_of, numbers)) == [alone[number] for number in numbers]


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("variant", library.VARIANTS)
def test_same_gradients_on_every_instruction_set(variant, tmp_path):
    """But for rounding: fused multiply-adds are used where there are some. (Images: the same bits.)"""
    if variant not in library.available_variants():
        pytest.skip(f"this processor or build has no variant {variant}")
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; import numpy as np, test_rasterize as t; "
        f"np.savez({str(tmp_path / 'found.npz')!r}, *t.all_gradients())"
    )
    environment = {**os.environ, "MESHSPLATS_VARIANT": variant}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    expected = all_gradients()
    with np.load(tmp_path / "found.npz") as found:
        assert len(found.files) == len(expected) == 20
        for name, part in zip(found.files, expected, strict=True):
            assert np.linalg.norm(found[name] - part) <= TOLERANCE * np.linalg.norm(part)


@pytest.mark.slow
def test_more_entries_than_are_kept_at_once():
    """1,100 layers over a tile, each an entry in 16 blocks."""
    mesh, view = stack(np.linspace(1, 2, 1100), 0.002), camera(16, 16)
    found = gradients(rasterize, torch.float32, mesh, [view], extra=0)
    truth = gradients(reference_autograd.rasterize, torch.float64, mesh, [view], extra=0)
    assert error(found[0], truth[0]) < TOLERANCE
    assert error(found[1], truth[1]) < TOLERANCE


def test_without_gradients_it_is_render():
    mesh, view = soup(11), camera()
    points, colors = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.colors)
    expected = render(mesh, view, background=(0.1, 0.2, 0.3), samples=2)
    with torch.no_grad():
        fast = rasterize(
            points.requires_grad_(), mesh.faces, colors, view, background=(0.1, 0.2, 0.3), samples=2
        )
    slow = rasterize(points, mesh.faces, colors, view, background=(0.1, 0.2, 0.3), samples=2)
    assert slow.color.requires_grad
    assert not fast.color.requires_grad
    for image in (fast, slow):
        np.testing.assert_array_equal(image.color.detach().numpy(), expected.color)
        np.testing.assert_array_equal(image.alpha.detach().numpy(), expected.alpha)
        assert image.attributes.shape == (view.height, view.width, 0)


def test_only_what_is_asked_for():
    mesh, view = soup(12), camera()
    points, colors = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.colors)
    rasterize(points, mesh.faces, colors.requires_grad_(), view).alpha.sum().backward()
    assert points.grad is None
    assert (colors.grad[:, 3] > 0).any()
    assert (colors.grad[:, :3] == 0).all()


def test_backward_twice_and_second_derivatives():
    mesh, view = soup(13), camera()
    points = torch.from_numpy(mesh.vertices).clone().requires_grad_()
    colors = torch.from_numpy(mesh.colors)
    total = rasterize(points, mesh.faces, colors, view).color.square().sum()
    (once,) = torch.autograd.grad(total, points, retain_graph=True)
    (again,) = torch.autograd.grad(total, points, create_graph=True)
    assert torch.equal(once, again)
    with pytest.raises(RuntimeError, match=r"once_differentiable|twice|second"):
        again.sum().backward()


def test_vertices_changed_in_place():
    mesh, view = soup(14), camera()
    points, colors = (
        torch.from_numpy(mesh.vertices).clone(),
        torch.from_numpy(mesh.colors).clone().requires_grad_(),
    )
    total = rasterize(points, mesh.faces, colors, view).color.sum()
    points += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


def test_indices_and_arrays_that_change_before_the_backward_pass_are_those_of_the_image():
    mesh, view = soup(14), camera()
    colors = torch.from_numpy(mesh.colors)

    def gradient(change) -> torch.Tensor:
        points = torch.from_numpy(mesh.vertices).clone().requires_grad_()
        faces, splat = torch.from_numpy(mesh.faces).clone(), np.arange(len(mesh.faces), dtype=np.int32)
        group, background = np.full(len(mesh.faces), -1, np.int32), np.zeros(3, np.float32)
        options = {"face_splat": splat, "depth_group": group, "background": background, "order": "splat"}
        total = rasterize(points, faces, colors, view, **options).color.square().sum()
        if change:
            faces.copy_(faces.flip(0))
            splat[:], group[:], background[:] = 0, 0, 1
        total.backward()
        return points.grad

    assert torch.equal(gradient(True), gradient(False))


META = torch.zeros(1, 3, dtype=torch.int32, device="meta")


def test_empty_mesh():
    points, colors = torch.zeros(0, 3, requires_grad=True), torch.zeros(0, 4, requires_grad=True)
    image = rasterize(points, np.zeros((0, 3), np.int32), colors, camera(), background=(0.5, 0.25, 0))
    image.color.sum().backward()
    assert (image.color == torch.tensor([0.5, 0.25, 0])).all()
    assert points.grad.shape == (0, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vertices": torch.zeros(5, 3, dtype=torch.float64)}, r"vertices must be \(v, 3\) float32"),
        ({"vertices": torch.zeros(5, 2)}, r"vertices must be \(v, 3\)"),
        ({"attributes": torch.zeros(5, 3)}, r"attributes must be \(5, 4 \+ k\)"),
        ({"attributes": torch.zeros(4, 4)}, r"attributes must be \(5, 4 \+ k\)"),
        ({"faces": np.array([[0, 1, 5]])}, "faces must be vertex indices from 0 to 4, got 0 to 5"),
        ({"faces": np.array([[0, -1, 2]])}, "faces must be vertex indices from 0 to 4, got -1 to 2"),
        ({"faces": np.zeros((1, 3))}, "faces must be"),
        ({"face_splat": np.zeros(2, np.int32)}, r"face_splat must be \(1,\)"),
        ({"depth_group": np.zeros(1)}, r"depth_group must be \(1,\)"),
        ({"background": torch.zeros(4)}, "background must have shape"),
        ({"background": (np.nan, 0, 0)}, "background must be finite"),
        ({"world_to_camera": torch.eye(3)[None]}, "world_to_camera must have shape"),
        ({"world_to_camera": torch.full((1, 4, 4), torch.nan)}, "world_to_camera must be finite"),
        ({"world_to_camera": torch.zeros(1, 4, 4)}, "number 0 flattens space"),
        (
            {"face_splat": np.array([1, 0]), "faces": np.array([[0, 1, 2]] * 2)},
            "face_splat must be ascending",
        ),
        ({"faces": META}, r"faces must be on the CPU, got a tensor on meta: give faces\.cpu\(\)"),
        ({"face_splat": META}, "face_splat must be on the CPU"),
        ({"background": META}, "background must be on the CPU"),
        ({"world_to_camera": torch.zeros(1, 4, 4, device="meta")}, "world_to_camera must be on the CPU"),
        ({"cameras": []}, "at least one camera"),
        ({"cameras": [camera(4, 4), camera(4, 5)]}, "one size"),
        ({"samples": 0}, "samples"),
        ({"threads": 0}, "threads"),
        ({"min_transmittance": 1.0}, "min_transmittance"),
    ],
)
def test_wrong_arguments(changes, message):
    arguments = {
        "vertices": torch.zeros(5, 3),
        "faces": np.array([[0, 1, 2]]),
        "attributes": torch.zeros(5, 4),
        "cameras": camera(4, 4),
        **changes,
    }
    with pytest.raises(ValueError, match=message):
        rasterize(**arguments)
