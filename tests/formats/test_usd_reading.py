"""Reading USD: our own files exactly, stages typed by hand, broken and hostile files."""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _meshes import assert_same, random_mesh

from meshsplats import DataWarning, FileFormatError, MissingDependencyError, load_mesh, save_mesh
from meshsplats.formats.usd import reader as usd_reader
from meshsplats.formats.usd.extraction import extract_meshes
from meshsplats.formats.usd.opening import checked
from meshsplats.scene.colors import linear_to_srgb

needs_usd = pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason="usd-core is not installed")
COLOR = ' color3f[] primvars:displayColor = [(0.5, 0, 1)] (interpolation = "constant")'
MESH = random_mesh(np.random.default_rng(0), 20, 30)


def stage(body: str, head: str = "") -> str:
    return f'#usda 1.0\n(\n    upAxis = "Y"\n{head})\n{body}'


def shape(name: str = "M", more: str = "", points: str = "(0, 0, 0), (1, 0, 0), (0, 1, 0)") -> str:
    count = points.count("(")
    return (
        f'def Mesh "{name}" {{\n point3f[] points = [{points}]\n int[] faceVertexCounts = [{count}]\n'
        f" int[] faceVertexIndices = [{', '.join(map(str, range(count)))}]\n{more}\n}}\n"
    )


def read(folder: Path, text: str) -> tuple[dict[str, np.ndarray], dict]:
    """The arrays and the report of ``extract`` for a stage typed by hand, in this process."""
    (folder / "m.usda").write_text(text)
    report = checked(extract_meshes, folder / "m.usda", folder / "m.npz", None)
    with np.load(folder / "m.npz") as arrays:
        return dict(arrays), report


@pytest.mark.slow(keep=1)
@needs_usd
@pytest.mark.parametrize(
    ("suffix", "mesh", "lit"),
    [
        (".usdc", MESH, False),
        (".usda", MESH, True),
        (".usd", replace(MESH, normals=None, blending="linear"), True),
        (".usdc", random_mesh(np.random.default_rng(1), extras=False), False),
    ],
)
def test_what_was_saved_comes_back(tmp_path, suffix, mesh, lit):
    save_mesh(mesh, tmp_path / f"m{suffix}", lit=lit)
    assert_same(load_mesh(tmp_path / f"m{suffix}"), mesh, 1e-6)


@needs_usd
def test_a_mesh_of_ours_that_was_moved_is_read_where_it_stands(tmp_path):
    save_mesh(replace(MESH, up=(0, -1, 0), normals=None), tmp_path / "m.usda")
    text = (tmp_path / "m.usda").read_text()
    moved = text.replace(
        'uniform token[] xformOpOrder = ["xformOp:orient"]',
        'double3 xformOp:translate = (10, 0, 0)\n    uniform token[] xformOpOrder = ["xformOp:translate",'
        ' "xformOp:orient"]',
    )
    assert moved != text
    arrays, report = read(tmp_path, moved)
    np.testing.assert_allclose(arrays["vertices"], MESH.vertices * [1, -1, -1] + [10, 0, 0], atol=1e-4)
    assert report["up"] == [0, 1, 0]
    np.testing.assert_array_equal(arrays["face_splat"], MESH.face_splat)


@needs_usd
@pytest.mark.parametrize("first", ["", "9, "], ids=["one too few", "not in order"])
def test_splat_numbers_that_no_longer_fit_are_left_out(tmp_path, first):
    save_mesh(replace(MESH, normals=None, attributes={}, order="splat"), tmp_path / "m.usda")
    text = (tmp_path / "m.usda").read_text()
    assert read(tmp_path, text)[1]["order"] == "splat"
    at = text.index("int[] primvars:face_splat = [") + len("int[] primvars:face_splat = [")
    arrays, report = read(tmp_path, text[:at] + first + text[text.index(",", at) + 1 :])
    lost = "face_splat, the order of its splats"
    assert report["warnings"] == [f"another program has changed the file, so this is ignored: {lost}"]
    assert "order" not in report
    assert "face_splat" not in arrays
    np.testing.assert_array_equal(arrays["depth_group"], MESH.depth_group)


@needs_usd
def test_polygons_places_and_winding(tmp_path):
    """A pentagon 10 to the right and twice as large, and a triangle that is wound the other way."""
    pentagon = shape("A", "", "(0, 0, 0), (1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0)")
    left = shape("B", ' uniform token orientation = "leftHanded"')
    placed = (
        'def Xform "X" {\n double3 xformOp:translate = (10, 0, 0)\n float3 xformOp:scale = (2, 2, 2)\n'
        f' uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n{pentagon}}}\n'
    )
    arrays, report = read(tmp_path, stage(placed + left))
    np.testing.assert_array_equal(
        arrays["vertices"],
        [[10, 0, 0], [12, 0, 0], [14, 2, 0], [12, 4, 0], [10, 2, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]],
    )
    np.testing.assert_array_equal(arrays["faces"], [[0, 1, 2], [0, 2, 3], [0, 3, 4], [7, 6, 5]])
    settings = {"attributes": [], "blending": "display", "up": [0, 1, 0], "origin": [0, 0, 0]}
    assert report == {"warnings": [], "textured": False, "times": [], **settings}


@needs_usd
def test_mirrors_do_not_turn_meshes_inside_out(tmp_path):
    """Nor do two of them, or one of a mesh that is wound the other way."""
    mirror = ' float3 xformOp:scale = (-1, 1, 1)\n uniform token[] xformOpOrder = ["xformOp:scale"]\n'
    meshes = (
        shape("A", mirror),
        shape("B", mirror + ' uniform token orientation = "leftHanded"'),
        f'def Xform "X" {{\n{mirror}{shape("C", mirror)}}}\n',
    )
    for body, expected in zip(meshes, ([2, 1, 0], [0, 1, 2], [0, 1, 2]), strict=True):
        assert read(tmp_path, stage(body))[0]["faces"].tolist() == [expected]


@needs_usd
def test_holes_are_not_filled(tmp_path):
    body = (
        'def Mesh "M" {\n point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]\n'
        " int[] faceVertexCounts = [4, 3, 3]\n int[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 2, 0, 2, 3]\n"
        " int[] holeIndices = [0, 2]\n}\n"
    )
    assert read(tmp_path, stage(body))[0]["faces"].tolist() == [[0, 1, 2]]


@needs_usd
@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("constant", "(1, 0, 0)", [[1, 0, 0]] * 4),
        (
            "vertex",
            "(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)",
            [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]],
        ),
        ("uniform", "(1, 0, 0), (0, 1, 0)", [[1, 0, 0]] * 3 + [[0, 1, 0]] * 3),
        (
            "faceVarying",
            "(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (1, 1, 0), (0, 0, 0)",
            [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 1, 0], [0, 0, 0]],
        ),
    ],
)
def test_colours_of_every_interpolation(tmp_path, kind, values, expected):
    """Two triangles on four points; the opacity stays one value a point, or a corner of it."""
    text = (
        'def Mesh "M" {\n point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]\n'
        " int[] faceVertexCounts = [3, 3]\n int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]\n"
        f' color3f[] primvars:displayColor = [{values}] (interpolation = "{kind}")\n'
        ' float[] primvars:displayOpacity = [0.1, 0.2, 0.3, 0.4] (interpolation = "vertex")\n}\n'
    )
    arrays, _ = read(tmp_path, stage(text))
    split = len(expected) == 6
    corners = [0, 1, 2, 0, 2, 3] if split else [0, 1, 2, 3]
    np.testing.assert_array_equal(arrays["linear"][:, :3], expected)
    np.testing.assert_array_equal(arrays["linear"][:, 3], np.array([0.1, 0.2, 0.3, 0.4], np.float32)[corners])
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(arrays["vertices"], points[corners])
    np.testing.assert_array_equal(arrays["vertices"][arrays["faces"]], points[[[0, 1, 2], [0, 2, 3]]])


@needs_usd
def test_foreign_stage_as_a_mesh(tmp_path):
    """Through the whole reader: z up, display values of linear colours, an own colour for what has none;
    invisible shapes are not there, those that are no meshes are counted."""
    body = (
        shape("A", COLOR) + shape("B") + shape("C", ' token visibility = "invisible"') + 'def Sphere "S" {}\n'
    )
    (tmp_path / "m.usda").write_text(stage(body).replace('"Y"', '"Z"'))
    with pytest.warns(DataWarning, match="1 shapes that are no meshes"):
        mesh = load_mesh(tmp_path / "m.usda")
    grey = float(linear_to_srgb(np.float32([0.18]))[0])
    half = float(linear_to_srgb(np.float32([0.5]))[0])
    np.testing.assert_allclose(mesh.colors, [[half, 0, 1, 1]] * 3 + [[grey, grey, grey, 1]] * 3, atol=1e-6)
    assert mesh.up.tolist() == [0, 0, 1]
    assert mesh.face_splat is None


@needs_usd
@pytest.mark.parametrize(
    ("text", "match"),
    [
        (stage("", " subLayers = [@/etc/passwd@]\n"), "refers to other files .*passwd.*python -c .*Flatten"),
        (stage('def "A" (references = @./other.usda@</X>) {}\n'), "refers to other files .*other.usda"),
        (stage('def "A" (payload = @./other.usda@) {}\n'), "refers to other files .*other.usda"),
        (
            stage(
                'def "A" (clips = {dictionary default = {asset[] assetPaths = [@/etc/passwd@]}}) {}\n'
                + shape()
            ),
            "refers to other files .*clips of /A",
        ),
        (stage('def Sphere "S" {}\n'), "no visible mesh, but 1 shapes that are no meshes"),
        (stage(shape().replace("[0, 1, 2]", "[0, 1, 3]")), "corners 0 to 3 of 3 points"),
        (stage(shape().replace("[0, 1, 2]", "[0, 1, -2]")), "corners -2 to 1 of 3 points"),
        (stage(shape().replace("Counts = [3]", "Counts = [4]")), "do not add up to 3 corners"),
        (stage(shape().replace("Counts = [3]", "Counts = [5, -2]")), "do not add up to 3 corners"),
        (stage(shape().replace("point3f[] points", "point3f[] spots")), "has no points"),
        (
            stage(shape("M", ' color3f[] primvars:displayColor = [(1, 1, 1)] (interpolation = "vertex")')),
            r"displayColor \(vertex\) has 1 values, expected 3",
        ),
    ],
)
def test_stages_that_are_refused(tmp_path, text, match):
    (tmp_path / "other.usda").write_text(stage(f'def "X" {{\n{shape()}}}\n'))
    with pytest.raises(FileFormatError, match=match):
        read(tmp_path, text)


@pytest.mark.slow
@needs_usd
@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"PXR-USDC\0\0", "not readable as USD|does not read this file"),
        (b"#usda 1.0\ndef Mesh {", "not readable as USD"),
        (stage(shape("M", COLOR, "(0, 0, 0), (1, 0, 0), (0, nan, 0)")).encode(), "finite"),
    ],
)
def test_broken_files_are_named(tmp_path, data, match):
    (tmp_path / "m.usd").write_bytes(data)
    with pytest.raises(FileFormatError, match=match) as caught:
        load_mesh(tmp_path / "m.usd")
    assert str(caught.value).startswith(str(tmp_path / "m.usd"))


@pytest.mark.parametrize(
    ("child", "match"),
    [
        pytest.param(
            "import os; os.abort()",
            "does not read this file: it crashed, signal 6",
            marks=pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX"),
        ),
        ("import time; time.sleep(30)", "stopped after 1 s"),
        ("import sys; sys.exit('sick')", "does not read this file: sick"),
    ],
)
def test_what_happens_to_the_other_process_is_an_error_here(tmp_path, monkeypatch, child, match):
    monkeypatch.setattr(usd_reader, "_SECONDS", 1)
    monkeypatch.setattr(usd_reader.importlib.util, "find_spec", lambda name: name)
    run = usd_reader.subprocess.run
    monkeypatch.setattr(usd_reader.subprocess, "run", lambda _, **k: run([sys.executable, "-c", child], **k))
    (tmp_path / "m.usda").write_text(stage(shape()))
    with pytest.raises(FileFormatError, match=match):
        load_mesh(tmp_path / "m.usda")


@needs_usd
def test_temporary_files_may_lie_in_the_current_folder(tmp_path, monkeypatch):
    """Where TMPDIR is "." or no other folder can be written."""
    save_mesh(MESH, tmp_path / "m.usda")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", os.curdir)
    assert len(load_mesh("m.usda").faces) == len(MESH.faces)


@pytest.mark.slow
@needs_usd
def test_instances_of_instances_do_not_eat_memory(tmp_path):
    """2^40 triangles in a file of 5 kB."""
    body = f'def "L0" {{\n{shape()}}}\n'
    for level in range(1, 41):
        two = "".join(f' def "{n}" (references = </L{level - 1}>) {{}}\n' for n in "AB")
        body += f'def "L{level}" {{\n{two}}}\n'
    (tmp_path / "m.usda").write_text(stage(body))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(usd_reader, "_SECONDS", 3)
        with pytest.raises(FileFormatError, match=r"stopped after|more memory|does not read"):
            load_mesh(tmp_path / "m.usda")


def test_without_usd_core_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(usd_reader.importlib.util, "find_spec", lambda name: None)
    (tmp_path / "m.usd").write_bytes(b"PXR-USDC\0\0")
    with pytest.raises(MissingDependencyError, match=r"extra 'usd': pip install usd-core"):
        load_mesh(tmp_path / "m.usd")


@needs_usd
@pytest.mark.parametrize(("lit", "linear"), [(False, False), (True, False), (False, True)])
def test_colours_that_blenders_exporter_wrote(tmp_path, lit, linear):
    """The extension's meshes: RGBA in a primvar named as the attribute, and no displayColor. Their stand-ins
    for light are left out."""
    rgba = "(0.5, 0.25, 1, 0.75)"
    primvar = 'color4f[] primvars:{} = [{}] (interpolation = "constant")'
    other = primvar.format("Color", "(0, 0, 0, 0)") if lit else ""
    note = "".join(
        f" custom bool userProperties:meshsplats_{name} = {int(value)}\n"
        for name, value in (("lit", lit), ("linear", linear))
    )
    colors = primvar.format("DisplayColor" if lit else "Color", rgba)
    body = 'def Xform "Splats" {\n' + shape("M", f"{colors}\n{other}\n{note}") + "}\n"
    helper = 'def Xform "stand" {\n custom bool userProperties:meshsplats_stand_in = 1\n' + shape() + "}\n"
    arrays, _ = read(tmp_path, stage(body + helper))
    assert len(arrays["faces"]) == 1
    colors = arrays["linear"] if linear else linear_to_srgb(arrays["linear"])
    np.testing.assert_allclose(colors[:, :3], [[0.5, 0.25, 1]] * 3, atol=1e-6)
    np.testing.assert_allclose(arrays["linear"][:, 3], 0.75)
