"""Surfaces as files, read back by us and by others."""

from __future__ import annotations

import importlib.util
import io
import struct
import zipfile
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from _glb import read_glb
from _priors import CUBE, CUBE_FACES
from PIL import Image

from meshsplats import BaseMesh, load_base, load_mesh, look_at, save_base
from meshsplats.errors import NoColorsWarning
from meshsplats.formats.base_meshes import BASE_SUFFIXES, companions
from meshsplats.formats.gltf.cameras import cameras_in_mesh
from meshsplats.formats.surfaces.convex import THICK, convex_parts
from meshsplats.formats.usd.cameras import cameras_in_usd
from meshsplats.scene.base_mesh import Texture

needs_scipy = pytest.mark.skipif(importlib.util.find_spec("scipy") is None, reason="install meshsplats[base]")
needs_usd = pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason="install meshsplats[usd]")


def tetrahedron(*, textured: bool = True, origin=(0, 0, 0), noise: bool = False) -> BaseMesh:
    """Closed, facing out, each face a chart of its own."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    if not textured:
        colors = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0.5, 0.25, 0.75, 1]])
        return BaseMesh(points, faces, colors, up=(0, -1, 0), origin=np.array(origin, float))
    uv = np.array([[[0.1, 0.1], [0.4, 0.1], [0.1, 0.4]]], np.float32) + np.array(
        [[[0, 0]], [[0.5, 0]], [[0, 0.5]], [[0.5, 0.5]]], np.float32
    )
    pixels = np.full((64, 32, 4), 255, np.uint8)
    y, x = np.mgrid[:64, :32]
    pixels[..., 0], pixels[..., 1], pixels[..., 2] = 4 * y, 8 * x, 90
    if noise:
        pixels = np.random.default_rng(0).integers(0, 256, (1024, 1024, 4), np.uint8)
        pixels[..., 3] = 255
    return BaseMesh(
        points,
        faces,
        uv=uv,
        face_texture=np.zeros(4, np.int32),
        textures=(Texture(pixels, ("clamp", "clamp")),),
        up=(0, -1, 0),
        origin=np.array(origin, float),
    )


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
@pytest.mark.parametrize("origin", [(0, 0, 0), (5e5, 4.5e6, 100)])
def test_a_texture_comes_back(tmp_path, suffix, origin):
    base = tetrahedron(origin=origin)
    save_base(base, tmp_path / f"a{suffix}")
    again = load_base(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(again.vertices[again.faces], base.vertices[base.faces], atol=1e-6)
    np.testing.assert_allclose(again.uv, base.uv, atol=1e-6)
    np.testing.assert_array_equal(again.textures[0].pixels, base.textures[0].pixels)
    np.testing.assert_allclose(again.up, base.up, atol=1e-6)
    np.testing.assert_array_equal(again.origin, base.origin)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
@pytest.mark.parametrize("up", [(0, 0, 1), (0.6, 0, 0.8)])
def test_up_and_origin_of_a_texture_come_back(tmp_path, suffix, up):
    base = replace(tetrahedron(origin=(500_000, 30, 4e6)), up=np.array(up))
    save_base(base, tmp_path / f"a{suffix}")
    again = load_base(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(again.up, base.up, atol=1e-6)
    np.testing.assert_array_equal(again.origin, base.origin)
    np.testing.assert_allclose(again.vertices[again.faces], base.vertices[base.faces], atol=1e-6)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply", ".npz", pytest.param(".usdc", marks=needs_usd)])
def test_colours_of_vertices_come_back(tmp_path, suffix):
    base = tetrahedron(textured=False)
    save_base(base, tmp_path / f"a{suffix}")
    mesh = load_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(mesh.vertices, base.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, base.faces)
    np.testing.assert_allclose(mesh.colors, base.colors, atol=1e-3)
    np.testing.assert_allclose(mesh.up, base.up, atol=1e-6)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply", ".npz", pytest.param(".usdc", marks=needs_usd)])
def test_a_surface_without_colours_has_none_when_it_is_read(tmp_path, suffix):
    base = replace(tetrahedron(textured=False), colors=None)
    save_base(base, tmp_path / f"a{suffix}")
    again = load_base(tmp_path / f"a{suffix}")
    assert again.colors is None
    np.testing.assert_allclose(again.vertices, base.vertices, atol=1e-6)
    np.testing.assert_array_equal(again.faces, base.faces)
    with pytest.warns(NoColorsWarning, match="no vertex colours"):
        load_mesh(tmp_path / f"a{suffix}")


def some_views(far: float = 4.0):
    """Of the tetrahedron, y down; the second has oblong pixels and a near plane."""
    front = look_at((0, 0, -far), (0.3, 0.6, 1), up=(0, -1, 0), fov=50, width=90, height=60, name="front")
    side = look_at((far, -0.2, 0.4), (0, 1, 0), up=(0, -1, 0), fov=70, width=64, height=64, near=0.05)
    return [front, replace(side, fx=side.fx * 0.8)]


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize(
    ("suffix", "collision", "origin"),
    [
        (".glb", None, (0, 0, 0)),
        (".glb", None, (5e5, 4.5e6, 100)),
        pytest.param(".glb", "convex", (5e5, 4.5e6, 100), marks=needs_scipy),
        pytest.param(".usdc", "drawn", (5e5, 4.5e6, 100), marks=needs_usd),
        pytest.param(".usda", None, (0, 0, 0), marks=needs_usd),
    ],
)
def test_views_come_back(tmp_path, suffix, collision, origin):
    base, given = tetrahedron(origin=origin), some_views()
    file, read = tmp_path / f"a{suffix}", cameras_in_mesh if suffix == ".glb" else cameras_in_usd
    save_base(base, file, cameras=given, collision=collision)
    again = load_base(file)
    found = [camera.relative_to(again.origin) for camera in read(file)]
    assert [camera.name for camera in found] == ["front", "view 2"]
    for camera, own in zip(found, given, strict=True):
        scale = np.array([own.width / camera.width, own.height / camera.height])  # square pixels now
        places, depths = own.project(base.vertices[base.faces].reshape(-1, 3))
        seen = camera.project(again.vertices[again.faces].reshape(-1, 3))
        assert np.abs(seen[0] * scale - places).max() < 0.02
        np.testing.assert_allclose(seen[1], depths, rtol=1e-5)
    save_base(base, tmp_path / f"b{suffix}", collision=collision)
    assert read(tmp_path / f"b{suffix}") == []


def test_views_are_not_lost_without_a_word(tmp_path):
    with pytest.raises(ValueError, match=r"cameras are for \.glb, \.usdc, .*, not for \.obj"):
        save_base(tetrahedron(), tmp_path / "b.obj", cameras=some_views())
    assert not any(tmp_path.iterdir())


def test_another_library_sees_the_surface_by_its_views(tmp_path):
    """glTF's y points up, and its cameras look along -z: the peak is above the middle, and before them."""
    trimesh = pytest.importorskip("trimesh")
    save_base(tetrahedron(), tmp_path / "a.glb", cameras=some_views())
    scene = trimesh.load_scene(tmp_path / "a.glb")
    (name,) = (node for node in scene.graph.nodes if node == "front")
    pose, _ = scene.graph.get(name)
    # The file's world is ours, turned by half about x.
    np.testing.assert_allclose(pose[:3, 3], [0, 0, 4], atol=1e-5)
    np.testing.assert_allclose(
        -pose[:3, 2], np.array([0.3, -0.6, -5]) / np.linalg.norm([0.3, 0.6, 5]), atol=1e-5
    )
    assert pose[1, 1] > 0.9, "upright"


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_another_library_reads_the_texture(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    base = tetrahedron()
    save_base(base, tmp_path / f"a{suffix}")
    mesh = trimesh.load(tmp_path / f"a{suffix}", force="mesh", process=False)
    assert len(mesh.faces) == 4
    material = mesh.visual.material
    picture = material.baseColorTexture if suffix == ".glb" else material.image
    colors = np.asarray(picture.convert("RGB")).astype(int)
    np.testing.assert_array_equal(colors, base.textures[0].pixels[..., :3])
    corners = mesh.visual.uv[mesh.faces]  # its v is up
    places = np.stack([corners[..., 0], 1 - corners[..., 1]], axis=2)
    np.testing.assert_allclose(places, base.uv, atol=1e-6)
    whole = trimesh.load(tmp_path / f"a{suffix}", force="mesh")
    whole.merge_vertices(merge_tex=True, merge_norm=True)
    assert whole.is_watertight
    assert whole.volume == pytest.approx(1)


@needs_usd
@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz"])
def test_usd_names_the_texture(tmp_path, suffix):
    from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdUtils

    base = tetrahedron()
    save_base(base, tmp_path / f"a{suffix}")
    stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    mesh = UsdGeom.Mesh(next(p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)))
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get()), base.vertices)
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()).reshape(-1, 3, 2)
    np.testing.assert_allclose(np.stack([st[..., 0], 1 - st[..., 1]], axis=2), base.uv, atol=1e-6)
    texture = UsdShade.Shader(stage.GetPrimAtPath("/Splats/Material/Texture"))
    path = texture.GetInput("file").Get()
    assert path.resolvedPath
    assert not UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(tmp_path / f"a{suffix}")))[2]
    names = {p.name for p in tmp_path.iterdir()}
    assert names == ({f"a{suffix}"} if suffix == ".usdz" else {f"a{suffix}", "a.png"})
    if suffix == ".usdz":
        with zipfile.ZipFile(tmp_path / "a.usdz") as package:
            assert package.testzip() is None
            assert {entry.date_time for entry in package.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_a_usdz_holds_no_webp(tmp_path):
    with pytest.raises(ValueError, match=r"holds no WebP: leave out image"):
        save_base(tetrahedron(), tmp_path / "a.usdz", image="webp")
    assert not list(tmp_path.iterdir())


def test_prints_are_solids_in_millimetres_with_z_up(tmp_path):
    base = tetrahedron(origin=(1e6, 0, 0))
    for suffix in (".stl", ".3mf"):
        save_base(base, tmp_path / f"a{suffix}")
    data = (tmp_path / "a.stl").read_bytes()
    assert struct.unpack_from("<I", data, 80) == (4,)
    kind = np.dtype([("n", "<f4", 3), ("p", "<f4", (3, 3)), ("unused", "<u2")])
    rows = np.frombuffer(data, kind, offset=84)
    with zipfile.ZipFile(tmp_path / "a.3mf") as package:
        model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
        assert {entry.date_time for entry in package.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    space = {"m": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"}
    assert model.get("unit") == "millimeter"
    points = np.array([[float(v.get(k)) for k in "xyz"] for v in model.iterfind(".//m:vertex", space)])
    triangles = model.iterfind(".//m:triangle", space)
    faces = np.array([[int(t.get(k)) for k in ("v1", "v2", "v3")] for t in triangles])
    np.testing.assert_allclose(rows["p"], points[faces], atol=1e-6)
    assert points.min() == 0
    # Up is -y: what is lowest along it ends at the top.
    np.testing.assert_allclose(points[:, 2], 2 - base.vertices[:, 1], atol=1e-6)
    corners = points[faces]
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(1), "no mirror image"
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(rows["n"], normals / np.linalg.norm(normals, axis=1)[:, None], atol=1e-6)


def test_large_textures_are_jpeg_unless_asked_otherwise(tmp_path):
    base = tetrahedron(noise=True)
    found = {}
    for name, image in (("default", None), ("png", "png"), ("webp", "webp")):
        save_base(base, tmp_path / f"{name}.glb", image=image)
        document, _ = read_glb(tmp_path / f"{name}.glb")
        found[name] = document["images"][0]["mimeType"]
        assert ("EXT_texture_webp" in document.get("extensionsRequired", [])) == (name == "webp")
        again = load_base(tmp_path / f"{name}.glb")
        if name != "default":
            np.testing.assert_array_equal(again.textures[0].pixels, base.textures[0].pixels)
    assert found == {"default": "image/jpeg", "png": "image/png", "webp": "image/webp"}


@pytest.mark.parametrize("unlit", [False, True])
def test_materials(tmp_path, unlit):
    save_base(tetrahedron(), tmp_path / "a.glb", unlit=unlit)
    document, _ = read_glb(tmp_path / "a.glb")
    material = document["materials"][0]
    assert ("KHR_materials_unlit" in material.get("extensions", {})) == unlit
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert "NORMAL" in document["meshes"][0]["primitives"][0]["attributes"]


@pytest.mark.parametrize(
    ("collision", "suffix"), [(None, "surface"), ("drawn", "surface-col"), ("only", "surface-colonly")]
)
def test_godot_knows_colliders_by_their_names(tmp_path, collision, suffix):
    save_base(tetrahedron(), tmp_path / "a.glb", collision=collision)
    document, _ = read_glb(tmp_path / "a.glb")
    assert [document["nodes"][0]["name"], document["meshes"][0]["name"]] == [suffix, suffix]
    base, again = tetrahedron(), load_base(tmp_path / "a.glb")
    np.testing.assert_array_equal(again.vertices[again.faces], base.vertices[base.faces])
    assert again.textured == (collision != "only")


@pytest.mark.parametrize(("radii", "sections"), [((2.0, 0.5), (64, 24)), ((1.0, 0.3), (60, 30))])
def test_unreal_gets_convex_parts_by_their_names(tmp_path, radii, sections):
    """As trimesh reads them: named after the surface, convex, closed, around all of it, and near it."""
    pytest.importorskip("scipy")
    trimesh = pytest.importorskip("trimesh")
    ring = trimesh.creation.torus(*radii, major_sections=sections[0], minor_sections=sections[1])
    base = BaseMesh(ring.vertices, ring.faces.astype(np.int32), up=[0, 0, 1], origin=[5, 0, 0])
    save_base(base, tmp_path / "a.glb", collision="convex")
    scene = trimesh.load_scene(tmp_path / "a.glb")
    count = len(scene.geometry) - 1
    assert sorted(scene.geometry) == [*(f"UCX_surface_{k:02d}" for k in range(count)), "surface"]
    shown = scene.geometry.pop("surface")
    hulls = list(scene.geometry.values())
    middle = shown.triangles.mean(axis=1)
    held = np.zeros(len(middle), bool)
    for hull in hulls:
        assert hull.is_convex
        assert hull.is_volume  # closed, and facing outwards
        sides = np.einsum("nd,md->nm", middle, hull.face_normals)
        held |= (sides <= (hull.face_normals * hull.triangles[:, 0]).sum(axis=1) + 1e-4).all(axis=1)
    assert held.all()
    volume = sum(hull.volume for hull in hulls)
    assert ring.volume < volume < 1.06 * ring.volume
    assert count < 16
    assert ring.convex_hull.volume > 1.5 * ring.volume  # what a single part would have
    for hull in hulls:
        material = hull.visual.material
        assert (material.alphaMode, material.baseColorFactor[3]) == ("MASK", 0)
    again = load_base(tmp_path / "a.glb")
    np.testing.assert_array_equal(again.vertices[again.faces], base.vertices[base.faces])


def ball() -> tuple[np.ndarray, np.ndarray]:
    """Vertices, those of each triangle apart, and 768 triangles that face outwards, of a ball of radius 1."""
    corners = CUBE[CUBE_FACES].astype(np.float64)
    for _ in range(3):
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    points = corners.reshape(-1, 3)
    points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    return points, np.arange(len(points), dtype=np.int32).reshape(-1, 3)


def volumes(parts) -> list[float]:
    return [float(np.linalg.det(points[triangles].astype(float)).sum() / 6) for points, triangles in parts]


def test_convex_parts_fill_a_solid_and_are_few():
    pytest.importorskip("scipy")
    points, faces = ball()
    (whole,) = volumes([(points, faces)])
    assert whole == pytest.approx(4 / 3 * np.pi, rel=0.05)
    (part,) = convex_parts(points, faces)
    np.testing.assert_allclose(volumes([part]), whole, rtol=2e-3)
    apart = (
        np.concatenate([points, points + np.float32([5, 0, 0])]),
        np.concatenate([faces, faces + len(points)]),
    )
    np.testing.assert_allclose(volumes(convex_parts(*apart)), [whole, whole], rtol=2e-3)
    # A cube on a larger one: two boxes, whichever way it is cut.
    steps = np.concatenate([CUBE * np.float32([3, 3, 1]), CUBE + np.float32([1, 1, 1])])
    parts = convex_parts(steps, np.concatenate([CUBE_FACES, CUBE_FACES + 8]))
    assert sum(volumes(parts)) == pytest.approx(10, rel=0.06)


def test_an_open_surface_has_parts_of_its_shell():
    pytest.importorskip("scipy")
    points, faces = ball()
    parts = convex_parts(points, faces[1:])
    assert len(parts) == 32
    assert sum(volumes(parts)) < 3


def test_flat_and_tiny_surfaces_have_convex_parts(tmp_path):
    pytest.importorskip("scipy")
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    for faces in ([[0, 1, 2]], [[0, 1, 2], [0, 2, 3]]):
        ((points, triangles),) = convex_parts(square, np.array(faces))
        low, high = points.min(axis=0), points.max(axis=0)
        np.testing.assert_allclose(high - low, [1, 1, THICK * np.sqrt(2)], rtol=1e-4)
        corners = points[triangles]
        volume = np.linalg.det(corners.astype(float)).sum() / 6
        assert volume == pytest.approx(len(faces) / 2 * THICK * np.sqrt(2), rel=1e-3)


@pytest.mark.parametrize("collision", [None, "drawn", "only"])
def test_usd_physics_knows_colliders(tmp_path, collision):
    pxr = pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdPhysics

    assert pxr
    save_base(tetrahedron(), tmp_path / "a.usdc", collision=collision)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    (prim,) = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert prim.HasAPI(UsdPhysics.CollisionAPI) == (collision is not None)
    assert prim.HasAPI(UsdPhysics.MeshCollisionAPI) == (collision is not None)
    assert (UsdGeom.Imageable(prim).ComputePurpose() == "guide") == (collision == "only")


def test_what_cannot_be_written(tmp_path):
    base, plain = tetrahedron(), tetrahedron(textured=False)
    both = BaseMesh(
        base.vertices,
        base.faces,
        uv=base.uv,
        face_texture=[0, 1, 0, 1],
        textures=(*base.textures, *base.textures),
    )
    for mesh, name, options, message in [
        (base, "a.fbx", {}, "choose a name that ends in .glb"),
        (base, "a.obj", {"unlit": True}, "unlit applies to"),
        (base, "caf\udce9.obj", {}, "'caf\ufffd.obj' is not UTF-8, as names of textures in .obj are"),
        (base, "a.glb", {"image": "gif"}, "image must be one of"),
        (plain, "a.glb", {"image": "png"}, "with a texture"),
        (base, "a.stl", {"image": "png"}, "with a texture"),
        (base, "a.glb", {"collision": "box"}, "collision must be one of drawn, only, convex, got 'box'"),
        (base, "a.usdc", {"collision": "convex"}, "collision 'convex' is for .glb, not for .usdc"),
        (base, "a.obj", {"collision": "only"}, "collision applies to .glb"),
        (base, "a.glb", {"collision": "only", "image": "png"}, "with a texture"),
        (BaseMesh(np.zeros((0, 3)), np.zeros((0, 3), int)), "a.glb", {}, "no faces"),
        (both, "a.glb", {}, "one texture on all faces"),
    ]:
        with pytest.raises(ValueError, match=message):
            save_base(mesh, tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_files_beside_are_those_that_are_named(tmp_path):
    for suffix in BASE_SUFFIXES:
        if suffix.startswith(".usd") and importlib.util.find_spec("pxr") is None:
            continue
        folder = tmp_path / suffix[1:]
        folder.mkdir()
        save_base(tetrahedron(), folder / f"a{suffix}")
        assert {p.name for p in folder.iterdir()} - {f"a{suffix}"} <= {
            p.name for p in companions(folder / f"a{suffix}")
        }


def test_a_failure_leaves_nothing(tmp_path, monkeypatch):
    import meshsplats.formats.surfaces.text as text

    def broken(*_):
        raise OSError("disk full")

    monkeypatch.setattr(text, "smooth_normals", broken)
    for suffix in (".obj", ".ply"):
        with pytest.raises(OSError, match="disk full"):
            save_base(tetrahedron(), tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_the_validator_finds_nothing(tmp_path, gltf_issues):
    cases = [
        (tetrahedron(), {}),
        (tetrahedron(noise=True), {}),
        (tetrahedron(origin=(5e5, 4.5e6, 100)), {"unlit": True}),
        (tetrahedron(textured=False), {}),
        (with_relief(), {}),
        (with_relief(), {"image": "webp"}),
        (tetrahedron(), {"cameras": some_views()}),
        *(([(tetrahedron(), {"collision": "convex"})]) if importlib.util.find_spec("scipy") else []),
    ]
    files = [tmp_path / f"{i}.glb" for i in range(len(cases))]
    for (base, options), file in zip(cases, files, strict=True):
        save_base(base, file, **options)
    for issues in gltf_issues(*files):
        assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


def accessor(document, chunk, index) -> np.ndarray:
    """The values of an accessor, a row for each."""
    found = document["accessors"][index]
    view = document["bufferViews"][found["bufferView"]]
    kind = {5123: "<u2", 5125: "<u4", 5126: "<f4"}[found["componentType"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[found["type"]]
    count = found["count"] * width
    return np.frombuffer(chunk, kind, count, view.get("byteOffset", 0)).reshape(-1, width)


def with_relief() -> BaseMesh:
    base = tetrahedron()
    pixels = np.random.default_rng(1).integers(0, 256, (32, 32, 3), np.uint8)
    return replace(base, normal_map=pixels)


def test_tangents_lie_along_u_and_bitangents_up_the_image(tmp_path):
    base = with_relief()
    save_base(base, tmp_path / "a.glb")
    document, chunk = read_glb(tmp_path / "a.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    tangents, normals, uv, points = (
        accessor(document, chunk, attributes[name])
        for name in ("TANGENT", "NORMAL", "TEXCOORD_0", "POSITION")
    )
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((tangents[:, :3] * normals).sum(axis=1), 0, atol=1e-6)
    primitive = document["meshes"][0]["primitives"][0]
    for corners in accessor(document, chunk, primitive["indices"]).reshape(-1, 3):
        steps, moves = uv[corners[1:]] - uv[corners[0]], points[corners[1:]] - points[corners[0]]
        along, against = np.linalg.solve(steps.astype(float), moves.astype(float))
        for corner in corners:
            tangent, sign, normal = tangents[corner, :3], tangents[corner, 3], normals[corner]
            across = along - normal * (along @ normal)
            if np.linalg.norm(across) < 1e-6:  # u runs along the normal: any tangent will do
                continue
            np.testing.assert_allclose(tangent, across / np.linalg.norm(across), atol=1e-5)
            assert sign * np.cross(normal, tangent) @ -against > -1e-6, "y of the map is against v"
    assert load_base(tmp_path / "a.glb").textured


def test_normal_maps_are_written_where_light_falls(tmp_path):
    base = with_relief()
    for name, options in (("lit.glb", {}), ("webp.glb", {"image": "webp"}), ("unlit.glb", {"unlit": True})):
        save_base(base, tmp_path / name, **options)
        document, chunk = read_glb(tmp_path / name)
        names = [image["name"] for image in document["images"]]
        assert names == (["surface"] if options.get("unlit") else ["surface", "normals"])
        assert ("normalTexture" in document["materials"][0]) == (len(names) == 2)
        if len(names) == 2:
            view = document["bufferViews"][document["images"][1]["bufferView"]]
            data = chunk[view["byteOffset"] :][: view["byteLength"]]
            found = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
            np.testing.assert_array_equal(found, base.normal_map)
    save_base(base, tmp_path / "a.obj")
    assert "norm a_normal.png" in (tmp_path / "a.mtl").read_text().splitlines()
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a_normal.png")), base.normal_map)
    assert set(tmp_path.glob("a*")) - {tmp_path / "a.obj"} <= set(companions(tmp_path / "a.obj"))
    with pytest.raises(ValueError, match="normal_map needs uv"):
        BaseMesh(base.vertices, base.faces, normal_map=base.normal_map)


@needs_usd
@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_usd_has_the_normal_map(tmp_path, suffix):
    from pxr import Usd, UsdShade

    for unlit in (False, True):
        path = tmp_path / f"{unlit}{suffix}"
        save_base(with_relief(), path, unlit=unlit)
        stage = Usd.Stage.Open(str(path))
        normals = UsdShade.Shader(stage.GetPrimAtPath("/Splats/Material/Normals"))
        assert bool(normals) == (not unlit)
        if unlit:
            continue
        assert normals.GetInput("file").Get().resolvedPath
        assert normals.GetInput("sourceColorSpace").Get() == "raw"
        assert tuple(normals.GetInput("scale").Get()) == (2, 2, 2, 1)
        assert tuple(normals.GetInput("bias").Get()) == (-1, -1, -1, 0)
        surface = UsdShade.Shader(stage.GetPrimAtPath("/Splats/Material/Surface"))
        assert surface.GetInput("normal").GetConnectedSources()[0][0].source.GetPath() == normals.GetPath()
