"""Profiles: known figures, the least squares themselves, and the opacity that fans really carry."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats.conversion import Profile, convert, fidelity, fit_profile
from meshsplats.scene.gaussians import GaussianCloud

PAPER = Profile(8, (2.7,), (1.0, 0.2))

# sides, radii, opacities, relative L2 error, integrated opacity: independent measurements on one splat.
MEASURED = [
    (8, (2.7,), (1.0, 0.2), 0.493, 1.53),
    (8, (2.404,), (1.067, 0.0), 0.113, 0.925),
    (6, (2.508,), (1.066, 0.0), 0.124, 0.924),
    (4, (2.93,), (1.0, 0.0), 0.190, 0.91),
    (8, (1.948, 2.980), (1.13, 0.153, 0.0), 0.053, 0.981),
    (6, (2.026, 3.110), (1.13, 0.155, 0.0), 0.074, 0.981),
    (12, (0.419, 1.862, 2.875), (1.024, 0.927, 0.161, 0.0), 0.039, 0.980),
]


@pytest.mark.parametrize(("sides", "radii", "opacities", "error", "mass"), MEASURED)
def test_measured_figures(sides, radii, opacities, error, mass):
    found = fidelity(Profile(sides, radii, opacities))
    assert found[0] == pytest.approx(error, abs=7e-4)
    assert found[1] == pytest.approx(mass, abs=2.5e-3)


@pytest.mark.parametrize("row", [MEASURED[i] for i in (1, 2, 4, 5)])
def test_fit_finds_them(row):
    sides, radii, opacities = row[:3]
    found = fit_profile(sides, len(radii))
    np.testing.assert_allclose(found.radii, radii, atol=8e-3)
    np.testing.assert_allclose(found.opacities, opacities, atol=4e-3)


def test_fit_with_a_fixed_centre():
    found = fit_profile(4, center_opacity=1.0)
    assert found.radii[0] == pytest.approx(2.93, abs=5e-3)
    assert found.opacities == (1.0, 0.0)


@pytest.mark.parametrize(("sides", "rings"), [(3, 1), (4, 1), (4, 2), (8, 1), (8, 2), (12, 3)])
def test_fit_is_a_minimum(sides, rings):
    """No small change of one number makes it better."""
    best = fit_profile(sides, rings)
    error = fidelity(best)[0]
    for j in range(rings):
        for change in (-0.02, 0.02):
            radii = list(best.radii)
            radii[j] += change
            assert fidelity(Profile(sides, tuple(radii), best.opacities))[0] > error
            opacities = list(best.opacities)
            opacities[j] += change
            assert fidelity(Profile(sides, best.radii, tuple(opacities)))[0] > error


@pytest.mark.parametrize(("sides", "rings"), [(4, 1), (6, 2), (8, 1)])
def test_conserved_opacity(sides, rings):
    kept = fit_profile(sides, rings, conserve=True)
    assert fidelity(kept)[1] == pytest.approx(1, abs=1e-6)
    assert fidelity(fit_profile(sides, rings))[0] < fidelity(kept)[0] < fidelity(PAPER)[0]


def test_what_is_given_stays():
    found = fit_profile(6, 2, rim_radius=3.5, rim_opacity=0.1, center_opacity=0.9)
    assert (found.radii[-1], found.opacities[0], found.opacities[-1]) == (3.5, 0.9, 0.1)
    assert 0 < found.radii[0] < 3.5


def test_more_rings_come_closer():
    errors = [fidelity(fit_profile(8, rings))[0] for rings in (1, 2, 3)]
    assert errors[0] > 1.5 * errors[1] > 1.5 * errors[2]


def test_profile_of_a_point():
    """An octagon by hand: towards a corner the radius counts, to the middle of an edge the apothem."""
    eighth = np.pi / 8
    assert PAPER(np.array(1.35), np.array(0.0)) == pytest.approx(0.6)
    assert PAPER(np.array(1.35 * np.cos(eighth)), np.array(eighth)) == pytest.approx(0.6)
    assert PAPER(np.array(2.71), np.array(2 * eighth)) == 0
    assert PAPER(np.array(2.6), np.array(3 * eighth)) == 0


@pytest.mark.parametrize(("sides", "rings"), [(8, 1), (6, 2), (4, 3)])
def test_fans_integrate_as_their_profile_says(sides, rings):
    """Opacity integrated triangle by triangle over the mesh: area times the mean of its corners."""
    splat = GaussianCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[0.3, 0.2, 0.0]], [0.5], np.zeros((1, 1, 3)))
    mesh = convert(splat, mode="flat", sides=sides, rings=rings, footprint="none", compensation=0)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    integral = (area * mesh.colors[mesh.faces, 3].mean(axis=1)).sum()
    # What a 3DGS renderer draws of it: down to an opacity of 1/255.
    assert integral == pytest.approx((1 - 1 / 127.5) * 0.5 * 2 * np.pi * 0.3 * 0.2, rel=1e-4)


def test_paper_fan_carries_half_as_much_again():
    splat = GaussianCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[0.3, 0.2, 0.0]], [0.5], np.zeros((1, 1, 3)))
    mesh = convert(splat, preset="paper")
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    integral = (area * mesh.colors[mesh.faces, 3].mean(axis=1)).sum()
    assert integral / (0.5 * 2 * np.pi * 0.3 * 0.2) == pytest.approx(1.53, abs=3e-3)
