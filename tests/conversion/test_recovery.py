"""Splats that became fans become splats again, also after edits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats import GaussianCloud, SplatMesh, convert
from meshsplats.conversion.recovery import THICKNESS, recover_splats

AFFINE = np.array([[0.0, -2, 0.3], [1, 0, 0], [0, 0.4, 1]])


def splats(count: int = 60, degree: int = 1) -> GaussianCloud:
    """Thick ones, flat ones and needles, none so opaque that the centre of its fan would be."""
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(count, 4))
    scales = np.exp(rng.uniform(-4, -1, (count, 3)))
    return GaussianCloud(
        rng.normal(size=(count, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales,
        rng.uniform(0.1, 0.6, count),
        0.3 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


def covariances(cloud: GaussianCloud, ranks: int = 3) -> np.ndarray:
    """Those of the splats, without the smallest axes beyond ``ranks``."""
    scales = cloud.scales.astype(np.float64)
    scales[np.argsort(np.argsort(scales, axis=1), axis=1) < 3 - ranks] = 0
    axes = cloud.rotations * scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


# Nothing widens or shrinks the splats.
PLAIN = {"footprint": "none", "shrink_faint": False, "min_opacity": 0.0, "compensation": 1.0}


@pytest.mark.parametrize(
    "options",
    [
        {"mode": "3d"},
        {"mode": "crossed", "flat_below": 0.0, "sides": 6},
        {"mode": "flat", "sides": 5},
        {"mode": "flat", "rings": 2},
    ],
)
def test_splats_are_found_again_in_their_fans(options):
    cloud = splats()
    mesh = convert(cloud, **PLAIN, **options)
    found, whole = recover_splats(mesh)
    assert whole.all()
    np.testing.assert_allclose(found.means, cloud.means, atol=1e-5)
    np.testing.assert_allclose(found.sh, cloud.sh, atol=1e-5)
    flat = options["mode"] == "flat"
    size = np.square(cloud.scales).max(axis=1)[:, None, None]
    pairs = covariances(found, 2 if flat else 3), covariances(cloud, 2 if flat else 3)
    np.testing.assert_allclose(pairs[0] / size, pairs[1] / size, atol=2e-4)
    if not flat:
        np.testing.assert_allclose(found.opacities, cloud.opacities, rtol=1e-3)
    else:
        thickness = np.sort(found.scales, axis=1)
        np.testing.assert_allclose(thickness[:, 0] / thickness[:, 1], THICKNESS, rtol=1e-3)
        assert (found.opacities >= cloud.opacities * 0.99).all(), "with the side that is missing, fainter"


def test_thick_splats_that_became_stars():
    from meshsplats.conversion.fans import build
    from meshsplats.conversion.stars import star

    cloud = splats(20, degree=0)
    order = np.tile(np.arange(3, dtype=np.int8), (20, 1))
    choice = np.arange(20) % 2
    shapes = [star(6, 4), star(10, 4)]
    vertices, faces, colors = build(
        shapes, choice, cloud.means, cloud.quaternions, order, cloud.scales, cloud.colors, cloud.opacities
    )
    owner = np.repeat(np.arange(20), np.array([24, 40])[choice])
    found, whole = recover_splats(SplatMesh(vertices, faces, colors, face_splat=owner))
    assert whole.all()
    size = np.square(cloud.scales).max(axis=1)[:, None, None]
    np.testing.assert_allclose(covariances(found) / size, covariances(cloud) / size, atol=1e-4)
    np.testing.assert_allclose(found.opacities, cloud.opacities, rtol=1e-3)


def test_an_affine_map_of_the_mesh_is_one_of_the_splats():
    cloud = splats()
    mesh = convert(cloud, mode="3d", **PLAIN)
    found, _ = recover_splats(mesh.moved(mesh.vertices @ AFFINE.T.astype(np.float32)))
    expected = AFFINE @ covariances(cloud) @ AFFINE.T
    size = np.linalg.norm(expected, axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(covariances(found) / size, expected / size, atol=5e-4)
    np.testing.assert_allclose(found.means, cloud.means @ AFFINE.T, atol=1e-4)


def test_cut_splats_are_left_out_and_wound_ones_are_not():
    cloud = splats()
    mesh = convert(cloud, **PLAIN)
    kept = np.ones(len(mesh.faces), bool)
    kept[np.flatnonzero(mesh.face_splat == 7)[0]] = False
    found, whole = recover_splats(mesh.take(kept))
    assert np.flatnonzero(~whole).tolist() == [7]
    np.testing.assert_allclose(found.means, np.delete(cloud.means, 7, axis=0), atol=1e-5)
    turned = replace(mesh, faces=mesh.faces[:, [0, 2, 1]])
    assert recover_splats(turned)[1].all()
    merged, own = mesh.faces.copy(), mesh.face_splat == 9
    merged[own] = merged[own].clip(max=merged[own].max() - 1)
    assert not recover_splats(replace(mesh, faces=merged))[1][9]


def test_meshes_that_cannot_be_splats():
    mesh = convert(splats(3), **PLAIN)
    with pytest.raises(ValueError, match="does not know which triangles"):
        recover_splats(replace(mesh, face_splat=None, harmonics=None))
    with pytest.raises(ValueError, match="blends linear light"):
        recover_splats(replace(mesh, blending="linear", harmonics=None))
    alone = SplatMesh(np.eye(3), [[0, 1, 2]], np.ones((3, 4)), face_splat=[0])
    with pytest.raises(ValueError, match="none of the splats has all its triangles"):
        recover_splats(alone)


def test_converted_again_round_splats_have_the_same_triangles():
    """Their principal axes may be any."""
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(60, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    sizes = np.tile(rng.uniform(0.1, 0.3, (60, 1)), 3)
    sizes[30:, 0] *= 2  # round across
    cloud = GaussianCloud(rng.normal(size=(60, 3)), turns, sizes, np.full(60, 0.5), np.zeros((60, 1, 3)))
    mesh = convert(cloud)
    again = convert(recover_splats(mesh)[0], footprint="none", shrink_faint=False)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=2e-3)
