""".ksplat files, encoded splat by splat as the viewer GaussianSplats3D writes them."""

from __future__ import annotations

import struct
import subprocess

import _splat_encoders as encode
import numpy as np
import pytest
from _splat_files import expected_cloud, random_splats
from _splats import refused

import meshsplats as ms
from meshsplats.formats.gaussians import format_of


def by_place(cloud):
    """The rows of ``cloud`` in the order of x, as the encoder sorts splats into buckets."""
    return cloud.take(np.argsort(cloud.means[:, 0]))


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("sections", [1, 3])
def test_every_level_and_degree_is_read(tmp_path, level, degree, sections):
    values = random_splats(41, degree=degree)
    for key in values:
        if key.startswith("f_"):
            values[key] = np.clip(values[key], -1.7, 1.7)
    (tmp_path / "a.ksplat").write_bytes(encode.ksplat(values, level, sections=sections))
    assert format_of(tmp_path / "a.ksplat") == "ksplat"
    cloud, expected = by_place(ms.load_gaussians(tmp_path / "a.ksplat")), expected_cloud(values)
    order = np.argsort(expected["means"][:, 0])
    np.testing.assert_allclose(cloud.means, expected["means"][order], atol=1e-6 if level == 0 else 4e-5)
    np.testing.assert_allclose(cloud.scales, expected["scales"][order], rtol=1e-6 if level == 0 else 1e-3)
    np.testing.assert_allclose(cloud.quaternions, expected["quaternions"][order], atol=1e-3)
    np.testing.assert_allclose(cloud.opacities, expected["opacities"][order], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(cloud.sh[:, 0], expected["sh"][order, 0], atol=0.5 / 255 / encode.C0 + 1e-5)
    limit = (1e-6, 1e-3, 2 / 255 + 1e-5)[level]
    np.testing.assert_allclose(cloud.sh[:, 1:], expected["sh"][order, 1:], atol=limit)


def test_blocks_and_other_names(tmp_path):
    values = random_splats(41, degree=1)
    (tmp_path / "scan").write_bytes(encode.ksplat(values, 1, sections=2))
    assert format_of(tmp_path / "scan") == "ksplat"
    blocks = list(ms.stream_gaussians(tmp_path / "scan", block=10))
    assert sum(map(len, blocks)) == 41
    np.testing.assert_array_equal(
        np.concatenate([block.means for block in blocks]), ms.load_gaussians(tmp_path / "scan").means
    )


def changed(data, at, kind, value):
    return data[:at] + struct.pack(kind, value) + data[at + struct.calcsize(kind) :]


GOOD = encode.ksplat(random_splats(21, degree=1), 1)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\0\1", "truncated: 44 bytes are needed"),
        (changed(GOOD, 1, "<B", 9), "version 0.9; known is 0.1"),
        (changed(GOOD, 20, "<H", 7), "compression level 7"),
        (changed(GOOD, 4, "<I", 1 << 31), "headers of 2,147,483,648 sections"),
        (changed(GOOD, 16, "<I", 22), "hold 21 splats, its header says 22"),
        (changed(GOOD, 4096, "<I", 1 << 30), "does not fit the file"),
        (changed(GOOD, 4096 + 12, "<I", 1 << 30), "does not fit the file"),
        (changed(GOOD, 4096 + 8, "<I", 1 << 31), "does not fit the file"),
        (changed(GOOD, 4096 + 40, "<H", 4), "degree 4, expected 0 to 3"),
        (changed(GOOD, 4096 + 16, "<f", np.nan), "does not fit the file"),
        (changed(GOOD, 36, "<f", np.inf), "range of harmonics that is not finite"),
        (changed(GOOD, 5120, "<I", 0), "bucket"),
        (GOOD[:-1], "does not fit the file"),
    ],
)
def test_broken_files_are_refused(tmp_path, data, message):
    (tmp_path / "a.ksplat").write_bytes(data)
    refused(tmp_path / "a.ksplat", message, 64 << 20)


@pytest.mark.parametrize(("level", "degree", "sections"), [(0, 2, 2), (1, 2, 2), (2, 1, 1)])
def test_splat_transform_reads_the_same(tmp_path, node_package, level, degree, sections):
    folder = node_package("@playcanvas/splat-transform")
    data = encode.ksplat(random_splats(300, degree=degree), level, sections=sections, capacity=16)
    (tmp_path / "a.ksplat").write_bytes(data)
    program = folder / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    subprocess.run(["node", program, "-q", tmp_path / "a.ksplat", tmp_path / "a.ply"], check=True)
    ours, theirs = ms.load_gaussians(tmp_path / "a.ksplat"), ms.load_gaussians(tmp_path / "a.ply")
    for name in ("means", "scales", "quaternions", "opacities", "sh"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6, err_msg=name)
