"""Files of one model agree whatever their format, and turned splats look the same from turned places."""

from __future__ import annotations

import struct

import _splat_encoders as encode
import numpy as np
import pytest
from _local import shared_data
from _splat_files import random_splats, splat_table, write_ply
from _splats import harmonics_of_3dgs
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import FileFormatError, GaussianCloud, load_gaussians

RUB = np.diag([1.0, -1, -1])
LUF = np.diag([-1.0, -1, 1])


def colors_seen(cloud, direction):
    """(n, 3) colours along one direction."""
    basis = harmonics_of_3dgs(*direction)
    return np.einsum("k,nkc->nc", basis[: cloud.sh.shape[1]], cloud.sh)


def covariances(cloud):
    half = cloud.rotations.astype(float) * cloud.scales[:, None]
    return half @ half.transpose(0, 2, 1)


def directions(seed=0):
    d = np.random.default_rng(seed).normal(size=(5, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def assert_mapped(before, after, a, shift=(0, 0, 0), tolerance=1e-5):
    """``after`` is ``before`` under x -> a x + shift."""
    a = np.asarray(a, float)
    u, _, vt = np.linalg.svd(a)
    turn = u @ vt
    size = np.abs(before.means).max() * np.linalg.norm(a) + np.abs(shift).max() + 1e-9
    np.testing.assert_allclose(after.means, before.means @ a.T + shift, atol=tolerance * size)
    wanted = a @ covariances(before) @ a.T
    largest = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(covariances(after) / largest, wanted / largest, atol=10 * tolerance)
    np.testing.assert_array_equal(after.opacities, before.opacities)
    for d in directions():
        np.testing.assert_allclose(colors_seen(after, turn @ d), colors_seen(before, d), atol=tolerance * 20)


def some_cloud(n=20, degree=3, seed=0, kernel="3dgs"):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    scales = np.exp(rng.normal(-3, 1, (n, 3)))
    if kernel == "2dgs":
        scales[:, 2] = 0
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    sh = rng.normal(size=(n, (degree + 1) ** 2, 3))
    return GaussianCloud(rng.normal(size=(n, 3)), q, scales, rng.uniform(size=n), sh, kernel)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(
    "signs", [(1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, -1), (-1, -1, -1), (1, 1, 1)]
)
def test_reversed_axes(degree, signs):
    cloud = some_cloud(degree=degree)
    turned = cloud.transformed(np.diag(signs))
    assert_mapped(cloud, turned, np.diag(signs), tolerance=1e-6)
    back = turned.transformed(np.diag(signs))
    for name in ("means", "quaternions", "sh"):
        np.testing.assert_array_equal(
            getattr(back, name), getattr(cloud, name)
        )  # signs only: nothing is rounded


@given(st.integers(0, 10**6), st.sampled_from(["turn", "mirror", "similarity", "affine"]), st.integers(0, 3))
def test_maps(seed, kind, degree):
    rng = np.random.default_rng(seed)
    a, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    if (np.linalg.det(a) < 0) != (kind == "mirror"):
        a = -a
    if kind == "similarity":
        a *= rng.uniform(0.1, 10)
    if kind == "affine":
        a = a @ np.diag(rng.uniform(0.3, 3, 3)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = a, rng.normal(size=3)
    cloud = some_cloud(degree=degree, seed=seed)
    assert_mapped(cloud, cloud.transformed(matrix), a, matrix[:3, 3])


def test_flat_axis_stays_the_third():
    cloud = some_cloud(kernel="2dgs")
    stretched = cloud.transformed(np.diag([1.0, 2, 3]))
    assert_mapped(cloud, stretched, np.diag([1.0, 2, 3]))
    assert (stretched.scales[:, 2] <= 1e-7 * stretched.scales[:, 0]).all()
    assert stretched.kernel == "2dgs"


def test_splats_along_the_axes_are_stretched():
    """Their singular vectors are a mirror, not a rotation, unless one of them is turned round."""
    cloud = some_cloud()
    cloud.quaternions[:] = [1, 0, 0, 0]
    cloud.scales[:] = [1, 2, 3]
    assert_mapped(cloud, cloud.transformed(np.diag([1, 1.5, 2])), np.diag([1, 1.5, 2]))


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1, 0]), np.full((3, 3), np.nan), np.diag([1, np.inf, 1])])
def test_impossible_maps_are_refused(matrix):
    with pytest.raises(ValueError, match="the transform"):
        some_cloud().transformed(matrix)


# -- files


def test_spz_is_y_up(tmp_path):
    (tmp_path / "a.spz").write_bytes(encode.spz(random_splats()))
    stored = load_gaussians(tmp_path / "a.spz", axes="y-down")
    assert_mapped(stored, load_gaussians(tmp_path / "a.spz"), RUB)
    assert_mapped(stored, load_gaussians(tmp_path / "a.spz", axes="y-up"), RUB)


def test_gltf_is_y_up_and_faces_z(tmp_path):
    (tmp_path / "a.glb").write_bytes(encode.gltf(encode.splat_accessors(random_splats())))
    stored = load_gaussians(tmp_path / "a.glb", axes="y-down")
    assert_mapped(stored, load_gaussians(tmp_path / "a.glb"), LUF)
    assert_mapped(stored, load_gaussians(tmp_path / "a.glb", axes="y-up"), LUF)


def test_node_transforms_of_gltf(tmp_path):
    s = np.sqrt(0.5)
    nodes = [
        {"mesh": 0, "rotation": [0, 0, s, s], "translation": [1, 2, 3]}
    ]  # x to y: a quarter turn about z
    accessors = encode.splat_accessors(random_splats())
    (tmp_path / "plain.glb").write_bytes(encode.gltf(accessors))
    (tmp_path / "node.glb").write_bytes(encode.gltf(accessors, nodes=nodes))
    stored = load_gaussians(tmp_path / "plain.glb", axes="y-down")
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert_mapped(stored, load_gaussians(tmp_path / "node.glb", axes="y-down"), turn, (1, 2, 3))
    assert_mapped(stored, load_gaussians(tmp_path / "node.glb"), LUF @ turn, LUF @ (1, 2, 3))
    nodes[0]["scale"] = [1, 0, 1]
    (tmp_path / "flat.glb").write_bytes(encode.gltf(accessors, nodes=nodes))
    with pytest.raises(FileFormatError, match="flattens space"):
        load_gaussians(tmp_path / "flat.glb")


def test_other_formats_are_y_down_unless_told(tmp_path):
    values = random_splats()
    write_ply(tmp_path / "a.ply", [splat_table(values)])
    (tmp_path / "b.ply").write_bytes(encode.compressed_ply(values))
    for name in ("a.ply", "b.ply"):
        stored = load_gaussians(tmp_path / name)
        np.testing.assert_array_equal(load_gaussians(tmp_path / name, axes="y-down").means, stored.means)
        assert_mapped(stored, load_gaussians(tmp_path / name, axes="y-up"), RUB)


@pytest.mark.parametrize(
    ("number", "to_y_down"),
    [
        (0, RUB),
        (4, RUB),
        (6, np.eye(3)),
        (7, LUF),
        (8, np.diag([1, -1, 1])),  # left-handed, as in Unity: a mirror
        (12, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),  # x right, y front, z up, as in Blender
        (16, [[1, 0, 0], [0, 0, -1], [0, -1, 0]]),
    ],
)
def test_spz_that_names_its_axes(tmp_path, number, to_y_down):
    record = struct.pack("<III", 0xADBE0002, 4, 9) + struct.pack("<III", 0xADBE0003, 4, number)
    (tmp_path / "a.spz").write_bytes(encode.spz(random_splats(), flags=2, extensions=record))
    stored = load_gaussians(tmp_path / "a.spz", axes="y-down")
    assert_mapped(stored, load_gaussians(tmp_path / "a.spz"), to_y_down)


def test_spz_4_names_its_axes_where_it_says_so(tmp_path):
    zstandard = pytest.importorskip("zstandard", reason="install meshsplats[formats]")
    record = struct.pack("<III", 0xADBE0003, 4, 6)
    for flags, to_y_down in ((2, np.eye(3)), (0, RUB)):
        data = encode.spz4(
            random_splats(), zstandard.ZstdCompressor().compress, flags=flags, extensions=record
        )
        (tmp_path / "a.spz").write_bytes(data)
        stored = load_gaussians(tmp_path / "a.spz", axes="y-down")
        assert_mapped(stored, load_gaussians(tmp_path / "a.spz"), to_y_down)


# -- real files


def images_agree(a, b, *, means, covariance, color):
    """Splats in the same order: means in units of the median size, covariances relative, colours absolute."""
    size = np.median(a.scales)
    assert np.abs(a.means - b.means).max() < means * size
    difference = np.linalg.norm(covariances(a) - covariances(b), axis=(1, 2))
    assert (difference / np.linalg.norm(covariances(a), axis=(1, 2))).max() < covariance
    assert np.abs(a.colors - b.colors).max() < color
    assert np.abs(a.opacities - b.opacities).max() < color


@pytest.mark.slow
@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("guitar_sh0.ply", "guitar.compressed.ply"),
        ("tt_truck_sh0.ply", "truck.splat"),
        ("playcanvas_logo_307k_sh0.ply", "playcanvas-logo-sog"),
    ],
)
def test_real_models_in_two_formats(one, other):
    a, b = load_gaussians(shared_data(f"splats/{one}")), load_gaussians(shared_data(f"splats/{other}"))
    images_agree(a, b, means=1e-3, covariance=1e-4, color=1e-5)


def test_real_bundle():
    cloud = load_gaussians(shared_data("splats/monkey_0001.sog"), strict=True)
    assert len(cloud) == 31_658
    assert 1 < np.abs(cloud.means).max() < 2


@pytest.mark.parametrize("version", [3, 4])
def test_gsply_agrees_on_spz(tmp_path, version):
    gsply = pytest.importorskip("gsply", reason="an oracle: pip install 'gsply[spz,sogs]'")
    path = shared_data("splats/playbot_lod5_3k_sh2.ply")
    gsply.write_spz(tmp_path / "a.spz", gsply.plyread(path), version=version)
    ours, theirs = load_gaussians(tmp_path / "a.spz", axes="y-down"), gsply.read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(ours.means, theirs.means, rtol=1e-6)
    np.testing.assert_allclose(ours.scales, np.exp(theirs.scales), rtol=1e-5)
    np.testing.assert_allclose(ours.sh[:, 0], np.reshape(theirs.sh0, (-1, 3)), atol=1e-5)
    np.testing.assert_array_equal(ours.sh[:, 1:], theirs.shN)
    np.testing.assert_allclose(np.abs((ours.quaternions * theirs.quats).sum(axis=1)), 1, atol=1e-5)


def test_gsply_agrees_on_compressed_ply(tmp_path):
    gsply = pytest.importorskip("gsply", reason="an oracle: pip install 'gsply[spz,sogs]'")
    source = gsply.plyread(shared_data("splats/playbot_lod5_3k_sh2.ply"))
    gsply.plywrite(tmp_path / "a.compressed.ply", source, compressed=True)
    ours, theirs = load_gaussians(tmp_path / "a.compressed.ply"), gsply.plyread(tmp_path / "a.compressed.ply")
    np.testing.assert_allclose(ours.means, theirs.means, atol=1e-6)
    np.testing.assert_allclose(ours.sh[:, 1:], theirs.shN, atol=1e-6)
    np.testing.assert_allclose(ours.scales, np.exp(theirs.scales), rtol=1e-4)
