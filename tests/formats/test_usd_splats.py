"""Splats of USD files that others write, typed out as text."""

from __future__ import annotations

import struct
import zipfile

import _splat_encoders as encode
import numpy as np
import pytest
from _splat_files import assert_same_cloud, expected_cloud, random_splats

import meshsplats as ms
from meshsplats.errors import DataWarning
from meshsplats.formats.gaussians import format_of
from meshsplats.formats.sniff import identify
from meshsplats.formats.usd import crate
from meshsplats.formats.usd.crate import holds_token

pytest.importorskip("pxr", reason="extra usd")
VALUES = random_splats(6, degree=2)
PRIM = b"ParticleField3DGaussianSplat"


def read(tmp_path, name="a.usda", *, axes="y-down", **options):
    (tmp_path / name).write_text(encode.usda(VALUES, **options))
    return ms.load_gaussians(tmp_path / name, axes=axes)


def test_a_field_is_read_as_it_stands(tmp_path):
    assert_same_cloud(read(tmp_path), expected_cloud(VALUES), 1e-5)
    assert identify(tmp_path / "a.usda") == "splats"
    assert format_of(tmp_path / "a.usda") == "usd"


@pytest.mark.slow
def test_y_up_and_z_up_both_become_y_down(tmp_path):
    turned = {up: read(tmp_path, up=up, axes="auto") for up in "YZ"}
    x, y, z = expected_cloud(VALUES)["means"].T
    np.testing.assert_allclose(turned["Y"].means, np.stack([x, -y, -z], 1), atol=1e-5)
    np.testing.assert_allclose(turned["Z"].means, np.stack([x, -z, y], 1), atol=1e-5)


def test_halves_are_read_where_there_are_no_floats(tmp_path):
    names = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
    assert_same_cloud(read(tmp_path, half=names), expected_cloud(VALUES), 4e-3)


@pytest.mark.slow
def test_transforms_place_the_splats(tmp_path):
    xform = "double3 xformOp:translate = (100, 0, 0)\n double3 xformOp:scale = (2, 2, 2)\n"
    xform += ' uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]'
    cloud, plain = read(tmp_path, xform=xform), read(tmp_path)
    np.testing.assert_allclose(cloud.means, plain.means * 2 + [100, 0, 0], atol=1e-4)
    np.testing.assert_allclose(cloud.scales, plain.scales * 2, rtol=1e-5)


@pytest.mark.slow
def test_what_is_missing_is_as_the_schema_says(tmp_path):
    cloud = read(tmp_path, drop=("opacities", "orientations", "scales"))
    assert (cloud.opacities == 1).all()
    assert (cloud.quaternions == [1, 0, 0, 0]).all()
    assert (cloud.scales == 1).all()
    with pytest.warns(DataWarning, match="no colours"):
        cloud = read(tmp_path, drop=("radiance:sphericalHarmonicsCoefficients",))
    assert (cloud.colors == 0.5).all()
    with pytest.raises(ms.FileFormatError, match="no positions"):
        read(tmp_path, drop=("positions",))


@pytest.mark.slow
def test_colours_are_linear_only_where_the_file_says_so(tmp_path):
    plain = read(tmp_path)
    np.testing.assert_array_equal(read(tmp_path, colors="srgb_rec709_scene").sh, plain.sh)
    with pytest.warns(DataWarning, match="its colours are linear"):
        linear = read(tmp_path, colors="lin_rec709_scene")
    assert np.abs(linear.sh - plain.sh).max() > 0.1


def test_harmonics_beyond_degree_3_are_left_out_with_a_word(tmp_path):
    values = random_splats(3, degree=4)
    (tmp_path / "a.usda").write_text(encode.usda(values))
    with pytest.warns(DataWarning, match="degree 4; those beyond degree 3 are left out"):
        cloud = ms.load_gaussians(tmp_path / "a.usda", axes="y-down")
    np.testing.assert_allclose(cloud.sh, expected_cloud(values)["sh"][:, :16], atol=1e-5)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("HarmonicsDegree = 2", "HarmonicsDegree = 77"), "must be 0 to 8"),
        (("point3f[] positions", "string[] positions"), "not readable as USD|3 numbers"),
        (("def Xform", 'def Xform "A" (references = @other.usda@) {}\ndef Xform'), "refers to other files"),
        (("-", "--"), "not readable as USD"),
    ],
)
def test_broken_files_give_one_clear_error(tmp_path, change, message):
    text = encode.usda(VALUES).replace(*change, 1)
    assert text != encode.usda(VALUES)
    (tmp_path / "a.usda").write_text(text)
    with pytest.raises(ms.FileFormatError, match=message):
        ms.load_gaussians(tmp_path / "a.usda")


def test_what_is_invisible_is_not_read(tmp_path):
    with pytest.raises(ms.FileFormatError, match="no visible splats"):
        read(tmp_path, xform='token visibility = "invisible"')


@pytest.mark.slow
def test_packages_are_read_by_their_first_file(tmp_path):
    from pxr import Sdf

    (tmp_path / "b.usda").write_text(encode.usda(VALUES))
    Sdf.Layer.FindOrOpen(str(tmp_path / "b.usda")).Export(str(tmp_path / "b.usdc"))
    for name in ("b.usda", "b.usdc"):
        with zipfile.ZipFile(tmp_path / "a.usdz", "w") as archive:
            archive.write(tmp_path / name, name)
        assert identify(tmp_path / "a.usdz") == "splats"
        assert_same_cloud(ms.load_gaussians(tmp_path / "a.usdz", axes="y-down"), expected_cloud(VALUES), 1e-5)


def test_meshes_stay_meshes(tmp_path):
    mesh = ms.convert(ms.GaussianCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]]))
    for name in ("m.usdc", "m.usda"):
        ms.save_mesh(mesh, tmp_path / name)
        assert identify(tmp_path / name) == "mesh"
        with pytest.raises(ms.FileFormatError):
            ms.load_gaussians(tmp_path / name)


def test_tokens_are_found_without_the_library_however_many(tmp_path):
    from pxr import Sdf

    names = "\n".join(f'def Xform "prim_{i * 7919 % 100003}_{"ab" * (i % 9)}" {{}}' for i in range(3000))
    for prim, expected in (("ParticleField3DGaussianSplat", True), ("Points", False)):
        (tmp_path / "a.usda").write_text(encode.usda(VALUES, prim=prim) + names)
        Sdf.Layer.FindOrOpen(str(tmp_path / "a.usda")).Export(str(tmp_path / f"{prim}.usdc"))
        with open(tmp_path / f"{prim}.usdc", "rb") as file:
            assert holds_token(file, PRIM) is expected


def test_broken_tables_of_tokens_are_no_splats(tmp_path):
    path = tmp_path / "a.usdc"
    far = struct.pack("<8xqQ16sqq", 24, 1, b"TOKENS", 64, 9)
    for body in (b"", struct.pack("<8xq", -5), struct.pack("<8xq", 10**12), far):
        path.write_bytes(b"PXR-USDC" + body)
        with open(path, "rb") as file:
            assert not holds_token(file, PRIM)
    with pytest.raises(ValueError, match="not there"):
        crate._lz4(b"\x10a\x05\x00", 100)
