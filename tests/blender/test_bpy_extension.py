# ruff: noqa: E402
"""The extension as Blender sees it: its manifest, its installation from the .zip, import, another
conversion, the image, and its removal."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from _glb import read_glb

from meshsplats.formats.splat_formats import splat_suffixes

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats, random_mesh
from _local import script

from meshsplats import convert, load_mesh, save_gaussians, save_mesh
from meshsplats.prior import bind
from meshsplats.scene.base_mesh import BaseMesh

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).with_name("_extension_session.py")
RANGE = "5.1" if bpy.app.version >= (5, 1, 0) else "4.2"
"""First Blender of the range that the package is for."""


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("extension")
    command = [sys.executable, str(ROOT / "blender_extension" / "build.py"), "-o", str(folder)]
    command += ["--blender", RANGE]
    if "MESHSPLATS_WHEEL" in os.environ:  # built already
        command += ["--wheel", os.environ["MESHSPLATS_WHEEL"]]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(folder.glob("*.zip"))


def test_blenders_own_tool_accepts_the_package(packed):
    tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    done = subprocess.run(
        [sys.executable, str(tool), "validate", str(packed)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Error" not in done.stdout + done.stderr


def test_package_holds_the_wheels_of_one_platform(packed):
    with zipfile.ZipFile(packed) as archive:
        names = archive.namelist()
        manifest = archive.read("blender_manifest.toml").decode()
    wheels = [name for name in names if name.startswith("wheels/")]
    assert [wheel.split("/")[1].split("-")[0] for wheel in wheels] == ["meshsplats", "pillow"]
    assert f'wheels = ["./{wheels[0]}", "./{wheels[1]}"]' in manifest
    assert 'license = ["SPDX:GPL-3.0-or-later"]' in manifest
    versions = {"4.2": 'min = "4.2.0"\nblender_version_max = "5.1.0"\n', "5.1": 'min = "5.1.0"\nlicense'}
    assert f"blender_version_{versions[RANGE]}" in manifest
    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    assert wheels[1].split("-")[2] == python, "Pillow for the Python of this Blender"
    assert {"__init__.py", "LICENSE", "blender_manifest.toml"} <= set(names)
    assert "build.py" not in names


def test_platform_names():
    build = script("blender_extension/build.py")
    assert build.platform_of("meshsplats-0.1.0-py3-none-manylinux_2_28_x86_64.whl") == "linux-x64"
    assert build.platform_of("meshsplats-0.1.0-py3-none-macosx_11_0_arm64.whl") == "macos-arm64"
    assert build.platform_of("meshsplats-0.1.0-py3-none-win_arm64.whl") == "windows-arm64"
    with pytest.raises(ValueError, match="not a wheel of a platform"):
        build.platform_of("meshsplats-0.1.0-py3-none-any.whl")
    different = [
        Path("meshsplats-0.1.0-py3-none-win_amd64.whl"),
        Path("pillow-1-cp311-cp311-linux_x86_64.whl"),
    ]
    with pytest.raises(ValueError, match="different platforms: linux-x64, windows-x64"):
        build.pack(different, Path("nowhere"), "4.2")


def test_a_package_names_the_python_that_is_not_blenders_own(tmp_path):
    build = script("blender_extension/build.py")
    wheels = [tmp_path / f"meshsplats-0.1.0-{tag}-linux_x86_64.whl" for tag in ("py3-none", "cp314-cp314")]
    for wheel in wheels:
        wheel.write_bytes(b"")
    assert build.pack(wheels, tmp_path, "4.2").name == "meshsplats-0.1.0-linux_x64-blender_4.2.zip"
    other = build.pack(wheels, tmp_path, "4.2", "3.14")
    assert other.name == "meshsplats-0.1.0-linux_x64-blender_4.2-python_3.14.zip"


def test_a_whole_session(packed, tmp_path):
    """In a process of its own, where meshsplats comes from the extension's wheel alone."""
    save_gaussians(ball_splats(400)[0], tmp_path / "ball.ply")
    save_mesh(random_mesh(30), tmp_path / "mesh.npz")
    save_mesh(random_mesh(30, blending="linear"), tmp_path / "linear.npz")
    base = BaseMesh(np.eye(3), [[0, 1, 2]])
    save_mesh(bind(base, triangles=4, layers=2, spacing=0).mesh, tmp_path / "prior.npz")
    (tmp_path / "chain").mkdir()
    rows = []
    for level, count in enumerate((400, 100)):
        save_mesh(convert(ball_splats(count)[0], mode="flat"), tmp_path / "chain" / f"level_{level}.glb")
        rows.append({"file": f"level_{level}.glb", "screen_size": 200 >> level})
    (tmp_path / "chain" / "levels.json").write_text(json.dumps({"levels": rows}))
    (tmp_path / "cameras.json").write_text("[]")
    (tmp_path / "broken.ply").write_bytes(b"ply\nnonsense")
    save_gaussians(ball_splats(400)[0], tmp_path / "small.sog")
    environment = {
        **os.environ,
        "BLENDER_USER_RESOURCES": str(tmp_path / "blender"),
        "BLENDER_USER_EXTENSIONS": str(tmp_path / "blender" / "extensions"),
        "PYTHONNOUSERSITE": "1",
    }
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(packed), str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    report = json.loads((tmp_path / "report.json").read_text())
    assert str(tmp_path / "blender") in report["package"], "meshsplats comes from the wheel"
    assert report["imported"] == ["FINISHED"]
    assert 0 < report["sog"] <= 800
    assert report["triangles"]["default"] > report["triangles"]["fewer"] > 0
    assert report["materials"] == ["Splats, lit", "Splats, unlit"]
    assert report["origin"] == pytest.approx([0, 0, -1], abs=0.12), "under the ball"
    assert report["moved"] == [1.0, 2.0, 2.0], "converting again leaves the object where it was"
    assert 64 <= report["bounces"] <= 1024
    assert report["broken"].startswith("Error: ")
    assert "broken.ply" in report["broken"]
    assert report["left"] == []
    assert report["dropped"]["operator"] == "import_scene.meshsplats"
    ends = {f".{suffix.rpartition('.')[2]}" for suffix in splat_suffixes()}
    assert {*ends, ".gz", ".npz", ".json"} == set(report["dropped"]["suffixes"])
    assert report["dropped"]["places"] == ["VIEW_3D", "OUTLINER"]
    assert report["linear"] == ["Standard", "Raw"]
    assert report["base"] == "prior base"
    assert report["followed"] == pytest.approx([1.0] * 12, abs=1e-4)
    assert report["follow"] == ["FINISHED"]
    assert report["triangles"]["again"] > report["triangles"]["fewer"]
    assert report["edge"] == pytest.approx(1, abs=0.01)
    assert report["middle"] == pytest.approx(0.7, abs=0.1), "the grey ball is drawn"
    assert report["named"] == ["chair", [0.0, 0.0, 0.0]]
    assert report["stage"] == ["FINISHED"]
    assert report["staged"] == ["Cameras", "Lights", "Surroundings"]
    assert report["camera"] == "Camera"
    assert report["dressed"]
    if bpy.app.version >= (4, 5, 0):
        own = report["own_splats"]
        assert own.pop("material").startswith("Splats, lit")
        assert 0 < own.pop("triangles") <= 800
        assert own.pop("middle") == pytest.approx(7, abs=0.12), "the mesh stands where the splats do"
        light = ["object.meshsplats_shading"] * 3 if bpy.app.version >= (5, 3, 0) else []
        assert own == {
            "buttons": ["import_scene.meshsplats", "object.meshsplats_from_splats", *light],
            "answer": ["FINISHED"],
            "name": "points mesh",
            "hidden": [True, True, False],
            "poll": False,
        }
    assert report["levels"][0] == "chain"
    assert report["levels"][1:] == [
        [name, [name, f"{name} stand-in", f"{name} light points"], visible]
        for name, visible in (("chain.001 level 0", False), ("chain.001 level 1", True))
    ]
    assert report["level_triangles"] == [3200, 800]
    names = ["chain.001 level 0", "chain.001 level 1"]
    assert report["shown"] == [[[0], names[0]], [[1], names[1]], [[0], names[0]], [[1], names[1]]]
    assert report["level_materials"] == ["Splats, unlit"] * 2 + ["Splats, lit"] * 2
    assert "has the levels 0 to 1, got 7" in report["level_errors"][0]
    assert "no chain of levels of detail nothing" in report["level_errors"][1]
    assert "cameras.json" in report["level_errors"][2]
    levels = [["0", False], ["1", True]]
    rows = [["Viewport", None], *levels, ["Render", None], *levels]
    assert report["panel"][:7] == [["chain.001: level in", None], *rows]
    assert report["panel"][7][0] == "scene.meshsplats_fit_level"
    waited = report["waited"]
    assert waited["answers"] == [["RUNNING_MODAL"], ["PASS_THROUGH"], ["FINISHED"]]
    assert (np.diff(waited["progress"]) >= 0).all()
    assert waited["results"] == 1
    assert (waited["timers"], waited["text"]) == (0, None)
    escape = report["escape"]
    assert escape["answer"] == ["CANCELLED"]
    assert escape["said"] == ["MeshSplats: cancelled"]
    assert (escape["results"], escape["was_cancelled"], escape["timers"]) == (None, True, 0)
    assert not escape["alive"], "the thread stops by itself"
    assert escape["converted"] < 50
    check_exports(report["exported"], tmp_path)
    plain, moved = report["imports"]
    assert (plain[0], moved[0]) == ("BLENDER_WORKBENCH", "CYCLES")
    assert plain[1] == moved[1] != [0, 0, 0]
    assert plain[2] != moved[2] == [0, 0, 0]
    light = report["light"]
    assert (light["baked"], light["again"]) == ("", "")
    assert light["lamp"] == "Baked light is out of date: Bake Light again"
    assert light["duplicated"] == light["joined"] == "Baked light belongs to other splats: Bake Light again"
    assert [len(names) for names in light["own"]] == [2, 2], "each has a stand-in and light points"
    assert light["left"] == [], "those of the copy are gone"
    assert not light["shadows"], "the stand-in casts them"
    assert light["strays"] == [2, []], "what was made for deleted splats goes with them"
    assert report["sorted"] == [[0, False], [1, True], [0, True], [1, True], [1, False]], (
        "asked for sorting, is sorted: a solid view, blended, drawn again, turned, solid again"
    )


def check_exports(report: dict, folder: Path) -> None:
    """A lit ball of splats, moved, turned and mirrored, and an unlit mesh: colours, places and owners."""
    ball, mesh = convert(ball_splats(400)[0], mode="flat"), random_mesh(30)
    matrices = np.array(report["places"]).reshape(2, 4, 4)
    ours = load_mesh(folder / "out.ply")
    assert len(ours.faces) == len(ball.faces) + len(mesh.faces)
    assert ours.splat_count == 430
    np.testing.assert_array_equal(ours.up, [0, 0, 1])
    colors = np.concatenate([ball.colors, mesh.colors])
    np.testing.assert_allclose(ours.colors, colors, atol=2e-6)
    local = ball.vertices - ball.vertices.mean(axis=0)
    rotation = matrices[0, :3, :3]
    placed = ours.vertices[: len(ball.vertices)]
    np.testing.assert_allclose(placed - placed.mean(axis=0), local @ rotation.T, atol=1e-4)
    np.testing.assert_allclose(load_mesh(folder / "out.glb").colors, colors, atol=1e-3)
    alone = load_mesh(folder / "out.npz")
    np.testing.assert_allclose(alone.colors, mesh.colors, atol=1e-6)
    theirs = load_mesh(folder / "theirs.glb")
    assert len(theirs.faces) == len(ours.faces), "no stand-in, no points of light, no ground"
    middle = theirs.colors[theirs.faces].mean(axis=1)
    np.testing.assert_allclose(middle, ours.colors[ours.faces].mean(axis=1), atol=1e-3)
    for material in read_glb(folder / "theirs.glb")[0]["materials"]:
        assert material["alphaMode"] == "BLEND"
        assert "KHR_materials_unlit" in material["extensions"]
    assert report["restored"]
    assert report["colors"] == [[], []]
    assert report["active"] == ["Color", "Color"]
    assert "nowhere" in report["error"]
