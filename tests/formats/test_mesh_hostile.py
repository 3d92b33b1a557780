"""Broken and hostile mesh files: one clear error each, little memory, no code run."""

import base64
import io
import json
import struct
import time
import tracemalloc
import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from _glb import edit_glb
from _local import linux_names, make_link
from _meshes import fan_mesh, random_mesh
from test_mesh_foreign import TRIANGLE, gltf

from meshsplats import DataWarning, FileFormatError, load_mesh, save_mesh
from meshsplats.formats import _validation as mesh_checks
from meshsplats.formats.obj.mesh import statements

MESH = random_mesh(np.random.default_rng(0), 5, 6)


def refused(path, match, megabytes=8):
    """Loading raises FileFormatError that names the file, within the given memory."""
    tracemalloc.start()
    try:
        with pytest.raises(FileFormatError, match=match) as caught:
            load_mesh(path)
        assert tracemalloc.get_traced_memory()[1] < megabytes << 20
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(str(path))
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("suffix", [".npz", ".ply", ".glb"])
def test_truncated_at_every_length(tmp_path, suffix):
    save_mesh(MESH, tmp_path / f"m{suffix}")
    data = (tmp_path / f"m{suffix}").read_bytes()
    for length in {*range(0, 60), *range(0, len(data), 101), *range(len(data) - 40, len(data))}:
        (tmp_path / "cut").write_bytes(data[:length])
        with pytest.raises(FileFormatError, match="cut"):
            load_mesh(tmp_path / "cut")


def test_things_that_are_no_mesh(tmp_path):
    path = tmp_path / "file"
    for data, match in (
        (b"", "the file is empty"),
        (b"\x89PNG\r\n\x1a\n", "an image; 'meshsplats train' makes a mesh of a folder of photographs"),
        (b"Dear reader,\nthis is text.\n", "not a mesh file of a known format"),
        (b"{}", "not a glTF 2 file"),
        (b'[{"name": "a"}]', "not a mesh file"),
        (b"ply\nformat ascii 1.0\nend_header\n", "no element 'vertex'"),
    ):
        path.write_bytes(data)
        refused(path, match)
    with pytest.raises(FileNotFoundError):
        load_mesh(tmp_path / "missing.glb")
    with pytest.raises(IsADirectoryError):
        load_mesh(tmp_path)


# -- npz


def npz(path, *, drop=(), compressed=False, **changed):
    arrays = {
        "vertices": TRIANGLE,
        "faces": np.array([[0, 1, 2]]),
        "vertex_colors": np.ones((3, 4), np.float32),
        **changed,
    }
    for name in drop:
        del arrays[name]
    (np.savez_compressed if compressed else np.savez)(path, **arrays)
    return path


class Runs:
    """Leaves a trace if it is unpickled."""

    traces: list[int] = []  # noqa: RUF012

    def __reduce__(self):
        return (Runs.traces.append, (1,))


def test_npz_that_do_not_hold_a_mesh(tmp_path):
    path = tmp_path / "m.npz"
    f4 = np.float32
    for changed, match in (
        ({"drop": ["vertices"]}, "array 'vertices' is missing .*faces"),
        ({"drop": ["vertex_colors"]}, "array 'vertex_colors' is missing"),
        ({"vertices": np.zeros((3, 2), f4)}, r"'vertices' has shape \(3, 2\), expected \(3, 3\)"),
        ({"vertices": f4(1)}, r"'vertices' has shape \(\)"),
        ({"vertex_colors": np.ones((2, 4), f4)}, r"'vertex_colors' has shape \(2, 4\), expected \(3, 4\) or"),
        ({"faces": np.array([[0.0, 1, 2]])}, "faces must hold integers"),
        ({"faces": np.array([[0, 1, 3]])}, "faces must be vertex indices from 0 to 2, got 0 to 3"),
        ({"faces": np.array([[0, 1, -1]])}, "faces must be vertex indices"),
        ({"vertices": TRIANGLE + np.nan}, "vertices must be finite"),
        ({"vertices": TRIANGLE.astype(float) + 1e300}, "vertices must be finite"),
        ({"vertex_colors": np.full((3, 4), np.inf)}, "colors must be finite"),
        ({"vertices": np.array([["a"] * 3] * 3)}, "'vertices' must hold numbers, got dtype <U1"),
        ({"vertices": TRIANGLE.astype(complex)}, "'vertices' must hold numbers"),
        ({"vertices": np.zeros(3, [("x", "f4")])}, "'vertices' must hold numbers"),
        ({"face_splat": np.array([1, 2])}, r"'face_splat' has shape \(2,\), expected \(1,\)"),
        ({"face_splat": np.array([-1])}, "face_splat must be ascending indices >= 0"),
        ({"up": np.zeros(3)}, "up must not be the zero vector"),
        ({"blending": np.array("additive")}, "blending must be one of display, linear"),
        ({"order": np.array("nearest")}, "order must be 'fragment' or 'splat', got 'nearest'"),
        ({"order": np.array("splat")}, "order='splat' blends whole splats, but the mesh has no face_splat"),
        ({"order": np.array(1)}, "'order' must hold text"),
        ({"filter_px2": np.array(0.3)}, "the mesh has no face_splat"),
        ({"filter_px2": np.array(-1.0), "face_splat": np.array([0])}, "filter_px2 must be a variance"),
        ({"filter_px2": np.array([0.3])}, r"'filter_px2' has shape \(1,\), expected \(\)"),
        ({"filter_px2": np.array("0.3")}, "'filter_px2' must hold numbers"),
        ({"blending": np.array("x" * 100)}, "'blending' must hold text"),
        ({"attribute_a": np.ones(2)}, r"'attribute_a' has shape \(2,\), expected \(3,\) or \(3, c\)"),
    ):
        refused(npz(path, **changed), match)


def test_pickled_npz_run_no_code(tmp_path):
    for name in ("vertices", "faces", "blending", "attribute_x"):
        refused(npz(tmp_path / "m.npz", **{name: np.array([Runs()], object)}), "pickled Python objects")
    npz(tmp_path / "m.npz", unrelated=np.array([Runs()], object))
    load_mesh(tmp_path / "m.npz")  # other arrays are not read
    assert not Runs.traces


def test_decompression_bombs(tmp_path, monkeypatch):
    """Megabytes of zeros in a few kilobytes, honestly declared: as positions alone, and as a whole mesh."""
    n = 1_000_000
    zeros = np.zeros((n, 3), np.float32)
    path = npz(tmp_path / "m.npz", compressed=True, vertices=zeros)
    refused(path, r"'vertex_colors' has shape \(3, 4\), expected \(1000000, 4\)")
    monkeypatch.setattr(mesh_checks, "_BASE_BYTES", 1 << 20)
    bomb = {"vertices": zeros, "faces": zeros.astype(np.int32), "vertex_colors": np.zeros((n, 4), np.float32)}
    refused(npz(path, compressed=True, **bomb), "decompression bomb")
    assert load_mesh(npz(path, **bomb)).vertices.shape == (n, 3)  # not compressed, it is as large as it says


def test_npz_headers_that_lie(tmp_path):
    """Claims in the array header, in the archive's directory, and an archive that is not one."""
    good = io.BytesIO()
    npz(good)
    path = tmp_path / "m.npz"
    for old, new, match in (
        (b"(3, 3)", b"(9**9)", "broken header"),
        (b"(3, 3), }", b"(99999999999, 3)}", "should take 1,200,000,000,116 bytes"),
        (b"'shape': (3, 3)", b"'shape': (-3,3)", "broken shape"),
        (b"'shape': (3, 3)", b"'shape':(True,)", "broken shape"),
        (b"'<f4'", b"'|O8'", "pickled"),
        (b"'<f4'", b"'4f4'", "must hold numbers"),
        (b"\x93NUMPY\x01", b"\x93NUMPY\x09", "not in .npy format"),
    ):
        out = io.BytesIO()
        with zipfile.ZipFile(good) as source, zipfile.ZipFile(out, "w") as changed:
            for name in source.namelist():
                data = source.read(name)
                if name == "vertices.npy":
                    assert old in data
                    if len(old) != len(new):
                        data = data.replace(old + b" " * (len(new) - len(old)), new)
                    data = data.replace(old, new)
                changed.writestr(name, data)
        path.write_bytes(out.getvalue())
        refused(path, match)
    data = bytearray(good.getvalue())
    data[data.index(TRIANGLE.tobytes()) + 12] ^= 1
    path.write_bytes(data)
    refused(path, "CRC")
    for compressed in (False, True):
        wrong = bytearray(npz(path, compressed=compressed).read_bytes())
        with zipfile.ZipFile(path) as archive:
            check_sum = archive.getinfo("vertices.npy").CRC.to_bytes(4, "little")
        assert wrong.count(check_sum) == 2
        path.write_bytes(wrong.replace(check_sum, b"\0\0\0\0"))
        refused(path, "CRC")
    path.write_bytes(b"PK\x03\x04" + bytes(100))
    refused(path, "not a zip file")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as odd, zipfile.ZipFile(good) as source:
        odd.writestr("vertices.npy", source.read("vertices.npy"))
    refused(path, "compressed by method 14")
    entry = struct.pack("<4s6H3I5H2I", b"PK\1\2", *[0] * 9, 65535, *[0] * 6) + bytes(65535)
    directory = entry * 300
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 300, 300, len(directory), 4, 0)
    path.write_bytes(b"PK\3\4" + directory + end)
    refused(path, "absurdly large")


# -- ply

PLY = """ply
format {encoding} 1.0
element vertex {vertices}
property float x
property float y
property float z
element face {faces}
property list {count} int vertex_indices
end_header
"""


def ply(path, body, *, encoding="binary_little_endian", vertices=3, faces=1, count="uchar"):
    head = PLY.format(encoding=encoding, vertices=vertices, faces=faces, count=count).encode()
    path.write_bytes(head + body)
    return path


@pytest.mark.filterwarnings("ignore:.*no vertex colours")
def test_ply_that_lie(tmp_path):
    path, body = tmp_path / "m.ply", TRIANGLE.tobytes()
    face = struct.pack("<B3i", 3, 0, 1, 2)
    refused(ply(path, body + face, vertices=10**11), "100,000,000,000 rows")
    refused(ply(path, body + face, faces=10**11), "100,000,000,000")
    refused(ply(path, body + face, faces=2), "past the end of the file|truncated")
    refused(ply(path, body + face[:-1]), "past the end of the file|truncated")
    refused(ply(path, body + struct.pack("<B3i", 255, 0, 1, 2)), "past the end")
    refused(ply(path, body + struct.pack("<b3i", -1, 0, 1, 2), count="char"), "list of length -1|truncated")
    refused(ply(path, body + struct.pack("<I3i", 2**32 - 1, 0, 1, 2), count="uint"), "past the end")
    refused(
        ply(path, body + struct.pack("<B3i", 3, 0, 1, 3)),
        "faces must be vertex indices from 0 to 2, got 0 to 3",
    )
    refused(ply(path, body + struct.pack("<B3i", 3, 0, 1, -7)), "faces must be vertex indices")
    refused(ply(path, (TRIANGLE + np.inf).tobytes() + face), "vertices must be finite")
    text = b"0 0 0\n1 0 0\n0 1 0\n"
    for line in (
        b"3 0 1\n",
        b"3 0 1 x\n",
        b"3 0 1 2 2\n",
        b"-1\n",
        b"9999999999 1\n",
        b"3 0 1 %d\n" % 10**30,
    ):
        refused(ply(path, text + line, encoding="ascii"), "face 0 cannot be read|beyond 64 bits")
    refused(ply(path, text, encoding="ascii"), "ends after 0 of 1 faces|truncated")


def test_ply_of_many_polygon_sizes_is_read_in_bounded_time_and_memory(tmp_path):
    """A file of polygons of 1, 2, 3 ... corners, each length once."""
    sizes = range(1, 256)
    body = TRIANGLE.tobytes() + b"".join(bytes([n]) + bytes(4 * n) for n in sizes)
    tracemalloc.start()
    mesh = load_mesh_grey(ply(tmp_path / "m.ply", body, faces=len(sizes)))
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()
    assert len(mesh.faces) == sum(max(n - 2, 0) for n in sizes)


def load_mesh_grey(path):
    with pytest.warns(UserWarning, match="no vertex colours"):
        return load_mesh(path)


# -- glTF


def broken_gltf(tmp_path, change, match):
    document = gltf(
        [(TRIANGLE, "VEC3", False), (np.arange(3, dtype="<u2")[:, None], "SCALAR", False)],
        primitive={"attributes": {"POSITION": 0}, "indices": 1},
    )
    change(document)
    path = tmp_path / "m.gltf"
    path.write_text(json.dumps(document))
    refused(path, match)


PACKED = {"buffer": 0, "byteLength": 36, "byteStride": 12, "count": 3, "mode": "ATTRIBUTES"}


def put(*keys):
    """A change that sets the last of ``keys`` as the value under the others."""

    def change(document):
        place = document
        for key in keys[:-2]:
            place = place[key]
        place[keys[-2]] = keys[-1]

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("asset", "version", "1.0"), "not a glTF 2 file"),
        (put("scene", 7), "refers to index 7 of 1 scenes"),
        (put("scene", -1), "refers to index -1"),
        (put("nodes", 0, "mesh", 1), "refers to index 1 of 1 meshes"),
        (put("nodes", 0, "children", [0]), "node 0 has two parents"),
        (put("nodes", 0, "children", "all"), "must be an array of whole numbers"),
        (put("nodes", 0, "matrix", [1] * 15), "must be 16 numbers"),
        (put("nodes", 0, "rotation", [0, 0, 0, "1"]), "must be 4 numbers"),
        (put("nodes", 0, "scale", [1e40, 1e40, 1e40]), "vertices must be finite"),
        (put("nodes", 5), "nodes must be an array of objects"),
        (put("accessors", 0, "bufferView", 9), "refers to index 9 of 2 bufferViews"),
        (put("accessors", 0, "count", 10**12), "claims 1,000,000,000,000 elements"),
        (put("accessors", 0, "count", 4), "claims 4 elements of 12 bytes"),
        (put("accessors", 0, "count", -1), "needs a whole number 'count'"),
        (put("accessors", 0, "count", 2.5), "needs a whole number 'count'"),
        (put("accessors", 0, "count", True), "needs a whole number 'count'"),
        (put("accessors", 0, "byteOffset", 1), "claims 3 elements"),
        (put("accessors", 0, "type", "MAT3"), "has type MAT3"),
        (put("accessors", 0, "type", "VEC2"), "POSITION must be 3 vectors of 3"),
        (put("accessors", 0, "componentType", 7), "of components 7"),
        (put("accessors", 0, "sparse", {}), "POSITION needs a whole number 'count'"),
        (put("accessors", 1, "componentType", 5126), "indices must be unsigned|claims"),
        (put("bufferViews", 0, "byteLength", 1000), "ends at byte 1,000"),
        (put("bufferViews", 0, "byteOffset", 2**60), "needs a whole number 'byteOffset'"),
        (put("bufferViews", 0, "byteStride", 2), "byteStride of buffer view 0 must be 4 to 252"),
        (put("bufferViews", 0, "buffer", 1), "refers to index 1 of 1 buffers"),
        (put("bufferViews", 0, "extensions", {"KHR_meshopt_compression": {}}), "gltf-transform"),
        (put("bufferViews", 0, "extensions", {"EXT_meshopt_compression": {}}), "whole number 'buffer'"),
        (put("bufferViews", 0, "extensions", {"EXT_meshopt_compression": PACKED}), "gltf-transform"),
        *(
            (put("bufferViews", 0, "extensions", {"EXT_meshopt_compression": PACKED | more}), match)
            for more, match in (
                ({"filter": "OCTAHEDRAL"}, "gltf-transform"),
                ({"mode": "INDICES"}, "gltf-transform"),
                ({"byteLength": 1000}, "ends at byte 1,000"),
                ({"count": -1}, "needs a whole number 'count'"),
            )
        ),
        (put("buffers", 0, "byteLength", 1000), "should have 1,000 bytes, has 44"),
        (put("buffers", 0, "uri", "data:;base64,!"), "data URI of buffer 0 is broken|should have"),
        (put("buffers", 0, "uri", "data:,abc"), "not base64"),
        (put("buffers", 0, "uri", None), "neither data nor URI"),
        (put("buffers", 0, "uri", "gone.bin"), "'gone.bin' is missing"),
        (put("extensionsRequired", ["KHR_draco_mesh_compression"]), "Draco"),
        (put("extensionsRequired", ["XY_secret"]), "needs the glTF extension XY_secret"),
        (put("meshes", 0, "primitives", []), "the scene holds no triangles"),
        (put("meshes", 0, "primitives", 0, "mode", 9), "unknown primitive mode 9"),
        (put("meshes", 0, "primitives", 0, "attributes", {}), "has no POSITION"),
        (put("meshes", 0, "primitives", 0, "attributes", "COLOR_0", 1), "COLOR_0 must be 3 RGB"),
        (put("meshes", 0, "primitives", 0, "material", 0), "refers to index 0 of 0 materials"),
        (
            put("meshes", 0, "primitives", [{"mode": 0, "extensions": {"KHR_gaussian_splatting": {}}}]),
            "read it with load_gaussians",
        ),
    ],
)
def test_gltf_that_lie(tmp_path, change, match):
    broken_gltf(tmp_path, change, match)


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "/etc/passwd",
        "file:///etc/passwd",
        "http://a/b",
        "%2e%2e/secret.bin",
        "a/../../secret.bin",
        "link.bin",
        "..\\secret.bin",
        "C:\\x",
        ".",
    ],
)
def test_gltf_reads_no_file_outside_its_folder(tmp_path, uri):
    inside = tmp_path / "inside"
    (inside / "a").mkdir(parents=True)
    (tmp_path / "secret.bin").write_bytes(TRIANGLE.tobytes() + bytes(8))
    if uri == "link.bin":
        make_link(inside / "link.bin", tmp_path / "secret.bin")
    broken_gltf(inside, put("buffers", 0, "uri", uri), "outside its folder")


@linux_names
@pytest.mark.parametrize("uri", ["a\x00b", "\ud800.bin", "a" * 300 + ".bin", "%00"])
def test_gltf_names_what_no_file_can_be_called(tmp_path, uri):
    broken_gltf(tmp_path, put("buffers", 0, "uri", uri), "which is no name of a file")


def test_gltf_indices_beyond_the_vertices(tmp_path):
    document = gltf(
        [(TRIANGLE, "VEC3", False), (np.array([[0], [1], [3]], "<u4"), "SCALAR", False)],
        primitive={"attributes": {"POSITION": 0}, "indices": 1},
    )
    (tmp_path / "m.gltf").write_text(json.dumps(document))
    refused(tmp_path / "m.gltf", "indices run up to 3, there are 3 vertices")


def test_gltf_json_bombs(tmp_path):
    path = tmp_path / "m.gltf"
    path.write_bytes(b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}")
    refused(path, "JSON part cannot be read")
    path.write_bytes(b'{"a":[' + b"[]," * 3_000_000 + b"[]]}")
    refused(path, "over 4,000,000 entries", megabytes=32)
    path.write_bytes(b'{"asset":{"version":"2.0"},"scene":NaN}')
    refused(path, "NaN is no JSON number")
    path.write_bytes(b'{"asset":{"version":"2.0"},"scene":' + b"9" * 10_000 + b"}")
    refused(path, "cannot be read|refers to index")


def test_a_small_gltf_that_repeats_one_mesh_for_ever(tmp_path, monkeypatch):
    positions = np.zeros((60_000, 3), "<f4")
    document = gltf([(positions, "VEC3", False)])
    document["nodes"] = [{"mesh": 0}] * 2000
    document["scenes"] = [{"nodes": list(range(2000))}]
    path = tmp_path / "m.gltf"
    path.write_text(json.dumps(document))
    monkeypatch.setattr(mesh_checks, "_BASE_BYTES", 1 << 20)
    monkeypatch.setattr(mesh_checks, "_FACTOR", 16)
    refused(path, "beyond what a file of", megabytes=32)


def test_gltf_of_many_nodes_takes_linear_time(tmp_path):
    """The arrays of a document are checked once, not for each reference to an entry of theirs."""
    count = 20_000
    path = tmp_path / "m.gltf"
    nodes = {"scenes": [{"nodes": list(range(count))}], "nodes": [{}] * count}
    path.write_text(json.dumps({"asset": {"version": "2.0"}, **nodes}))
    start = time.process_time()
    with pytest.raises(FileFormatError, match="no triangles"):
        load_mesh(path)
    assert time.process_time() - start < 5  # 26 s if each look-up checks all nodes


def test_obj_of_one_endless_line_takes_linear_time():
    start = time.process_time()
    ((number, words),) = statements(b"v 1 \\\n" * 1_000_000)
    assert (number, len(words)) == (1_000_001, 2_000_000)
    assert time.process_time() - start < 8  # minutes if all that is joined is copied for each line


def test_glb_containers_that_lie(tmp_path):
    save_mesh(MESH, tmp_path / "good.glb")
    good = (tmp_path / "good.glb").read_bytes()
    path = tmp_path / "m.glb"
    for at, value, match in (
        (4, 1, "container of version 2 expected, got version 1"),
        (8, len(good) + 1, "truncated"),
        (12, 2**32 - 1, "runs past the end"),
        (16, 0x11111111, "without a JSON chunk"),
    ):
        path.write_bytes(good[:at] + struct.pack("<I", value) + good[at + 4 :])
        refused(path, match)


@pytest.mark.parametrize(
    "note",
    [
        5,
        {"up": "north"},
        {"up": [0, 0, 0]},
        {"up": [0, 1, 0], "blending": "odd"},
        {"up": [1e300, 1, 0]},
        {
            "up": [0, -1, 0],
            "blending": "display",
            "attributes": [5, {}, {"name": 3}, {"name": "a", "columns": -1}],
        },
    ],
)
def test_odd_extras_are_ignored(tmp_path, note):
    save_mesh(MESH, tmp_path / "m.glb")
    edit_glb(tmp_path / "m.glb", lambda d: d["meshes"][0]["extras"].update(meshsplats=note))
    mesh = load_mesh(tmp_path / "m.glb")
    assert mesh.face_splat is None
    assert not mesh.attributes


@pytest.mark.parametrize(
    ("value", "match"),
    [
        (-1, "filter_px2 must be a variance"),
        ("0.3", "filter_px2 must be 1 numbers"),
        (None, "filter_px2 must be 1 numbers"),
        (1e200, "filter_px2 must be a variance"),
    ],
)
def test_filters_that_cannot_be(tmp_path, value, match):
    save_mesh(MESH, tmp_path / "m.glb")
    edit_glb(tmp_path / "m.glb", lambda d: d["meshes"][0]["extras"]["meshsplats"].update(filter_px2=value))
    refused(tmp_path / "m.glb", match)
    save_mesh(MESH, tmp_path / "m.ply")
    line = f"comment meshsplats filter_px2 {value}\nelement vertex".encode()
    (tmp_path / "m.ply").write_bytes((tmp_path / "m.ply").read_bytes().replace(b"element vertex", line, 1))
    if value != "0.3":
        refused(tmp_path / "m.ply", "filter_px2 must be a")


def test_a_filter_without_splats_is_left_out(tmp_path):
    """Another program has dropped the splat index of the triangles."""
    save_mesh(replace(MESH, face_splat=None), tmp_path / "m.glb")
    edit_glb(tmp_path / "m.glb", lambda d: d["meshes"][0]["extras"]["meshsplats"].update(filter_px2=0.3))
    save_mesh(replace(MESH, face_splat=None), tmp_path / "m.ply")
    line = b"comment meshsplats filter_px2 0.3\nelement vertex"
    (tmp_path / "m.ply").write_bytes((tmp_path / "m.ply").read_bytes().replace(b"element vertex", line, 1))
    for name in ("m.glb", "m.ply"):
        with pytest.warns(DataWarning, match="ignored: the filter of its splats"):
            assert load_mesh(tmp_path / name).filter_px2 == 0


def test_base64_that_is_long_is_fine(tmp_path):
    """The limits do not stand in the way of honest files."""
    positions = np.random.default_rng(0).random((30_000, 3)).astype("<f4")
    document = gltf([(positions, "VEC3", False)])
    assert len(base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])) == 360_000
    (tmp_path / "m.gltf").write_text(json.dumps(document))
    np.testing.assert_array_equal(load_mesh(tmp_path / "m.gltf").vertices, positions)


def test_spoilt_compressed_glb(tmp_path):
    """Each ends in a mesh or in one error."""
    save_mesh(fan_mesh(np.random.default_rng(0), degree=1), tmp_path / "m.glb", compression="meshopt")
    whole = (tmp_path / "m.glb").read_bytes()
    start = 28 + int.from_bytes(whole[12:16], "little")
    rng, errors = np.random.default_rng(1), 0
    for _ in range(150):
        spoilt = bytearray(whole)
        spoilt[rng.integers(start, len(whole))] = rng.integers(256)
        (tmp_path / "m.glb").write_bytes(spoilt)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                load_mesh(tmp_path / "m.glb")
            except FileFormatError:
                errors += 1
    assert errors > 5


@pytest.mark.parametrize("change", [{"count": 10**15}, {"count": 3 * 10**9, "byteStride": 4}])
def test_compressed_views_that_claim_much(tmp_path, change):
    save_mesh(fan_mesh(np.random.default_rng(0)), tmp_path / "m.glb", compression="meshopt")
    extension = "EXT_meshopt_compression"
    edit_glb(tmp_path / "m.glb", lambda d: d["bufferViews"][0]["extensions"][extension].update(change))
    refused(tmp_path / "m.glb", "m.glb")
