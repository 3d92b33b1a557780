"""What is missing, too old, broken or in the way is said in words, and nothing is left behind."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import stat
from pathlib import Path

import pytest
from _blender_scenes import cameras, random_mesh

from meshsplats import MissingDependencyError, save_mesh
from meshsplats.blender import BlenderError, SceneOptions, draw, launch
from meshsplats.cli import main


@pytest.fixture
def program(tmp_path):
    """Makes an executable that answers --version with a text, and else runs a line of shell."""

    def make(version: str, line: str = "exit 0"):
        path = tmp_path / "blender"
        path.write_text(f'#!/bin/sh\nif [ "$1" = --version ]; then echo "{version}"; exit 0; fi\n{line}\n')
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return path

    return make


def test_missing_bpy_names_the_extra_and_the_environment(monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "bpy" else real(name))
    with pytest.raises(MissingDependencyError, match=r"pip install 'meshsplats\[blender\]'.*--executable"):
        draw(random_mesh(3), cameras()[:1], pictures=["a.png"])


def test_executable_that_is_not_blender(program, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such program"):
        launch.command(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"3\.6 is too old; 4\.2 or newer"):
        launch.command(program("Blender 3.6.5"))
    with pytest.raises(ValueError, match=r"not Blender.*'GIMP 2.10'"):
        launch.command(program("GIMP 2.10"))
    broken = program("", "")
    broken.write_text("#!/bin/sh\necho 'cannot open libX11.so.6' >&2\nexit 127\n")
    with pytest.raises(ValueError, match=r"not Blender.*cannot open libX11\.so\.6"):
        launch.command(broken)
    command = launch.command(program("Blender 4.2.1 LTS"))
    assert command[1:3] == ["--background", "--factory-startup"]
    assert command[-2].endswith("worker.py")


def test_what_blender_said_last_is_in_the_error(program, tmp_path):
    crashing = program("Blender 5.0.1", "echo 'no memory for the render'; exit 3")
    target = tmp_path / "a.png"
    with pytest.raises(BlenderError, match=r"exit code 3.*no memory for the render"):
        draw(random_mesh(3), cameras()[:1], pictures=[target], executable=crashing)
    killed = program("Blender 5.0.1", "kill -9 $$")
    with pytest.raises(BlenderError, match=r"SIGKILL.*fewer triangles"):
        draw(random_mesh(3), cameras()[:1], pictures=[target], executable=killed)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["blender"]


def test_folders_that_cannot_be_written_in_are_told_first(program, tmp_path):
    blender = program("Blender 5.0.1", f"touch {tmp_path}/started")
    places = [tmp_path / "nowhere"] + [Path("/proc")] * Path("/proc/self").exists()
    for folder in places:
        for outputs in ({"pictures": [folder / "a.png"]}, {"blend": folder / "a.blend"}):
            with pytest.raises(OSError, match="cannot write in the folder") as told:
                draw(random_mesh(3), cameras()[:1], executable=blender, **outputs)
            assert told.value.filename == str(folder)
    assert not (tmp_path / "started").exists()


@pytest.mark.skipif(not os.sys.platform.startswith("linux"), reason="libraries have other names")
def test_missing_graphics_libraries_are_named(program, monkeypatch, tmp_path):
    def absent(name, *_, **__):
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", absent)
    with pytest.raises(MissingDependencyError, match=r"libEGL\.so\.1.*apt install libegl1.*--engine cycles"):
        launch.run_job({}, {}, [], SceneOptions(engine="eevee"), limit=1, executable=program("Blender 5.0.1"))


@pytest.mark.skipif(not os.sys.platform.startswith("linux"), reason="libraries have other names")
def test_missing_system_libraries_are_named(monkeypatch, tmp_path):
    """bpy is there, but a library that it is linked with is not."""
    (tmp_path / "bpy.py").write_text("raise ImportError('libSM.so.6: cannot open shared object file')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDependencyError, match=r"libSM\.so\.6: cannot open.*apt install .*libsm6"):
        draw(random_mesh(3), cameras()[:1], pictures=[tmp_path / "a.png"])
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "a.jpg"], "must end in .png, .exr, .blend"),
        (["-o", "a.png", "--mirror"], "the options of light need --lit"),
        (["-o", "a.png", "--denoise"], "--denoise needs --lit"),
        (["-o", "a.png", "--transparent", "--background", "black"], "exclude each other"),
        (["-o", "a.png", "--orbit", "3"], "3 views do not fit one .png"),
        (["-o", "a.blend", "--samples", "2"], "one sample a pixel"),
        (["-o", "a.png", "--format", "exr"], "--format is for a folder"),
        (["-o", "nowhere/a.png"], "folder for the output does not exist"),
        (["-o", "taken.png"], "taken.png: the output exists already"),
    ],
)
def test_command_line_mistakes(arguments, words, program, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_mesh(random_mesh(3), "mesh.npz")
    (tmp_path / "taken.png").write_bytes(b"")
    blender = program("Blender 5.0.1", "exit 9")
    before = sorted(path.name for path in tmp_path.iterdir())
    assert main(["blender", "mesh.npz", *arguments, "--executable", str(blender)]) in (1, 2)
    assert words in " ".join(capsys.readouterr().err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == before
