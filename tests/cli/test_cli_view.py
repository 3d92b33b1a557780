"""``meshsplats view``: pages, and the server until Ctrl-C."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request

import numpy as np
import pytest
from PIL import Image

from meshsplats._common import toml
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.trajectories import look_at, orbit
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.formats.base_meshes import save_base
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.meshes import save_mesh
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer import content
from meshsplats.viewer.unpacking import unpack_mesh


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """scene.ply, mesh.npz made of it, cameras.json with two cameras."""
    made = tmp_path_factory.mktemp("view")
    cloud = make_scene(200)
    save_gaussians(cloud, made / "scene.ply")
    save_mesh(convert(cloud), made / "mesh.npz")
    save_cameras(orbit(cloud, 2, width=60, height=40), made / "cameras.json")
    return made


def settings(path) -> dict:
    return json.loads(re.search(r'id="settings">(.*?)</script>', path.read_text("utf-8"))[1])  # type: ignore[index]


def has_splats(path) -> bool:
    return 'id="splats">' in path.read_text("utf-8")


def test_splats_become_a_page_with_both(folder, tmp_path, capsys):
    page = tmp_path / "page.html"
    assert main(["view", str(folder / "scene.ply"), "-o", str(page)]) == 0
    printed = capsys.readouterr().out
    assert "1,600 triangles, 200 splats" in printed
    assert re.search(
        r"\d\.\d bytes a triangle; quantisation moves vertices by at most \S+ of the scene's radius", printed
    )
    assert settings(page)["title"] == "scene"
    assert has_splats(page)
    assert toml.load(tmp_path / "page.html.config.toml")["command"] == "view"


def test_a_file_of_a_common_name_has_the_name_of_its_folder(folder, tmp_path):
    model = tmp_path / "vase" / "point_cloud" / "iteration_7"
    model.mkdir(parents=True)
    shutil.copy(folder / "scene.ply", model / "point_cloud.ply")
    page = tmp_path / "page.html"
    assert main(["view", str(model / "point_cloud.ply"), "-o", str(page), "--without-splats"]) == 0
    assert settings(page)["title"] == "vase"


def test_options_reach_the_page(folder, tmp_path):
    page = tmp_path / "page.html"
    words = ["--title", "a vase", "--background", "#204060", "--up", "z", "--without-splats"]
    words += ["--cameras", str(folder / "cameras.json"), "--without-controls"]
    assert main(["view", str(folder / "scene.ply"), "-o", str(page), *words]) == 0
    found = settings(page)
    assert (found["title"], found["background"], found["up"]) == ("a vase", "#204060", [0, 0, 1])
    assert [camera["width"] for camera in found["cameras"]] == [60, 60]
    assert '<body class="plain"' in page.read_text(encoding="utf-8")
    assert not has_splats(page)


def test_a_mesh_alone_or_with_its_splats(folder, tmp_path):
    alone, both = tmp_path / "alone.html", tmp_path / "both.html"
    assert main(["view", str(folder / "mesh.npz"), "-o", str(alone)]) == 0
    assert not has_splats(alone)
    assert (
        main(["view", str(folder / "mesh.npz"), "--splats", str(folder / "scene.ply"), "-o", str(both)]) == 0
    )
    assert has_splats(both)


def test_a_model_folder_brings_its_cameras(folder, tmp_path):
    model = tmp_path / "model"
    (model / "point_cloud" / "iteration_7").mkdir(parents=True)
    (model / "point_cloud" / "iteration_7" / "point_cloud.ply").write_bytes(
        (folder / "scene.ply").read_bytes()
    )
    (model / "cameras.json").write_bytes((folder / "cameras.json").read_bytes())
    assert main(["view", str(model), "-o", str(tmp_path / "page.html")]) == 0
    assert len(settings(tmp_path / "page.html")["cameras"]) == 2


def test_the_cameras_inside_a_surface_are_those_of_its_page_and_its_image(folder, tmp_path, capsys):
    triangle = BaseMesh(np.eye(3, dtype=np.float32), [[0, 1, 2]], np.ones((3, 4)), up=(0, -1, 0))
    inside = [look_at((0.1 * i, 0.2, -2), (0.3, 0.3, 0.3), width=60, height=40) for i in range(3)]
    save_base(triangle, tmp_path / "room.glb", cameras=inside)
    assert main(["view", str(tmp_path / "room.glb"), "-o", str(tmp_path / "page.html")]) == 0
    assert len(settings(tmp_path / "page.html")["cameras"]) == 3
    assert "seen from 3 of the 3 cameras in its file" in capsys.readouterr().err
    assert main(["render", str(tmp_path / "room.glb"), "-o", str(tmp_path / "room.png")]) == 0
    (drawn,) = load_cameras(tmp_path / "room.png.cameras.json")
    np.testing.assert_allclose(drawn.center, inside[0].center, atol=1e-5)


def test_a_crop_leaves_less(folder, tmp_path, capsys):
    words = ["view", str(folder / "scene.ply"), "-o", str(tmp_path / "page.html"), "--json"]
    box = ["--crop", "-0.1", "-9", "-9", "9", "9", "9"]
    assert main([*words, *box]) == 0
    result = json.loads(capsys.readouterr().out)
    assert 0 < result["triangles"] < 1600
    assert 0 < result["splats"] < 200
    assert result["bytes"] == (tmp_path / "page.html").stat().st_size
    assert 0 < result["position_error_radii"] < 1e-5
    assert 0 < result["color_error_levels"] < 0.01
    assert 0 <= result["image_error_levels"] < 3


def test_many_splats_are_merged_and_it_says_so(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(content, "TRIANGLES", 800)
    page = tmp_path / "page.html"
    assert main(["view", str(folder / "scene.ply"), "-o", str(page)]) == 0
    out, err = capsys.readouterr()
    assert "800 triangles, 100 splats" in out
    found = re.search(
        r"200 splats were merged to 100: an image of them with 400 pixels has (\S+) dB against that of all;"
        r" --max-triangles N or --whole keeps more",
        err,
    )
    assert found is not None
    assert 10 < float(found[1]) < 45
    assert settings(page)["statistics"]["merged from"] == "200 splats"
    for words, triangles in (["--whole"], 1600), (["--max-triangles", "1207"], 1200):
        assert main(["view", str(folder / "scene.ply"), "-o", str(page), "--force", "--json", *words]) == 0
        result = json.loads(capsys.readouterr().out)
        assert (result["triangles"], result["splats"]) == (triangles, triangles // 8)
        assert result.get("merged_from") == (200 if triangles < 1600 else None)
        assert ("merged from" in settings(page)["statistics"]) == (triangles < 1600)


@pytest.mark.parametrize("shown", ["splats", "mesh"])
def test_the_command_keeps_to_its_threads(folder, tmp_path, monkeypatch, shown):
    """Without the option, images ask for the number of processors; the result is the same."""
    monkeypatch.setattr(content, "COARSE_TRIANGLES", 400)
    asked, page = [], tmp_path / "page.html"
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: asked.append(pid) or {0}, raising=False)
    given = [folder / "scene.ply", "--max-triangles", 800]
    if shown == "mesh":
        given = [folder / "mesh.npz", "--splats", folder / "scene.ply"]
    words = ["view", *map(str, given), "-o", str(page)]
    assert main([*words, "--threads", "1"]) == 0
    assert not asked
    first = page.read_bytes()
    assert main([*words, "--force"]) == 0
    assert asked
    assert page.read_bytes() == first


@pytest.mark.slow
def test_large_meshes_get_a_coarse_level_of_their_splats(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(content, "COARSE_TRIANGLES", 400)
    page = tmp_path / "page.html"

    def made(name: str, *words: str) -> tuple[dict, str]:
        line = ["view", str(folder / name), "-o", str(page), "--force", *words]
        assert main(line) == 0
        return settings(page)["triangles"], "".join(capsys.readouterr())

    counts, printed = made("scene.ply")
    assert counts == {"fine": 1600, "coarse": 400}
    assert printed.count("1,600 triangles, a coarse level of 400, 200 splats") == 2  # before and after
    assert made("scene.ply", "--without-splats")[0] == counts
    assert made("mesh.npz", "--splats", str(folder / "scene.ply"))[0] == counts
    packed = re.search(r'id="coarse">(.*?)</script>', page.read_text("utf-8"))
    assert packed is not None
    assert len(unpack_mesh(base64.b64decode(packed[1])).faces) == 400
    for words in (["mesh.npz"], ["scene.ply", "--max-triangles", "400"]):
        counts, printed = made(*words)
        assert list(counts) == ["fine"]
        assert "coarse level" not in printed
        assert 'id="coarse"' not in page.read_text("utf-8")


def test_the_size_is_said_before_anything_is_packed(folder, tmp_path, monkeypatch, capsys):
    def packed(*_: object, **__: object) -> None:
        raise MemoryError

    page = tmp_path / "page.html"
    assert main(["view", str(folder / "scene.ply"), "-o", str(page)]) == 0
    size = page.stat().st_size
    capsys.readouterr()
    monkeypatch.setattr("meshsplats.viewer.page.quantise_mesh", packed)
    other = tmp_path / "other.html"
    assert main(["view", str(folder / "scene.ply"), "-o", str(other)]) != 0
    assert not other.exists()
    said = re.search(
        r"other.html will have about (\S+) kB: 1,600 triangles, 200 splats", capsys.readouterr().err
    )
    assert said is not None
    assert float(said[1]) * 1000 == pytest.approx(size, rel=0.05)


def test_a_page_has_a_limit(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(content, "MOST_TRIANGLES", 1000)
    for name, words in ("scene.ply", ["--whole"]), ("mesh.npz", []):
        assert main(["view", str(folder / name), "-o", str(tmp_path / "p.html"), *words]) == 2
        error = capsys.readouterr().err
        assert "a page holds at most 1,000 triangles, and these would be 1,600" in error
        assert "meshsplats tiles" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scene.ply", "-o", "page.png"], "must end in .html"),
        (["scene.ply", "--splats", "scene.ply", "-o", "page.html"], "--splats is for a mesh"),
        (["mesh.npz", "--splats", "scene.ply", "--without-splats", "-o", "p.html"], "not both"),
        (["scene.ply", "--no-open", "-o", "page.html"], "no effect with -o"),
        (["scene.ply", "--force"], "no effect without -o"),
        (["scene.ply", "--background", "beige", "-o", "page.html"], "--background must be"),
        (["scene.ply", "--up", "north", "-o", "page.html"], "--up must be"),
        (["scene.ply", "--cameras", "c.json", "--data", "d", "-o", "page.html"], "not both"),
        (["cameras.json", "-o", "page.html"], "expected splats or a mesh"),
        (["scene.ply", "-o", "nowhere/page.html"], "does not exist"),
        (["scene.ply", "--max-triangles", "7", "-o", "page.html"], "--max-triangles must be from 8"),
        (["scene.ply", "--max-triangles", "80", "--whole", "-o", "p.html"], "not both"),
        (["mesh.npz", "--max-triangles", "800", "-o", "page.html"], "--max-triangles is for splats"),
        (["mesh.npz", "--whole", "-o", "page.html"], "--whole is for splats"),
    ],
)
def test_wrong_usage_is_told_before_anything_is_written(
    folder, tmp_path, monkeypatch, capsys, words, message
):
    for name in ("scene.ply", "mesh.npz", "cameras.json"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    before = sorted(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    assert main(["view", *words]) in (1, 2)
    assert message in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_a_page_is_not_overwritten(folder, tmp_path, capsys):
    page = tmp_path / "page.html"
    page.write_text("mine")
    assert main(["view", str(folder / "scene.ply"), "-o", str(page)]) == 3
    assert page.read_text() == "mine"
    assert main(["view", str(folder / "scene.ply"), "-o", str(page), "--force"]) == 0
    assert page.stat().st_size > 50_000


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is sent as a POSIX signal")
def test_the_address_is_printed_and_answers_until_ctrl_c(folder):
    # Tests that run in a shell's background ignore the signal, and processes inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, "-m", "meshsplats", "view", str(folder / "scene.ply"), "--no-open"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    signal.signal(signal.SIGINT, before)
    try:
        assert process.stdout is not None
        url = next(line.strip() for line in process.stdout if line.startswith("http://127.0.0.1:"))
        with urllib.request.urlopen(url, timeout=30) as answer:
            text = answer.read().decode()
        assert 'id="mesh">' in text
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(url.rsplit("/", 2)[0] + "/", timeout=30)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    finally:
        process.kill()
        _, errors = process.communicate()
    assert errors == "meshsplats: ended\n"


def test_a_machine_without_a_window_gets_the_address(folder, monkeypatch, capsys):
    import webbrowser

    from meshsplats.viewer import server

    asked: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: asked.append(url) or True)
    monkeypatch.setattr(server.PageServer, "serve_forever", lambda self: None)
    monkeypatch.setattr(server.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(folder / "mesh.npz")]) == 0
    printed = capsys.readouterr()
    assert asked == []
    assert "open the address above" in printed.err
    assert re.search(r"^http://127\.0\.0\.1:\d+/\S{20,}/$", printed.out, re.MULTILINE)
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(["view", str(folder / "mesh.npz"), "--json"]) == 0
    printed = capsys.readouterr()
    assert asked == [json.loads(printed.out)["url"]]
    assert printed.err == ""
    assert main(["view", str(folder / "mesh.npz"), "--no-open"]) == 0
    assert len(asked) == 1
    assert np.isfinite(json.loads(printed.out)["image_error_levels"])


@pytest.fixture(scope="module")
def surface(folder):
    """surface.glb: a textured triangle."""
    pixels = np.full((64, 64, 4), 255, np.uint8)
    corners = np.eye(3, dtype=np.float32)
    base = BaseMesh(
        corners,
        np.array([[0, 1, 2]]),
        uv=np.array([[[0, 0], [1, 0], [0, 1]]]),
        face_texture=np.zeros(1, np.int32),
        textures=(Texture(pixels, ("clamp", "clamp")),),
    )
    for name in ("surface.glb", "surface.obj"):
        save_base(base, folder / name)
    return folder / "surface.glb"


def blocks(path) -> set[str]:
    found = re.findall(r'<script type="[\w/]+" id="(\w+)">', path.read_text("utf-8"))
    return set(found) - {"settings", "kernels"}


def test_a_textured_surface_alone_or_beside(folder, surface, tmp_path, capsys):
    page, scene = tmp_path / "page.html", str(folder / "scene.ply")
    textured = {"surface", "coordinates", "picture"}
    cases = {
        "a surface of 1 triangle": ([str(surface)], textured),
        "a surface of 1 triangle, 200 splats": ([str(surface), "--splats", scene], {*textured, "splats"}),
        "1,600 triangles, a surface of 1 triangle, 200 splats": (
            [scene, "--surface", str(surface)],
            {*textured, "mesh", "splats"},
        ),
        "1,600 triangles, a surface of 1 triangle": (
            [str(folder / "mesh.npz"), "--surface", str(folder / "surface.obj")],
            {*textured, "mesh"},
        ),
    }
    for printed, (words, there) in cases.items():
        assert main(["view", *words, "-o", str(page), "--force"]) == 0
        said = capsys.readouterr()
        assert f"): {printed}\n" in said.out
        assert "left out" not in said.err
        assert blocks(page) == there
    assert main(["view", str(surface), "-o", str(page), "--force", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["triangles"], result["surface_triangles"]) == (0, 1)
    assert 0 < result["texture_bytes"] < result["bytes"]


def test_a_mesh_of_splats_is_no_surface(tmp_path, capsys):
    bright = SplatMesh(np.eye(3), np.array([[0, 1, 2]]), np.full((3, 4), [2.0, 0.5, 0.5, 0.5]))
    save_mesh(bright, tmp_path / "bright.npz")
    words = [str(tmp_path / "bright.npz"), "--surface", str(tmp_path / "bright.npz")]
    assert main(["view", *words, "-o", str(tmp_path / "page.html")]) == 2
    error = capsys.readouterr().err
    assert "--surface: " in error
    assert (
        "bright.npz is no surface, as one of 'meshsplats surface' is, but perhaps a mesh of splats" in error
    )
    assert not (tmp_path / "page.html").exists()


def test_options_that_a_surface_has_not(folder, surface, tmp_path, capsys):
    page = ["-o", str(tmp_path / "page.html")]
    for words, message in (
        (["--surface", str(surface)], "is a textured surface: --surface has no effect"),
        (["--crop", *"012345"], "is a textured surface: --crop has no effect"),
        (["--whole"], "is a mesh: --whole is for splats"),
    ):
        assert main(["view", str(surface), *page, *words]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_a_mesh_with_several_textures_is_shown_in_its_colours(tmp_path, surface):
    trimesh = pytest.importorskip("trimesh")
    visuals = [
        trimesh.visual.TextureVisuals(
            uv=np.eye(3)[:, :2],
            material=trimesh.visual.material.PBRMaterial(
                baseColorTexture=Image.fromarray(np.full((8, 8, 3), tone, np.uint8))
            ),
        )
        for tone in (10, 200)
    ]
    parts = [trimesh.Trimesh(np.eye(3) + k, [[0, 1, 2]], visual=v) for k, v in enumerate(visuals)]
    trimesh.Scene(parts).export(tmp_path / "two.glb")
    page = tmp_path / "page.html"
    assert main(["view", str(tmp_path / "two.glb"), "-o", str(page)]) == 0
    assert blocks(page) == {"mesh"}
