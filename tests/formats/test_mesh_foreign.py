"""Meshes of other programs."""

import json
import struct
import warnings
from dataclasses import replace

import _splat_encoders as encode
import numpy as np
import pytest
from _glb import edit_glb
from _gltf_meshes import TRIANGLE, gltf, instanced, skinned
from _local import shared_data
from _meshes import random_mesh
from _splat_files import random_splats

from meshsplats import DataWarning, FileFormatError, load_mesh, save_mesh
from meshsplats.formats import _validation
from meshsplats.formats.sniff import identify
from meshsplats.scene.colors import linear_to_srgb


def load(tmp_path, document):
    path = tmp_path / "m.gltf"
    path.write_text(json.dumps(document))
    return load_mesh(path)


def test_gltf_without_colours_takes_the_materials(tmp_path):
    mesh = load(
        tmp_path,
        gltf(
            [(TRIANGLE, "VEC3", False)],
            primitive={"attributes": {"POSITION": 0}, "material": 0},
            materials=[
                {"pbrMetallicRoughness": {"baseColorFactor": [0.2158605, 1, 0, 0.5]}, "alphaMode": "BLEND"}
            ],
        ),
    )
    np.testing.assert_allclose(mesh.colors, [[128 / 255, 1, 0, 0.5]] * 3, atol=1e-6)
    assert mesh.faces.tolist() == [[0, 1, 2]]
    assert mesh.up.tolist() == [0, 1, 0]


BLACK = {"baseColorFactor": [0, 0, 0, 0.5]}
OLD = "KHR_materials_pbrSpecularGlossiness"


@pytest.mark.parametrize(
    ("material", "wanted"),
    [
        ({"pbrMetallicRoughness": BLACK, "emissiveFactor": [0, 1, 0]}, [0, 1, 0, 0.5]),
        ({"pbrMetallicRoughness": BLACK}, [0, 0, 0, 0.5]),
        (
            {
                "pbrMetallicRoughness": BLACK,
                "emissiveFactor": [0, 1, 0],
                "extensions": {"KHR_materials_unlit": {}},
            },
            [0, 0, 0, 0.5],
        ),
        ({"emissiveFactor": [0, 1, 0]}, [0.5, 1, 0, 1]),
        ({"extensions": {OLD: {"diffuseFactor": [1, 0, 1, 1]}}}, [0.5, 0, 0, 1]),
        (
            {
                "extensions": {OLD: {"diffuseFactor": [1, 0, 1, 1]}},
                "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]},
            },
            [0.5, 1, 0, 0.5],
        ),
    ],
)
def test_gltf_colours_that_are_no_base_colour(tmp_path, material, wanted):
    """What a black material emits, which vertex colours have no part in; the diffuse colour of old
    files, unless there is a base colour, too."""
    document = gltf(
        [(TRIANGLE, "VEC3", False), (np.array([[0.5, 1, 0, 1]] * 3, "<f4"), "VEC4", False)],
        primitive={"attributes": {"POSITION": 0, "COLOR_0": 1}, "material": 0},
        materials=[{"alphaMode": "BLEND"} | material],
        extensionsRequired=[OLD],
    )
    expected = [*linear_to_srgb(np.array(wanted[:3])), wanted[3]]
    np.testing.assert_allclose(load(tmp_path, document).colors, [expected] * 3, atol=1e-5)


@pytest.mark.parametrize(
    ("array", "kind"),
    [
        (np.array([[255, 0, 51, 102]] * 3, "u1"), "VEC4"),
        (np.array([[65535, 0, 13107, 26214]] * 3, "<u2"), "VEC4"),
        (np.array([[1, 0, 0.2, 0.4]] * 3, "<f4"), "VEC4"),
    ],
)
@pytest.mark.parametrize("alpha_mode", ["BLEND", "MASK", "OPAQUE"])
def test_gltf_colours_of_every_type(tmp_path, array, kind, alpha_mode):
    document = gltf(
        [(TRIANGLE, "VEC3", False), (array, kind, True)],
        primitive={"attributes": {"POSITION": 0, "COLOR_0": 1}, "material": 0},
        materials=[{"alphaMode": alpha_mode}],
    )
    expected = [1, 0, 1.055 * 0.2 ** (1 / 2.4) - 0.055, 1 if alpha_mode == "OPAQUE" else 0.4]
    np.testing.assert_allclose(load(tmp_path, document).colors, [expected] * 3, atol=1e-5)


def test_gltf_nodes_place_their_meshes(tmp_path):
    """A mesh of two primitives under a scaled and moved parent, and once more through a matrix."""
    normals = np.array([[0.6, 0.8, 0]] * 3, "<f4")
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1}}
    half = 0.5**0.5
    document = gltf(
        [(TRIANGLE, "VEC3", False), (normals, "VEC3", False)],
        nodes=[
            {"scale": [1, 2, 1], "translation": [10, 0, 0], "children": [1]},
            {"rotation": [0, 0, half, half], "mesh": 0},
            {"matrix": [0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1], "mesh": 0},
        ],
        scenes=[{"nodes": [0, 2]}],
    )
    document["meshes"][0]["primitives"] = [primitive, primitive]
    mesh = load(tmp_path, document)
    # A quarter turn about z takes (x, y) to (-y, x); then y is doubled and x moved by 10.
    first = [[10, 0, 0], [10, 2, 0], [8, 0, 0]]
    last = [[0, 0, 5], [0, 1, 5], [2, 0, 5]]
    np.testing.assert_allclose(mesh.vertices, first + first + last + last, atol=1e-6)
    # The last matrix makes a mirror image, whose triangles go the other way around to keep their sides.
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 5], [6, 8, 7], [9, 11, 10]]
    # Under the scale of (1, 2, 1) the normal (-0.8, 0.6) goes with (1, 1/2, 1).
    turned = np.array([-0.8, 0.3, 0]) / np.hypot(0.8, 0.3)
    np.testing.assert_allclose(mesh.normals[0], turned, atol=1e-6)
    np.testing.assert_allclose(mesh.normals[6], [0.8, 0.6, 0], atol=1e-6)


def test_gltf_skins_stand_as_their_joints_do(tmp_path):
    """glTF 2.0, 3.7.3.3: the node's own transform has no part in it."""
    mesh = load(tmp_path, skinned())
    # The second joint takes p to (10 + 2 x, p_y, 2 z); the third corner is half way between the two, both the
    # same here.
    np.testing.assert_allclose(mesh.vertices, [[10, 0, 0], [12, 0, 0], [10, 2, 0]], atol=1e-6)
    np.testing.assert_allclose(mesh.normals[0], [0.6, 0.8, 0], atol=1e-6)
    stretched = np.array([0.6 / 2, 0.8, 0]) / np.hypot(0.3, 0.8)
    np.testing.assert_allclose(mesh.normals[1], stretched, atol=1e-6)
    # Weights that do not sum to 1 are scaled; without any the first joint counts.
    mesh = load(tmp_path, skinned(weights=[(0, 0, 0, 0), (0, 3, 0, 0), (0, 0.2, 0, 0)]))
    np.testing.assert_allclose(mesh.vertices, [[10, 0, 0], [12, 0, 0], [10, 2, 0]], atol=1e-6)
    document = skinned()
    del document["skins"][0]["inverseBindMatrices"]  # then they are the identity
    np.testing.assert_allclose(
        load(tmp_path, document).vertices, [[10, 0, 0], [12, 1, 0], [10, 2.5, 0]], atol=1e-6
    )
    # A second set of four joints adds to the first.
    document = skinned(weights=[(0.5, 0, 0, 0), (0, 0.25, 0, 0), (0, 0.5, 0, 0)])
    document["meshes"][0]["primitives"][0]["attributes"] |= {"JOINTS_1": 2, "WEIGHTS_1": 3}
    np.testing.assert_allclose(
        load(tmp_path, document).vertices, [[10, 0, 0], [12, 0, 0], [10, 2, 0]], atol=1e-6
    )


def test_gltf_skins_that_stand_apart(tmp_path):
    """Joints of no scene, numbers that have no weight, primitives without weights."""
    document = skinned()
    wanted = load(tmp_path, document).vertices
    document["scenes"] = [{"nodes": [0]}]
    np.testing.assert_array_equal(load(tmp_path, document).vertices, wanted)
    document = skinned(weights=[(1, 0, 0, 0)] * 3)
    document["skins"][0] = {"joints": [1]}  # the second, which the vertices name too, has no weight
    np.testing.assert_allclose(load(tmp_path, document).vertices, np.add(TRIANGLE, [10, 0, 0]), atol=1e-6)
    del document["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]
    np.testing.assert_allclose(load(tmp_path, document).vertices, 100 * TRIANGLE + 7, atol=1e-6)


def test_gltf_mirror_images_keep_their_sides(tmp_path):
    """glTF 2.0, 3.7.4; of a skin the joints count, not the node that holds it."""
    mirror = {"scale": [-1, 1, 1]}
    mesh = load(tmp_path, gltf([(TRIANGLE, "VEC3", False)], nodes=[{"mesh": 0} | mirror]))
    np.testing.assert_array_equal(mesh.vertices, TRIANGLE * [-1, 1, 1])
    assert mesh.faces.tolist() == [[0, 2, 1]]
    assert load(tmp_path, instanced(SCALE=[[1, 1, 1], [1, -1, 1]])).faces.tolist() == [[0, 1, 2], [3, 5, 4]]
    document = skinned()
    document["nodes"][0] |= mirror
    assert load(tmp_path, document).faces.tolist() == [[0, 1, 2]]
    document["nodes"][1] |= mirror
    assert load(tmp_path, document).faces.tolist() == [[0, 2, 1]]


def morphed(weights, of_mesh=None, values=((1, 2, 3),)):
    """A triangle with two targets: one moves all of it, a sparse one its last corner."""
    sideways = np.array([[0, 0, 1]] * 3, "<f4")
    document = gltf(
        [
            (TRIANGLE, "VEC3", False),
            (sideways, "VEC3", False),
            (np.array([[2]], "u1"), "SCALAR", False),
            (np.array(values, "<f4"), "VEC3", False),
        ],
        primitive={
            "attributes": {"POSITION": 0, "NORMAL": 1},
            "targets": [{"POSITION": 1, "NORMAL": 1}, {"POSITION": 4}],
        },
        nodes=[{"mesh": 0} | ({} if weights is None else {"weights": weights})],
    )
    sparse = {"count": 1, "indices": {"bufferView": 2, "componentType": 5121}, "values": {"bufferView": 3}}
    document["accessors"].append({"componentType": 5126, "count": 3, "type": "VEC3", "sparse": sparse})
    if of_mesh is not None:
        document["meshes"][0]["weights"] = of_mesh
    return document


@pytest.mark.parametrize(
    ("weights", "of_mesh", "counted"),
    [(None, None, (0, 0)), (None, [0.5, 2], (0.5, 2)), ([1, 0], [0.5, 2], (1, 0)), ([0, 1], None, (0, 1))],
)
def test_gltf_morph_targets_count_by_their_weights(tmp_path, weights, of_mesh, counted):
    mesh = load(tmp_path, morphed(weights, of_mesh))
    wanted = (
        TRIANGLE + counted[0] * np.array([0, 0, 1]) + counted[1] * np.array([[0] * 3, [0] * 3, [1, 2, 3]])
    )
    np.testing.assert_allclose(mesh.vertices, wanted, atol=1e-6)
    np.testing.assert_allclose(mesh.normals[0], [0, 0, 1 + counted[0]], atol=1e-6)


def test_gltf_sparse_elements_replace_others(tmp_path):
    document = morphed(None)
    document["accessors"][0]["sparse"] = document["accessors"][4]["sparse"]
    np.testing.assert_array_equal(load(tmp_path, document).vertices, [*TRIANGLE[:2], [1, 2, 3]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["nodes"][0].update(weights=[1]), "weights of morph targets must be 2 numbers"),
        (lambda d: d["meshes"][0]["primitives"][0].update(targets=7), "targets of a primitive must be an"),
        (lambda d: d["accessors"][4].update(count=4), r"target must have shape \(3, 3\), got \(4, 3\)"),
        (lambda d: d["accessors"][4].update(count=2), "sparse indices of POSITION .* run up to 2 of 2"),
        (lambda d: d["accessors"][4].update(count=10**12), "would take the data beyond"),
        (lambda d: d["accessors"][4]["sparse"].update(count=2), "claims 2 elements"),
        (
            lambda d: d["accessors"][4]["sparse"]["indices"].update(componentType=5126),
            "sparse indices that are unsigned",
        ),
        (lambda d: d["accessors"][4]["sparse"].update(values=1), "refers to index None of 4 bufferViews"),
    ],
)
def test_gltf_morph_targets_that_lie(tmp_path, change, message):
    document = morphed([1, 1])
    change(document)
    with pytest.raises(FileFormatError, match=message):
        load(tmp_path, document)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["skins"][0].update(joints=[1, 9]), "a skin or node refers to index 9 of 3 nodes"),
        (lambda d: d["skins"][0].update(joints=[]), "a skin needs joints"),
        (lambda d: d["skins"][0].update(joints="all"), "joints of a skin must be an array"),
        (lambda d: d["skins"][0].update(joints=[1]), "JOINTS_0 runs up to 1, the skin has 1 joints"),
        (lambda d: d["skins"][0].update(joints=[1, 2, 1]), "must be 3 matrices of 16 numbers"),
        (lambda d: d["skins"][0].update(inverseBindMatrices=3), "must be 2 matrices of 16 numbers"),
        (lambda d: d["nodes"][0].update(skin=1), "refers to index 1 of 1 skins"),
        (
            lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(JOINTS_0=3),
            "must be 3 times 4 integers",
        ),
        (
            lambda d: d.update(
                scenes=[{"nodes": [0]}], nodes=[d["nodes"][0], {"children": [2]}, {"children": [1]}]
            ),
            "a cycle in the node hierarchy at node [12]",
        ),
    ],
)
def test_gltf_skins_that_lie(tmp_path, change, message):
    document = skinned()
    change(document)
    with pytest.raises(FileFormatError, match=message):
        load(tmp_path, document)


def test_gltf_instances_are_all_there(tmp_path):
    half = 0.5**0.5
    mesh = load(
        tmp_path,
        instanced(
            TRANSLATION=[[0, 0, 0], [5, 0, 0]],
            ROTATION=[[0, 0, 0, 1], [0, 0, half, half]],
            SCALE=[[1, 1, 1], [1, 3, 1]],
        ),
    )
    first = [[0, 0, 1], [1, 0, 1], [0, 2, 1]]
    second = [[5, 0, 1], [5, 1, 1], [-1, 0, 1]]  # scaled, turned by a quarter about z, moved
    np.testing.assert_allclose(mesh.vertices, first + second, atol=1e-6)
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 5]]
    document = instanced(TRANSLATION=[[0, 0, 0], [5, 0, 0]])
    extension = document["nodes"][0]["extensions"]["EXT_mesh_gpu_instancing"]
    extension["attributes"] = {"_ID": 1}  # of the application
    np.testing.assert_allclose(load(tmp_path, document).vertices, first + first, atol=1e-6)
    moved = load(tmp_path, instanced(TRANSLATION=[[0, 0, 0], [5, 0, 0], [9, 0, 0]]))
    np.testing.assert_allclose(moved.vertices[6:], np.add(first, [9, 0, 0]), atol=1e-6)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({}, "equal counts of all attributes"),
        ({"TRANSLATION": [[0, 0, 0]], "SCALE": [[1, 1, 1]] * 2}, "equal counts of all attributes"),
        ({"ROTATION": [[0, 0, np.nan, 1]]}, "finite"),
    ],
)
def test_gltf_instances_that_lie(tmp_path, rows, message):
    with pytest.raises(FileFormatError, match=message):
        load(tmp_path, instanced(**rows))


def test_gltf_skins_and_instances_do_not_multiply_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(_validation, "_BASE_BYTES", 8 << 20)
    document = skinned()
    document["skins"][0]["joints"] = [1, 2] * 1000
    del document["skins"][0]["inverseBindMatrices"]
    document["nodes"] += [{"mesh": 0, "skin": 0}] * 500
    document["scenes"][0]["nodes"] += list(range(3, 503))
    with pytest.raises(FileFormatError, match="the 2,000 joints of a node would take the data beyond"):
        load(tmp_path, document)
    document = instanced(TRANSLATION=np.zeros((10_000, 3)))
    document["nodes"] = document["nodes"] * 500
    document["scenes"][0]["nodes"] = list(range(500))
    with pytest.raises(FileFormatError, match="would take the data beyond"):
        load(tmp_path, document)


@pytest.mark.parametrize(
    ("mode", "faces"),
    [
        (4, None),
        (5, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]]),
        (6, [[1, 2, 0], [2, 3, 0], [3, 4, 0], [4, 5, 0]]),
    ],
)
@pytest.mark.parametrize("index_type", ["u1", "<u2", "<u4"])
def test_gltf_strips_and_fans(tmp_path, mode, faces, index_type):
    positions = np.arange(18, dtype="<f4").reshape(6, 3)
    document = gltf(
        [(positions, "VEC3", False), (np.arange(6).astype(index_type)[:, None], "SCALAR", False)],
        primitive={"attributes": {"POSITION": 0}, "indices": 1, "mode": mode},
    )
    assert load(tmp_path, document).faces.tolist() == (faces or [[0, 1, 2], [3, 4, 5]])


def test_gltf_positions_in_integers_and_interleaved(tmp_path):
    """KHR_mesh_quantization, with a stride of 12 bytes and an offset."""
    rows = np.zeros((3, 6), "<i2")
    rows[:, 1:4] = [[0, 0, 0], [32767, 0, 0], [-32768, -32767, 16384]]  # both of the last are -1
    document = gltf([(rows, "VEC4", True)], extensionsRequired=["KHR_mesh_quantization"])
    document["bufferViews"][0]["byteStride"] = 12
    document["accessors"][0] |= {"type": "VEC3", "byteOffset": 2}
    got = load(tmp_path, document).vertices
    np.testing.assert_allclose(got, [[0, 0, 0], [1, 0, 0], [-1, -1, 16384 / 32767]], rtol=1e-6)


def test_gltf_buffers_beside_the_file(tmp_path):
    document = gltf([(TRIANGLE, "VEC3", False)])
    document["buffers"][0]["uri"] = "my%20data/a.bin"
    (tmp_path / "my data").mkdir()
    (tmp_path / "my data" / "a.bin").write_bytes(TRIANGLE.tobytes())
    np.testing.assert_array_equal(load(tmp_path, document).vertices, TRIANGLE)


def test_gltf_textures_and_points_are_left_out_with_a_word(tmp_path):
    document = gltf(
        [(TRIANGLE, "VEC3", False)],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    )
    triangle = {"attributes": {"POSITION": 0}, "material": 0}
    document["meshes"][0]["primitives"] = [triangle, {"attributes": {"POSITION": 0}, "mode": 0}]
    with pytest.warns(DataWarning) as caught:
        load(tmp_path, document)
    assert [str(w.message).partition("m.gltf: ")[2][:40] for w in caught] == [
        "1 primitives of points or lines were lef",
        "1 primitives have a texture, which was l",
    ]


def test_our_mesh_moved_by_another_program(tmp_path):
    mesh = random_mesh(np.random.default_rng(0))
    save_mesh(mesh, tmp_path / "m.glb")
    edit_glb(tmp_path / "m.glb", lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 1], scale=[2, 2, 2]))
    got = load_mesh(tmp_path / "m.glb")
    np.testing.assert_allclose(got.vertices, mesh.vertices * 2, rtol=1e-6)
    assert got.up.tolist() == [0, 1, 0]
    np.testing.assert_array_equal(got.face_splat, mesh.face_splat)


def test_our_extras_renumbered_by_another_program_are_not_believed(tmp_path):
    mesh = replace(random_mesh(np.random.default_rng(0)), order="splat")
    save_mesh(mesh, tmp_path / "m.glb")

    def renumber(document):
        note = document["meshes"][0]["extras"]["meshsplats"]
        note["face_splat"]["bufferView"], note["depth_group"]["bufferView"] = (
            note["depth_group"]["bufferView"],
            note["face_splat"]["bufferView"],
        )
        del document["meshes"][0]["primitives"][0]["attributes"]["_FLAT"]

    edit_glb(tmp_path / "m.glb", renumber)
    with pytest.warns(DataWarning, match="ignored: face_splat, depth_group, the order of its splats, flat"):
        got = load_mesh(tmp_path / "m.glb")
    assert got.face_splat is None
    assert got.order == "fragment"
    assert got.depth_group is None
    assert "flat" not in got.attributes
    np.testing.assert_array_equal(got.attributes["FLAT"], mesh.attributes["FLAT"])


PLY_POLYGONS = """ply
format ascii 1.0
comment made by hand
element vertex 5
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 3
property list uchar int vertex_index
property int face_splat
end_header
0 0 0 255 0 0
1 0 0 0 255 0
1 1 0 0 0 255
0 1 0 51 51 51
0 0 1 0 0 0
3 0 1 2 4
5 0 1 2 3 4 5

2 0 1 7
"""


def test_ply_polygons_become_triangles(tmp_path):
    (tmp_path / "m.ply").write_text(PLY_POLYGONS)
    mesh = load_mesh(tmp_path / "m.ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert mesh.face_splat.tolist() == [4, 5, 5, 5]
    np.testing.assert_allclose(mesh.colors[3], [0.2, 0.2, 0.2, 1], atol=1e-7)


def test_a_ply_that_has_lost_its_splats_has_lost_their_order_and_filter(tmp_path):
    mesh = replace(random_mesh(np.random.default_rng(0)), order="splat", filter_px2=0.3)
    save_mesh(mesh, tmp_path / "m.ply")
    whole = (tmp_path / "m.ply").read_bytes()
    (tmp_path / "m.ply").write_bytes(whole.replace(b"property int face_splat", b"property int other_name"))
    with pytest.warns(DataWarning, match="ignored: the filter of its splats, their order"):
        got = load_mesh(tmp_path / "m.ply")
    assert (got.order, got.filter_px2) == ("fragment", 0)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("sides", [(3, 3), (4, 4), (3, 4), (5, 2, 3)])
@pytest.mark.parametrize("second_list", [False, True])
def test_binary_ply_polygons_of_either_byte_order(tmp_path, order, sides, second_list):
    head = PLY_POLYGONS.partition("end_header")[0].replace("face 3", f"face {len(sides)}")
    head = head.replace("ascii", f"binary_{'little' if order == '<' else 'big'}_endian")
    body = b"".join(struct.pack(order + "3f3B", i, 0, 0, i, i, i) for i in range(5))
    expected, owner = [], []
    for number, n in enumerate(sides):
        body += struct.pack(f"{order}B{n}ii", n, *range(n), number)
        body += struct.pack(f"{order}B{n}d", n, *range(n)) if second_list else b""
        expected += [[0, k, k + 1] for k in range(1, n - 1)]
        owner += [number] * max(n - 2, 0)
    head += ("property list uchar double weights\n" if second_list else "") + "end_header\n"
    (tmp_path / "m.ply").write_bytes(head.encode() + body)
    mesh = load_mesh(tmp_path / "m.ply")
    assert mesh.faces.tolist() == expected
    assert mesh.face_splat.tolist() == owner


def test_ply_without_colours_is_grey_with_a_word(tmp_path):
    text = PLY_POLYGONS
    for name in ("red", "green", "blue"):
        text = text.replace(f"property uchar {name}\n", f"property uchar c_{name}\n")
    (tmp_path / "m.ply").write_text(text)
    with pytest.warns(DataWarning, match="no vertex colours"):
        mesh = load_mesh(tmp_path / "m.ply")
    assert mesh.colors.tolist() == [[0.5, 0.5, 0.5, 1]] * 5


COLORED = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property {kind} red
property {kind} green
property {kind} blue
property float opacity
element face 1
property list uchar int vertex_indices
end_header
0 0 0 255 0 51 1
1 0 0 255 0 51 1
0 1 0 255 0 51 1
3 0 1 2
"""


def test_ply_colours_of_0_and_1_in_a_signed_type_stay(tmp_path):
    (tmp_path / "m.ply").write_text(COLORED.format(kind="int").replace("255 0 51", "1 0 1"))
    assert load_mesh(tmp_path / "m.ply").colors[0].tolist() == [1, 0, 1, 1]


@pytest.mark.parametrize("kind", ["uchar", "short", "int"])
def test_ply_bytes_in_a_wider_signed_type_are_bytes(tmp_path, kind):
    (tmp_path / "m.ply").write_text(COLORED.format(kind=kind))
    np.testing.assert_allclose(load_mesh(tmp_path / "m.ply").colors, [[1, 0, 0.2, 1]] * 3, atol=1e-7)


def test_a_ply_mesh_with_opacities_is_a_mesh(tmp_path):
    path = tmp_path / "m.ply"
    path.write_text(COLORED.format(kind="uchar"))
    assert identify(path) == "mesh"
    path.write_text(COLORED.format(kind="uchar").replace("face 1", "face 0"))
    assert identify(path) == "splats"  # which lack the rest, as their reader says


def test_compressed_splats_are_no_mesh(tmp_path):
    (tmp_path / "s.ply").write_bytes(encode.compressed_ply(random_splats(9, degree=0)))
    with pytest.raises(FileFormatError, match="holds Gaussian splats, not a mesh"):
        load_mesh(tmp_path / "s.ply")


def test_ply_that_is_no_mesh(tmp_path):
    (tmp_path / "points.ply").write_text(PLY_POLYGONS.replace("element face 3", "element edge 3"))
    with pytest.raises(FileFormatError, match=r"no element 'face'; nor splats, .* f_dc_0"):
        load_mesh(tmp_path / "points.ply")
    with pytest.raises(FileFormatError, match="Gaussian splats, not a mesh; read it with load_gaussians"):
        load_mesh(shared_data("splats/playbot_lod6_2k_sh2.ply"))


def test_obj(tmp_path):
    (tmp_path / "m.obj").write_text(
        "# two faces\no thing\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nv 0 0 1 .2 .2 .2\nvt 0 0\n"
        "f 1/1 2/1 3/1\r\nf -4//1 \\\n-3 \\\n-2 -1\n"
    )
    mesh = load_mesh(tmp_path / "m.obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]
    np.testing.assert_allclose(mesh.colors[:, :3], [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 0.2]])
    assert mesh.up.tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("line", "number"), [("v 0 0", 5), ("f 1 2 x", 5), ("f 0 1 2", 5), ("f -9 1 2", 5), ("v 1 2 nope", 5)]
)
def test_obj_errors_name_the_line(tmp_path, line, number):
    (tmp_path / "m.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n{line}\n")
    with pytest.raises(FileFormatError, match=f"line {number} cannot be read: '{line}'"):
        load_mesh(tmp_path / "m.obj")


def test_npz_of_the_published_code(tmp_path):
    """Plain arrays, compressed, 64-bit numbers, colours without alpha or in bytes or a little beyond 1."""
    vertices, faces = TRIANGLE.astype(float), np.array([[0, 1, 2]])
    for colors, expected in (
        (np.full((3, 4), 0.25), [0.25] * 4),
        (np.full((3, 3), 0.25), [0.25] * 3 + [1]),
        (np.full((3, 4), 51, np.uint8), [0.2] * 4),
    ):
        np.savez_compressed(
            tmp_path / "m.npz",
            vertices=np.asfortranarray(vertices),
            faces=faces,
            vertex_colors=colors,
            more=1,
        )
        mesh = load_mesh(tmp_path / "m.npz")
        np.testing.assert_array_equal(mesh.vertices, TRIANGLE)
        np.testing.assert_allclose(mesh.colors, [expected] * 3, atol=1e-7)
        assert mesh.blending == "display"
    np.savez(tmp_path / "m.npz", vertices=vertices, faces=faces, vertex_colors=np.full((3, 4), 1.25))
    with pytest.warns(DataWarning, match="3 vertex colours lay outside"):
        assert (load_mesh(tmp_path / "m.npz").colors == 1).all()


def test_real_meshes():
    hull = load_mesh(shared_data("meshes/lego_visual_hull_40k_vertexcolor.ply"))
    assert hull.vertices.shape == (19849, 3)
    assert hull.faces.shape == (40000, 3)
    assert np.linalg.norm(hull.vertices, axis=1).max() < 2.5
    assert (hull.colors[:, 3] == 1).all()
    assert hull.colors[:, :3].std() > 0.05
    with pytest.warns(DataWarning, match="no vertex colours"):
        spot = load_mesh(shared_data("meshes/spot.obj"))
    assert spot.vertices.shape == (2930, 3)
    assert spot.faces.shape == (5856, 3)
    with pytest.warns(DataWarning, match="no vertex colours"):
        quads = load_mesh(shared_data("meshes/spot_textured/spot/spot_quadrangulated.obj"))
    assert quads.faces.shape == (5856, 3)


def test_trimesh_writes_what_we_read(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = random_mesh(np.random.default_rng(8), 30, 40, extras=False)
    colors = (mesh.colors * 255).astype(np.uint8)
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    for name, encoding in (("a.ply", "binary"), ("b.ply", "ascii"), ("c.glb", None)):
        options = {"encoding": encoding} if encoding else {}
        data = made.export(file_type=name[2:], **options)
        (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            got = load_mesh(tmp_path / name)
        np.testing.assert_allclose(got.vertices, mesh.vertices, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(got.faces, mesh.faces)
        if name != "c.glb":
            np.testing.assert_allclose(got.colors, colors / 255, atol=1e-6)


@pytest.mark.parametrize("flag", [False, True])
@pytest.mark.parametrize("dtype", ["<u2", "u1"])
def test_integer_colours_are_fractions_with_or_without_the_flag(tmp_path, dtype, flag):
    """Blender 2.91 and others leave the flag out; the specification allows integers only with it."""
    most = np.iinfo(dtype).max
    linear = np.array([0.5, 0.25, 0.1, 1])
    colors = np.tile(np.round(linear * most), (3, 1)).astype(dtype)
    document = gltf(
        [(TRIANGLE, "VEC3", False), (colors, "VEC4", flag)],
        primitive={"attributes": {"POSITION": 0, "COLOR_0": 1}},
    )
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        mesh = load(tmp_path, document)
    np.testing.assert_allclose(mesh.colors[0, :3], linear_to_srgb(linear[:3]), atol=1 / most)
    told = [str(w.message) for w in found]
    if flag:
        assert told == []
    else:
        assert len(told) == 1
        assert "COLOR_0 has integers without the flag 'normalized'" in told[0]


@pytest.mark.parametrize("flag", [False, True])
def test_integer_normals_are_fractions(tmp_path, flag):
    normals = np.tile(np.array([0, 0, 127], "i1"), (3, 1))
    document = gltf(
        [(TRIANGLE, "VEC3", False), (normals, "VEC3", flag)],
        primitive={"attributes": {"POSITION": 0, "NORMAL": 1}},
    )
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        mesh = load(tmp_path, document)
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1]] * 3, atol=1e-6)
    assert any("NORMAL has integers without the flag" in str(w.message) for w in found) != flag
