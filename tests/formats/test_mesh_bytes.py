"""The bytes of saved files, taken apart by hand and by readers of other people."""

import ast
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from _glb import read_glb
from _meshes import assert_same, random_mesh

from meshsplats import SplatMesh, load_mesh, save_mesh
from meshsplats.formats._orientation import up_quaternion
from meshsplats.formats.gltf.writer import computed_normals

SQUARE = SplatMesh(
    vertices=[[0, 0, 2], [1, 0, 2], [1, 1, 2], [0, 1, 2]],
    faces=[[0, 1, 2], [0, 2, 3]],
    colors=[[0, 0, 0, 0], [1, 0, 0, 1], [0, 1, 0, 0.5], [1, 1, 1, 0.25]],
    face_splat=[4, 7],
)

HALF_SOLID = replace(SQUARE, colors=[[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [1, 1, 1, 0.25]])
"""The first triangle is solid."""


def values(document, binary, index):
    """Rows of an accessor, by struct."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    code = {5123: "H", 5125: "I", 5126: "f"}[accessor["componentType"]]
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    row = struct.Struct(f"<{columns}{code}")
    assert view["byteOffset"] % 4 == 0
    assert view["byteLength"] == row.size * accessor["count"]
    start = view["byteOffset"]
    return [row.unpack_from(binary, start + i * row.size) for i in range(accessor["count"])]


def test_glb_by_hand(tmp_path):
    save_mesh(SQUARE, tmp_path / "m.glb")
    document, binary = read_glb(tmp_path / "m.glb")
    assert document["asset"]["version"] == "2.0"
    assert document["scenes"][document["scene"]]["nodes"] == [0]
    (node,) = document["nodes"]
    assert node["rotation"] == [1, 0, 0, 0]  # y down: half a turn about x
    assert set(node) == {"name", "mesh", "rotation"}
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    assert primitive.get("mode", 4) == 4
    attributes = primitive["attributes"]
    assert set(attributes) == {"POSITION", "COLOR_0"}
    assert values(document, binary, attributes["POSITION"]) == [(0, 0, 2), (1, 0, 2), (1, 1, 2), (0, 1, 2)]
    position, color = (document["accessors"][attributes[n]] for n in ("POSITION", "COLOR_0"))
    assert position["min"] == [0, 0, 2]
    assert position["max"] == [1, 1, 2]
    assert (color["type"], color["componentType"], color["normalized"]) == ("VEC4", 5123, True)
    assert values(document, binary, attributes["COLOR_0"]) == [
        (0, 0, 0, 0),
        (65535, 0, 0, 65535),
        (0, 65535, 0, 32768),
        (65535, 65535, 65535, 16384),
    ]
    assert [i for (i,) in values(document, binary, primitive["indices"])] == [0, 1, 2, 0, 2, 3]
    assert document["accessors"][primitive["indices"]]["componentType"] == 5123
    (material,) = document["materials"]
    assert material["alphaMode"] == "BLEND"
    assert material["doubleSided"] is True
    assert material["extensions"] == {"KHR_materials_unlit": {}}
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    note = mesh["extras"]["meshsplats"]
    assert note["blending"] == "display"
    assert note["up"] == [0, -1, 0]
    view = document["bufferViews"][note["face_splat"]["bufferView"]]
    assert struct.unpack_from("<2i", binary, view["byteOffset"]) == (4, 7)


def test_a_lit_glb_has_normals_and_no_unlit_extension(tmp_path):
    save_mesh(SQUARE, tmp_path / "m.glb", lit=True)
    document, binary = read_glb(tmp_path / "m.glb")
    assert "extensionsUsed" not in document
    assert "extensions" not in document["materials"][0]
    normals = values(document, binary, document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"])
    assert normals == [(0, 0, 1)] * 4


def test_a_glb_for_viewers_that_mask(tmp_path):
    save_mesh(SQUARE, tmp_path / "m.glb", alpha="mask")
    document, binary = read_glb(tmp_path / "m.glb")
    (material,) = document["materials"]
    assert material["alphaMode"] == "MASK"
    assert material["alphaCutoff"] == 0.2
    color = values(document, binary, document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
    assert [c[3] for c in color] == [0, 65535, 32768, 16384]  # the truth


def test_true_opacities_come_back_from_masked_files(tmp_path):
    mesh = random_mesh(np.random.default_rng(3))
    mesh = replace(mesh, attributes={**mesh.attributes, "alpha": np.arange(9)})
    save_mesh(mesh, tmp_path / "m.glb", alpha="mask")
    assert_same(load_mesh(tmp_path / "m.glb"), mesh, 1e-4)


def test_a_hybrid_glb_has_an_opaque_and_a_blended_primitive(tmp_path):
    # Two blended triangles that the heights of their corners put in the other order, a solid one between.
    points = [[0, 0, 2], [1, 0, 2], [1, 1, 2], [0, 1, 2], [0, 2, 2]]
    colors = [[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [1, 1, 1, 0.25], [0, 0, 1, 0.5]]
    faces = np.array([[2, 3, 4], [0, 1, 2], [0, 2, 3]])
    mesh = SplatMesh(points, faces, colors, up=(0, 1, 0), face_splat=[1, 2, 3])
    save_mesh(mesh, tmp_path / "m.glb", alpha="hybrid")
    document, binary = read_glb(tmp_path / "m.glb")
    assert [m["alphaMode"] for m in document["materials"]] == ["OPAQUE", "BLEND"]
    assert [p["material"] for p in document["meshes"][0]["primitives"]] == [0, 1]
    corners, opacities = [], []
    for primitive in document["meshes"][0]["primitives"]:
        vertices = values(document, binary, primitive["attributes"]["POSITION"])
        rgba = values(document, binary, primitive["attributes"]["COLOR_0"])
        rows = [i for (i,) in values(document, binary, primitive["indices"])]
        assert sorted(set(rows)) == list(range(len(vertices)))  # none that it does not use
        corners.append([vertices[i][:2] for i in rows])
        opacities.append([rgba[i][3] for i in rows])
    assert corners == [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1), (1, 1), (0, 1), (0, 2)]]
    assert opacities == [3 * [65535], [65535, 65535, 16384, 65535, 16384, 32768]]
    again, order = load_mesh(tmp_path / "m.glb"), faces[[1, 2, 0]]
    assert np.array_equal(again.up, mesh.up)
    assert np.array_equal(again.vertices[again.faces], mesh.vertices[order])
    assert np.allclose(again.colors[again.faces], mesh.colors[order], atol=1e-4)
    save_mesh(replace(mesh, up=(0, -1, 0)), tmp_path / "m.glb", alpha="hybrid")
    again, order = load_mesh(tmp_path / "m.glb"), faces[[1, 0, 2]]
    assert np.array_equal(again.up, (0, -1, 0))
    assert np.array_equal(again.vertices[again.faces], mesh.vertices[order])


@pytest.mark.parametrize(("opacity", "mode"), [(1, "OPAQUE"), (0.5, "BLEND")])
def test_a_hybrid_glb_has_no_empty_primitive(tmp_path, opacity, mode):
    mesh = replace(SQUARE, colors=[(0.5, 0.5, 0.5, opacity)] * 4)
    save_mesh(mesh, tmp_path / "m.glb", alpha="hybrid")
    document, _ = read_glb(tmp_path / "m.glb")
    assert [m["alphaMode"] for m in document["materials"]] == [mode]
    assert len(document["meshes"][0]["primitives"]) == 1


def test_what_alpha_refuses(tmp_path):
    with pytest.raises(ValueError, match="alpha must be one of blend, mask, opaque, hybrid, got 'add'"):
        save_mesh(SQUARE, tmp_path / "m.glb", alpha="add")
    with pytest.raises(ValueError, match=r"alpha applies to \.glb only"):
        save_mesh(SQUARE, tmp_path / "m.ply", alpha="mask")
    with pytest.raises(ValueError, match=r"alpha applies to \.glb only"):
        save_mesh(SQUARE, tmp_path / "m.ply", alpha="hybrid")


def test_a_glb_with_many_vertices_has_32_bit_indices(tmp_path):
    vertices = np.zeros((65536, 3))
    save_mesh(SplatMesh(vertices, [[0, 1, 65535]], np.ones((65536, 4))), tmp_path / "m.glb")
    document, binary = read_glb(tmp_path / "m.glb")
    index = document["meshes"][0]["primitives"][0]["indices"]
    assert document["accessors"][index]["componentType"] == 5125
    assert [i for (i,) in values(document, binary, index)] == [0, 1, 65535]


@pytest.mark.parametrize(
    "up", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (1, 0, 0), (0.6, -0.8, 0), (1e-6, -1, 1e-6)]
)
def test_the_node_turns_up_to_plus_y(up):
    x, y, z, w = up_quaternion(np.array(up, np.float32))
    assert x * x + y * y + z * z + w * w == pytest.approx(1)
    # v' = v + 2 q x (q x v + w v)
    q, v = np.array([x, y, z]), np.array(up) / np.linalg.norm(up)
    turned = v + 2 * np.cross(q, np.cross(q, v) + w * v)
    np.testing.assert_allclose(turned, [0, 1, 0], atol=2e-6)


def test_the_turn_of_a_z_up_mesh_is_the_customary_one():
    """(x, y, z) becomes (x, z, -y), as Blender's exporter has it."""
    x, y, z, w = up_quaternion(np.array([0, 0, 1]))
    q, v = np.array([x, y, z]), np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(v + 2 * np.cross(q, np.cross(q, v) + w * v), [1, 3, -2], atol=1e-12)


@pytest.mark.parametrize("up", [(0.02, -0.99, -0.04), (-0.02, -0.99, 0.04), (0.03, -0.99, 0), (0, -1, 1e-9)])
def test_the_turn_of_a_nearly_upright_capture_is_nearly_the_half_turn(up):
    """Its x axis stays right, where the shortest rotation has any axis: meshes of one scene would differ by
    any angle around the vertical."""
    x, y, z, w = up_quaternion(np.array(up))
    q, tilt = np.array([x, y, z]), np.hypot(up[0], up[2])
    for v, half_turned in ((1.0, 0, 0), (1.0, 0, 0)), ((0, 0, 1.0), (0, 0, -1.0)):
        turned = np.array(v) + 2 * np.cross(q, np.cross(q, v) + w * np.array(v))
        assert np.linalg.norm(turned - half_turned) <= 1.5 * tilt + 1e-9


def test_vertex_normals_weigh_by_area_and_never_vanish():
    # A triangle of area 2 facing +z and one of area 1 facing +x meet in vertex 0; vertex 5 has a sliver only.
    vertices = [[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 1, 0], [0, 0, 2], [9, 9, 9]]
    faces = [[0, 1, 2], [0, 3, 4], [5, 5, 5]]
    normals = computed_normals(SplatMesh(vertices, faces, np.ones((6, 4)), up=(0, 0, 1)))
    np.testing.assert_allclose(normals[0], np.array([1, 0, 2]) / 5**0.5, rtol=1e-6)
    np.testing.assert_allclose(normals[1:], [[0, 0, 1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [0, 0, 1]])


def test_ply_by_hand(tmp_path):
    save_mesh(SQUARE, tmp_path / "m.ply")
    data = (tmp_path / "m.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "comment meshsplats up 0.0 -1.0 0.0" in lines
    assert "comment meshsplats blending display" in lines
    assert [x for x in lines if not x.startswith("comment")][2:] == [
        "element vertex 4",
        *(f"property float {n}" for n in ("x", "y", "z", "red", "green", "blue", "alpha")),
        "element face 2",
        "property list uchar int vertex_indices",
        "property int face_splat",
    ]
    assert struct.unpack_from("<7f", body, 2 * 28) == (1, 1, 2, 0, 1, 0, 0.5)
    assert struct.unpack_from("<B4i", body, 4 * 28) == (3, 0, 1, 2, 4)
    assert struct.unpack_from("<B4i", body, 4 * 28 + 17) == (3, 0, 2, 3, 7)
    assert len(body) == 4 * 28 + 2 * 17


def test_npz_by_hand(tmp_path):
    save_mesh(SQUARE, tmp_path / "m.npz")
    with zipfile.ZipFile(tmp_path / "m.npz") as archive:
        assert archive.testzip() is None
        assert set(archive.namelist()) == {
            f"{n}.npy" for n in ("vertices", "faces", "vertex_colors", "face_splat", "up", "blending")
        }
        raw = archive.read("vertex_colors.npy")
    assert raw[:8] == b"\x93NUMPY\x01\x00"
    (length,) = struct.unpack_from("<H", raw, 8)
    header = ast.literal_eval(raw[10 : 10 + length].decode())
    assert header == {"descr": "<f4", "fortran_order": False, "shape": (4, 4)}
    assert struct.unpack_from("<4f", raw, 10 + length + 32) == (0, 1, 0, 0.5)


def test_npz_is_plain_numpy(tmp_path):
    mesh = random_mesh(np.random.default_rng(0))
    save_mesh(mesh, tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["vertices"], mesh.vertices)
        np.testing.assert_array_equal(arrays["attribute_wide"], mesh.attributes["wide"])
        assert arrays["blending"] == "display"


# -- readers of other people


@pytest.mark.parametrize("suffix", [".glb", ".ply"])
def test_trimesh_reads_what_we_write(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    mesh = random_mesh(np.random.default_rng(5), 50, 80, extras=False)
    mesh = replace(mesh, up=(0, -1, 0))
    save_mesh(mesh, tmp_path / f"m{suffix}")
    scene = trimesh.load(tmp_path / f"m{suffix}", process=False)
    got = scene if suffix == ".ply" else next(iter(scene.geometry.values()))
    np.testing.assert_array_equal(got.vertices.astype(np.float32), mesh.vertices)
    np.testing.assert_array_equal(got.faces, mesh.faces)
    if suffix == ".glb":
        (name,) = scene.graph.nodes_geometry
        turned = trimesh.transform_points(mesh.vertices[:1], scene.graph[name][0])
        np.testing.assert_allclose(turned[0], mesh.vertices[0] * [1, -1, -1], rtol=1e-5)


def test_pygltflib_reads_what_we_write(tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    mesh = random_mesh(np.random.default_rng(6))
    save_mesh(mesh, tmp_path / "m.glb", color_type="float32")
    file = pygltflib.GLTF2().load(tmp_path / "m.glb")
    attributes = file.meshes[0].primitives[0].attributes
    view = file.bufferViews[file.accessors[attributes.POSITION].bufferView]
    blob = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    np.testing.assert_array_equal(np.frombuffer(blob, np.float32).reshape(-1, 3), mesh.vertices)


def test_the_khronos_validator_is_content(tmp_path, gltf_issues):
    rng = np.random.default_rng(7)
    files = []
    for extras in (False, True):
        mesh = random_mesh(rng, 60, 90, extras=extras)
        mesh = replace(
            mesh, faces=[f for f in mesh.faces if len(set(f)) == 3], face_splat=None, depth_group=None
        )
        for lit in (False, True):
            for color_type in ("uint16", "float32"):
                files.append(tmp_path / f"{extras}-{lit}-{color_type}.glb")
                save_mesh(mesh, files[-1], lit=lit, color_type=color_type)
    for alpha in ("blend", "mask", "opaque", "hybrid"):
        files.append(tmp_path / f"{alpha}.glb")
        save_mesh(HALF_SOLID if alpha == "hybrid" else SQUARE, files[-1], alpha=alpha)
    for file, issues in zip(files, gltf_issues(*files), strict=True):
        assert issues["numErrors"] == issues["numWarnings"] == 0, (file, issues["messages"])
        # Arrays that only our extras refer to are reported as possibly unused, by the way.
        assert {m["code"] for m in issues["messages"]} <= {"UNUSED_OBJECT"}


def test_the_khronos_validator_would_complain(tmp_path, gltf_issues):
    """The check above can fail."""
    save_mesh(SQUARE, tmp_path / "m.glb")
    data = (tmp_path / "m.glb").read_bytes()
    (tmp_path / "m.glb").write_bytes(data.replace(b'"max":[1.0', b'"max":[7.0'))
    (issues,) = gltf_issues(tmp_path / "m.glb")
    assert issues["numErrors"] > 0


def test_load_mesh_of_the_hand_made_square(tmp_path):
    save_mesh(SQUARE, tmp_path / "m.glb")
    assert load_mesh(tmp_path / "m.glb").face_splat.tolist() == [4, 7]
