"""Textures of USD files: our own come back, those of other programs by hand, and files that lie."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from _local import make_link
from PIL import Image

import meshsplats as ms
from meshsplats.errors import DataWarning, FileFormatError, NoColorsWarning, NoTextureWarning
from meshsplats.formats.base_meshes import load_textured
from meshsplats.formats.sniff import identify
from meshsplats.formats.usd import reader as usd_reader
from meshsplats.formats.usd.cameras import cameras_in_usd
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.viewpoints.showing import default_views

pytest.importorskip("pxr", reason="install meshsplats[usd]")

PIXELS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
RED, GREEN, BLUE, WHITE = [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]
READER = "/Mat/Reader.outputs:result"
QUAD = """def Mesh "Quad" (prepend apiSchemas = ["MaterialBindingAPI"])
{{
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    texCoord2f[] primvars:st = [{st}] (interpolation = "{kind}")
    rel material:binding = </Mat>
    {mesh}
}}
"""
MATERIAL = """def Material "Mat"
{{
    {interface}
    token outputs:surface.connect = </Mat/Surface.outputs:surface>
    def Shader "Surface"
    {{
        uniform token info:id = "UsdPreviewSurface"
        {surface}
        token outputs:surface
    }}
    def Shader "Texture"
    {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{file}@
        float2 inputs:st.connect = <{source}>
        {texture}
        float3 outputs:rgb
        float outputs:a
    }}
    def Shader "Reader"
    {{
        uniform token info:id = "UsdPrimvarReader_float2"
        {reader}
        float2 outputs:result
    }}
    {shaders}
}}
"""
CORNERS = "(0, 0), (1, 0), (1, 1), (0, 1)"
TEXTURED = "color3f inputs:diffuseColor.connect = </Mat/Texture.outputs:rgb>"
DEFAULTS = {
    **{"st": CORNERS, "kind": "faceVarying", "mesh": "", "interface": "", "surface": TEXTURED},
    **{"file": "t.png", "source": READER, "texture": "", "shaders": ""},
    "reader": 'string inputs:varname = "st"',
}


@pytest.fixture
def parts(monkeypatch):
    """Reads USD in this process, which is quick; the names of the parts that ran."""
    from meshsplats.formats.usd import camera_extraction, extraction, opening, texture_extraction

    found = {
        "extraction": extraction.extract_meshes,
        "texture_extraction": texture_extraction.extract_textures,
        "camera_extraction": camera_extraction.extract_cameras,
    }
    ran = []

    def extract(module, file, path, result, origin):
        ran.append(module.rpartition(".")[2])
        try:
            report = opening.checked(found[ran[-1]], file, result, origin)
        except FileFormatError as error:
            raise FileFormatError(f"{path}: {error}") from None
        return json.loads(json.dumps(report))

    monkeypatch.setattr(usd_reader, "_extract", extract)
    return ran


def write(folder, body=QUAD + MATERIAL, pixels=PIXELS, **changes):
    """A square with a texture, put together by hand."""
    Image.fromarray(pixels).save(folder / "t.png")
    (folder / "m.usda").write_text("#usda 1.0\n" + body.format(**DEFAULTS | changes))
    return folder / "m.usda"


def load_mesh_quietly(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return ms.load_mesh(path)


def png(pixels=PIXELS):
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    return data.getvalue()


def package(folder, entries=None, **changes):
    path = folder / "m.usdz"
    entries = entries or {"m.usda": write(folder, **changes).read_bytes(), "t.png": png()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return path


def at_corners(base, inwards=0.1):
    """(m, 3, 4) texture colours a tenth of the way from each corner to the face's middle."""
    weights = np.tile(np.eye(3) * (1 - inwards) + inwards / 3, (len(base.faces), 1, 1))
    face = np.repeat(np.arange(len(base.faces)), 3)
    return base.texture_at(face, weights.reshape(-1, 3)).reshape(-1, 3, 4)


def corner_colors(base):
    """(4, 3) near the corners of the square: from the lower left anticlockwise."""
    return np.rint(at_corners(base).reshape(-1, 4)[[0, 1, 2, 5], :3])


def surface(normal_map=False):
    """Two triangles, each with a chart of its own."""
    uv = np.array([[[1, 2], [3, 2], [1, 6]], [[5, 3], [7, 3], [7, 7]]], np.float32) / 8
    pixels = np.random.default_rng(0).integers(0, 256, (6, 10, 4), np.uint8)
    pixels[..., 3] = 255
    relief = np.full((4, 4, 3), 128, np.uint8) if normal_map else None
    return BaseMesh(
        *(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.3], [0, 1, 0]], np.float32), [[0, 1, 2], [0, 2, 3]]),
        **{"uv": uv, "face_texture": [0, 0], "textures": (Texture(pixels, ("clamp", "clamp")),)},
        **{"up": (0, -1, 0), "origin": np.array([5e5, 0, 100]), "normal_map": relief},
    )


def assert_same_surface(again, base):
    np.testing.assert_allclose(again.vertices[again.faces], base.vertices[base.faces], atol=1e-6)
    np.testing.assert_array_equal(again.origin, base.origin)
    np.testing.assert_array_equal(again.face_texture, base.face_texture)
    shown = base.textured_faces()
    np.testing.assert_allclose(again.uv[shown], base.uv[shown], atol=1e-6)
    assert len(again.textures) == len(base.textures)
    for found, own in zip(again.textures, base.textures, strict=True):
        np.testing.assert_array_equal(found.pixels, own.pixels)
        assert found.wrap == own.wrap
        np.testing.assert_allclose(found.factor, own.factor)


# ---- Our own files


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("suffix", [".usdz", ".usdc", ".usda"])
@pytest.mark.parametrize("unlit", [False, True])
def test_a_surface_of_ours_comes_back(tmp_path, suffix, unlit):
    base = surface(normal_map=True)
    ms.save_base(base, tmp_path / f"a{suffix}", unlit=unlit)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = ms.load_base(tmp_path / f"a{suffix}")
    assert_same_surface(again, base)
    assert again.colors is None


@pytest.mark.parametrize("lit", [False, True])
def test_a_scene_of_ours_has_its_textures_again(tmp_path, parts, lit):
    """Several of them, translucent and cut out, on some of the faces; vertex colours on the others."""
    base = surface()
    pixels = base.textures[0].pixels
    cut, blended = pixels.copy(), np.random.default_rng(1).integers(0, 256, (6, 10, 4), np.uint8)
    cut[:3, :, 3] = 0
    faces = np.concatenate([base.faces] * 2)
    base = replace(
        base,
        **{"faces": faces, "uv": np.concatenate([base.uv] * 2), "face_texture": [1, -1, 2, 0]},
        **{"up": (0, 1, 0), "origin": np.zeros(3)},
        textures=(
            Texture(pixels, ("repeat", "mirror"), (0.5, 1, 0.25, 1)),
            Texture(cut, ("clamp", "repeat")),
            Texture(blended, ("mirror", "clamp"), (1, 1, 1, 0.5)),
        ),
        colors=np.tile([0.25, 0.5, 0.75, 1], (4, 1)),
    )
    ms.save_scene(tmp_path / "a.usdz", surface=base, lit=lit)
    again = ms.load_base(tmp_path / "a.usdz")
    assert_same_surface(again, base)
    np.testing.assert_allclose(again.colors, base.colors, atol=1e-6)
    assert parts == ["extraction", "texture_extraction"]


def test_pictures_of_usd_and_gltf_are_the_same(tmp_path, parts):
    pictures = []
    for suffix in (".glb", ".usdc"):
        ms.save_base(surface(), tmp_path / f"a{suffix}")
        with pytest.warns(NoTextureWarning, match="its texture counts as the colours"):
            mesh = ms.load_vertex_colored(tmp_path / f"a{suffix}")
        camera = ms.orbit(mesh, 1, width=64, height=64)[0]
        pictures.append(ms.render(mesh, camera).color)
    assert np.ptp(pictures[0]) > 0.5
    np.testing.assert_allclose(pictures[1], pictures[0], atol=1e-5)


def test_only_textures_start_a_second_process(tmp_path, parts):
    ms.save_base(replace(surface(), uv=None, face_texture=None, textures=()), tmp_path / "a.usdc")
    assert not ms.load_base(tmp_path / "a.usdc").textured
    assert parts == ["extraction"]
    assert not load_textured(write(tmp_path, surface="color3f inputs:diffuseColor = (1, 0, 0)")).attributes
    assert parts == ["extraction"] * 2


# ---- Other programs


def test_a_quad_shows_its_texture(tmp_path, parts):
    """USD's v goes up: the first row of the image is at the top of the square."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        base = ms.load_base(write(tmp_path))
    np.testing.assert_array_equal(corner_colors(base), [BLUE, WHITE, GREEN, RED])
    np.testing.assert_array_equal(base.uv[0], [[0, 1], [1, 1], [1, 0]])
    assert base.textures[0].wrap == ("repeat", "repeat")
    assert (base.textures[0].pixels[..., 3] == 255).all()
    with pytest.warns(DataWarning) as caught:
        ms.load_mesh(tmp_path / "m.usda")
    assert [each.category for each in caught] == [NoTextureWarning, NoColorsWarning]


def test_a_texture_beside_vertex_colours_is_seen(tmp_path, parts):
    """Without the hint that colours are missing."""
    base = load_textured(write(tmp_path, mesh="color3f[] primvars:displayColor = [(1, 0, 0)]"))
    assert base.textured
    np.testing.assert_array_equal(base.colors, [[1, 0, 0, 1]] * 4)


@pytest.mark.parametrize(
    ("modes", "wrap", "expected"),
    [
        (("mirror", "clamp"), ("mirror", "clamp"), [WHITE, BLUE, RED, GREEN]),
        (("black", "useMetadata"), ("clamp", "repeat"), [WHITE, WHITE, GREEN, GREEN]),
        (("repeat", "mirror"), ("repeat", "mirror"), [BLUE, WHITE, GREEN, RED]),
    ],
)
def test_beyond_the_edge(tmp_path, parts, modes, wrap, expected):
    """The square shows what lies to the right of the image."""
    texture = "\n".join(f'token inputs:wrap{axis} = "{mode}"' for axis, mode in zip("ST", modes, strict=True))
    base = ms.load_base(write(tmp_path, st="(1, 0), (2, 0), (2, 1), (1, 1)", texture=texture))
    assert base.textures[0].wrap == wrap
    np.testing.assert_array_equal(corner_colors(base), expected)


def transform(name, source, *values):
    lines = "\n".join([f"float2 inputs:in.connect = <{source}>", *values, "float2 outputs:result"])
    return f'def Shader "{name}" {{\nuniform token info:id = "UsdTransform2d"\n{lines}\n}}\n'


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (["float2 inputs:translation = (0.5, 0)"], [[0.5, 0], [2.5, 0], [2.5, 3], [0.5, 3]]),
        # Scale first, then a quarter anticlockwise: (u, v) -> (-3 v, 2 u); then the way.
        (
            ["float inputs:rotation = 90", "float2 inputs:translation = (1, 5)"],
            [[1, 5], [1, 7], [-2, 7], [-2, 5]],
        ),
    ],
)
def test_transforms_of_coordinates(tmp_path, parts, values, expected):
    shaders = transform("Place", READER, "float2 inputs:scale = (2, 3)", *values)
    base = ms.load_base(write(tmp_path, source="/Mat/Place.outputs:result", shaders=shaders))
    found = base.uv.reshape(-1, 2)[[0, 1, 2, 5]]
    np.testing.assert_allclose(found * [1, -1] + [0, 1], expected, atol=1e-6)


def test_transforms_one_behind_the_other(tmp_path, parts):
    """The one that is nearer to the primvar is the first; a circle of them has an end."""
    first = transform("First", READER, "float2 inputs:translation = (1, 0)")
    second = transform("Second", "/Mat/First.outputs:result", "float2 inputs:scale = (2, 2)")
    source = "/Mat/Second.outputs:result"
    base = ms.load_base(write(tmp_path, source=source, shaders=first + second))
    np.testing.assert_allclose(base.uv[0] * [1, -1] + [0, 1], [[2, 0], [4, 0], [4, 2]])
    circle = transform("First", source) + second
    assert ms.load_base(write(tmp_path, source=source, shaders=circle)).textured


@pytest.mark.parametrize(
    ("kind", "st", "mesh"),
    [
        ("vertex", CORNERS, ""),
        ("varying", CORNERS, ""),
        ("faceVarying", "(1, 1), (0, 1), (0, 0), (1, 0)", "int[] primvars:st:indices = [3, 0, 1, 2]"),
    ],
)
def test_coordinates_of_every_interpolation(tmp_path, parts, kind, st, mesh):
    body = QUAD.replace("[0, 1, 2, 3]", "[1, 2, 3, 0]") + MATERIAL
    base = ms.load_base(write(tmp_path, body, kind=kind, st=st, mesh=mesh))
    np.testing.assert_array_equal(base.uv, [[[1, 1], [1, 0], [0, 0]], [[1, 1], [0, 0], [0, 1]]])


def test_one_coordinate_for_all_corners(tmp_path, parts):
    base = ms.load_base(write(tmp_path, kind="constant", st="(0.25, 0.75)"))
    np.testing.assert_array_equal(base.uv, np.full((2, 3, 2), 0.25))


def test_left_handed_meshes_keep_their_colours(tmp_path, parts):
    """Corners are listed the other way round, coordinates with them."""
    right = ms.load_base(write(tmp_path))
    left = ms.load_base(write(tmp_path, mesh='uniform token orientation = "leftHanded"'))
    np.testing.assert_array_equal(left.faces, right.faces[:, ::-1])
    np.testing.assert_array_equal(left.uv, right.uv[:, ::-1])


SUBSETS = """def GeomSubset "A" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [%s]
        rel material:binding = </Other>
    }
"""
STRIP = {
    "st": f"{CORNERS}, {CORNERS}, (0, 0), (1, 0), (1, 1)",
    "counts": "[4, 4, 3]",
    "corners": "[0, 1, 2, 3, 3, 2, 1, 0, 0, 1, 2]",
}


OTHER = {"surface": TEXTURED.replace("Mat", "Other"), "source": READER.replace("Mat", "Other")}
PLAIN = {"surface": "color3f inputs:diffuseColor = (0, 1, 0)"}


def strip(folder, other, subset="1", **changes):
    """Two squares and a triangle; faces of a subset have another material."""
    body = QUAD.replace("[4]", "{counts}").replace("[0, 1, 2, 3]", "{corners}")
    material = MATERIAL.replace('"Mat"', '"Other"').replace("/Mat", "/Other").format(**DEFAULTS | other)
    body += MATERIAL + material.replace("{", "{{").replace("}", "}}")
    return write(folder, body, mesh=SUBSETS % subset, **STRIP | changes)


def test_subsets_have_materials_of_their_own(tmp_path, parts):
    """By the numbers of polygons, of which quads are two triangles; coordinates are those of the primvar that
    each material names."""
    Image.fromarray(PIXELS[::-1]).save(tmp_path / "o.png")
    uv = 'float2[] primvars:uv = [(0.25, 0.25)] (interpolation = "constant")\n'
    path = strip(tmp_path, {**OTHER, "file": "o.png", "reader": 'string inputs:varname = "uv"'})
    path.write_text(path.read_text().replace("int[] faceVertexCounts", f"{uv} int[] faceVertexCounts"))
    base = ms.load_base(path)
    np.testing.assert_array_equal(base.face_texture, [0, 0, 1, 1, 0])
    np.testing.assert_array_equal(base.uv[2:4], np.tile([0.25, 0.75], (2, 3, 1)))
    np.testing.assert_array_equal(base.uv[[0, 4]], [[[0, 1], [1, 1], [1, 0]]] * 2)
    np.testing.assert_array_equal(base.textures[1].pixels[..., :3], PIXELS[::-1])


def test_materials_share_images(tmp_path, parts):
    """And textures, if they use them alike."""
    np.testing.assert_array_equal(ms.load_base(strip(tmp_path, OTHER)).face_texture, [0] * 5)
    base = ms.load_base(strip(tmp_path, {**OTHER, "texture": 'token inputs:wrapS = "mirror"'}))
    np.testing.assert_array_equal(base.face_texture, [0, 0, 1, 1, 0])
    half = np.full((1, 1, 4), 127, np.uint8)
    base = ms.load_base(strip(tmp_path, OTHER, pixels=half, surface=f"{TEXTURED}\n{ALPHA}"))
    assert [int(texture.pixels[0, 0, 3]) for texture in base.textures] == [127, 255]


def test_a_subset_of_faces_that_are_not_there_is_refused(tmp_path, parts):
    for faces, message in (("1, 3", "faces 1 to 3 of 3"), ("-1", "faces -1 to -1 of 3")):
        with pytest.raises(FileFormatError, match=f"/Quad/A: {message}"):
            ms.load_base(strip(tmp_path, {}, subset=faces))


def test_interfaces_of_materials_are_followed(tmp_path, parts):
    interface = """asset inputs:image = @t.png@
        token inputs:frame:name = "st"
        float4 inputs:tint = (1, 0.5, 1, 1)"""
    texture = """float4 inputs:scale.connect = </Mat.inputs:tint>
        asset inputs:file.connect = </Mat.inputs:image>"""
    reader = "string inputs:varname.connect = </Mat.inputs:frame:name>"
    graph = """def NodeGraph "Graph" {
        float3 outputs:color.connect = </Mat/Texture.outputs:rgb>
    }"""
    path = write(
        tmp_path,
        **{"interface": interface, "texture": texture, "reader": reader, "shaders": graph},
        surface="color3f inputs:diffuseColor.connect = </Mat/Graph.outputs:color>",
    )
    path.write_text(path.read_text().replace("asset inputs:file = @t.png@\n", ""))
    base = ms.load_base(path)
    assert base.textures[0].factor == (1, 0.5, 1, 1)
    assert base.textured_faces().all()


ALPHA = "float inputs:opacity.connect = </Mat/Texture.outputs:a>"
CUT = f"{ALPHA}\nfloat inputs:opacityThreshold = 0.3"
FACTOR = "float4 inputs:scale = (1, 1, 1, 0.5)"


@pytest.mark.parametrize(
    ("opacity", "texture", "alphas"),
    [
        ("", FACTOR, [255, 255, 255, 255]),
        ("float inputs:opacity = 0.2", "", [51, 51, 51, 51]),
        ("float inputs:opacity = 0.2\nfloat inputs:opacityThreshold = 0.1", "", [255, 255, 255, 255]),
        (ALPHA, "", [0, 102, 160, 255]),
        (ALPHA, FACTOR, [0, 51, 80, 127.5]),
        (CUT, "", [0, 255, 255, 255]),
        (CUT, FACTOR, [0, 0, 255, 255]),
    ],
)
def test_opacity(tmp_path, parts, opacity, texture, alphas):
    pixels = np.dstack([PIXELS, np.array([[0, 102], [160, 255]], np.uint8)])
    base = ms.load_base(write(tmp_path, pixels=pixels, surface=f"{TEXTURED}\n{opacity}", texture=texture))
    middles = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    np.testing.assert_allclose(base.textures[0].at(middles)[:, 3] * 255, alphas, atol=1e-3)


def test_linear_pixels_become_display_values(tmp_path, parts):
    grey = np.full((1, 1, 3), 55, np.uint8)
    base = ms.load_base(write(tmp_path, pixels=grey, texture='token inputs:sourceColorSpace = "raw"'))
    assert base.textures[0].pixels[0, 0].tolist() == [128, 128, 128, 255]


def test_a_bias_is_named(tmp_path, parts):
    texture = "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)"
    with pytest.warns(DataWarning, match="/Mat/Texture: its scale and bias are not read"):
        base = ms.load_base(write(tmp_path, texture=texture))
    assert base.textures[0].factor == (1, 1, 1, 1)


def test_an_image_given_by_hand(tmp_path, parts):
    """Also where no material has one."""
    path = write(tmp_path, surface="color3f inputs:diffuseColor = (1, 0, 0)")
    Image.fromarray(PIXELS[::-1]).save(tmp_path / "o.png")
    base = ms.load_base(path, texture=tmp_path / "o.png")
    np.testing.assert_array_equal(corner_colors(base), [RED, GREEN, WHITE, BLUE])
    path.write_text(path.read_text().replace("primvars:st", "primvars:uv"))
    with pytest.raises(ValueError, match="no texture coordinates"):
        ms.load_base(path, texture=tmp_path / "o.png")


def test_faces_without_coordinates_are_bare(tmp_path, parts):
    assert not ms.load_base(write(tmp_path, reader='string inputs:varname = "other"')).textured
    base = ms.load_base(write(tmp_path, st=CORNERS.replace("(0, 1)", "(inf, 1)")))
    np.testing.assert_array_equal(base.textured_faces(), [True, False])


# ---- Plain colours


def test_plain_colours_of_materials(tmp_path, parts):
    plain = "color3f inputs:diffuseColor = (0.5, 0, 1)"
    half = float(linear_to_srgb(np.float32([0.5]))[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = ms.load_mesh(write(tmp_path, surface=f"{plain}\nfloat inputs:opacity = 0.25"))
    np.testing.assert_allclose(mesh.colors, [[half, 0, 1, 0.25]] * 4, atol=1e-6)
    painted = "color3f[] primvars:displayColor = [(0, 1, 0)]\nfloat[] primvars:displayOpacity = [0.5]"
    mesh = ms.load_mesh(write(tmp_path, surface=plain, mesh=painted))  # as renderers have it
    np.testing.assert_allclose(mesh.colors, [[half, 0, 1, 1]] * 4, atol=1e-6)
    mesh = ms.load_mesh(strip(tmp_path, PLAIN, surface=plain))
    np.testing.assert_allclose(mesh.colors[mesh.faces].mean(axis=1)[:, 1], [0, 0, 1, 1, 0])
    mesh = ms.load_mesh(strip(tmp_path, PLAIN, surface=plain))
    np.testing.assert_allclose(mesh.colors[mesh.faces].mean(axis=1)[:, 1], [0, 0, 1, 1, 0])
    with pytest.warns(NoColorsWarning):
        ms.load_mesh(write(tmp_path, surface=""))


def test_a_material_may_read_the_colours_of_the_mesh(tmp_path, parts):
    """And its opacity; in black, too, of which it emits them."""
    painted = "color3f[] primvars:displayColor = [(0, 1, 0)]\nfloat[] primvars:displayOpacity = [0.5]"
    link = "Color.connect = </Mat/Primvar.outputs:result>"
    kind = 'uniform token info:id = "UsdPrimvarReader_float3"'
    shader = f'def Shader "Primvar" {{ {kind}\nfloat3 outputs:result\n}}'
    diffuse = f"color3f inputs:diffuse{link}"
    for surface in (diffuse, f"color3f inputs:emissive{link}\ncolor3f inputs:diffuseColor = (0, 0, 0)"):
        mesh = ms.load_mesh(write(tmp_path, surface=surface, mesh=painted, shaders=shader))
        np.testing.assert_array_equal(mesh.colors, [[0, 1, 0, 0.5]] * 4)
    surface = f"color3f inputs:diffuseColor = (1, 0, 0)\nfloat inputs:opacity.connect = {link.split()[-1]}"
    mesh = ms.load_mesh(write(tmp_path, surface=surface, mesh=painted, shaders=shader))
    np.testing.assert_array_equal(mesh.colors, [[1, 0, 0, 0.5]] * 4)


def test_colours_of_faces_without_a_material(tmp_path, parts):
    """They are those of the mesh, if it has any."""
    path = strip(tmp_path, PLAIN, surface="")
    green = load_mesh_quietly(path).colors[:, :3]
    painted = path.read_text().replace(
        "point3f[] points", "color3f[] primvars:displayColor = [(1, 0, 1)]\npoint3f[] points"
    )
    path.write_text(painted)
    mesh = ms.load_mesh(path)
    np.testing.assert_array_equal(mesh.colors[mesh.faces[2:4], :3].reshape(-1, 3), [[0, 1, 0]] * 6)
    np.testing.assert_array_equal(mesh.colors[mesh.faces[[0, 1, 4]], :3].reshape(-1, 3), [[1, 0, 1]] * 9)
    assert len(mesh.colors) == len(green)


def test_plain_colours_beside_a_texture(tmp_path, parts):
    """Vertices become one for each corner; coordinates are still those of the same triangles."""
    base = ms.load_base(strip(tmp_path, PLAIN))
    assert len(base.vertices) == 11
    np.testing.assert_array_equal(base.face_texture, [0, 0, -1, -1, 0])
    weights = np.full((2, 3), 1 / 3)
    np.testing.assert_allclose(base.colors_at(np.array([2, 3]), weights), [[0, 1, 0, 1]] * 2)
    np.testing.assert_array_equal(base.uv[4], [[0, 1], [1, 1], [1, 0]])


# ---- Packages


def test_packages_hold_their_images(tmp_path, parts):
    text = write(tmp_path, file="./0/t.png").read_bytes()
    (tmp_path / "t.png").unlink()
    for entries in ({"m.usda": text, "0/t.png": png()}, {"in/m.usda": text, "in/0/t.png": png()}):
        base = ms.load_base(package(tmp_path, entries))
        np.testing.assert_array_equal(corner_colors(base), [BLUE, WHITE, GREEN, RED])
    assert identify(tmp_path / "m.usdz") == "mesh"


def test_packages_take_nothing_from_beside_them(tmp_path, parts):
    path = package(tmp_path, {"m.usda": write(tmp_path).read_bytes()})
    with pytest.warns(DataWarning, match=r"m\.usdz: missing: t\.png"):
        assert not ms.load_base(path).textured


def test_packages_have_cameras(tmp_path, parts):
    view = ms.look_at((0, 0, -4), (0.5, 0.5, 0), up=(0, -1, 0), width=90, height=60, name="front")
    for suffix in (".usdc", ".usdz"):
        ms.save_base(replace(surface(), origin=np.zeros(3)), tmp_path / f"a{suffix}", cameras=[view])
        (found,) = cameras_in_usd(tmp_path / f"a{suffix}")
        assert default_views(load_mesh_quietly(tmp_path / f"a{suffix}"), tmp_path / f"a{suffix}", 1)
        assert found.name == "front"
        np.testing.assert_allclose(found.center, view.center, atol=1e-5)


# ---- Files that lie


@pytest.mark.parametrize("name", ["../t.png", "/etc/t.png", "in/../../t.png", "C:/t.png", "//host/t.png"])
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, parts, name):
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in", file=name)
    (tmp_path / "in" / "t.png").rename(tmp_path / "t.png")
    with pytest.raises(FileFormatError, match=r"m\.usda: refers to '.*t\.png' outside its folder; refused"):
        ms.load_base(path)
    if name != "C:/t.png":  # the name of an entry, as any other
        with pytest.raises(FileFormatError, match=r"m\.usdz: refers to '.*t\.png' outside the package"):
            ms.load_base(package(tmp_path, file=name))


def test_a_link_out_of_the_folder_is_refused(tmp_path, parts):
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in", file="o.png")
    Image.fromarray(PIXELS).save(tmp_path / "o.png")
    make_link(tmp_path / "in" / "o.png", tmp_path / "o.png")
    with pytest.raises(FileFormatError, match="outside its folder"):
        ms.load_base(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("away.png", r"missing: away\.png; faces that need it have no texture"),
        ("t.exr", "1 textures are of a kind that is not read; their faces have none"),
        ("", "1 textures are of a kind that is not read"),
        ("http://host/t.png", r"missing: http://host/t\.png"),
    ],
)
def test_images_that_are_not_there_are_named(tmp_path, parts, name, message):
    path = write(tmp_path, file=name)
    if not name:
        path.write_text(path.read_text().replace("asset inputs:file = @@\n", ""))
    with pytest.warns(DataWarning, match=message):
        assert not ms.load_base(path).textured


def test_broken_images_are_errors(tmp_path, parts):
    path = write(tmp_path)
    whole = png(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8))
    for data, message in ((whole[: len(whole) // 2], "a broken image"), (b"nothing", "not an image")):
        (tmp_path / "t.png").write_bytes(data)
        with pytest.raises(FileFormatError, match=rf"t\.png: {message}"):
            ms.load_base(path)
        packed = package(tmp_path, {"m.usda": path.read_bytes(), "t.png": data})
        with pytest.raises(FileFormatError, match=rf"m\.usdz: {message}"):
            ms.load_base(packed)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"texture": "float4 inputs:scale = (1, inf, 1, 1)"}, "/Mat/Texture: scale must be 4 finite"),
        ({"texture": "float2 inputs:scale = (1, 1)"}, "/Mat/Texture: scale must be 4 finite"),
        (
            {"surface": f'{TEXTURED}\nstring inputs:opacityThreshold = "x"'},
            "Threshold must be 1 finite",
        ),
        ({"st": "(0, 0), (1, 0)"}, r"st \(faceVarying\) has 2 values, expected 4"),
    ],
)
def test_materials_that_lie(tmp_path, parts, changes, message):
    with pytest.raises(FileFormatError, match=message):
        ms.load_base(write(tmp_path, **changes))


@pytest.mark.parametrize("name", ["m.usda", "t.png"])
def test_bombs_in_packages_are_refused(tmp_path, parts, monkeypatch, name):
    monkeypatch.setattr("meshsplats.formats._validation._BASE_BYTES", 1 << 16)
    entries = {"m.usda": write(tmp_path).read_bytes(), "t.png": png()}
    with zipfile.ZipFile(tmp_path / "m.usdz", "w", zipfile.ZIP_DEFLATED) as archive:
        for each, data in entries.items():
            archive.writestr(each, data + bytes(1 << 22) if each == name else data)
    with pytest.raises(FileFormatError, match=rf"m\.usdz: '{name}' in it .*decompression bomb"):
        ms.load_base(tmp_path / "m.usdz")


def test_large_images_are_refused(tmp_path, parts, monkeypatch):
    """Small files; and copies of an image, one for each way in which materials use it."""
    path = write(tmp_path, pixels=np.zeros((512, 512, 3), np.uint8))
    for megabytes, what in ((0, "an image"), (1, "a texture")):
        monkeypatch.setattr("meshsplats.formats._validation._BASE_BYTES", megabytes << 20)
        with pytest.raises(FileFormatError, match=rf"m\.usda: {what} would take .*decompression bomb"):
            ms.load_base(path)
    monkeypatch.setattr("meshsplats.formats._validation._BASE_BYTES", 2 << 20)
    assert ms.load_base(path).textured


@pytest.mark.parametrize("name", ["m.usda", "t.png"])
def test_encrypted_packages_are_refused(tmp_path, parts, name):
    data = bytearray(package(tmp_path).read_bytes())
    for signature, flags, at in ((b"PK\3\4", 6, 30), (b"PK\1\2", 8, 46)):
        start = data.index(signature)
        while data[start + at : start + at + len(name)] != name.encode():
            start = data.index(signature, start + 1)
        data[start + flags] |= 1
    (tmp_path / "m.usdz").write_bytes(data)
    with pytest.raises(FileFormatError, match=rf"m\.usdz: '{name}' cannot be unpacked: .*encrypted"):
        ms.load_base(tmp_path / "m.usdz")


def test_packages_that_begin_with_something_else(tmp_path, parts):
    text = write(tmp_path).read_bytes()
    path = package(tmp_path, {"t.png": png(), "m.usda": text})
    with pytest.raises(FileFormatError, match=r"m\.usdz: a \.usdz package begins .* one with 't\.png'"):
        ms.load_base(path)
    path.write_bytes(package(tmp_path).read_bytes()[:-40])
    with pytest.raises(FileFormatError, match=r"m\.usdz: a broken zip archive"):
        ms.load_base(path)
    path = package(tmp_path, {"m.usda": b"nothing"})
    with pytest.raises(FileFormatError, match=r"m\.usdz: not readable as USD"):
        ms.load_base(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("m.usda", text)
    with pytest.raises(FileFormatError, match=r"m\.usdz: 'm\.usda' cannot be unpacked: .*not by deflate"):
        ms.load_base(path)


def test_an_archive_of_splats_is_not_a_package(tmp_path):
    """Though a mesh lies in it, too, and first."""
    cloud = ms.GaussianCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
    ms.save_gaussians(cloud, tmp_path / "x.ply")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(write(tmp_path), "m.usda")
        archive.write(tmp_path / "x.ply", "x.ply")
    assert identify(tmp_path / "a.zip") == "splats"
    assert len(ms.load_gaussians(tmp_path / "a.zip")) == 1
    assert identify((tmp_path / "a.zip").rename(tmp_path / "a.usdz")) == "mesh"
