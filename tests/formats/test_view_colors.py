"""View-dependent colours, in files: they come back, and other programs see plain ones."""

from __future__ import annotations

import os
import struct
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from _glb import edit_glb, read_glb
from _meshes import assert_same, fan_mesh

from meshsplats import (
    DataWarning,
    FileFormatError,
    drawing_order,
    load_mesh,
    orbit,
    render,
    save_mesh,
)
from meshsplats.formats.meshes import expected_bytes
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.spherical_harmonics import sh_basis

USD = (".usda", ".usdc")


def mesh_of(degree=2, seed=0, **more):
    return fan_mesh(np.random.default_rng(seed), 9, degree, **more)


def needs(suffix):
    if suffix in USD:
        pytest.importorskip("pxr", reason="usd-core is not installed")


def errors(mesh, suffix):
    """How much colours and harmonics may differ: 16 and 8 bits."""
    if suffix in USD:
        return 1e-6, 0
    if suffix != ".glb":
        return 0, 0
    largest = 0 if mesh.harmonics is None else np.abs(mesh.harmonics).max()
    return 1e-4, largest / 127 * 0.501


@pytest.mark.slow(keep=6)
@pytest.mark.parametrize(
    ("plain", "degree", "suffix"),
    [
        *product([False, True], range(4), [".npz", ".ply", ".glb"]),
        # Files of USD take seconds, and both kinds are written by the same lines.
        *((True, 0, ".usda"), (False, 1, ".usdc"), (True, 2, ".usda")),
        *((False, 3, ".usda"), (True, 3, ".usdc")),
    ],
)
def test_round_trip(tmp_path, suffix, degree, plain):
    needs(suffix)
    mesh = mesh_of(degree, plain=plain)
    path = tmp_path / f"m{suffix}"
    save_mesh(mesh, path)
    got = load_mesh(path)
    assert_same(got, mesh, *errors(mesh, suffix))
    save_mesh(got, tmp_path / f"again{suffix}")
    assert_same(load_mesh(tmp_path / f"again{suffix}"), got, 1e-6)
    if suffix in (".npz", ".ply", ".glb"):
        assert abs(os.stat(path).st_size - expected_bytes(mesh, suffix)) < 4000


def test_glb_of_floats_is_exact(tmp_path):
    mesh = mesh_of(3)
    save_mesh(mesh, tmp_path / "m.glb", color_type="float32")
    assert_same(load_mesh(tmp_path / "m.glb"), mesh, 1e-6)


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".usda", ".obj"])
@pytest.mark.parametrize("plain", [False, True])
def test_other_programs_see_plain_colours(tmp_path, suffix, plain):
    """As programs see them that know neither our notes nor our attributes."""
    needs(suffix)
    mesh = mesh_of(2, plain=plain)
    path = tmp_path / f"m{suffix}"
    if suffix == ".obj":
        with (
            pytest.warns(DataWarning, match=r"m\.obj: harmonics are left out"),
            pytest.warns(DataWarning, match="left out: face_splat, flat"),
        ):
            save_mesh(mesh, path)
        lines = path.read_text().splitlines()
        seen = np.array([line.split()[4:] for line in lines if line.startswith("v ")], float)
    else:
        save_mesh(mesh, path)
    if suffix == ".ply":
        head, _, data = path.read_bytes().partition(b"end_header\n")
        names = [line.split()[2] for line in head.decode().splitlines() if line.startswith("property float")]
        vertex = [(name, "<f4") for name in names if not name.startswith("f_rest")]
        rows = np.frombuffer(data, vertex, len(mesh.vertices))
        seen = np.stack([rows[name] for name in ("red", "green", "blue")], axis=1)
    elif suffix == ".usda":
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(path))
        shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Splats/Mesh"))
        seen = linear_to_srgb(np.array(shape.GetDisplayColorAttr().Get(), np.float32))
    elif suffix == ".glb":
        pygltflib = pytest.importorskip("pygltflib")
        document = pygltflib.GLTF2.load(str(path))
        accessor = document.accessors[document.meshes[0].primitives[0].attributes.COLOR_0]
        start = document.bufferViews[accessor.bufferView].byteOffset
        stored = np.frombuffer(document.binary_blob(), "<u2", 4 * accessor.count, start).reshape(-1, 4)
        seen = linear_to_srgb(stored[:, :3].astype(np.float32) / 65535)
    wanted = mesh.plain_colors if plain else np.minimum(mesh.colors[:, :3], 1)
    np.testing.assert_allclose(seen, wanted, atol=1e-4)
    assert plain or (mesh.colors > 1).any()


@pytest.mark.slow
def test_trimesh_sees_plain_colours(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = mesh_of(2)
    save_mesh(mesh, tmp_path / "m.ply")
    seen = trimesh.load(tmp_path / "m.ply", process=False)
    assert len(seen.faces) == len(mesh.faces)
    np.testing.assert_allclose(seen.visual.vertex_colors[:, :3] / 255, mesh.plain_colors, atol=0.005)


def test_usd_passes_the_validators_of_usd(tmp_path):
    validation = pytest.importorskip("pxr.UsdValidation")
    from pxr import Usd

    save_mesh(mesh_of(2), tmp_path / "m.usda")
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert [
        str(error.GetMessage()) for error in context.Validate(Usd.Stage.Open(str(tmp_path / "m.usda")))
    ] == []


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("packing", ["attributes", "texcoords"])
def test_compressed_files_have_the_same_colours(tmp_path, degree, plain, packing):
    mesh = mesh_of(degree, plain=plain)
    for name, compression in (("a.glb", None), ("b.glb", "meshopt")):
        save_mesh(mesh, tmp_path / name, harmonics=packing, compression=compression)
    whole, packed = (load_mesh(tmp_path / name) for name in ("a.glb", "b.glb"))
    for name in ("colors", "harmonics", "plain_colors"):
        np.testing.assert_array_equal(getattr(packed, name), getattr(whole, name))


def accessor_of(path, name):
    """Rows of an attribute of the first primitive, as stored, read from the file alone."""
    document, binary = read_glb(path)
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = {5120: "<i1", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
    columns = {"VEC2": 2, "VEC4": 4}[accessor["type"]]
    rows = np.frombuffer(binary, kind, accessor["count"] * columns, view["byteOffset"]).reshape(-1, columns)
    return rows, document["meshes"][0]["extras"]["meshsplats"]["viewColors"]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_attributes_as_a_shader_reads_them(tmp_path, degree):
    """The formula in docs/viewers.md, from the bytes of the file."""
    mesh = mesh_of(degree)
    path = tmp_path / "m.glb"
    save_mesh(mesh, path)
    direction = np.array([0.48, -0.6, 0.64])
    basis = sh_basis(direction[None], degree)[0, 1:]
    owner = np.maximum(mesh.splats.of_vertex, 0)
    wanted = np.maximum(0, mesh.colors[:, :3] + np.einsum("k,vkc->vc", basis, mesh.harmonics[owner]))
    base, note = accessor_of(path, "_BASE")
    fours = np.concatenate([basis, np.zeros(-len(basis) % 4)]).reshape(-1, 4)
    got = note["base"] * base[:, :3] / 65535
    for c, channel in enumerate(("RED", "GREEN", "BLUE")):
        for i, b in enumerate(fours):
            got[:, c] += note["scale"] * (accessor_of(path, f"_SH_{channel}_{i}")[0] / 127) @ b
    used = mesh.splats.of_vertex >= 0
    np.testing.assert_allclose(np.maximum(got, 0)[used], wanted[used], atol=0.02)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_few_attributes(tmp_path, degree):
    """Blender's EEVEE draws 14 in one material, engines have 8 pairs of texture coordinates."""
    for packing in ("attributes", "texcoords"):
        save_mesh(mesh_of(degree), tmp_path / "m.glb", harmonics=packing)
        document, _ = read_glb(tmp_path / "m.glb")
        names = set(document["meshes"][0]["primitives"][0]["attributes"])
        if packing == "attributes":
            assert len(names - {"POSITION", "_FLAT"}) == 2 + 3 * (1, 2, 4)[degree - 1] <= 14
        else:
            texcoords = {f"TEXCOORD_{i}" for i in range((2, 5, 8)[degree - 1])}
            assert names == {"POSITION", "COLOR_0", "_FLAT", *texcoords}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_texcoords(tmp_path, degree):
    """As vertex shaders of engines unpack them, and back again: RGB within 8 bits where it is above white or
    differs from what is shown."""
    mesh = mesh_of(degree)
    path = tmp_path / "m.glb"
    save_mesh(mesh, path, harmonics="texcoords")
    got = load_mesh(path)
    brightest = mesh.colors[:, :3].max()
    np.testing.assert_allclose(got.colors, mesh.colors, atol=brightest / 255 * 0.501)
    assert_same(replace(got, colors=mesh.colors), mesh, 1e-4, errors(mesh, ".glb")[1])
    shown = mesh_of(degree, plain=False)
    save_mesh(shown, path, harmonics="texcoords")
    dark = shown.colors[:, :3] < 1
    assert np.abs(load_mesh(path).colors[:, :3] - shown.colors[:, :3])[dark].max() < 1e-4
    if degree:
        rows, note = accessor_of(path, "TEXCOORD_0")
        red, green, blue = (rows[:, 1] % 256, rows[:, 1] // 256 % 256, rows[:, 1] // 65536)
        first = (np.stack([red, green, blue], axis=1) - 128) / 127 * note["scale"]
        owner = shown.splats.of_vertex
        np.testing.assert_allclose(first[owner >= 0], shown.harmonics[owner[owner >= 0], 0], atol=0.01)


@pytest.mark.parametrize("nodes", [1, 3])
def test_ordered_files(tmp_path, nodes):
    mesh = mesh_of(2, extras=False)
    order = drawing_order(mesh, nodes=nodes, quick=True)
    for packing in ("attributes", "texcoords"):
        save_mesh(mesh, tmp_path / "m.glb", order=order, harmonics=packing)
        got = load_mesh(tmp_path / "m.glb")
        error = 1e-4 if packing == "attributes" else mesh.colors.max() / 255
        assert_same(got, mesh, error, errors(mesh, ".glb")[1])


def test_solid_and_translucent_triangles_have_theirs(tmp_path):
    mesh = mesh_of(2)
    alpha = mesh.colors[:, 3].copy()
    alpha[:16] = 1
    mesh = replace(mesh, colors=np.column_stack([mesh.colors[:, :3], alpha]))
    save_mesh(mesh, tmp_path / "m.glb", alpha="hybrid")
    document, _ = read_glb(tmp_path / "m.glb")
    primitives = document["meshes"][0]["primitives"]
    assert len(primitives) == 2
    assert all("_SH_BLUE_1" in primitive["attributes"] for primitive in primitives)
    for change in ({}, {"plain_colors": None}):
        part = replace(mesh, **change)
        save_mesh(part, tmp_path / "m.glb", alpha="hybrid")
        got = load_mesh(tmp_path / "m.glb")
        assert got.splat_count == mesh.splat_count
        assert (got.plain_colors is None) == (part.plain_colors is None)
        for camera in orbit(mesh, 3, width=32, height=32):
            shown, wanted = (render(m, camera).color for m in (got, part))
            np.testing.assert_allclose(shown, wanted, atol=0.02)
            assert np.abs(render(part.of_degree(0), camera).color - wanted).max() > 0.1
    edit_glb(tmp_path / "m.glb", lambda d: note_of(d)["splats"].update(crc32=1))
    with pytest.warns(DataWarning, match="ignored: harmonics"):
        assert load_mesh(tmp_path / "m.glb").harmonics is None
    save_mesh(mesh.of_degree(0), tmp_path / "m.glb", alpha="hybrid")
    assert load_mesh(tmp_path / "m.glb").face_splat is None
    save_mesh(mesh, tmp_path / "cut.glb", alpha="opaque")
    cut = load_mesh(tmp_path / "cut.glb")
    assert cut.sh_degree == 2
    assert (cut.colors[:, 3] == 1).all()


def test_a_file_that_another_program_has_turned(tmp_path):
    """Harmonics turn along: seen along the turned direction, splats look as before."""
    for suffix in (".glb", ".usda"):
        if suffix == ".usda" and not pytest.importorskip("pxr"):
            continue
        mesh = replace(mesh_of(3), up=np.float32([0, 1, 0]))
        path = tmp_path / f"m{suffix}"
        save_mesh(mesh, path)
        if suffix == ".glb":
            edit_glb(path, lambda d: d["nodes"][0].update(rotation=[0.5, 0.5, 0.5, 0.5]))
        else:
            path.write_text(
                path.read_text().replace(
                    "quatd xformOp:orient = (1, 0, 0, 0)", "quatd xformOp:orient = (0.5, 0.5, 0.5, 0.5)"
                )
            )
        got = load_mesh(path)
        turn = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # x to y to z to x
        np.testing.assert_allclose(got.vertices, mesh.vertices @ turn.T, atol=1e-5)
        d = np.array([[0.48, -0.6, 0.64]])
        before = sh_basis(d, 3)[:, 1:] @ mesh.harmonics
        after = sh_basis(d @ turn.T, 3)[:, 1:] @ got.harmonics
        np.testing.assert_allclose(after, before, atol=0.02)
        assert np.abs(sh_basis(d, 3)[:, 1:] @ got.harmonics - before).max() > 0.1


# -- files that are not as they should be


def test_ply_without_splats_or_with_others(tmp_path):
    path = tmp_path / "m.ply"
    mesh = mesh_of(1)
    save_mesh(mesh, path)
    whole = path.read_bytes()
    for old, new, message in (
        (b"element splat 9", b"element splat 8", "follow the last row"),
        (b"element splat 9", b"element splat 99", "file truncated or count wrong"),
        (b"property float f_rest_8\n", b"property float g_rest_8\n", "'splat' must have f_rest_0"),
        (b"property float f_rest_8\n", b"", "'splat' must have f_rest_0"),
    ):
        assert old in whole
        path.write_bytes(whole.replace(old, new))
        with pytest.raises(FileFormatError, match=message):
            load_mesh(path)
    path.write_bytes(whole[:-36].replace(b"element splat 9", b"element splat 8"))
    with pytest.raises(FileFormatError, match=r"harmonics must have shape \(9"):
        load_mesh(path)
    path.write_bytes(whole[:-4] + struct.pack("<f", np.nan))
    with pytest.raises(FileFormatError, match="harmonics"):
        load_mesh(path)
    path.write_bytes(whole.replace(b"int face_splat", b"int face_other"))
    with pytest.warns(DataWarning, match="ignored: their harmonics"):
        assert load_mesh(path).harmonics is None


def test_npz_of_other_shapes(tmp_path):
    mesh = mesh_of(2)
    arrays = {"vertex_colors" if n == "colors" else n: a for n, a in mesh.arrays().items() if "." not in n}
    for wrong in (mesh.harmonics[:, :5], mesh.harmonics[:-1], mesh.harmonics[..., :2], mesh.harmonics[0]):
        np.savez(tmp_path / "m.npz", **arrays | {"harmonics": wrong})
        with pytest.raises(FileFormatError, match="harmonics"):
            load_mesh(tmp_path / "m.npz")
    np.savez(tmp_path / "m.npz", **{n: a for n, a in arrays.items() if n != "face_splat"})
    with pytest.raises(FileFormatError, match="harmonics"):
        load_mesh(tmp_path / "m.npz")


def note_of(document):
    return document["meshes"][0]["extras"]["meshsplats"]


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("scale", "NaN", "scales of colours must be numbers"),
        ("scale", 0, "scales of colours must be numbers above 0"),
        ("scale", 1e30, "at most 10000"),
        ("base", -1, "scales of colours"),
        ("base", True, "scales of colours"),
        ("degree", 5, "degree 1, 2 or 3"),
        ("degree", [2], "degree 1, 2 or 3"),
        ("packing", "zip", "unknown packing"),
    ],
)
def test_glb_with_a_note_that_is_wrong(tmp_path, key, value, message):
    path = tmp_path / "m.glb"
    save_mesh(mesh_of(2), path)
    edit_glb(path, lambda d: note_of(d)["viewColors"].update({key: value}))
    with pytest.raises(FileFormatError, match=message):
        load_mesh(path)


def test_glb_whose_attributes_are_others(tmp_path):
    path = tmp_path / "m.glb"
    mesh = mesh_of(2)

    def attributes(document):
        return document["meshes"][0]["primitives"][0]["attributes"]

    save_mesh(mesh, path)
    edit_glb(path, lambda d: attributes(d).pop("_SH_RED_1"))
    with pytest.warns(DataWarning, match="ignored: harmonics"):
        got = load_mesh(path)
    assert got.harmonics is None
    np.testing.assert_allclose(got.colors[:, :3], mesh.plain_colors, atol=1e-4)

    save_mesh(mesh, path)
    edit_glb(path, lambda d: attributes(d).update(_SH_RED_1=attributes(d)["POSITION"]))
    with pytest.raises(FileFormatError, match="_SH_RED_1 must have shape"):
        load_mesh(path)

    save_mesh(mesh, path)
    edit_glb(path, lambda d: attributes(d).update(_SH_RED_1=attributes(d)["_BASE"]))  # not one of a splat
    with pytest.warns(DataWarning, match="ignored: harmonics"):
        assert load_mesh(path).harmonics is None


@pytest.mark.parametrize("packing", ["attributes", "texcoords"])
def test_the_validator_finds_nothing(tmp_path, gltf_issues, packing):
    files = [tmp_path / f"{degree}.glb" for degree in range(4)]
    for degree, file in enumerate(files):
        save_mesh(mesh_of(degree), file, harmonics=packing)
    for issues in gltf_issues(*files):
        assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]
