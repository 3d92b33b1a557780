"""Shading normals: those of a known surface, outwards, whatever the layers' own tilt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _blender_scenes import ball_splats, sheets

from meshsplats import convert
from meshsplats.blender.linear import linear_colors
from meshsplats.blender.subject import lit_subject
from meshsplats.conversion.normals import shading_normals, surfels_of, typical_spacing
from meshsplats.demo_scene.city import city_blocks
from meshsplats.scene.colors import srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud


def angles(mesh, normals, true):
    """Degrees between the normal of each splat and the truth."""
    first = np.flatnonzero(np.concatenate([[True], np.diff(mesh.face_splat) != 0]))
    found = normals[mesh.faces[first, 0]]
    return np.degrees(np.arccos(np.clip((found * true[mesh.face_splat[first]]).sum(axis=1), -1, 1)))


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "mean", "worst"), [(0.0, 2.0, 8.0), (0.35, 6.0, 30.0)])
def test_normals_of_a_ball_point_outwards_and_are_smooth(noise, mean, worst):
    cloud, true = ball_splats(noise=noise)
    mesh = convert(cloud)
    found = angles(mesh, shading_normals(mesh), true)
    assert found.mean() < mean
    assert found.max() < worst


@pytest.mark.slow
def test_normals_turn_with_the_scene():
    cloud, _ = ball_splats(800)
    mesh = convert(cloud)
    turn = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
    moved = replace(mesh, vertices=5 * mesh.vertices @ turn.T + 3, up=turn @ mesh.up)
    difference = shading_normals(moved) - shading_normals(mesh) @ turn.T
    # Cells lie elsewhere and views see other pixels: nearly the same, not the same.
    assert np.abs(difference).mean() < 0.02


@pytest.mark.parametrize("stray", [-1e6, 1e6])
def test_a_stray_leaves_the_normals_of_the_others(stray):
    cloud, true = ball_splats(500)
    far = cloud.take(np.zeros(1, int))
    far = replace(far, means=far.means + np.float32([stray, 0, 0]))
    mesh = convert(GaussianCloud.joined([cloud, far]))
    found = angles(mesh, shading_normals(mesh), np.concatenate([true, true[:1]]))
    assert found[:-1].mean() < 15


def test_unit_length_and_own_normals_are_kept():
    cloud, _ = ball_splats(500)
    mesh = convert(cloud)
    normals = shading_normals(mesh)
    assert normals.dtype == np.float32
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    own = np.tile(np.float32([0, 0, 1]), (len(mesh.vertices), 1))
    assert (shading_normals(replace(mesh, normals=own)) == own).all()


def test_a_mesh_without_splats_and_degenerate_ones_work():
    plain = sheets(1, 1.0)
    assert (np.abs(shading_normals(plain)[:, 2]) > 0.99).all()
    point = replace(plain, vertices=np.zeros_like(plain.vertices))
    assert np.isfinite(shading_normals(point)).all()
    assert typical_spacing(point, surfels_of(point).centers) > 0
    nothing = plain.take(np.zeros(2, bool))
    assert shading_normals(nothing).shape == (0, 3)


@pytest.mark.nightly
def test_lit_faces_wind_towards_their_normals_and_colours_are_linear():
    cloud, _ = ball_splats(500)
    mesh = convert(cloud)
    arrays, facts = lit_subject(mesh)
    a, b, c = (mesh.vertices[arrays["faces"][:, k]] for k in range(3))
    facing = (np.cross(b - a, c - a) * arrays["normals"][arrays["faces"]].sum(axis=1)).sum(axis=1)
    assert (facing >= 0).all()
    assert (np.sort(arrays["faces"], axis=1) == np.sort(mesh.faces, axis=1)).all()
    plain = linear_colors(mesh, steps=0)
    assert np.allclose(plain[:, :3], srgb_to_linear(mesh.colors[:, :3]))
    assert (plain[:, 3] == mesh.colors[:, 3]).all()
    assert np.abs(arrays["colors"] - plain).mean() < 0.1, "fitted to blending in linear light"
    assert (arrays["colors"] != plain).any()
    assert 0 < facts["self_shadow"] < 1
    assert (lit_subject(replace(mesh, blending="linear"))[0]["colors"] == mesh.colors).all()


def test_a_street_faces_up_though_it_is_seen_better_from_below():
    """Houses hide it from most cameras above the scene, and nothing from those below it."""
    mesh = convert(GaussianCloud.joined(list(city_blocks(6000, degree=0))), mode="flat")
    up = mesh.up.astype(np.float64)
    heights = mesh.vertices @ up
    flat = np.delete(mesh.vertices, int(np.abs(up).argmax()), axis=1)
    cell = np.floor((flat - flat.min(axis=0)) / 0.5).astype(int) + 1
    tops = np.full(cell.max(axis=0) + 2, -np.inf)
    np.maximum.at(tops, tuple(cell.T), heights)
    around = np.max([np.roll(tops, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    street = around[tuple(cell.T)] < np.quantile(heights, 0.05) + 0.3  # nothing above it or beside it
    assert street.sum() > 1000
    assert (shading_normals(mesh)[street] @ up > 0.9).mean() > 0.99
