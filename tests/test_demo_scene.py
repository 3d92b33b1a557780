"""The demo scene: the right number of splats, on the surfaces, lit as it says."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numpy.polynomial.legendre import legval

from meshsplats import demo_scene, load_gaussians
from meshsplats.demo_scene._light import KEY_LIGHT, Patch, spherical_harmonics
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.spherical_harmonics import sh_basis


@pytest.fixture(scope="module")
def scene() -> GaussianCloud:
    return demo_scene.make_scene(4_000)


def part(scene: GaussianCloud, name: str) -> GaussianCloud:
    """The splats of one part, which lie in this order."""
    names = ["vase", "ball", "orange 1", "orange 2", "leaves", "flowers", "table"]
    sizes = [int(demo_scene.SHARES[n.split()[0]] * len(scene)) for n in names[:-1]]
    ends = np.cumsum([0, *sizes, len(scene) - sum(sizes)])
    at = names.index(name)
    return scene.take(np.arange(ends[at], ends[at + 1]))


@pytest.mark.parametrize("count", [200, 1_001, 20_000])
def test_has_as_many_splats_as_asked(count):
    assert len(demo_scene.make_scene(count)) == count


def test_too_few_splats_are_an_error():
    with pytest.raises(ValueError, match="at least 200"):
        demo_scene.make_scene(199)


def test_runs_as_a_module(tmp_path):
    command = [sys.executable, "-m", "meshsplats.demo_scene", "scene.ply", "200"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert len(load_gaussians(tmp_path / "scene.ply")) == 200


def test_the_seed_decides(scene):
    again, other = demo_scene.make_scene(4_000), demo_scene.make_scene(4_000, seed=1)
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(again, name), getattr(scene, name))
    assert not np.array_equal(other.means, scene.means)


@pytest.mark.parametrize("name", ["ball", "orange 1", "orange 2"])
def test_splats_lie_flat_on_spheres(scene, name):
    center, radius = {
        "ball": demo_scene.BALL,
        "orange 1": demo_scene.ORANGES[0],
        "orange 2": demo_scene.ORANGES[1],
    }[name]
    splats = part(scene, name)
    outwards = (splats.means - center) / radius
    np.testing.assert_allclose(np.linalg.norm(outwards, axis=1), 1, atol=1e-5)
    assert (np.argmin(splats.scales, axis=1) == 2).all()
    np.testing.assert_allclose(np.einsum("ni,ni->n", splats.rotations[:, :, 2], outwards), 1, atol=1e-5)


def test_vase_stands_on_the_table_and_its_normals_point_outwards(scene):
    vase = part(scene, "vase")
    assert -vase.means[:, 1].max() == pytest.approx(0, abs=0.01)
    assert -vase.means[:, 1].min() == pytest.approx(1.065, abs=0.01)
    from_axis = (vase.means - demo_scene.VASE_FOOT) * [1, 0, 1]
    belly = (vase.means[:, 1] < -0.3) & (vase.means[:, 1] > -0.5)
    assert (np.einsum("ni,ni->n", vase.rotations[belly, :, 2], from_axis[belly]) > 0).all()


def test_table_fades_out_and_is_darker_in_the_shadow(scene):
    table = part(scene, "table")
    radius = np.linalg.norm(table.means[:, [0, 2]], axis=1)
    assert table.opacities[radius > 0.99 * demo_scene.TABLE_RADIUS].max() < 0.05
    assert table.opacities[radius < 0.7 * demo_scene.TABLE_RADIUS].min() > 0.9
    center, size = demo_scene.BALL
    shadow = center + KEY_LIGHT * (center[1] / -KEY_LIGHT[1])  # of the ball's centre, on y = 0
    assert shadow[1] == pytest.approx(0)
    mirrored = 2 * center - shadow  # the same distance from the ball, on the lit side
    brightness = [
        table.colors[np.linalg.norm(table.means[:, [0, 2]] - place[[0, 2]], axis=1) < 0.8 * size].mean()
        for place in (shadow, mirrored)
    ]
    assert brightness[0] < 0.7 * brightness[1]


def test_quaternions_are_those_of_the_rotations():
    rng = np.random.default_rng(5)
    q = rng.standard_normal((500, 4))
    q[:4] = np.eye(4)  # no turn, and half turns about the axes
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    n = len(q)
    cloud = GaussianCloud(np.zeros((n, 3)), q, np.ones((n, 3)), np.ones(n), np.zeros((n, 1, 3)))
    found = demo_scene.quaternions_of_frames(cloud.rotations.astype(np.float64))
    np.testing.assert_allclose(np.abs((found * q).sum(axis=1)), 1, atol=1e-6)


def test_basis_obeys_the_addition_theorem():
    rng = np.random.default_rng(6)
    a, b = rng.standard_normal((2, 40, 3))
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    product = sh_basis(a, 3) * sh_basis(b, 3)
    for level in range(4):
        found = product[:, level**2 : (level + 1) ** 2].sum(axis=1)
        expected = (2 * level + 1) / (4 * np.pi) * legval((a * b).sum(axis=1), np.eye(4)[level])
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_highlight_is_seen_in_the_mirrored_direction():
    """Light from above left on a floor: a viewer on the right, as high as the light, sees it brightest."""
    n = np.array([[0.0, -1.0, 0.0]])
    zero, one = np.zeros((1, 3)), np.ones((1, 3))
    patch = Patch(zero, n, np.array([[1.0, 0, 0]]), one, zero, np.ones(1), gloss=0.5)
    sh = spherical_harmonics(patch, np.full((1, 3), 0.2))
    angles = np.linspace(-1.4, 1.4, 281)
    across = KEY_LIGHT * [1, 0, 1] / np.linalg.norm(KEY_LIGHT[[0, 2]])
    to_viewer = np.cos(angles)[:, None] * n + np.sin(angles)[:, None] * -across
    seen = 0.5 + sh_basis(-to_viewer, 3) @ sh[0, :, 0]  # stored by the direction in which one looks
    brightest = to_viewer[np.argmax(seen)]
    mirrored = -across * np.linalg.norm(KEY_LIGHT[[0, 2]]) + n[0] * -KEY_LIGHT[1]
    assert brightest @ mirrored > np.cos(np.radians(6))
    assert seen.max() > 0.2 + 0.9 * patch.gloss
    assert seen.min() > 0.2 - 0.1 * patch.gloss


def test_command_writes_a_splat_file(tmp_path, capsys):
    demo_scene.main([str(tmp_path / "new folder" / "scene.ply"), "300"])
    assert "300 splats" in capsys.readouterr().out
    cloud = load_gaussians(tmp_path / "new folder" / "scene.ply")
    expected = demo_scene.make_scene(300)
    assert (len(cloud), cloud.sh_degree, cloud.kernel) == (300, 3, "3dgs")
    np.testing.assert_array_equal(cloud.means, expected.means)
    np.testing.assert_allclose(cloud.sh, expected.sh, atol=1e-6)


@pytest.mark.parametrize("arguments", [[], ["a.ply", "many"], ["a.ply", "300", "0"]])
def test_command_explains_itself(arguments):
    with pytest.raises(SystemExit, match="usage"):
        demo_scene.main(arguments)
