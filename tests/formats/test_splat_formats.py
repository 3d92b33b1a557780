"""Every compressed splat format gives the values that went in, as closely as its steps allow."""

from __future__ import annotations

import json
import struct
import zipfile

import _splat_encoders as encode
import numpy as np
import pytest
from _splat_files import assert_same_cloud, expected_cloud, random_splats, splat_table, write_ply

from meshsplats import DataWarning, FileFormatError, load_gaussians, stream_gaussians
from meshsplats.formats.gaussians import format_of
from meshsplats.formats.sniff import identify

DEGREES = [0, 1, 2, 3]


def some_splats(n=9, degree=3, seed=4):
    """Values within the range of every format."""
    values = random_splats(n, degree, seed)
    for key in values:
        if key.startswith("f_"):
            values[key] = np.clip(values[key] / 2, -0.95, 0.95)
    return values


def close(cloud, values, *, means=0.0, quaternions=0.0, log_scales=0.0, opacities=0.0, dc=0.0, rest=0.0):
    """Absolute tolerances of the stored values; a little is added for rounding to float32."""
    expected = expected_cloud(values)
    e = 2e-6
    np.testing.assert_allclose(cloud.means, expected["means"], atol=means + e)
    sign = np.sign((cloud.quaternions * expected["quaternions"]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(cloud.quaternions * sign, expected["quaternions"], atol=quaternions + e)
    np.testing.assert_allclose(np.log(cloud.scales), np.log(expected["scales"]), atol=log_scales + e)
    np.testing.assert_allclose(cloud.opacities, expected["opacities"], atol=opacities + e)
    np.testing.assert_allclose(cloud.sh[:, :1], expected["sh"][:, :1], atol=dc + e)
    assert cloud.sh.shape == expected["sh"].shape
    np.testing.assert_allclose(cloud.sh[:, 1:], expected["sh"][:, 1:], atol=rest + e)


HALF_BYTE = 0.5 / 255


# -- PlayCanvas compressed .ply


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("n", [1, 9, 256, 300])
def test_compressed_ply(tmp_path, degree, order, n):
    values = some_splats(n, degree)
    path = tmp_path / "a.ply"
    path.write_bytes(encode.compressed_ply(values, order))
    assert format_of(path) == "compressed.ply"
    span = [np.ptp(values[key]) for key in values]
    # 10 and 11 bits over the range of a chunk; 8 bits for colours; 1/32 for harmonics.
    close(
        load_gaussians(path, strict=True),
        values,
        means=max(span[:3]) / 1023 / 2,
        quaternions=0.004,
        log_scales=max(np.ptp(values[f"scale_{k}"]) for k in range(3)) / 1023 / 2,
        opacities=HALF_BYTE,
        dc=max(np.ptp(values[f"f_dc_{c}"]) for c in range(3)) * HALF_BYTE,
        rest=1 / 32,
    )


def test_compressed_ply_with_an_empty_element_of_harmonics(tmp_path):
    """gsplat's exporter names the element at degree 0, too, without properties."""
    data = encode.compressed_ply(some_splats(degree=0))
    (tmp_path / "a.ply").write_bytes(data)
    (tmp_path / "b.ply").write_bytes(data.replace(b"end_header", b"element sh 9\nend_header"))
    plain, named = load_gaussians(tmp_path / "a.ply"), load_gaussians(tmp_path / "b.ply")
    assert named.sh_degree == 0
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(named, name), getattr(plain, name))
    (block,) = stream_gaussians(tmp_path / "b.ply")
    np.testing.assert_array_equal(block.means, plain.means)


@pytest.mark.parametrize("name", ["ROTATION", "OPACITY"])
def test_gltf_integers_are_fractions_without_the_flag(tmp_path, name):
    values = some_splats(degree=0)
    accessors = encode.splat_accessors(values)
    key = f"KHR_gaussian_splatting:{name}"
    dtype = "<i2" if name == "ROTATION" else "<u2"
    accessors[key] = np.round(accessors[key] * np.iinfo(dtype).max).astype(dtype)
    data = encode.gltf(accessors)
    (tmp_path / "a.glb").write_bytes(data)
    flag = b'"normalized": true'
    assert flag in data
    (tmp_path / "b.glb").write_bytes(data.replace(flag, b'"normalizes": true'))
    with pytest.warns(DataWarning, match=f"{name} has integers without the flag"):
        cloud = load_gaussians(tmp_path / "b.glb", axes="y-down")
    plain = load_gaussians(tmp_path / "a.glb", axes="y-down")
    np.testing.assert_array_equal(cloud.quaternions, plain.quaternions)
    np.testing.assert_array_equal(cloud.opacities, plain.opacities)


def test_compressed_ply_without_colour_ranges(tmp_path):
    values = some_splats(degree=0)
    (tmp_path / "a.ply").write_bytes(encode.compressed_ply(values, colors=False))
    cloud = load_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(
        cloud.colors, 0.5 + encode.C0 * expected_cloud(values)["sh"][:, 0], atol=HALF_BYTE
    )


def test_compressed_ply_kernel(tmp_path):
    (tmp_path / "a.ply").write_bytes(encode.compressed_ply(some_splats(), comments=["SplatRenderMode: mip"]))
    assert load_gaussians(tmp_path / "a.ply").kernel == "antialiased"


def test_compressed_ply_by_hand(tmp_path):
    """One splat with its fields typed out: a quarter turn about z, at three fifths of the range of x."""
    names = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    header = "ply\nformat binary_little_endian 1.0\nelement chunk 1\n"
    header += "".join(f"property float {name}\n" for name in names) + "element vertex 1\n"
    header += "".join(f"property uint packed_{what}\n" for what in ("position", "rotation", "scale", "color"))
    ranges = struct.pack("<12f", -1, 0, 10, 4, 1, 30, -5, -5, -5, -5, -3, -1)
    position = 0b10011001101 << 21 | 0b1111111111 << 11 | 0  # 1229 / 2047 of the x range, all of y, none of z
    # Largest: w = sqrt(1/2); x = y = 0 are nearly the middle of 10 bits, z = sqrt(1/2) their end.
    rotation = 0 << 30 | 512 << 20 | 511 << 10 | 1023
    scale = 0 << 21 | 0b1111111111 << 11 | 0b11111111111
    color = 255 << 24 | 0 << 16 | 51 << 8 | 204
    data = ranges + struct.pack("<4I", position, rotation, scale, color)
    (tmp_path / "a.ply").write_bytes((header + "end_header\n").encode() + data)
    cloud = load_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(cloud.means, [[-1 + 5 * 1229 / 2047, 1, 10]], rtol=1e-6)
    np.testing.assert_allclose(cloud.quaternions, [[0.7071, 0.0007, -0.0007, 0.7071]], atol=1e-4)
    np.testing.assert_allclose(cloud.scales, np.exp([[-5, -3, -1]]), rtol=1e-6)
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0.2]], atol=1e-6)
    np.testing.assert_allclose(cloud.opacities, [0.8], rtol=1e-6)


# -- .splat


@pytest.mark.parametrize("name", ["a.splat", "a.bin"])
def test_dot_splat(tmp_path, name):
    values = some_splats(700, degree=0)
    (tmp_path / name).write_bytes(encode.dot_splat(values))
    assert format_of(tmp_path / name) == "splat"
    cloud = load_gaussians(tmp_path / name, strict=True)
    dc = HALF_BYTE / encode.C0
    close(cloud, values, quaternions=0.008, opacities=HALF_BYTE, dc=dc)


@pytest.mark.parametrize("length", [0.5, 1.4, "255 q"])
def test_dot_splat_of_writers_that_do_not_store_unit_rotations(tmp_path, length):
    """Some leave their quaternions as they were optimised; some write 255 for w of round splats. Viewers of
    the web show both, for which the name is enough."""
    values = some_splats(400, degree=0)
    records = np.frombuffer(encode.dot_splat(values), np.uint8).reshape(-1, 32).copy()
    q = (records[:, 28:] - 127.5) / 127.5
    records[:, 28:] = [255, 0, 0, 0] if length == "255 q" else np.clip(128 + 128 * length * q, 0, 255)
    (tmp_path / "scene.splat").write_bytes(records.tobytes())
    cloud = load_gaussians(tmp_path / "scene.splat")
    np.testing.assert_allclose(np.linalg.norm(cloud.quaternions, axis=1), 1, atol=1e-6)
    expected = expected_cloud(values)
    np.testing.assert_array_equal(cloud.means, expected["means"])
    if length == 0.5:
        turned = np.abs((cloud.quaternions * expected["quaternions"]).sum(axis=1))
        assert np.degrees(2 * np.arccos(np.minimum(turned, 1))).max() < 3
    (tmp_path / "scene.bin").write_bytes(records.tobytes())  # without the name, nothing else tells
    with pytest.raises(FileFormatError, match="not a splat file of a known format"):
        load_gaussians(tmp_path / "scene.bin")


def test_dot_splat_refuses_negative_scales(tmp_path):
    data = bytearray(encode.dot_splat(some_splats(20, degree=0)))
    data[32 + 12 : 32 + 16] = struct.pack("<f", -0.5)
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.warns(DataWarning, match="1 of 20"):
        assert len(load_gaussians(tmp_path / "a.splat")) == 19


# -- SPZ


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz(tmp_path, version, degree):
    values = some_splats(degree=degree)
    (tmp_path / "a.spz").write_bytes(encode.spz(values, version))
    assert format_of(tmp_path / "a.spz") == "spz"
    cloud = load_gaussians(tmp_path / "a.spz", strict=True, axes="y-down")
    spz_close(cloud, values, version)


def spz_close(cloud, values, version):
    close(
        cloud,
        values,
        means=2**-10 if version == 1 else 2**-13,
        # 8 bits for x, y, z; where w is small, it takes the error of their squares.
        quaternions=0.06 if version < 3 else 0.0015,
        log_scales=1 / 32,
        opacities=HALF_BYTE,
        dc=HALF_BYTE / 0.15,
        rest=1 / 256,
    )


def test_spz_positions_by_hand(tmp_path):
    values = some_splats(2, degree=0)
    data = encode.spz_attributes(values, 3, bits=8)
    data["positions"] = bytes([0, 1, 0, 255, 255, 255, 0, 0, 128]) + bytes(
        [255, 255, 127, 1, 0, 0, 128, 0, 0]
    )
    body = encode.spz_header(values, 3, bits=8) + b"".join(data.values())
    (tmp_path / "a.spz").write_bytes(encode.gzip.compress(body))
    cloud = load_gaussians(tmp_path / "a.spz", axes="y-down")
    np.testing.assert_array_equal(cloud.means, [[1, -1 / 256, -32768], [32768 - 1 / 256, 1 / 256, 0.5]])


def test_rotations_too_long_for_their_largest_component(tmp_path):
    """Three components of sqrt(1/2) leave less than nothing for the fourth, which is 0."""
    values = some_splats(1, degree=0)
    data = encode.spz_attributes(values, 3)
    data["rotations"] = struct.pack("<I", 3 << 30 | 511 << 20 | 511 << 10 | 511)
    body = encode.spz_header(values, 3) + b"".join(data.values())
    (tmp_path / "a.spz").write_bytes(encode.gzip.compress(body))
    cloud = load_gaussians(tmp_path / "a.spz", axes="y-down", strict=True)
    np.testing.assert_allclose(cloud.quaternions, [[0, 3**-0.5, 3**-0.5, 3**-0.5]], rtol=1e-6)


@pytest.mark.parametrize(("flags", "kernel"), [(0, "3dgs"), (1, "antialiased")])
def test_spz_kernel(tmp_path, flags, kernel):
    (tmp_path / "a.spz").write_bytes(encode.spz(some_splats(), flags=flags))
    assert load_gaussians(tmp_path / "a.spz").kernel == kernel


def test_spz_of_degree_4_is_cut(tmp_path):
    values = some_splats(degree=3)
    rest = [[values[f"f_rest_{15 * c + j}"] for j in range(15)] for c in range(3)]
    four = {key: value for key, value in values.items() if not key.startswith("f_rest")}
    for c in range(3):
        for j in range(24):
            four[f"f_rest_{24 * c + j}"] = rest[c][j] if j < 15 else np.full(9, 0.7)
    (tmp_path / "a.spz").write_bytes(encode.spz(four))
    with pytest.warns(DataWarning, match="degree 4"):
        cloud = load_gaussians(tmp_path / "a.spz", axes="y-down")
    spz_close(cloud, values, 3)


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_version_4(tmp_path, degree):
    zstandard = pytest.importorskip("zstandard", reason="install meshsplats[formats]")
    values = some_splats(degree=degree)
    unknown = struct.pack("<II5s", 0x12340001, 5, b"hello")
    data = encode.spz4(values, zstandard.ZstdCompressor().compress, flags=3, extensions=unknown)
    (tmp_path / "a.spz").write_bytes(data)
    cloud = load_gaussians(tmp_path / "a.spz", strict=True, axes="y-down")
    assert cloud.kernel == "antialiased"
    spz_close(cloud, values, 4)


def test_spz_version_4_without_zstandard(tmp_path, monkeypatch):
    from meshsplats import MissingDependencyError

    monkeypatch.setitem(__import__("sys").modules, "zstandard", None)
    monkeypatch.setitem(__import__("sys").modules, "compression.zstd", None)
    (tmp_path / "a.spz").write_bytes(encode.spz4(some_splats(), lambda raw: raw))
    with pytest.raises(MissingDependencyError, match=r"extra 'formats': pip install zstandard"):
        load_gaussians(tmp_path / "a.spz")


# -- SOG


def put(folder, files):
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("form", ["folder", "meta", "bundle", "bundle in a folder"])
def test_sog(tmp_path, version, degree, form):
    values = some_splats(70, degree)
    files = encode.sog(values, version)
    if form.startswith("bundle"):
        path = tmp_path / "a.sog"
        path.write_bytes(encode.bundle(files, "scene/" if "folder" in form else "", zipfile.ZIP_DEFLATED))
    else:
        path = put(tmp_path / "scene", files)
        path = path if form == "folder" else path / "meta.json"
    assert format_of(path) == "sog"
    cloud = load_gaussians(path, strict=True)

    def step(*names):
        stored = [values[key] for key in values if key.startswith(names)]
        spans = [np.ptp(column) for column in stored] if version == 1 else [np.ptp(np.stack(stored))]
        return max(spans) * HALF_BYTE

    rest = [values[key] for key in values if key.startswith("f_rest")]
    close(
        cloud,
        values,
        means=2e-3,
        quaternions=0.006,
        log_scales=step("scale_"),
        # Version 1 has steps of the logit, whose sigmoid is at most a quarter as steep.
        opacities=HALF_BYTE if version == 2 else step("opacity") / 4,
        dc=step("f_dc_"),
        rest=np.ptp(np.stack(rest)) * HALF_BYTE if rest else 0,
    )


def test_sog_bundle_is_read_by_its_outermost_meta(tmp_path):
    inner = {f"parts/{name}": data for name, data in encode.sog(some_splats(3)).items()}
    (tmp_path / "a.sog").write_bytes(encode.bundle(inner | encode.sog(some_splats(9))))
    assert len(load_gaussians(tmp_path / "a.sog")) == 9


@pytest.mark.parametrize(
    ("extra", "kernel"),
    [
        ({"antialias": True}, "antialiased"),
        ({"model": "antialiased"}, "antialiased"),
        ({"model": "2dgs"}, "2dgs"),
    ],
)
def test_sog_kernel(tmp_path, extra, kernel):
    assert load_gaussians(put(tmp_path / "s", encode.sog(some_splats(), extra=extra))).kernel == kernel


def test_sog_labels_beyond_the_palette_have_no_harmonics(tmp_path):
    values = some_splats(9, degree=1)
    files = encode.sog(values)
    files["shN_labels.webp"] = encode.webp(np.array([[k, k == 3, 0, 255] for k in range(9)]))
    cloud = load_gaussians(put(tmp_path / "s", files))
    assert (cloud.sh[3, 1:] == 0).all()
    assert (cloud.sh[4, 1:] != 0).any()


def changed_meta(files, change):
    meta = json.loads(files["meta.json"])
    change(meta)
    return files | {"meta.json": json.dumps(meta).encode()}


@pytest.mark.parametrize("degree", [1, 3])
def test_sog_of_the_first_days_of_version_2_states_neither_bands_nor_count(tmp_path, degree):
    files = encode.sog(some_splats(9, degree))

    def forget(meta):
        del meta["shN"]["bands"], meta["shN"]["count"]

    cloud = load_gaussians(put(tmp_path / "old", changed_meta(files, forget)), strict=True)
    assert np.array_equal(cloud.sh, load_gaussians(put(tmp_path / "new", files)).sh)


def test_sog_codebooks_may_lack_their_first_entry(tmp_path):
    """As PlayCanvas' engine mends it: as far below the second as all others are apart in the mean."""
    files = encode.sog(some_splats(9, degree=1))
    files["sh0.webp"] = encode.webp(np.tile([0, 1, 255, 255], (9, 1)))

    def empty(meta):
        meta["sh0"]["codebook"] = [None, *np.linspace(1.0, 52.0, 255)]

    cloud = load_gaussians(put(tmp_path / "s", changed_meta(files, empty)), strict=True)
    np.testing.assert_allclose(cloud.sh[:, 0], np.tile([0.8, 1, 52], (9, 1)), rtol=1e-6)


def test_sog_images_may_be_png(tmp_path):
    values = some_splats(9, degree=0)
    files = encode.sog(values)
    from io import BytesIO

    from PIL import Image

    files["quats.webp"] = encode.image(
        np.asarray(Image.open(BytesIO(files["quats.webp"])).convert("RGBA")), "PNG"
    )
    assert len(load_gaussians(put(tmp_path / "s", files), strict=True)) == 9


def test_a_sog_folder_that_names_its_generator_is_no_gltf(tmp_path):
    # As PlayCanvas' splat-transform writes it since version 0.16.
    files = encode.sog(some_splats(9), extra={"asset": {"generator": "splat-transform v0.16.0"}})
    folder = put(tmp_path / "s", files)
    for path in (folder, folder / "meta.json"):
        assert format_of(path) == "sog"
        assert len(load_gaussians(path, strict=True)) == 9


def test_streamed_sog_is_read_place_by_place_in_the_finest_level(tmp_path):
    fine, coarse, sky = (random_splats(n, degree=d, seed=n) for n, d in ((9, 1), (4, 0), (3, 1)))
    leaves = [
        {0: ("0_0", 5, 4), 1: ("1_0", 0, 1)},
        {1: ("1_0", 1, 2)},  # a place without level 0; the first and the last of 1_0 are not needed
        {1: ("1_0", 3, 1), 0: ("0_0", 0, 3)},
    ]
    files = encode.streamed_sog({"0_0": fine, "1_0": coarse, "env": sky}, leaves, environment="env/meta.json")
    folder = put(tmp_path / "scene", files)
    parts = [load_gaussians(folder / name) for name in ("0_0", "1_0", "env")]
    for path in (folder, folder / "lod-meta.json"):
        cloud = load_gaussians(path, strict=True)
        for name in ("means", "quaternions", "scales", "opacities"):
            a, b, c = (getattr(part, name) for part in parts)
            assert np.array_equal(getattr(cloud, name), np.concatenate([a[:3], a[5:], b[1:3], c]))
        assert cloud.sh.shape == (12, 4, 3)
        assert np.array_equal(cloud.sh[:3], parts[0].sh[:3])
        assert np.array_equal(cloud.sh[7:9, :1], parts[1].sh[1:3])
        assert (cloud.sh[7:9, 1:] == 0).all()
    assert format_of(folder) == "streamed sog"
    assert identify(folder / "lod-meta.json") == "splats"


def test_streamed_sog_may_be_zipped_in_parts_and_have_empty_places(tmp_path):
    part = some_splats(9)
    files = encode.streamed_sog({"a": part}, [{0: ("a", 0, 9)}, {0: ("a", 9, 0)}], filenames=["a.sog"])
    folder = put(tmp_path / "scene", files | {"a.sog": encode.bundle(encode.sog(part))})
    assert len(load_gaussians(folder)) == 9


def test_sog_quaternions_without_a_tag_are_dropped(tmp_path):
    files = encode.sog(some_splats(9, degree=0))
    files["quats.webp"] = encode.webp(np.array([[128, 128, 128, 252 if i else 7] for i in range(9)]))
    with pytest.warns(DataWarning, match="1 with a zero quaternion"):
        assert len(load_gaussians(put(tmp_path / "s", files))) == 8


# -- glTF


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("kind", ["glb", "gltf"])
def test_gltf(tmp_path, degree, kind):
    values = some_splats(degree=degree)
    path = tmp_path / f"a.{kind}"
    path.write_bytes(encode.gltf(encode.splat_accessors(values), kind=kind))
    assert format_of(path) == "gltf"
    close(load_gaussians(path, strict=True, axes="y-down"), values)


def test_gltf_with_log_scales_of_the_draft(tmp_path):
    values = some_splats()
    (tmp_path / "a.glb").write_bytes(encode.gltf(encode.splat_accessors(values, log_scales=True)))
    close(load_gaussians(tmp_path / "a.glb", axes="y-down"), values)


def test_gltf_with_quantised_attributes(tmp_path):
    values = some_splats(degree=0)
    accessors = encode.splat_accessors(values)
    prefix = "KHR_gaussian_splatting:"
    accessors[prefix + "ROTATION"] = np.round(accessors[prefix + "ROTATION"] * 32767).astype("<i2")
    accessors[prefix + "OPACITY"] = np.round(accessors[prefix + "OPACITY"] * 65535).astype("<u2")
    (tmp_path / "a.glb").write_bytes(encode.gltf(accessors))
    cloud = load_gaussians(tmp_path / "a.glb", axes="y-down")
    close(cloud, values, quaternions=3e-5, opacities=1e-5)


def test_gltf_with_spz_inside(tmp_path):
    values = some_splats()
    (tmp_path / "a.spz").write_bytes(encode.spz(values))
    (tmp_path / "a.glb").write_bytes(encode.gltf(spz_data=encode.spz(values)))
    alone, inside = load_gaussians(tmp_path / "a.spz"), load_gaussians(tmp_path / "a.glb")
    np.testing.assert_array_equal(alone.means, inside.means)
    np.testing.assert_array_equal(alone.quaternions, inside.quaternions)
    np.testing.assert_array_equal(alone.sh, inside.sh)


def test_gltf_joins_the_splats_of_all_nodes(tmp_path):
    values = some_splats(degree=1)
    nodes = [{"mesh": 0, "children": [1]}, {"mesh": 0, "translation": [10, 0, 0], "scale": [2, 2, 2]}]
    (tmp_path / "a.glb").write_bytes(encode.gltf(encode.splat_accessors(values), nodes=nodes))
    cloud = load_gaussians(tmp_path / "a.glb", axes="y-down")
    one = expected_cloud(values)
    np.testing.assert_allclose(
        cloud.means, np.concatenate([one["means"], 2 * one["means"] + [10, 0, 0]]), rtol=1e-5
    )
    np.testing.assert_allclose(cloud.scales, np.concatenate([one["scales"], 2 * one["scales"]]), rtol=1e-5)
    np.testing.assert_allclose(cloud.sh, np.tile(one["sh"], (2, 1, 1)), rtol=1e-5)


# -- what is not read


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.lcc2", b'{"version": "5.0", "splats": 10, "totalLevel": 3}', "splat-transform a.lcc2 a.ply"),
        ("a.splatv", b"\x4b\x67\0\0\x02\0\0\0{}" + bytes(64), "splats that move, are not read here"),
        ("cut.splat", bytes(33), "not records of 32 bytes"),
        ("a.ply.gz", b"\x1f\x8b\x08" + bytes(40), "a gzip file, but not SPZ; unpack it first"),
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
        ("a.spz", b"\n<!DOCTYPE html><html>", "a web page, not the file itself"),
    ],
)
def test_what_is_not_read_is_named_by_all_who_meet_it(tmp_path, name, data, message):
    path = tmp_path / name
    path.write_bytes(data)
    for ask in (load_gaussians, identify, format_of):
        with pytest.raises(FileFormatError, match=message):
            ask(path)


def test_axes_must_be_known(tmp_path):
    path = write_ply(tmp_path / "a.ply", [splat_table(random_splats(degree=0))])
    assert_same_cloud(load_gaussians(path, axes="y-down"), expected_cloud(random_splats(degree=0)))
    with pytest.raises(ValueError, match="axes must be one of auto, y-down, y-up, got 'z-up'"):
        load_gaussians(path, axes="z-up")
