"""``convert --scale`` and ``--up``, of meshes and splats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _priors import cube
from _splats import few_splats

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.formats.outputs import scaled

ORIGIN = [5e5, 4.5e6, -20.0]


@pytest.fixture
def splats(tmp_path):
    cloud = replace(few_splats(), origin=np.array(ORIGIN))
    ms.save_gaussians(cloud, tmp_path / "a.ply")
    return cloud


def run(tmp_path, name, *words):
    out = [str(tmp_path / "a.ply"), "-o", str(tmp_path / name), "--no-preview", "--no-sidecar"]
    return main(["convert", *out, *words])


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", ["b.ply", "b.npz", "b.glb", "b.usdc", "b.obj"])
def test_meshes_are_scaled_in_every_format(tmp_path, splats, name):
    if name.endswith("usdc"):
        pytest.importorskip("pxr")
    assert run(tmp_path, name) == 0
    plain = ms.load_mesh(tmp_path / name)
    assert run(tmp_path, name, "--scale", "0.01", "--force") == 0
    mesh = ms.load_mesh(tmp_path / name)
    world, expected = mesh.vertices + mesh.origin, 0.01 * (plain.vertices + plain.origin)
    np.testing.assert_allclose(world, expected, rtol=1e-7, atol=1e-6)
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(
        0.01 * np.ptp(plain.vertices, axis=0).max(), rel=1e-4
    )


@pytest.mark.parametrize("name", ["b.ply", "b.sog", "b.glb", "b.usdz"])
def test_splats_are_scaled_and_say_which_way_is_up(tmp_path, splats, name):
    if name.endswith("usdz"):
        pytest.importorskip("pxr")
    assert run(tmp_path, name, "--as-splats", "--scale", "100", "--up", "z") == 0
    cloud = ms.load_gaussians(tmp_path / name)
    order, theirs = np.argsort(splats.means[:, 0]), np.argsort(cloud.means[:, 0])
    np.testing.assert_allclose(cloud.means[theirs], 100 * splats.means[order], rtol=1e-5, atol=0.05)
    np.testing.assert_allclose(
        np.sort(cloud.scales, 1)[theirs], 100 * np.sort(splats.scales, 1)[order], rtol=0.05
    )
    np.testing.assert_allclose(cloud.origin, 100 * np.array(ORIGIN))
    np.testing.assert_allclose(cloud.up, [0, 0, 1], atol=1e-6)


def test_up_is_said_of_streamed_splats(tmp_path, splats):
    assert run(tmp_path, "b.ply", "--as-splats", "--stream", "--up", "0,-1,1") == 0
    np.testing.assert_allclose(
        ms.load_gaussians(tmp_path / "b.ply").up, [0, -(0.5**0.5), 0.5**0.5], atol=1e-6
    )


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--scale", "0"], 2, "--scale must be a number above 0"),
        (["--scale", "nan"], 2, "--scale must be a number above 0"),
        (["--scale", "2", "--stream"], 2, "need all in memory: leave out --stream"),
        (["--as-splats", "--up", "w"], 2, "--up must be an axis"),
    ],
)
def test_wrong_values_are_refused_first(tmp_path, splats, capsys, words, code, message):
    assert run(tmp_path, "b.ply", *words) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "b.ply").exists()


def test_a_prior_is_scaled_with_its_base_alone():
    with pytest.raises(ValueError, match="scale the base"):
        scaled(ms.bind(cube()).mesh, 2.0)
    mesh = ms.convert(few_splats())
    assert scaled(mesh, None) is mesh
