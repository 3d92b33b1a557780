"""USD stages that move: skeletons, blend shapes, time samples; and their units."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

import meshsplats as ms
from meshsplats.errors import AnimationWarning, DataWarning, FileFormatError
from meshsplats.formats.usd import reader as usd_reader
from meshsplats.formats.usd.cameras import cameras_in_usd
from meshsplats.prior.planning import save_poses

pytest.importorskip("pxr", reason="install meshsplats[usd]")

SQUARE = "(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)"
FACES = "int[] faceVertexCounts = [4]\n int[] faceVertexIndices = [0, 1, 2, 3]\n"
MESH = 'def Mesh "M" {{\n ' + FACES + " {points}\n {more}\n}}\n"
RIGGED = """def SkelRoot "Rig" {{
    def Skeleton "S" (prepend apiSchemas = ["SkelBindingAPI"]) {{
        uniform token[] joints = ["a"]
        uniform matrix4d[] bindTransforms = [{identity}]
        uniform matrix4d[] restTransforms = [{rest}]
        {source}
        def SkelAnimation "A" {{ {motion}
        }}
    }}
    def Mesh "M" (prepend apiSchemas = ["SkelBindingAPI"]) {{
        {faces}
        point3f[] points = [{points}]
        rel skel:skeleton = </Rig/S>
        int[] primvars:skel:jointIndices = [0, 0, 0, 0] (elementSize = 1
            interpolation = "vertex")
        float[] primvars:skel:jointWeights = [0, 1, 1, 1] (elementSize = 1
            interpolation = "vertex")
        {shapes}
    }}
}}
"""
IDENTITY = "((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))"
UP = IDENTITY.replace("(0, 0, 0, 1)", "(0, 0, 5, 1)")
SOURCE = "rel skel:animationSource = </Rig/S/A>"
LIFTED = """uniform token[] joints = ["a"]
 float3[] translations.timeSamples = {1: [(0, 0, 0)], 3: [(0, 0, 2)]}
 quatf[] rotations = [(1, 0, 0, 0)]
 half3[] scales = [(1, 1, 1)]"""
SHAPES = """uniform token[] skel:blendShapes = ["up"]
 rel skel:blendShapeTargets = </Rig/M/up>
 def BlendShape "up" { uniform vector3f[] offsets = [(0, 0, 0), (0, 0, 0), (0, 0, 4), (0, 0, 0)]
 uniform int[] pointIndices = [0, 1, 2, 3]
 }"""


@pytest.fixture(autouse=True)
def here(monkeypatch):
    """Reads USD in this process, which is quick."""
    from functools import partial

    from meshsplats.formats.usd import camera_extraction, extraction, opening, splat_extraction

    found = {
        "extraction": extraction.extract_meshes,
        "frame_extraction": partial(extraction.extract_meshes, frames=True),
        "camera_extraction": camera_extraction.extract_cameras,
        "splat_extraction": splat_extraction.extract_splats,
    }

    def extract(module, file, path, result, origin):
        try:
            report = opening.checked(found[module.rpartition(".")[2]], file, result, origin)
        except FileFormatError as error:
            raise FileFormatError(f"{path}: {error}") from None
        return json.loads(json.dumps(report))

    monkeypatch.setattr(usd_reader, "_extract", extract)


def write(path, body, head=""):
    path.write_text(f'#usda 1.0\n(\n upAxis = "Z"\n{head})\n{body}')
    return path


def rig(path, **changes):
    parts = {"rest": IDENTITY, "source": "", "motion": "", "shapes": "", "points": SQUARE, "faces": FACES}
    return write(path, RIGGED.format(identity=IDENTITY, **parts | changes))


def read(path):
    """Vertices of the mesh, and messages but for that of missing colours."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = ms.load_base(path)
    return mesh.vertices + mesh.origin, [str(each.message).removeprefix(f"{path}: ") for each in caught]


# ---- Skeletons and blend shapes


def test_a_posed_skeleton_moves_its_mesh(tmp_path):
    """As Blender exports a pose: where its bones rest. Points without weights stay."""
    points, said = read(rig(tmp_path / "m.usda", rest=UP))
    np.testing.assert_allclose(points, [[0, 0, 0], [1, 0, 5], [1, 1, 5], [0, 1, 5]])
    assert said == []


def test_a_rigged_instance_is_posed(tmp_path):
    body = RIGGED.replace('def SkelRoot "Rig"', 'def SkelRoot "Rig" (instanceable = true)').format(
        identity=IDENTITY, rest=UP, source="", motion="", shapes="", points=SQUARE, faces=FACES
    )
    body = (
        'def "Proto" {\n' + body.replace("</Rig", "</Proto/Rig").replace(" (instanceable = true)", "") + "}\n"
    )
    body += 'def Xform "I" (instanceable = true\n references = </Proto>) {}\n'
    points, _ = read(write(tmp_path / "m.usda", body))
    np.testing.assert_allclose(points[:, 2], [0, 5, 5, 5] * 2)


def test_blend_shapes_count(tmp_path):
    weights = 'uniform token[] blendShapes = ["up"]\n float[] blendShapeWeights = [0.5]'
    path = tmp_path / "m.usda"
    points, said = read(rig(path, source=SOURCE, motion=weights, shapes=SHAPES))
    np.testing.assert_allclose(points[:, 2], [0, 0, 2, 0])
    assert said == []
    nothing = 'uniform token[] blendShapes = ["up"]\n float[] blendShapeWeights'
    points, (message,) = read(rig(path, source=SOURCE, motion=nothing, shapes=SHAPES))
    assert not points[:, 2].any()
    assert "1 meshes have blend shapes (shape keys) without values" in message


# ---- Time


def test_an_animation_is_read_at_its_first_time(tmp_path):
    points, (message,) = read(rig(tmp_path / "m.usda", source=SOURCE, motion=LIFTED))
    assert not points[:, 2].any()
    assert message == "holds an animation (2 time samples, 1 to 3), of which the first was read"
    still = MESH.format(points=f"point3f[] points.timeSamples = {{7: [{SQUARE}]}}", more="")
    assert read(write(tmp_path / "m.usda", still))[1] == []


def prior_of(path, folder):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AnimationWarning)
        prior = ms.bind(ms.load_base(path), triangles=1, layers=1, spacing=0.0)
    ms.save_mesh(prior.mesh, folder / "prior.npz")
    return folder / "prior.npz"


@pytest.mark.parametrize("kind", ["points", "transforms", "skeleton"])
def test_deform_takes_every_time_of_an_animation(tmp_path, kind):
    path = tmp_path / "film.usda"
    high = SQUARE.replace(" 0)", " 2)")
    moving = "double3 xformOp:translate.timeSamples = {1: (0, 0, 0), 3: (0, 0, 2)}\n"
    moving += ' uniform token[] xformOpOrder = ["xformOp:translate"]'
    if kind == "points":
        samples = f"point3f[] points.timeSamples = {{1: [{SQUARE}], 2: [{SQUARE}], 3: [{high}]}}"
        write(path, MESH.format(points=samples, more=""))
    elif kind == "transforms":
        write(path, MESH.format(points=f"point3f[] points = [{SQUARE}]", more=moving))
    else:
        rig(path, source=SOURCE, motion=LIFTED)
    prior = prior_of(path, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        files = save_poses(prior, [path, path], tmp_path / "out.npz")
    heights = [0, 0, 2] if kind == "points" else [0, 2]
    assert [file.name for file in files] == [f"out_{i + 1:04d}.npz" for i in range(2 * len(heights))]
    found = [float(ms.load_mesh(file).vertices[:, 2].max()) for file in files]
    np.testing.assert_allclose(found, heights * 2)
    assert set(files.values()) == {path}


def test_a_film_of_a_base_that_we_wrote(tmp_path):
    """Its up, and its place far from that of the prior's origin, are those of one pose."""
    grid = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    base = ms.BaseMesh(grid, [[0, 1, 2]], up=(0, 0, 1), origin=(5000, 0, 0))
    path = tmp_path / "film.usda"
    ms.save_base(base, path)
    ms.save_mesh(ms.bind(base.relative_to([5010, 0, 0])).mesh, tmp_path / "prior.npz")
    text = path.read_text()
    at = text.index("point3f[] points = ") + len("point3f[] points = ")
    first = text[at : text.index("]", at) + 1]
    moved = first.replace("(0, 1, 0)", "(0, 1, 4)")
    path.write_text(text.replace(f" = {first}", f".timeSamples = {{ 1: {first}, 2: {moved} }}", 1))
    one, two = (ms.load_mesh(file) for file in save_poses(tmp_path / "prior.npz", [path], tmp_path / "o.npz"))
    assert one.origin.tolist() == two.origin.tolist() == [5010, 0, 0]
    for mesh, height in ((one, 0), (two, 4)):
        expected = grid - [10, 0, 0] + [[0, 0, 0], [0, 0, 0], [0, 0, height]]
        np.testing.assert_allclose(mesh.binding.base_vertices, expected, atol=1e-5)


def test_points_that_change_in_number_are_no_film(tmp_path):
    samples = f"point3f[] points.timeSamples = {{1: [{SQUARE}], 2: [{SQUARE}, (5, 5, 5)]}}"
    path = write(tmp_path / "film.usda", MESH.format(points=samples, more=""))
    with pytest.raises(FileFormatError, match="mesh /M has 5 points at the time 2, but 4 at first"):
        save_poses(prior_of(path, tmp_path), [path], tmp_path / "out.npz")
    assert not list(tmp_path.glob("out*"))


# ---- Units


def test_other_units_become_metres(tmp_path):
    """Of a mesh, cameras and splats alike, and not without a word."""
    path = tmp_path / "m.usda"
    camera = 'def Camera "C" {\n double3 xformOp:translate = (0, 0, 300)\n'
    camera += ' uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    body = MESH.format(points=f"point3f[] points = [{SQUARE.replace('1', '200')}]", more="") + camera
    points, said = read(write(path, body, " metersPerUnit = 0.01\n"))
    np.testing.assert_allclose(points, [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    assert said == ["its unit is 0.01 m: read in metres, coordinates times 0.01"]
    np.testing.assert_allclose(cameras_in_usd(path)[0].center, [0, 0, 3])
    for head in ("", " metersPerUnit = 1\n", " metersPerUnit = 0\n"):
        points, said = read(write(path, body, head))
        assert points.max() == 200
        assert said == []


def test_splats_in_other_units_become_metres(tmp_path):
    cloud = ms.GaussianCloud([[1, 2, 3]], [[1, 0, 0, 0]], [[0.1, 0.2, 0.3]], [0.5], [[[0, 0, 0]]])
    path = tmp_path / "s.usda"
    ms.save_gaussians(cloud, path)
    assert "metersPerUnit = 1" in path.read_text()
    path.write_text(path.read_text().replace("metersPerUnit = 1", "metersPerUnit = 0.01"))
    with pytest.warns(DataWarning, match=r"s\.usda: its unit is 0.01 m: read in metres"):
        found = ms.load_gaussians(path)
    np.testing.assert_allclose(np.abs(found.means + found.origin), np.abs(cloud.means) / 100, rtol=1e-5)
    np.testing.assert_allclose(np.sort(found.scales), cloud.scales / 100, rtol=1e-5)


# ---- Point instancers


def test_what_instancers_copy_is_not_drawn_itself(tmp_path):
    body = 'def PointInstancer "I" {\n point3f[] positions = [(5, 0, 0)]\n int[] protoIndices = [0]\n'
    body += " prepend rel prototypes = </I/M>\n"
    body += MESH.format(points=f"point3f[] points = [{SQUARE}]", more="") + "}\n"
    path = tmp_path / "m.usda"
    with pytest.raises(FileFormatError, match=r"no visible mesh, but 1 point instancers .*make their copies"):
        ms.load_mesh(write(path, body))
    points, (message,) = read(
        write(
            path, body + MESH.format(points=f"point3f[] points = [{SQUARE}]", more="") + 'def Sphere "S" {}\n'
        )
    )
    assert len(points) == 4
    assert message.startswith("1 shapes that are no meshes and 1 point instancers (make their copies")
