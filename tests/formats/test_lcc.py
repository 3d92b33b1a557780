"""LCC scenes of XGRIDS, encoded splat by splat as the white paper says."""

from __future__ import annotations

import struct
import subprocess

import _splat_encoders as encode
import numpy as np
import pytest
from _splat_files import expected_cloud, random_splats
from _splats import refused

import meshsplats as ms
from meshsplats.errors import FileFormatError
from meshsplats.formats.gaussians import format_of


def put(folder, files):
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder / "meta.lcc"


@pytest.mark.parametrize("harmonics", [True, False])
def test_the_finest_level_is_read(tmp_path, harmonics):
    values = random_splats(20, degree=3)
    path = put(tmp_path / "scene", encode.lcc(values, harmonics=harmonics))
    assert format_of(path) == "lcc"
    cloud, expected = ms.load_gaussians(path, axes="y-down"), expected_cloud(values)
    np.testing.assert_array_equal(cloud.means, expected["means"].astype(np.float32))
    np.testing.assert_allclose(cloud.scales, np.minimum(expected["scales"], 0.5), atol=1e-5)
    np.testing.assert_allclose(
        cloud.quaternions,
        expected["quaternions"] * np.sign((cloud.quaternions * expected["quaternions"]).sum(1))[:, None],
        atol=2e-3,
    )
    np.testing.assert_allclose(cloud.opacities, expected["opacities"], atol=0.5 / 255 + 1e-6)
    assert cloud.sh_degree == (3 if harmonics else 0)
    if harmonics:
        rest = np.clip(expected["sh"][:, 1:], -2, 2)
        np.testing.assert_allclose(cloud.sh[:, 1:], rest, atol=2 / 1023 + 1e-5)


def test_a_folder_is_read_and_z_points_up(tmp_path):
    values = random_splats(9, degree=3)
    put(tmp_path / "scene", encode.lcc(values))
    cloud = ms.load_gaussians(tmp_path / "scene")
    x, y, z = expected_cloud(values)["means"].astype(np.float32).T
    np.testing.assert_allclose(cloud.means, np.stack([x, -z, y], axis=1))
    np.testing.assert_allclose(cloud.up, [0, -1, 0], atol=1e-6)
    assert sum(map(len, ms.stream_gaussians(tmp_path / "scene", block=4))) == 9
    (tmp_path / "scene" / "meta.lcc").rename(tmp_path / "scene" / "Market Hall.lcc")  # after its project
    np.testing.assert_array_equal(ms.load_gaussians(tmp_path / "scene").means, cloud.means)


FILES = encode.lcc(random_splats(9, degree=3))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("data.bin", FILES["data.bin"][:-64], "does not hold them"),
        ("data.bin", None, "'data.bin' must lie beside it"),
        ("shcoef.bin", FILES["shcoef.bin"][:64], "does not hold them"),
        ("index.bin", FILES["index.bin"][:-1], "no multiple of 36"),
        (
            "index.bin",
            struct.pack("<i", -5).join([FILES["index.bin"][:4], FILES["index.bin"][8:]]),
            "-5 splats",
        ),
        ("index.bin", FILES["index.bin"] * 50, "they overlap"),
        (
            "meta.lcc",
            FILES["meta.lcc"].replace(b'"totalLevel": 2', b'"totalLevel": 1e9'),
            "totalLevel must be",
        ),
        (
            "meta.lcc",
            FILES["meta.lcc"].replace(b'"min": [0.0', b'"min": ["a"'),
            "min of scale must be 3 numbers",
        ),
        (
            "meta.lcc",
            FILES["meta.lcc"].replace(b'"attributes": [', b'"attributes": [3, '),
            "a list of objects",
        ),
    ],
)
def test_broken_scenes_are_refused(tmp_path, name, content, message):
    path = put(tmp_path / "scene", FILES)
    (path.parent / name).unlink()
    if content is not None:
        (path.parent / name).write_bytes(content)
    refused(path, message, 64 << 20)


def test_splat_transform_reads_the_same(tmp_path, node_package):
    folder = node_package("@playcanvas/splat-transform")
    path = put(tmp_path / "scene", encode.lcc(random_splats(40, degree=3)))
    program = folder / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    subprocess.run(["node", program, "-q", "-O", "0", path, tmp_path / "a.ply"], check=True)
    ours, theirs = ms.load_gaussians(path, axes="y-down"), ms.load_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(np.sort(ours.opacities), np.sort(theirs.opacities), atol=1e-6)
    np.testing.assert_allclose(
        np.linalg.norm(ours.means, axis=1), np.linalg.norm(theirs.means, axis=1), atol=1e-5
    )
    np.testing.assert_allclose(ours.scales, theirs.scales, atol=1e-6)
    np.testing.assert_allclose(ours.sh[:, 0], theirs.sh[:, 0], atol=1e-5)


def test_a_folder_of_lcc2_is_refused_with_the_command_that_converts_it(tmp_path):
    (tmp_path / "scene.lcc2").write_text('{"version": "0.0.3", "root": {}}')
    with pytest.raises(FileFormatError, match=r"splat-transform scene\.lcc2 scene\.ply"):
        ms.load_gaussians(tmp_path)
