"""Splats, meshes and colliders together in one file: in their places, read back, and valid."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from _glb import read_glb
from _splats import few_splats
from PIL import Image

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.errors import DataWarning, NoTextureWarning
from meshsplats.scene.base_mesh import Texture

UP = np.array([0.6, -0.64, 0.48], np.float32)
CLOUD = replace(few_splats(), up=UP)
MESH = ms.convert(CLOUD)
BOX = ms.BaseMesh(MESH.vertices[:30], np.arange(30).reshape(-1, 3), up=UP)
PIXELS = np.random.default_rng(3).integers(0, 255, (4, 8, 4), np.uint8)
SURFACE = replace(
    BOX,
    uv=np.random.default_rng(4).random((10, 3, 2), np.float32),
    face_texture=[0, 0, 0, 1, 1, -1, -1, -1, 0, 1],
    textures=(Texture(PIXELS), Texture(PIXELS[::-1].copy(), ("clamp", "mirror"), (0.5, 1, 1, 1))),
    colors=np.random.default_rng(5).random((30, 4), np.float32) * [1, 1, 1, 0] + [0, 0, 0, 1],
)


def need_usd(suffix):
    if suffix != ".glb":
        pytest.importorskip("pxr")


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("suffix", [".glb", ".usdc", ".usda"])
@pytest.mark.parametrize("away", [0, 4.5e6])
def test_each_reader_finds_its_part(tmp_path, suffix, away):
    need_usd(suffix)
    origin = np.array([away, 0, 3])
    cloud, mesh = replace(CLOUD, origin=origin), replace(MESH, origin=origin + 1)
    path = tmp_path / f"a{suffix}"
    ms.save_scene(path, splats=cloud, mesh=mesh, collider=replace(BOX, origin=origin))
    splats = ms.load_gaussians(path)
    np.testing.assert_array_equal(splats.means, cloud.means)
    np.testing.assert_array_equal(splats.sh, cloud.sh)
    np.testing.assert_allclose(splats.up, UP, atol=1e-6)
    np.testing.assert_array_equal(splats.origin, origin)
    with pytest.warns(DataWarning, match="left out"):
        back = ms.load_mesh(path)
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.origin, mesh.origin)


def points_of(document, chunk, node):
    """(n, 3) positions of the mesh of a node where viewers draw them, by the JSON alone."""
    primitive = document["meshes"][node["mesh"]]["primitives"][0]
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    view = document["bufferViews"][accessor["bufferView"]]
    stored = np.frombuffer(chunk, "<f4", 3 * accessor["count"], view["byteOffset"]).reshape(-1, 3)
    x, y, z, w = node["rotation"]
    v = stored.astype(np.float64)
    q = np.array([x, y, z])
    turned = v + 2 * np.cross(q, np.cross(q, v) + w * v)
    return turned + node.get("translation", [0, 0, 0])


@pytest.mark.parametrize("up", [UP, np.array([0, -1, 0]), np.array([0.6, 0.8, 0])])
def test_viewers_draw_the_parts_of_a_glb_on_each_other(tmp_path, up):
    """Splats lie in other axes in the file than meshes; nodes bring them together, up to +y."""
    mesh = replace(MESH, up=up)
    ms.save_scene(tmp_path / "a.glb", splats=replace(CLOUD, up=up), mesh=mesh, collider=mesh)
    document, chunk = read_glb(tmp_path / "a.glb")
    splats, fans, collider = (points_of(document, chunk, document["nodes"][i]) for i in range(3))
    centers = np.array([MESH.vertices[faces].mean(axis=(0, 1)) for faces in fans_of(MESH)])
    drawn = np.array([fans[faces].mean(axis=(0, 1)) for faces in fans_of(MESH)])
    world = np.linalg.lstsq(centers, drawn, rcond=None)[0]  # the map of the mesh: a rotation
    np.testing.assert_allclose(splats, CLOUD.means @ world, atol=1e-5)
    np.testing.assert_allclose(up @ world, [0, 1, 0], atol=1e-5)
    np.testing.assert_allclose(collider, fans, atol=1e-9)


def fans_of(mesh):
    return [mesh.faces[mesh.face_splat == i] for i in range(mesh.face_splat.max() + 1)]


def test_a_collider_is_named_for_godot_and_drawn_by_nobody(tmp_path):
    ms.save_scene(tmp_path / "a.glb", splats=CLOUD, collider=BOX)
    document, _ = read_glb(tmp_path / "a.glb")
    node = document["nodes"][1]
    assert node["name"] == "collider-colonly"
    primitive = document["meshes"][node["mesh"]]["primitives"][0]
    material = document["materials"][primitive["material"]]
    assert material["alphaMode"] == "MASK"
    assert material["pbrMetallicRoughness"]["baseColorFactor"][3] == 0
    with pytest.raises(ms.FileFormatError, match="Gaussian splats, not a mesh"):
        ms.load_mesh(tmp_path / "a.glb")


def test_a_collider_of_usd_has_the_api_of_physics(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdPhysics

    ms.save_scene(tmp_path / "a.usdc", splats=CLOUD, mesh=MESH, collider=BOX)
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    (found,) = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.CollisionAPI)]
    assert UsdGeom.Imageable(found).ComputePurpose() == "guide"
    assert UsdPhysics.MeshCollisionAPI(found).GetApproximationAttr().Get() == "none"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    material = UsdGeom.Mesh(stage.GetPrimAtPath("/Scene/Mesh/Mesh"))
    binding = material.GetPrim().GetRelationship("material:binding").GetTargets()
    assert binding == ["/Scene/Mesh/Material"]


def test_a_textured_surface_comes_back_from_glb(tmp_path):
    path = tmp_path / "a.glb"
    ms.save_scene(path, splats=CLOUD, surface=SURFACE)
    with pytest.warns(DataWarning, match="splats are left out"):
        back = ms.load_base(path)
    assert len(back.textures) == 2
    # Faces are grouped by their texture, those without first.
    order = np.argsort(SURFACE.face_texture, kind="stable")
    np.testing.assert_array_equal(back.face_texture, SURFACE.face_texture[order])
    textured = back.face_texture >= 0
    np.testing.assert_allclose(back.uv[textured], SURFACE.uv[order][textured], atol=1e-6)
    for mine, other in zip(SURFACE.textures, back.textures, strict=True):
        np.testing.assert_array_equal(mine.pixels, other.pixels)
        assert (mine.wrap, mine.factor) == (other.wrap, other.factor)
    corners = back.vertices[back.faces[~textured]]
    wanted = ms.load_base(write_plain(tmp_path)).vertices.reshape(-1, 3, 3)[order][~textured]
    np.testing.assert_allclose(corners, wanted, atol=1e-6)


def write_plain(folder):
    """The surface as a mesh of vertices alone, whose node our reader applies."""
    path = folder / "plain.glb"
    ms.save_scene(path, surface=BOX)
    return path


RELIEF = replace(SURFACE, normal_map=np.random.default_rng(6).integers(1, 255, (4, 4, 3), np.uint8))


def test_a_lit_surface_of_a_glb_has_its_normals_and_normal_map(tmp_path):
    ms.save_scene(tmp_path / "lit.glb", surface=RELIEF, lit=True)
    document, chunk = read_glb(tmp_path / "lit.glb")

    def array(index, columns):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        return np.frombuffer(chunk, "<f4", columns * accessor["count"], view["byteOffset"]).reshape(
            -1, columns
        )

    bare, *textured = [part["attributes"] for part in document["meshes"][0]["primitives"]]
    assert "TANGENT" not in bare
    for part in (bare, *textured):
        np.testing.assert_allclose(np.linalg.norm(array(part["NORMAL"], 3), axis=1), 1, atol=1e-6)
    for part in textured:
        normals, tangents = array(part["NORMAL"], 3), array(part["TANGENT"], 4)
        np.testing.assert_allclose((normals * tangents[:, :3]).sum(axis=1), 0, atol=1e-6)
        assert set(np.abs(tangents[:, 3])) == {1}
    relief = [material.get("normalTexture") for material in document["materials"]]
    assert relief == [None, {"index": 0}, {"index": 0}]
    view = document["bufferViews"][document["images"][document["textures"][0]["source"]]["bufferView"]]
    with Image.open(io.BytesIO(chunk[view["byteOffset"] :][: view["byteLength"]])) as image:
        np.testing.assert_array_equal(np.asarray(image), RELIEF.normal_map)
    back = ms.load_base(tmp_path / "lit.glb")
    np.testing.assert_array_equal(back.textures[1].pixels, SURFACE.textures[1].pixels)
    ms.save_scene(tmp_path / "unlit.glb", surface=RELIEF)
    attributes = read_glb(tmp_path / "unlit.glb")[0]["meshes"][0]["primitives"][1]["attributes"]
    assert attributes.keys() == {"POSITION", "TEXCOORD_0"}


def test_a_lit_surface_of_a_package_has_its_normals_and_normal_map(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdShade

    pixels = np.where(PIXELS > 99, np.uint8(255), np.uint8(0))  # cut out
    base = replace(RELIEF, textures=(Texture(pixels), RELIEF.textures[1]))
    ms.save_scene(tmp_path / "a.usdz", surface=base, lit=True)
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Scene/Surface/Mesh"))
    normals = np.array(shape.GetNormalsAttr().Get())
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert shape.GetNormalsInterpolation() == "vertex"
    for i, threshold in enumerate((0.5, None)):
        at = f"/Scene/Surface/Texture_{i}"
        shader = UsdShade.Shader(stage.GetPrimAtPath(f"{at}/Surface"))
        (source, *_), _ = shader.GetInput("normal").GetConnectedSources()
        assert source.source.GetPath() == f"{at}/Normals"
        asset = UsdShade.Shader(stage.GetPrimAtPath(f"{at}/Normals")).GetInput("file").Get()
        assert asset.resolvedPath.endswith("normals.png]")
        found = shader.GetInput("opacityThreshold")
        assert (found.Get() if found else None) == threshold


def test_a_package_of_usd_holds_the_textures(tmp_path):
    sdf = pytest.importorskip("pxr.Sdf")
    ms.save_scene(tmp_path / "a.usdz", splats=CLOUD, surface=SURFACE, collider=BOX)
    names = sdf.ZipFile.Open(str(tmp_path / "a.usdz")).GetFileNames()
    assert sorted(name.rpartition("/")[2] for name in names) == [
        "scene.usdc",
        "texture_0.png",
        "texture_1.png",
    ]
    assert len(ms.load_gaussians(tmp_path / "a.usdz")) == len(CLOUD)


@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_the_validators_of_openusd_are_content(tmp_path, suffix):
    validation = pytest.importorskip("pxr.UsdValidation", reason="usd-core 25.05 or newer")
    from pxr import Usd

    surface = RELIEF if suffix == ".usdz" else BOX
    ms.save_scene(tmp_path / f"a{suffix}", splats=CLOUD, mesh=MESH, surface=surface, collider=BOX, lit=True)
    stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []


def test_the_khronos_validator_finds_nothing_but_the_extension(tmp_path, gltf_issues):
    files = [tmp_path / "plain.glb", tmp_path / "lit.glb"]
    for lit, file in enumerate(files):
        parts = {"splats": CLOUD, "mesh": MESH, "surface": RELIEF, "collider": BOX}
        ms.save_scene(file, **parts, lit=bool(lit))
    for issues in gltf_issues(*files):
        codes = {issue["code"] for issue in issues["messages"]}
        assert codes <= {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNUSED_OBJECT"}


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("a.ply", {"splats": CLOUD}, "'a.ply' names no scene; choose a name that ends in .glb"),
        ("a.glb", {}, "nothing to write"),
        ("a.glb", {"splats": CLOUD.take(slice(0, 0))}, "splats is empty"),
        ("a.usdc", {"surface": SURFACE}, "no place for the textures"),
        ("a.glb", {"splats": CLOUD, "collider": replace(BOX, up=[0, 1, 0])}, "give dataclasses.replace"),
        ("a.glb", {"splats": replace(CLOUD, up=None), "collider": BOX}, "splats has up 0 -1 0, collider 0.6"),
    ],
)
def test_what_is_no_scene_is_refused_before_anything_is_written(tmp_path, name, given, message):
    with pytest.raises(ValueError, match=message):
        ms.save_scene(tmp_path / name, **given)
    assert list(tmp_path.iterdir()) == []


def test_splats_without_up_take_that_of_the_mesh(tmp_path):
    ms.save_scene(tmp_path / "a.glb", splats=replace(CLOUD, up=None), mesh=MESH, collider=MESH)
    np.testing.assert_allclose(ms.load_gaussians(tmp_path / "a.glb").up, UP, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".glb", ".usdc"])
def test_convert_puts_a_mesh_and_a_collider_beside_splats(tmp_path, suffix, capsys):
    need_usd(suffix)
    ms.save_gaussians(CLOUD, tmp_path / "a.ply")
    ms.save_mesh(MESH, tmp_path / "m.npz")
    out = tmp_path / f"b{suffix}"
    words = ["convert", str(tmp_path / "a.ply"), "-o", str(out), "--as-splats", "--no-sidecar"]
    beside = ["--with-mesh", str(tmp_path / "m.npz"), "--collider", str(tmp_path / "m.npz")]
    assert main([*words, *beside, "--scale", "2", "--up=-y"]) == 0
    cloud = ms.load_gaussians(out)
    np.testing.assert_allclose(cloud.means, 2 * CLOUD.means, rtol=1e-6)
    np.testing.assert_allclose(cloud.up, [0, -1, 0], atol=1e-6)
    with pytest.warns(DataWarning, match="left out"):
        np.testing.assert_allclose(ms.load_mesh(out).vertices, 2 * MESH.vertices, rtol=1e-6)
    capsys.readouterr()
    for more, message in (
        (beside[:2], "--with-mesh and --collider go beside splats"),
        (["--as-splats", *beside[2:], "-o", str(tmp_path / "b.spz")], "are for .glb and USD"),
    ):
        words = ["convert", str(tmp_path / "a.ply"), "-o", str(tmp_path / "c.glb"), "--no-sidecar"]
        assert main([*words, *more]) == 2
        assert message in capsys.readouterr().err
    words = ["convert", str(tmp_path / "a.ply"), "-o", str(tmp_path / "m.glb"), "--as-splats", "--force"]
    ms.save_mesh(MESH, tmp_path / "m.glb")
    assert main([*words, "--collider", str(tmp_path / "m.glb")]) != 0


def test_textures_of_scenes_are_told_to_load_mesh(tmp_path):
    ms.save_scene(tmp_path / "a.glb", surface=SURFACE)
    with pytest.warns(NoTextureWarning):
        assert len(ms.load_mesh(tmp_path / "a.glb").faces) == 10
