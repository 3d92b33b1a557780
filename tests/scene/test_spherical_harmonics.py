"""The basis: orthonormal on the sphere, the signs and order of splat files, and SciPy's values."""

from __future__ import annotations

import numpy as np
import pytest
from _splats import harmonics_of_3dgs

from meshsplats.scene.spherical_harmonics import degree_of, harmonic_terms, in_fours, sh_basis


def sphere(n: int) -> np.ndarray:
    v = np.random.default_rng(n).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_orthonormal():
    # Gauss-Legendre in z and even steps round it integrate polynomials of this degree exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    turn = 2 * np.pi * np.arange(16) / 16
    radius = np.sqrt(1 - z * z)[:, None]
    v = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.repeat(z[:, None], 16, axis=1)], axis=2)
    y = sh_basis(v.reshape(-1, 3), 3)
    gram = (y * np.repeat(weight * 2 * np.pi / 16, 16)[:, None]).T @ y
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)


def test_signs_of_the_first_degree():
    c1 = 0.4886025119029199
    np.testing.assert_allclose(
        sh_basis(np.eye(3), 1)[:, 1:], [[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]], atol=1e-15
    )


def test_one_direction_by_hand():
    x, y, z = 2 / 7, -3 / 7, 6 / 7
    expected = harmonics_of_3dgs(x, y, z)
    np.testing.assert_allclose(sh_basis(np.array([[x, y, z]]), 3)[0], expected, rtol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_are_the_beginning(degree):
    v = sphere(20)
    np.testing.assert_array_equal(sh_basis(v, degree), sh_basis(v, 3)[:, : (degree + 1) ** 2])
    assert sh_basis(v.astype(np.float32), degree).dtype == np.float32


def test_same_as_the_renderer():
    from meshsplats.rendering import reference_splats

    v = sphere(50)
    names = [name for name in dir(reference_splats) if "harmonic" in name or name.endswith("sh_basis")]
    assert names, "the reference renderer has no basis of its own any more"
    np.testing.assert_allclose(getattr(reference_splats, names[0])(v, 3), sh_basis(v, 3), atol=1e-12)


@pytest.mark.parametrize("degree", [-1, 4, 1.5])
def test_unknown_degree(degree):
    with pytest.raises(ValueError, match="degree must be 0, 1, 2 or 3"):
        sh_basis(np.eye(3), degree)


@pytest.mark.parametrize("index", range(1, 16))
def test_each_harmonic_is_its_polynomial(index):
    directions = sphere(50)
    found = sum(f * np.prod(directions ** np.array(powers), axis=1) for f, powers in harmonic_terms(index))
    np.testing.assert_allclose(found, sh_basis(directions, 3)[:, index], atol=1e-12)


def test_coefficients_in_fours():
    harmonics = np.arange(2 * 8 * 3).reshape(2, 8, 3)
    fours = in_fours(harmonics)
    assert fours.shape == (3, 2, 2, 4)
    assert fours[1, 0, 1].tolist() == harmonics[1, :4, 1].tolist()
    assert fours[2, 1, 0].tolist() == harmonics[0, 4:, 2].tolist()
    assert in_fours(harmonics[:, :3])[:, 0, :, 3].tolist() == [[0, 0]] * 3
    assert [degree_of(np.zeros((1, k, 3))) for k in (3, 8, 15)] == [1, 2, 3]
