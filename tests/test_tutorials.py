"""The tutorials: their commands and their Python run as they stand, one after the other in one folder."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from _photographs import write_photographs

from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import COMMANDS, main
from meshsplats.demo_scene import make_scene
from meshsplats.demo_scene.room import make_room
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.rendering import render_splats

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
SHORTER = {"--minutes": ["--steps", "2"]}
SMALLER = {
    "render": ["--width", "48"],
    "compare": ["--width", "48"],
    "finetune": ["--width", "32", "--views", "3", "--held-out", "1"],
    "evaluate": ["--strips", "1"],
}


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def commands(path: Path) -> list[list[str]]:
    lines = "".join(blocks(path, "sh")).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("meshsplats ")]


def small(command: list[str]) -> list[str]:
    """The same command with fewer steps and smaller images."""
    short: list[str] = []
    rest = iter(command)
    for word in rest:
        if word in SHORTER:
            next(rest)
            short += SHORTER[word]
        else:
            short.append(word)
    if "--data" in command or "--width" in command:
        return short
    return short + SMALLER.get(command[0], [])


def run_all(path: Path, capsys) -> None:
    for command in commands(path):
        assert main(small(command)) == 0, f"{shlex.join(command)}\n{capsys.readouterr().err}"


@pytest.mark.nightly
def test_from_a_splat_file(tmp_path, monkeypatch, capsys):
    cloud = make_scene(300)
    save_gaussians(cloud, tmp_path / "scene.ply")
    monkeypatch.chdir(tmp_path)
    run_all(TUTORIALS / "from_a_splat_file.md", capsys)
    for block in blocks(TUTORIALS / "from_a_splat_file.md", "python"):
        exec(compile(block, "tutorial", "exec"), {})
    assert {"scores", "look", "tuned.npz", "tuned.glb"} <= {p.name for p in tmp_path.iterdir()}


@pytest.mark.nightly
def test_places(tmp_path, monkeypatch, capsys):
    save_gaussians(make_room(3000), tmp_path / "room.ply")
    monkeypatch.chdir(tmp_path)
    run_all(TUTORIALS / "places.md", capsys)
    assert {"cameras.json", "round", "tuned.npz", "scores"} <= {p.name for p in tmp_path.iterdir()}


@pytest.mark.nightly
def test_from_photographs(tmp_path, monkeypatch, capsys):
    cloud = make_scene(300)
    save_gaussians(cloud, tmp_path / "scene.ply")
    cameras = orbit(cloud, 9, width=32, height=32)
    write_photographs(tmp_path / "photos", cameras, [render_splats(cloud, c).color for c in cameras])
    monkeypatch.chdir(tmp_path)
    run_all(TUTORIALS / "from_photographs.md", capsys)
    assert {"check", "scores", "exposures.npz"} <= {p.name for p in tmp_path.iterdir()}


@pytest.mark.parametrize("path", sorted(TUTORIALS.glob("*.md")), ids=lambda p: p.stem)
def test_what_a_tutorial_names_exists(path):
    text = path.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
    assert [link for link in links if not (path.parent / link).exists()] == []
    for name in re.findall(r"^meshsplats (\w+)", text, re.MULTILINE):
        assert name in COMMANDS
