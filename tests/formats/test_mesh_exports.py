"""Formats that are written for other programs first: USD, .obj, compressed .glb."""

import builtins
import os
import subprocess
import warnings
from dataclasses import replace

import numpy as np
import pytest
from _glb import edit_glb
from _meshes import fan_mesh, random_mesh

from meshsplats import DataWarning, MissingDependencyError, SplatMesh, load_mesh, save_mesh
from meshsplats.formats._orientation import up_rotation
from meshsplats.formats.gltf.document import GltfDocument
from meshsplats.formats.gltf.writer import change_alpha
from meshsplats.scene.colors import srgb_to_linear

MESH = random_mesh(np.random.default_rng(0), 20, 30)


# -- USD


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usd"])
@pytest.mark.parametrize("lit", [False, True])
def test_usd(tmp_path, suffix, lit):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdShade

    mesh = replace(MESH, up=(0, 0, 1))
    path = tmp_path / f"m{suffix}"
    save_mesh(mesh, path, lit=lit)
    assert path.read_bytes().startswith(b"#usda" if suffix == ".usda" else b"PXR-USDC")
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    shape = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("Mesh"))
    np.testing.assert_array_equal(np.array(shape.GetPointsAttr().Get()), mesh.vertices)
    np.testing.assert_array_equal(np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), mesh.faces)
    assert set(shape.GetFaceVertexCountsAttr().Get()) == {3}
    assert shape.GetDoubleSidedAttr().Get()
    assert shape.GetSubdivisionSchemeAttr().Get() == "none"
    np.testing.assert_array_equal(
        np.array(shape.GetExtentAttr().Get()), [mesh.vertices.min(0), mesh.vertices.max(0)]
    )
    turned = shape.ComputeLocalToWorldTransform(Usd.TimeCode.Default()).Transform((0, 0, 1))
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-7)
    color, opacity = shape.GetDisplayColorPrimvar(), shape.GetDisplayOpacityPrimvar()
    assert color.GetInterpolation() == opacity.GetInterpolation() == "vertex"
    np.testing.assert_allclose(np.array(color.Get()), srgb_to_linear(mesh.plain_colors), atol=1e-7)
    np.testing.assert_array_equal(np.array(opacity.Get()), mesh.colors[:, 3])
    np.testing.assert_array_equal(np.array(shape.GetNormalsAttr().Get()), mesh.normals)
    primvars = UsdGeom.PrimvarsAPI(shape)
    np.testing.assert_array_equal(np.array(primvars.GetPrimvar("face_splat").Get()), mesh.face_splat)
    assert primvars.GetPrimvar("face_splat").GetInterpolation() == "uniform"
    wide = primvars.GetPrimvar("wide")
    assert wide.GetElementSize() == 7
    np.testing.assert_array_equal(np.array(wide.Get()).reshape(-1, 7), mesh.attributes["wide"])
    material, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    for name, primvar in (
        ("diffuseColor" if lit else "emissiveColor", "displayColor"),
        ("opacity", "displayOpacity"),
    ):
        source = surface.GetInput(name).GetConnectedSource()[0]
        reader = UsdShade.Shader(source.GetPrim())
        assert reader.GetInput("varname").Get() == primvar
    custom = shape.GetPrim().GetCustomDataByKey("meshsplats")
    assert custom["blending"] == "display"


def test_usd_passes_the_validators_of_usd(tmp_path):
    pytest.importorskip("pxr")
    validation = pytest.importorskip("pxr.UsdValidation")
    from pxr import Usd

    save_mesh(MESH, tmp_path / "m.usda")
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    errors = context.Validate(Usd.Stage.Open(str(tmp_path / "m.usda")))
    assert [e.GetMessage() for e in errors] == []


def test_usd_of_a_lit_mesh_without_normals_has_some(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    save_mesh(replace(MESH, normals=None), tmp_path / "m.usdc", lit=True)
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Splats/Mesh"))
    lengths = np.linalg.norm(np.array(shape.GetNormalsAttr().Get()), axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)
    save_mesh(replace(MESH, normals=None), tmp_path / "n.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "n.usdc"))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Splats/Mesh"))
    assert shape.GetNormalsAttr().Get() is None


def test_without_usd_core_the_error_names_the_extra(tmp_path, monkeypatch):
    def no_pxr(name, *args, **kwargs):
        if name.startswith("pxr"):
            raise ModuleNotFoundError(name)
        return importer(name, *args, **kwargs)

    importer = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", no_pxr)
    with pytest.raises(MissingDependencyError, match=r"extra 'usd': pip install usd-core"):
        save_mesh(MESH, tmp_path / "m.usdc")
    assert os.listdir(tmp_path) == []


# -- .obj


def test_obj_keeps_positions_colours_and_up(tmp_path):
    with pytest.warns(DataWarning, match=r"no opacity: 20 of 20 .*left out: face_splat, depth_group, flat"):
        save_mesh(MESH, tmp_path / "m.obj")
    got = load_mesh(tmp_path / "m.obj")
    np.testing.assert_array_equal(got.vertices, MESH.vertices)
    np.testing.assert_array_equal(got.faces, MESH.faces)
    np.testing.assert_array_equal(got.colors[:, :3], MESH.plain_colors)
    assert (got.colors[:, 3] == 1).all()
    np.testing.assert_allclose(got.up, MESH.up, atol=1e-6)


def test_obj_by_hand(tmp_path):
    mesh = SplatMesh(
        [[0, 0, 0.1], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], [[1, 0, 0.25, 1]] * 3, normals=[[0, 0, 1]] * 3
    )
    save_mesh(mesh, tmp_path / "m.obj")  # opaque: no warning
    lines = (tmp_path / "m.obj").read_text().splitlines()
    assert [x for x in lines if not x.startswith("#")] == [
        "o meshsplats_up_0_-1_0_to_y",
        "v 0 0 -0.100000001 1 0 0.25",
        "v 1 0 0 1 0 0.25",
        "v 0 -1 0 1 0 0.25",
        *["vn 0 0 -1"] * 3,
        "f 1//1 2//2 3//3",
    ]


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0.3, -0.8, 0.2), (-0.3, 0.8, 0.2)])
def test_obj_has_y_up_and_comes_back_as_it_was(tmp_path, up):
    unit = np.array(up) / np.linalg.norm(up)
    mesh = SplatMesh([[0.1, 0.2, 0.3], [1, 0, 0.7], unit], [[0, 1, 2]], np.ones((3, 4)), up=unit)
    save_mesh(mesh, tmp_path / "m.obj")
    text = (tmp_path / "m.obj").read_text()
    tip = [line.split()[1:4] for line in text.splitlines() if line.startswith("v ")][2]
    np.testing.assert_allclose([float(x) for x in tip], (0, 1, 0), atol=1e-7)
    again = load_mesh(tmp_path / "m.obj")
    np.testing.assert_allclose(again.vertices, mesh.vertices, rtol=0, atol=1e-16)
    np.testing.assert_array_equal(again.up, mesh.up)
    # Editors drop comments and keep names of objects.
    (tmp_path / "edited.obj").write_text("".join(x for x in text.splitlines(True) if x[0] != "#"))
    np.testing.assert_allclose(load_mesh(tmp_path / "edited.obj").vertices, mesh.vertices, atol=1e-8)


def test_older_obj_of_ours_is_not_turned(tmp_path):
    (tmp_path / "m.obj").write_text(
        "# meshsplats up 0 -1 0\nv 0 0 0 1 1 1\nv 1 2 3 1 1 1\nv 1 0 0 1 1 1\nf 1 2 3\n"
    )
    mesh = load_mesh(tmp_path / "m.obj")
    assert mesh.vertices[1].tolist() == [1, 2, 3]
    assert mesh.up.tolist() == [0, -1, 0]


def test_obj_of_a_mesh_for_linear_blending_has_display_colours(tmp_path):
    mesh = SplatMesh(np.eye(3), [[0, 1, 2]], [[0.2158605, 0, 1, 1]] * 3, blending="linear")
    save_mesh(mesh, tmp_path / "m.obj")
    np.testing.assert_allclose(load_mesh(tmp_path / "m.obj").colors[0], [128 / 255, 0, 1, 1], atol=1e-6)


def test_trimesh_reads_our_obj(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = replace(MESH, normals=None, colors=np.hstack([MESH.plain_colors, np.ones((20, 1))]))
    save_mesh(mesh, tmp_path / "m.obj")
    got = trimesh.load(tmp_path / "m.obj", process=False, maintain_order=True)
    np.testing.assert_allclose(got.vertices, mesh.vertices @ up_rotation(mesh.up).T, atol=1e-6)
    np.testing.assert_array_equal(got.faces, mesh.faces)
    np.testing.assert_allclose(got.visual.vertex_colors / 255, mesh.colors, atol=1 / 255)


# -- compressed .glb


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize(
    ("alpha", "solid", "modes"),
    [("blend", 0, ["BLEND"]), ("opaque", 400, ["OPAQUE"]), ("hybrid", 150, ["OPAQUE", "BLEND"])],
)
@pytest.mark.parametrize("unpacked", [False, True])
def test_compressed_glb(tmp_path, node_package, alpha, solid, modes, unpacked):
    """Every triangle is back within the stated error, also unpacked by another program."""
    rng = np.random.default_rng(1)
    corners = rng.random((400, 1, 3)) * [10, 5, 1] + rng.normal(size=(400, 3, 3)) * 0.05
    colors = rng.random((1200, 4))
    colors[: 3 * solid, 3] = 1
    mesh = SplatMesh(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3), colors, np.arange(400))
    save_mesh(mesh, tmp_path / "plain.glb", alpha=alpha)
    save_mesh(mesh, path := tmp_path / "m.glb", alpha=alpha, compression="meshopt")
    assert path.stat().st_size < (tmp_path / "plain.glb").stat().st_size
    if unpacked:
        tool = node_package("@gltf-transform/cli") / "node_modules" / ".bin" / "gltf-transform"
        path = tmp_path / "back.glb"
        words = [tool, "copy", tmp_path / "m.glb", path]
        subprocess.run(words, check=True, capture_output=True, timeout=60)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the other program leaves out what only this project reads
        back = load_mesh(path)
    materials = GltfDocument(path).json["materials"]
    assert sorted(m.get("alphaMode", "OPAQUE") for m in materials) == sorted(modes)

    def in_order(vertices, m):
        """Corners with colours, triangles in the order of their centres along x."""
        c = np.concatenate([vertices, m.colors], axis=1)[m.faces]
        rows = np.argsort(c[:, :, 0].mean(axis=1))
        # The corners of a triangle may have been turned round.
        first = c[rows, :, 0].argmin(axis=1)
        return np.stack([np.roll(t, -k, axis=0) for t, k in zip(c[rows], first, strict=True)])

    seen = mesh.vertices if (back.up == mesh.up).all() else mesh.vertices * [1, -1, -1]
    got, expected = in_order(back.vertices, back), in_order(seen, mesh)
    longest = np.ptp(mesh.vertices, axis=0).max()
    assert np.abs(got[:, :, :3] - expected[:, :, :3]).max() <= longest / 131070 * 1.05
    assert np.abs(got[:, :, 3:] - expected[:, :, 3:]).max() < 1 / 5000


def test_a_compressed_glb_keeps_everything_else(tmp_path):
    """As the file without compression has it, whose triangles may begin at another corner."""
    mesh = fan_mesh(np.random.default_rng(3), degree=2)
    mesh = replace(mesh, filter_px2=0.3, up=(0, 0.6, 0.8), origin=(5e5, 4.5e6, -70.25))
    normals = np.random.default_rng(4).normal(size=mesh.vertices.shape)
    mesh = replace(mesh, normals=normals / np.linalg.norm(normals, axis=1, keepdims=True))
    for name, compression in (("a.glb", None), ("b.glb", "meshopt")):
        with pytest.warns(DataWarning, match="to be rendered with a filter"):
            save_mesh(mesh, tmp_path / name, compression=compression)
    whole, packed = (load_mesh(tmp_path / name) for name in ("a.glb", "b.glb"))
    kept = whole.arrays().keys() - {"vertices", "normals", "faces"}
    assert packed.arrays().keys() == whole.arrays().keys()
    assert {"harmonics", "plain_colors", "face_splat", "origin", "attribute.flat"} <= kept
    for name in kept:
        np.testing.assert_array_equal(packed.arrays()[name], whole.arrays()[name], err_msg=name)
    np.testing.assert_array_equal(np.sort(packed.faces), np.sort(whole.faces))
    longest = np.ptp(mesh.vertices, axis=0).max()
    assert 0 < np.abs(packed.vertices - whole.vertices).max() <= longest / 131070 * 1.05
    np.testing.assert_allclose(packed.normals, whole.normals, atol=1 / 65534 * 1.05)


def test_a_compressed_glb_that_another_program_has_moved(tmp_path):
    mesh = replace(fan_mesh(np.random.default_rng(3), degree=2), up=(0, 1, 0))
    save_mesh(mesh, tmp_path / "m.glb", compression="meshopt")
    edit_glb(tmp_path / "m.glb", lambda d: d["nodes"][0].update(translation=[1, 2, 3]))
    got = load_mesh(tmp_path / "m.glb")
    np.testing.assert_allclose(got.vertices, mesh.vertices + np.array([1, 2, 3]), atol=1e-4)
    np.testing.assert_allclose(got.harmonics, mesh.harmonics, atol=np.abs(mesh.harmonics).max() / 127)


def test_what_compression_refuses(tmp_path):
    with pytest.raises(ValueError, match="compression must be one of meshopt, got 'zip'"):
        save_mesh(MESH, tmp_path / "m.glb", compression="zip")
    with pytest.raises(ValueError, match="compressed colours are of type 'uint16'"):
        save_mesh(MESH, tmp_path / "m.glb", compression="meshopt", color_type="float32")
    with pytest.raises(ValueError, match=r"compression applies to \.glb only"):
        save_mesh(MESH, tmp_path / "m.ply", compression="meshopt")
    assert os.listdir(tmp_path) == []


def test_the_alpha_mode_of_a_file_is_changed_in_place(tmp_path):
    path, expected = tmp_path / "a.glb", tmp_path / "b.glb"
    for alpha, cutoff in (("mask", 0.3), ("blend", None)):
        save_mesh(MESH, path, alpha="mask")
        save_mesh(MESH, expected, alpha=alpha, cutoff=cutoff)
        size = path.stat().st_size
        change_alpha(path, alpha, 0.2 if cutoff is None else cutoff)
        assert path.stat().st_size == size
        documents = [GltfDocument(file).json for file in (path, expected)]
        assert documents[0] == documents[1]
        np.testing.assert_array_equal(load_mesh(path).colors, load_mesh(expected).colors)
    save_mesh(MESH, path, alpha="blend")
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"no room for alpha mask with cutoff 0\.123"):
        change_alpha(path, "mask", 0.123)
    assert path.read_bytes() == before
