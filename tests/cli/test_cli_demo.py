"""``meshsplats demo``: the first minute, without a file."""

from __future__ import annotations

import pytest

from meshsplats import demo_scene, load_gaussians, load_mesh
from meshsplats.cli import demo, main
from meshsplats.viewer import server


@pytest.fixture
def quick(monkeypatch):
    """Without the images, which take seconds."""
    monkeypatch.setattr(demo, "STEPS", (demo.STEPS[0] + " --alpha blend --no-preview", demo.STEPS[3]))


@pytest.fixture
def small(monkeypatch):
    """A scene of few splats."""
    make_scene = demo_scene.make_scene
    monkeypatch.setattr(demo_scene, "make_scene", lambda: make_scene(500))


@pytest.mark.nightly
def test_it_makes_a_scene_and_types_the_first_commands(tmp_path, quick, capfd, monkeypatch):
    opened = []
    monkeypatch.setattr(server, "open_page", lambda url: not opened.append(url))
    assert main(["demo", "-o", str(tmp_path / "first")]) == 0
    folder = tmp_path / "first"
    assert len(load_gaussians(folder / "scene.ply")) == 20_000
    assert len(load_mesh(folder / "scene.glb").faces) == 160_000
    assert opened == [(folder / "scene.html").as_uri()]
    printed = capfd.readouterr().out
    for line in ("$ meshsplats convert scene.ply -o scene.glb", "$ meshsplats view scene.ply -o scene.html"):
        assert line in printed
    assert "scene.html is open in the browser" in printed
    assert printed.index("$ meshsplats convert") < printed.index("20,000 splats ->") < printed.index("\nNext")


@pytest.mark.slow
@pytest.mark.usefixtures("quick", "small")
def test_without_a_browser_it_says_what_to_open(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(server, "open_page", lambda url: False)
    assert main(["demo", "-o", str(tmp_path / "first")]) == 0
    assert "scene.html opens in any browser" in capfd.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("quick", "small")
def test_what_is_there_stays_unless_it_is_forced(tmp_path, capsys):
    (tmp_path / "scene.glb").write_bytes(b"mine")
    assert main(["demo", "-o", str(tmp_path), "--no-open"]) == 3
    assert "scene.glb: the output exists already" in capsys.readouterr().err
    assert (tmp_path / "scene.glb").read_bytes() == b"mine"
    assert not (tmp_path / "scene.ply").exists()
    assert main(["demo", "-o", str(tmp_path), "--no-open", "--force"]) == 0
    assert len(load_gaussians(tmp_path / "scene.ply")) == 500
    assert load_mesh(tmp_path / "scene.glb").splat_count == 500


def test_it_imports_nothing_from_its_folder(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(demo, "STEPS", ("--version",))
    (tmp_path / "json.py").write_text("raise SystemExit('a stranger')")
    assert main(["demo", "-o", str(tmp_path), "--no-open"]) == 0
    assert "\nmeshsplats " in capfd.readouterr().out


def test_a_command_that_fails_ends_it_with_its_code(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(demo, "STEPS", ("convert missing.ply -o scene.glb", "view scene.ply -o scene.html"))
    assert main(["demo", "-o", str(tmp_path), "--no-open"]) == 1
    assert "missing.ply" in capfd.readouterr().err
    assert not (tmp_path / "scene.html").exists()
