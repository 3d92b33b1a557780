"""View-dependent colours: the core's shading against its definition, its gradients, and its laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _rendering import camera, splats, turned

from meshsplats import GaussianCloud, SplatMesh, convert, render
from meshsplats.rendering import reference
from meshsplats.rendering.shading import Shading, seen_from, shaded
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import MAX_COLOR
from meshsplats.scene.spherical_harmonics import harmonics_map, sh_basis, turned_harmonics

DEGREES = (1, 2, 3)


def colorful(degree: int, seed: int = 0, count: int = 40) -> SplatMesh:
    """A converted cloud in front of ``camera()``, with strong harmonics."""
    rng = np.random.default_rng(seed)
    cloud = splats(seed, count)
    sh = rng.normal(0, 0.7, (len(cloud), (degree + 1) ** 2, 3))
    return convert(replace(cloud, sh=sh))


@pytest.mark.parametrize("degree", DEGREES)
def test_the_core_shades_as_defined(degree):
    mesh, view = colorful(degree), turned(camera(), 1)
    seen = shaded(mesh.triangles, view).colors
    assert mesh.sh_degree == degree
    assert np.abs(seen - reference.shaded_colors(mesh, view)).max() < 2e-6
    assert (seen[:, 3] == mesh.colors[:, 3]).all()
    assert (seen[:, :3] == 0).any()  # the clamp acts
    assert np.abs(seen - mesh.colors).max() > 0.1


def test_a_triangle_that_is_bright_from_one_side():
    """By hand: the third harmonic is -sqrt(3 / (4 pi)) x; a camera that looks along +x sees d = (1, 0, 0)."""
    corners = np.array([[0, 0, 0], [0, 1e-6, 0], [0, 0, 1e-6]])
    harmonics = np.zeros((1, 3, 3))
    harmonics[0, 2] = [-1, 0, 1]
    mesh = SplatMesh(corners, [[0, 1, 2]], [[0.5, 0.5, 0.2, 1]] * 3, face_splat=[7], harmonics=harmonics)
    c = np.sqrt(3 / (4 * np.pi))
    for side, expected in ((-1, [0.5 + c, 0.5, 0]), (1, [0.5 - c, 0.5, 0.2 + c])):
        pose = np.array([[0, side, 0, 0], [0, 0, -1, 0], [-side, 0, 0, 3.0], [0, 0, 0, 1]])
        view = Camera(pose, 10, 10, 5, 5, 10, 10)
        assert view.center == pytest.approx([3 * side, 0, 0])
        assert shaded(mesh.triangles, view).colors[0, :3] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("degree", DEGREES)
def test_images_are_those_of_the_reference(degree):
    mesh, view = colorful(degree, 3), camera()
    for order in ("fragment", "splat"):
        image = render(mesh, view, samples=2, order=order, min_transmittance=0)
        exact = reference.render(mesh, view, samples=2, order=order)
        assert np.abs(image.color - exact.color).max() < 1e-4
    plain = render(replace(mesh, harmonics=None), view, samples=2)
    assert np.abs(plain.color - image.color).max() > 0.05
    assert np.array_equal(plain.alpha, render(mesh, view, samples=2).alpha)
    same = render(seen_from(mesh, view), view, samples=2)
    assert np.array_equal(same.color, render(mesh, view, samples=2).color)


@pytest.mark.parametrize("degree", DEGREES)
def test_gradients_are_those_in_float64(degree):
    torch = pytest.importorskip("torch", reason="gradients in float64 are torch's")
    from meshsplats import rasterize
    from meshsplats.rendering import reference_autograd

    mesh, view = colorful(degree, 5, 15), camera(23, 17)
    weights = np.random.default_rng(1).normal(size=(17, 23, 3))
    found = []
    for operator, dtype in ((rasterize, torch.float32), (reference_autograd.rasterize, torch.float64)):
        leaves = [
            torch.tensor(a, dtype=dtype, requires_grad=True)
            for a in (mesh.vertices, mesh.colors, mesh.harmonics)
        ]
        more = {"min_transmittance": 0.0} if operator is rasterize else {}
        image = operator(
            leaves[0], mesh.faces, leaves[1], view, harmonics=leaves[2], face_splat=mesh.face_splat,
            samples=2, **more,
        )  # fmt: skip
        (image.color.double() * torch.from_numpy(weights)).sum().backward()
        found.append([leaf.grad.double().numpy() for leaf in leaves])
    for ours, exact in zip(*found, strict=True):
        assert np.abs(ours - exact).max() < 2e-4 * np.abs(exact).max()
    assert np.abs(found[1][2]).max() > 0


def test_a_colour_held_at_zero_only_follows_what_raises_it():
    harmonics = np.zeros((1, 3, 3), np.float32)
    harmonics[0, 1] = -5  # seen along +z, the second harmonic is positive
    mesh = SplatMesh(
        [[0, 0, 3], [1, 0, 3], [0, 1, 3]], [[0, 1, 2]], [[0.5, 0.5, 0.5, 1]] * 3,
        face_splat=[0], harmonics=harmonics,
    )  # fmt: skip
    shading = Shading(mesh.triangles, camera())
    assert (shading.colors[:, :3] == 0).all()
    gradient = np.array([[1, -1, 0, 2]] * 3, np.float32)
    colors, found = np.zeros((3, 4), np.float32), np.zeros((1, 3, 3), np.float32)
    shading.backward(gradient, colors, found)
    assert colors.tolist() == [[0, -1, 0, 2]] * 3
    assert (found[0, :, 0] == 0).all()
    assert found[0, 1, 1] < -1
    shading.backward(gradient, colors, None)  # added, and without harmonics
    assert colors.tolist() == [[0, -2, 0, 4]] * 3


def test_threads_do_not_change_a_bit():
    mesh, view = colorful(2, 7, 4000), camera()
    gradient = np.random.default_rng(0).normal(size=mesh.colors.shape).astype(np.float32)
    results = []
    for threads in (1, 2, 5):
        shading = Shading(mesh.triangles, view, threads=threads)
        sums = np.zeros_like(mesh.colors), np.zeros_like(mesh.harmonics)
        shading.backward(gradient, *sums)
        results.append((shading.colors, *sums))
    for other in results[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(results[0], other, strict=True))


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


@pytest.mark.parametrize("degree", DEGREES)
def test_a_rigid_motion_of_mesh_and_camera_changes_nothing(degree):
    mesh, view, turn, shift = colorful(degree, 9), camera(), rotation(2), np.array([3.0, -1, 2])
    moved = mesh.moved(mesh.vertices @ turn.T + shift)
    pose = view.world_to_camera.copy()
    pose[:3, :3] = view.world_to_camera[:3, :3] @ turn.T
    pose[:3, 3] -= pose[:3, :3] @ shift
    before, after = shaded(mesh.triangles, view), shaded(moved.triangles, replace(view, world_to_camera=pose))
    assert np.abs(before.colors - after.colors).max() < 1e-4
    still = replace(moved, harmonics=mesh.harmonics)
    assert (
        np.abs(shaded(still.triangles, replace(view, world_to_camera=pose)).colors - before.colors).max()
        > 0.1
    )


def test_harmonics_turn_one_by_one_as_all_do():
    harmonics = np.random.default_rng(0).normal(size=(20_000, 15, 3)).astype(np.float32)
    turns = np.stack([rotation(0), rotation(1)])[np.arange(20_000) % 2]
    turned_ones = turned_harmonics(harmonics, turns)
    for which in (0, 1):
        expected = harmonics_map(rotation(which), 3) @ harmonics[which::2]
        assert np.abs(turned_ones[which::2] - expected).max() < 1e-5
    direction = np.array([[0.6, -0.48, 0.64]])
    seen = sh_basis(direction @ rotation(0).T, 3)[:, 1:] @ turned_ones[0]
    assert seen == pytest.approx(sh_basis(direction, 3)[:, 1:] @ harmonics[0], abs=1e-5)


def test_what_is_joined_looks_as_it_does_apart():
    one, two, view = colorful(2, 11), colorful(2, 12), camera()
    for parts, error in (([one, two], 0), ([colorful(3), two], 1e-6)):
        joined = shaded(SplatMesh.joined(parts).triangles, view).colors
        apart = np.concatenate([shaded(part.triangles, view).colors for part in parts])
        np.testing.assert_allclose(joined, apart, rtol=0, atol=error)


def test_plain_colours_may_be_missing_in_some_of_what_is_joined():
    one, two = colorful(2, 11), colorful(2, 12)
    grey = np.full((len(two.vertices), 3), 0.25, np.float32)
    joined = SplatMesh.joined([one, replace(two, plain_colors=grey)])
    assert np.array_equal(joined.plain_colors, np.concatenate([one.plain.colors[:, :3], grey]))
    assert SplatMesh.joined([one, two]).plain_colors is None


def test_a_choice_of_triangles_keeps_the_colours_of_its_splats():
    mesh, view = colorful(2, 13), camera()
    chosen = np.flatnonzero(np.isin(mesh.face_splat, mesh.splats.numbers[[3, 20, 21]]))[::-1]
    with pytest.raises(ValueError, match="ascending"):
        mesh.take(chosen)
    part = mesh.take(chosen[::-1])
    assert part.harmonics.shape == (3, 8, 3)
    whole = shaded(mesh.triangles, view).colors[mesh.faces[chosen[::-1]]]
    assert np.array_equal(shaded(part.triangles, view).colors[part.faces], whole)


def test_convert_keeps_what_the_file_has():
    rng = np.random.default_rng(0)
    cloud = replace(splats(1, 30), sh=rng.normal(0, 1, (30, 16, 3)))
    mesh = convert(cloud)
    assert np.array_equal(mesh.harmonics, cloud.sh[mesh.splats.numbers, 1:])
    base = 0.5 + 0.28209479 * cloud.sh[mesh.splats.numbers, 0]
    assert mesh.colors[mesh.faces[mesh.splats.starts, 0], :3] == pytest.approx(np.maximum(base, 0), abs=1e-6)
    assert mesh.colors[:, :3].max() > 1
    assert mesh.plain.colors.max() <= 1
    assert mesh.plain.harmonics is None
    assert np.array_equal(convert(cloud, color_degree=1).harmonics, mesh.harmonics[:, :3])
    assert np.array_equal(mesh.of_degree(1).harmonics, mesh.harmonics[:, :3])
    plain = convert(cloud, colors="base")
    assert plain.harmonics is None
    assert np.array_equal(plain.colors, mesh.of_degree(0).colors)
    assert convert(replace(cloud, sh=cloud.sh[:, :1])).harmonics is None
    assert convert(cloud, preset="paper").harmonics is None
    with pytest.raises(ValueError, match="color_degree has no effect without colors"):
        convert(cloud, colors="base", color_degree=2)


def test_plain_colors_take_the_place_of_colors_in_other_programs():
    mesh = colorful(1)
    grey = np.full((len(mesh.vertices), 3), 0.25, np.float32)
    told = replace(mesh, plain_colors=grey)
    assert (told.plain.colors[:, :3] == 0.25).all()
    assert np.array_equal(told.plain.colors[:, 3], mesh.colors[:, 3])
    assert np.array_equal(shaded(told.triangles, camera()).colors, shaded(mesh.triangles, camera()).colors)
    assert told.take(slice(0, 8)).plain_colors.shape == (len(told.take(slice(0, 8)).vertices), 3)
    with pytest.raises(ValueError, match=r"plain_colors must lie in \[0, 1\], got 0.25 to 1.5"):
        replace(told, plain_colors=np.append(grey[1:], [[0.5, 1.5, 0.5]], axis=0))


def fan_of(**changes) -> SplatMesh:
    corners, rgba = np.random.default_rng(0).normal(size=(4, 3)), np.full((4, 4), 0.5)
    options = dict(face_splat=[0, 0], harmonics=np.zeros((1, 3, 3))) | changes
    return SplatMesh(corners, [[0, 1, 2], [0, 2, 3]], rgba, **options)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(harmonics=np.zeros((1, 5, 3))), "3, 8 or 15 coefficients for degree 1, 2 or 3"),
        (dict(harmonics=np.zeros((2, 3, 3))), r"harmonics must have shape \(1, n, 3\)"),
        (dict(harmonics=np.zeros((1, 3, 4))), "harmonics must have shape"),
        (dict(harmonics=np.full((1, 3, 3), np.nan)), "harmonics must be finite"),
        (dict(face_splat=None), "harmonics has a row for each splat: give face_splat, too"),
        (dict(face_splat=[0, 1], harmonics=np.zeros((2, 3, 3))), "two splats share a vertex"),
        (dict(blending="linear"), "blended in linear light"),
    ],
)
def test_harmonics_that_do_not_fit_are_refused(changes, message):
    assert fan_of().sh_degree == 1
    with pytest.raises(ValueError, match=message):
        fan_of(**changes)


def test_colours_may_be_brighter_than_white_but_opacities_not():
    rgba = np.full((3, 4), 0.5)
    for column, value, message in ((0, 1.5, None), (3, 1.5, "opacities"), (0, 2 * MAX_COLOR, "colors"),
                                   (1, -0.1, "colors")):  # fmt: skip
        bad = rgba.copy()
        bad[1, column] = value
        if message is None:
            image = render(SplatMesh([[-9, -9, 2], [9, -9, 2], [0, 9, 2]], [[0, 1, 2]], bad), camera())
            assert np.isfinite(image.color).all()
            continue
        with pytest.raises(ValueError, match=message):
            SplatMesh(np.eye(3), [[0, 1, 2]], bad)


def test_the_core_refuses_another_number_of_splats():
    mesh = fan_of()
    wrong = mesh.triangles._replace(harmonics=np.zeros((2, 3, 3), np.float32))
    with pytest.raises(ValueError, match="a row for each of the 1 splats of the triangles, got 2"):
        shaded(wrong, camera())


def test_a_cloud_of_lower_degree_is_a_part_of_it():
    cloud = GaussianCloud(
        np.zeros((2, 3)), [[1, 0, 0, 0]] * 2, np.ones((2, 3)), [0.5, 0.5], np.ones((2, 9, 3))
    )
    assert [cloud.of_degree(degree).sh.shape[1] for degree in (0, 1, 2, 3)] == [1, 4, 9, 9]
    with pytest.raises(ValueError, match="degree must be 0, 1, 2 or 3, got 4"):
        cloud.of_degree(4)
