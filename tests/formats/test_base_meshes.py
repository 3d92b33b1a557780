"""Base meshes from files: vertex colours, textures by hand, and files that lie."""

from __future__ import annotations

import base64
import io
import json
import warnings

import numpy as np
import pytest
from _local import make_link, shared_data
from PIL import Image

from meshsplats import DataWarning, FileFormatError, load_mesh, orbit, render, save_mesh
from meshsplats.formats.base_meshes import load_base
from meshsplats.prior import bind
from meshsplats.scene.base_mesh import BaseMesh, Texture

PIXELS = np.array(
    [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8
)  # red, green above blue, white
OBJ = """mtllib m.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl painted
f 1/1 2/2 3/3 4/4
"""


def write_image(path, pixels=PIXELS) -> None:
    Image.fromarray(pixels).save(path)


def write_obj(folder, text=OBJ, library="newmtl painted\nmap_Kd t.png\n"):
    (folder / "m.obj").write_text(text)
    (folder / "m.mtl").write_text(library)
    write_image(folder / "t.png")
    return folder / "m.obj"


def at_corners(base: BaseMesh) -> np.ndarray:
    """(m, 3, 4) texture colours a tenth of the way from each corner to the face's middle."""
    weights = np.tile(np.eye(3) * 0.9 + 0.1 / 3, (len(base.faces), 1, 1))
    face = np.repeat(np.arange(len(base.faces)), 3)
    return base.texture_at(face, weights.reshape(-1, 3)).reshape(-1, 3, 4)


# ---- Textures


def test_a_texture_by_hand():
    texture = Texture(np.dstack([PIXELS, np.full((2, 2), 255, np.uint8)]))
    middles = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    np.testing.assert_allclose(texture.at(middles)[:, :3], PIXELS.reshape(4, 3) / 255, atol=1e-6)
    np.testing.assert_allclose(texture.at(np.array([[0.5, 0.25]])), [[0.5, 0.5, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(texture.at(np.array([[0.5, 0.5]])), [[0.5, 0.5, 0.5, 1]], atol=1e-6)


@pytest.mark.parametrize(("wrap", "beyond"), [("repeat", 0), ("mirror", 1), ("clamp", 1)])
def test_what_lies_beyond_the_edge(wrap, beyond):
    """Half a pixel past the right edge: the left column comes again, the right one back, or it goes on."""
    texture = Texture(np.dstack([PIXELS, np.full((2, 2), 255, np.uint8)]), (wrap, wrap))
    np.testing.assert_allclose(
        texture.at(np.array([[1.25, 0.25]]))[0, :3], PIXELS[0, beyond] / 255, atol=1e-6
    )
    np.testing.assert_allclose(texture.at(np.array([[3.25, -0.75]]))[0, 3], 1)
    assert np.isfinite(texture.at(np.array([[1e30, -1e30], [3e38, 0]]))).all()


def test_a_factor_is_of_linear_light():
    grey = np.full((1, 1, 4), 188, np.uint8)  # 0.5 of linear light
    color = Texture(grey, factor=(0.5, 1, 1, 0.5)).at(np.array([[0.5, 0.5]]))[0]
    np.testing.assert_allclose(color, [0.537, 0.737, 0.737, 188 / 510], atol=2e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((2, 2, 3), np.uint8),), "pixels must be"),
        ((np.zeros((0, 2, 4), np.uint8),), "pixels must be"),
        ((np.zeros((2, 2, 4)),), "pixels must be"),
        ((np.zeros((2, 2, 4), np.uint8), ("repeat", "never")), "wrap must be"),
    ],
)
def test_a_texture_checks_itself(arguments, message):
    with pytest.raises(ValueError, match=message):
        Texture(*arguments)


def test_a_base_checks_itself():
    vertices, faces = np.eye(3), [[0, 1, 2]]
    with pytest.raises(ValueError, match="faces must be indices"):
        BaseMesh(vertices, [[0, 1, 3]])
    with pytest.raises(ValueError, match="colors must lie"):
        BaseMesh(vertices, faces, np.full((3, 4), 2.0))
    with pytest.raises(ValueError, match="given together"):
        BaseMesh(vertices, faces, uv=np.zeros((1, 3, 2)))
    with pytest.raises(ValueError, match="face_texture must be indices of the 0 textures"):
        BaseMesh(vertices, faces, uv=np.zeros((1, 3, 2)), face_texture=[0])


# ---- .obj


def test_obj_with_a_material_library(tmp_path):
    """A square of one polygon: the image's first row lies at v = 1, as these files have it."""
    base = load_base(write_obj(tmp_path))
    assert base.colors is None
    assert base.textured
    np.testing.assert_array_equal(base.faces, [[0, 1, 2], [0, 2, 3]])
    colors = at_corners(base)[..., :3]
    blue, white, green, red = (PIXELS.reshape(4, 3)[i] / 255 for i in (2, 3, 1, 0))
    for found, wanted in zip(colors.reshape(6, 3), (blue, white, green, blue, green, red), strict=True):
        np.testing.assert_array_equal(np.rint(found), wanted)
    mesh = bind(base, triangles=16).mesh
    camera = orbit(mesh, 1, width=64, height=64, up=(0, 1, 0), elevation=0)[0]
    image = render(mesh, camera).color
    quarter = image[20, 20], image[20, 44], image[44, 20], image[44, 44]
    np.testing.assert_array_equal(np.rint(quarter), (red, green, blue, white))


def test_obj_faces_without_coordinates_or_material_are_bare(tmp_path):
    text = OBJ + "f 1 2 3\nusemtl other\nf 1/1 2/2 3/3\nf 1/-4 2/-3 3/-2\n"
    base = load_base(write_obj(tmp_path, text))
    np.testing.assert_array_equal(base.textured_faces(), [True, True, False, False, False])
    library = "newmtl painted\nmap_Kd t.png\nnewmtl other\nmap_Kd -clamp on -s 1 1 1 -bm 0.5 t.png\n"
    base = load_base(write_obj(tmp_path, text, library))
    np.testing.assert_array_equal(base.face_texture, [0, 0, -1, 1, 1])
    np.testing.assert_array_equal(base.uv[3], base.uv[4])  # counted from the end
    assert [t.wrap[0] for t in base.textures] == ["repeat", "clamp"]


def test_obj_vertex_colours_serve_where_there_is_no_texture(tmp_path):
    colored = OBJ.replace("v 0 0 0", "v 0 0 0 1 0 0").replace("v 1 0 0", "v 1 0 0 1 0 0")
    colored = colored.replace("v 1 1 0", "v 1 1 0 1 0 0").replace("v 0 1 0", "v 0 1 0 1 0 0")
    base = load_base(write_obj(tmp_path, colored + "f 1 2 3\n"))
    mesh = bind(base, layers=1).mesh
    np.testing.assert_allclose(mesh.colors[6:], [[1, 0, 0, 1]] * 3)
    np.testing.assert_allclose(bind(base, layers=1, colors="vertices").mesh.colors, [[1, 0, 0, 1]] * 9)
    assert (bind(base, layers=1, colors="texture").mesh.colors[:6, 2] > 0).any()


def test_missing_images_are_reported(tmp_path):
    path = write_obj(tmp_path, library="newmtl painted\nmap_Kd away.png\n")
    with pytest.warns(DataWarning, match=r"missing: away\.png"):
        assert not load_base(path).textured
    (tmp_path / "m.mtl").unlink()
    with pytest.warns(DataWarning, match=r"missing: m\.mtl"):
        assert not load_base(path).textured
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_base(path, textures=False).uv is None


def test_an_image_given_by_hand(tmp_path):
    path = write_obj(tmp_path, OBJ.replace("mtllib m.mtl\n", ""))
    assert not load_base(path).textured
    base = load_base(path, texture=tmp_path / "t.png")
    np.testing.assert_array_equal(base.face_texture, [0, 0])
    (tmp_path / "bare.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match="no texture coordinates"):
        load_base(tmp_path / "bare.obj", texture=tmp_path / "t.png")


@pytest.mark.parametrize(
    ("text", "library", "message"),
    [
        (OBJ.replace("m.mtl", "../away.mtl"), "", "outside its folder"),
        (OBJ.replace("m.mtl", "/etc/passwd"), "", "outside its folder"),
        (OBJ, "newmtl painted\nmap_Kd ../../away.png\n", "outside its folder"),
        (OBJ, "newmtl painted\nmap_Kd C:\\away.png\n", "outside its folder"),
        (OBJ, "newmtl painted\nmap_Kd /dev/zero\n", "outside its folder"),
        (OBJ, "newmtl painted\nmap_Kd\n", "line 2: map_Kd names no image"),
        (OBJ, "newmtl painted\nmap_Kd m.obj\n", "not an image"),
        (OBJ.replace("4/4", "4/9"), "", "texture coordinate 9 of 4"),
        (OBJ.replace("4/4", "4/0"), "", "line 11 cannot be read"),
        (OBJ.replace("vt 1 1", "vt one 1"), "", "line 8 cannot be read"),
    ],
)
def test_obj_that_lie(tmp_path, text, library, message):
    path = write_obj(tmp_path, text, library)
    with pytest.raises(FileFormatError, match=message):
        load_base(path)


@pytest.mark.parametrize(
    "name", ["C:\\Users\\me\\t.png", "/home/me/t.png", "../textures/t.png", "\\\\host\\share\\t.png"]
)
def test_names_on_another_machine_are_looked_for_beside_the_mesh(tmp_path, name):
    (tmp_path / "in").mkdir()
    base = load_base(write_obj(tmp_path / "in", library=f"newmtl painted\nmap_Kd {name}\n"))
    np.testing.assert_array_equal(base.face_texture, [0, 0])


@pytest.mark.parametrize("through", ["in", "link"])
def test_whole_paths_below_the_folder_are_inside_it(tmp_path, through):
    """As flattening writes them; also where a link leads to the folder."""
    (tmp_path / "in" / "textures").mkdir(parents=True)
    make_link(tmp_path / "link", tmp_path / "in")
    write_image(tmp_path / "in" / "textures" / "t.png")
    image = (tmp_path / through / "textures" / "t.png").as_posix()
    write_obj(tmp_path / "in", library=f"newmtl painted\nmap_Kd {image}\n")
    (tmp_path / "in" / "t.png").unlink()
    base = load_base(tmp_path / through / "m.obj")
    np.testing.assert_array_equal(base.face_texture, [0, 0])


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    (tmp_path / "in").mkdir()
    write_image(tmp_path / "t.png")
    path = write_obj(tmp_path / "in")
    (tmp_path / "in" / "t.png").unlink()
    make_link(tmp_path / "in" / "t.png", tmp_path / "t.png")
    with pytest.raises(FileFormatError, match="outside its folder"):
        load_base(path)
    (tmp_path / "in" / "m.mtl").write_text("newmtl painted\nmap_Kd ../t.png\n")
    with pytest.raises(FileFormatError, match="outside its folder"):
        load_base(path)


# ---- glTF


def gltf(tmp_path, **changes):
    """A square of two triangles with a texture, as .gltf with everything inside."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")
    index = np.array([0, 1, 2, 0, 2, 3], "<u2")
    png = io.BytesIO()
    Image.fromarray(PIXELS).save(png, "PNG")
    parts = [points.tobytes(), uv.tobytes(), index.tobytes() + b"\0" * 4, png.getvalue()]
    starts = np.cumsum([0, *(len(p) for p in parts)])
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(a), "byteLength": len(p)}
            for a, p in zip(starts[:-1], parts, strict=True)
        ],
        "buffers": [
            {
                "byteLength": int(starts[-1]),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(b"".join(parts)).decode(),
            }
        ],
    }
    document |= changes
    (tmp_path / "m.gltf").write_text(json.dumps(document))
    return tmp_path / "m.gltf"


def corner_colors(base):
    return np.rint(at_corners(base).reshape(-1, 4)[[0, 1, 2, 5], :3])


SQUARE = np.array([[0, 0, 1], [1, 1, 1], [0, 1, 0], [1, 0, 0]], float)  # from the lower left, anticlockwise


def test_gltf_with_a_texture(tmp_path):
    base = load_base(gltf(tmp_path))
    np.testing.assert_array_equal(base.vertices, load_mesh_quietly(tmp_path / "m.gltf").vertices)
    np.testing.assert_array_equal(corner_colors(base), SQUARE)


def load_mesh_quietly(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return load_mesh(path)


def test_gltf_transforms_and_wrapping(tmp_path):
    half = {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [1, 1]}}
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": half}}}
    base = load_base(gltf(tmp_path, materials=[material], samplers=[{"wrapS": 10497}]))
    np.testing.assert_array_equal(corner_colors(base), SQUARE[[1, 0, 3, 2]])
    base = load_base(gltf(tmp_path, materials=[material], samplers=[{"wrapS": 33071}]))
    np.testing.assert_array_equal(corner_colors(base), SQUARE[[1, 1, 2, 2]])
    turned = {"KHR_texture_transform": {"rotation": np.pi / 2, "offset": [0, 1]}}
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": turned}}}
    base = load_base(gltf(tmp_path, materials=[material]))
    # u' = v, v' = 1 - u: the lower left corner, (0, 1), takes what lies at (1, 1), the lower right.
    np.testing.assert_array_equal(corner_colors(base), SQUARE[[1, 2, 3, 0]])


@pytest.mark.parametrize(
    "material",
    [
        {
            "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
            "emissiveFactor": [1, 1, 1],
            "emissiveTexture": {"index": 0},
        },
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}}},
    ],
)
def test_gltf_textures_that_are_no_base_colour(tmp_path, material):
    np.testing.assert_array_equal(corner_colors(load_base(gltf(tmp_path, materials=[material]))), SQUARE)


def test_corners_of_mirror_images_keep_their_colours(tmp_path):
    base = load_base(gltf(tmp_path, nodes=[{"mesh": 0, "scale": [-1, 1, 1]}]))
    assert base.faces.tolist() == [[0, 2, 1], [0, 3, 2]]
    np.testing.assert_array_equal(np.rint(at_corners(base).reshape(-1, 4)[[0, 2, 1, 4], :3]), SQUARE)


def test_gltf_alpha_modes(tmp_path):
    pbr = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 0.4]}
    for mode, alpha in (("OPAQUE", 1), ("BLEND", 0.4), ("MASK", 0)):
        base = load_base(gltf(tmp_path, materials=[{"pbrMetallicRoughness": pbr, "alphaMode": mode}]))
        np.testing.assert_allclose(at_corners(base)[..., 3], alpha, atol=1e-6)


def textured_parts(tmp_path, materials):
    """The base mesh of a square in each of ``materials``."""
    parts = [
        {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": i}
        for i in range(len(materials))
    ]
    return load_base(gltf(tmp_path, meshes=[{"primitives": parts}], materials=materials))


def looks(mode, colors, cutoff=0.5):
    """A textured material of each of the base ``colors``."""
    pbrs = [{"baseColorTexture": {"index": 0}, "baseColorFactor": color} for color in colors]
    return [{"pbrMetallicRoughness": pbr, "alphaMode": mode, "alphaCutoff": cutoff} for pbr in pbrs]


def test_materials_share_the_pixels_of_an_image(tmp_path):
    """The image is opaque: OPAQUE and BLEND show it as it is; MASK removes all of it below a factor."""
    reds = [(0.1 * i, 1, 1, 0.4) for i in range(9)]
    base = textured_parts(tmp_path, looks("OPAQUE", reds) + looks("BLEND", reds) + looks("MASK", reds))
    pixels = [texture.pixels for texture in base.textures]
    assert len(pixels) == 27
    assert len({id(p) for p in pixels[:18]}) == len({id(p) for p in pixels[18:]}) == 1
    assert (pixels[0][..., 3] == 255).all()
    assert not pixels[18][..., 3].any()
    np.testing.assert_array_equal(pixels[0][..., :3], pixels[18][..., :3])


def test_cut_out_images_are_of_the_budget(tmp_path, monkeypatch):
    spent = []
    monkeypatch.setattr(
        "meshsplats.formats._validation.Budget.spend", lambda _, count, what: spent.append((count, what))
    )
    few = [(1, 1, 1, 0.1 * i) for i in range(1, 5)]  # each cuts the image on its own
    textured_parts(tmp_path, looks("MASK", few) + looks("OPAQUE", few) + looks("MASK", few))
    assert spent.count((16, "an image")) == 1
    assert spent.count((16, "a texture")) == 4


def test_gltf_without_a_texture_keeps_its_colours(tmp_path):
    material = {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}
    base = load_base(gltf(tmp_path, materials=[material]))
    assert not base.textured
    np.testing.assert_allclose(base.colors, np.tile([1, 0, 0, 1], (4, 1)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": [{"uri": "../t.png"}]}, "outside its folder"),
        ({"images": [{"uri": "t.png"}]}, "its file .t.png. is missing"),
        ({"images": [{"uri": "data:image/png;base64,AAAA"}]}, "not an image"),
        ({"images": [{}]}, "neither data nor URI"),
        ({"images": []}, "refers to index 0 of 0 images"),
        ({"textures": []}, "refers to index 0 of 0 textures"),
        ({"samplers": []}, "refers to index 0 of 0 samplers"),
        ({"samplers": [{"wrapT": 7}]}, "unknown wrapping"),
        ({"samplers": [{"wrapT": [1]}]}, "unknown wrapping"),
        ({"textures": [{"source": [0]}]}, r"refers to index \[0\] of 1 images"),
    ],
)
def test_gltf_textures_that_lie(tmp_path, changes, message):
    with pytest.raises(FileFormatError, match=message):
        load_base(gltf(tmp_path, **changes))


def test_gltf_textures_of_unknown_kinds_are_told(tmp_path):
    texture = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    with pytest.warns(DataWarning, match="1 textures are of a kind that is not read"):
        assert not load_base(gltf(tmp_path, textures=[texture])).textured


# ---- Others


def test_normal_maps_hold_bytes():
    given = {"vertices": np.eye(3), "faces": [[0, 1, 2]], "uv": np.zeros((1, 3, 2)), "face_texture": [-1]}
    with pytest.raises(ValueError, match="normal_map must fit uint8, got values from 300 to 300"):
        BaseMesh(**given, normal_map=np.full((2, 2, 3), 300))
    with pytest.raises(TypeError, match="normal_map must hold integers, got dtype float64"):
        BaseMesh(**given, normal_map=np.full((2, 2, 3), 0.5))


def test_other_formats(tmp_path):
    mesh = load_mesh_quietly(gltf(tmp_path))
    save_mesh(mesh, tmp_path / "m.ply")
    base = load_base(tmp_path / "m.ply")
    np.testing.assert_array_equal(base.colors, mesh.colors)
    plain = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    plain += (
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    (tmp_path / "plain.ply").write_text(plain)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_base(tmp_path / "plain.ply").colors is None


def test_spot_has_spots():
    folder = shared_data("meshes/spot_textured/spot")
    base = load_base(folder / "spot_triangulated.obj", texture=folder / "spot_texture.png")
    assert base.textured_faces().all()
    mesh = bind(base, triangles=4).mesh
    dark = (mesh.colors[:, :3].max(axis=1) < 0.35).mean()
    assert 0.02 < dark < 0.5
