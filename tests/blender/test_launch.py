"""Anything missing, too old, broken or in the way is a clear error, and nothing is left behind."""

from __future__ import annotations

import ctypes
import errno
import importlib.util
import json
import os
import re
import runpy
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from _blender_scenes import cameras, random_mesh

from meshsplats import MissingDependencyError, errors, save_mesh
from meshsplats._files.locks import locked
from meshsplats.blender import BlenderError, SceneOptions, draw, inside, launch
from meshsplats.cli import main

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes and libraries of Linux")


@pytest.fixture
def program(tmp_path):
    """Makes an executable that answers --version with a text, and else runs a line of shell."""
    if sys.platform == "win32":
        pytest.skip("a shell script stands in for the program")

    def make(version: str, line: str = "exit 0"):
        path = tmp_path / "blender"
        path.write_text(f'#!/bin/sh\nif [ "$1" = --version ]; then echo "{version}"; exit 0; fi\n{line}\n')
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return path

    return make


def test_missing_bpy_names_the_extra_and_the_environment(monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "bpy" else real(name))
    install = r'--executable.*pip install ".*meshsplats.*\[blender\]"'
    with pytest.raises(MissingDependencyError, match=install):
        draw(random_mesh(3), cameras()[:1], images=["a.png"])


def test_missing_bpy_on_windows_is_said_as_its_shells_take_it(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(errors, "PACKAGE", runpy.run_path(errors.__file__)["PACKAGE"])
    words = runpy.run_path(inside.__file__)["MISSING"]
    assert r'blender-env\Scripts\pip install "C:\path' in words
    assert not re.search(r"&&|/bin/|python3|/path| '|clone", words)


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


def test_executable_is_run_from_another_folder(program, tmp_path, monkeypatch):
    own = program("Blender 4.2.1 LTS")
    monkeypatch.setenv("PATH", "")
    monkeypatch.chdir(tmp_path.parent)
    command = launch.command(own.relative_to(tmp_path.parent))
    assert command[0] == str(own)
    assert command[1:3] == ["--background", "--factory-startup"]
    assert command[-2].endswith("worker.py")
    monkeypatch.chdir(tmp_path)
    assert launch.command(Path("./blender"))[0] == str(own)


def test_executables_of_windows_have_an_ending(program, tmp_path, monkeypatch):
    """And ``which`` of its Python 3.11 takes no Path."""
    blender = program("Blender 4.5.0")
    monkeypatch.setattr(sys, "platform", "win32")
    asked = []

    def which(name):
        assert isinstance(name, str)
        asked.append(name)
        return str(blender) if name.endswith(".exe") else None

    monkeypatch.setattr(shutil, "which", which)
    assert launch.command(tmp_path / "Blender 4.5" / "blender")[0] == str(blender)
    assert asked[-1] == str(tmp_path / "Blender 4.5" / "blender.exe")


def test_nothing_is_imported_from_the_current_folder(tmp_path, monkeypatch):
    """It may be a downloaded one, with a json.py in it; temporary files may lie there."""
    monkeypatch.setattr(tempfile, "tempdir", os.curdir)
    (tmp_path / "json.py").write_text("open('ran', 'w').close(); raise SystemExit")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep)
    monkeypatch.setattr(launch, "command", lambda executable: [sys.executable, "-m", launch.worker.__name__])
    with launch.begun(SceneOptions(engine="cycles")) as job:
        assert job.folder.is_absolute()
        (job.folder / launch.JOB).write_text("[]")  # no job: it ends
        said = job.process.stdout.read()
        job.process.wait()
    assert "Error" in said
    assert [path.name for path in tmp_path.iterdir()] == ["json.py"]


def test_what_blender_said_last_is_in_the_error(program, tmp_path):
    crashing = program("Blender 5.0.1", "echo 'no memory for the render'; exit 3")
    target = tmp_path / "a.png"
    with pytest.raises(BlenderError, match=r"exit code 3.*no memory for the render"):
        draw(random_mesh(3), cameras()[:1], images=[target], executable=crashing)
    killed = program("Blender 5.0.1", "kill -9 $$")
    with pytest.raises(BlenderError, match=r"SIGKILL.*fewer triangles"):
        draw(random_mesh(3), cameras()[:1], images=[target], executable=killed)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["blender"]


@pytest.mark.parametrize(
    ("engine", "writes", "runs"), [("eevee", "", 2), ("cycles", "", 1), ("eevee", "echo half > {}; ", 1)]
)
def test_after_a_crash_eevee_gets_another_try(engine, writes, runs, program, tmp_path, monkeypatch):
    """Unless there is an output already, which stays."""
    monkeypatch.setattr(launch, "_check_graphics", lambda: None)
    target, log = tmp_path / "a.png", tmp_path / "log"
    line = f"echo run >> {log}; [ $(wc -l < {log}) = 1 ] || exit 3; {writes.format(target)}kill -SEGV $$"
    crashing = program("Blender 5.3.0", line)
    how = "exit code 3" if runs == 2 else "by signal SIGSEGV"
    with pytest.raises(BlenderError, match=how):
        draw(
            random_mesh(3),
            cameras()[:1],
            images=[target],
            options=SceneOptions(engine=engine),
            executable=crashing,
        )
    assert log.read_text().count("run") == runs
    names = ["a.png", "blender", "log"] if writes else ["blender", "log"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_crashes_of_eevee_end_with_an_error(program, tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "_check_graphics", lambda: None)
    log = tmp_path / "log"
    with pytest.raises(BlenderError, match=r"by signal SIGABRT.*crashes now and then"):
        draw(
            random_mesh(3),
            cameras()[:1],
            images=[tmp_path / "a.png"],
            options=SceneOptions(engine="eevee"),
            executable=program("Blender 5.3.0", f"echo run >> {log}; kill -ABRT $$"),
        )
    assert log.read_text().count("run") == launch.EEVEE_ATTEMPTS


def test_folders_that_cannot_be_written_in_are_told_first(program, tmp_path):
    blender = program("Blender 5.0.1", f"touch {tmp_path}/started")
    places = [tmp_path / "nowhere"] + [Path("/proc")] * Path("/proc/self").exists()
    for folder in places:
        for outputs in ({"images": [folder / "a.png"]}, {"blend": folder / "a.blend"}):
            with pytest.raises(OSError, match="cannot write in the folder") as caught:
                draw(random_mesh(3), cameras()[:1], executable=blender, **outputs)
            assert caught.value.filename == str(folder)
    assert not (tmp_path / "started").exists()


STAND_IN = """
import json, os, sys, time
while not os.path.exists(sys.argv[-1]):
    time.sleep(0.02)
job = json.load(open(sys.argv[-1]))
for path in job["temporary"].values():
    open(path, "wb").close()  # as Blender's own writer begins
os.mkdir(os.environ["TMPDIR"] + "/blender_own")
child = os.fork()
print(os.getpid(), file=open(sys.argv[1] + ("/child" if child == 0 else "/parent"), "w"), flush=True)
time.sleep(600)
"""


def _until(met, seconds=60.0):
    """Waits for ``met()``; whether it came."""
    deadline = time.monotonic() + seconds
    while not met() and time.monotonic() < deadline:
        time.sleep(0.02)
    return met()


def _alive(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat", encoding="ascii", errors="replace") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"  # which waits to be noticed only
    except OSError:
        return False


@contextmanager
def _killed(process: subprocess.Popen) -> Iterator[subprocess.Popen]:
    """``process``, which does not outlive a failure of the test."""
    with process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.slow
@linux
@pytest.mark.parametrize("name", ["SIGKILL", "SIGTERM", "SIGINT"])
def test_blender_ends_with_the_command_and_leaves_nothing(program, tmp_path, name):
    number = signal.Signals[name]
    notes, place, scratch = (tmp_path / folder for folder in ("notes", "place", "scratch"))
    for folder in (notes, place, scratch):
        folder.mkdir()
    save_mesh(random_mesh(3), tmp_path / "mesh.npz")
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    line = f'exec {sys.executable} {tmp_path}/stand_in.py {notes} "$@"'
    command = [sys.executable, "-m", "meshsplats", "blender", str(tmp_path / "mesh.npz")]
    command += ["-o", str(place / "a.png"), "--executable", str(program("Blender 5.0.1", line))]
    environment = os.environ | {"TMPDIR": str(scratch)}
    # Where the tests run in the background of a shell, it has SIGINT ignored.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with _killed(
        subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, preexec_fn=heed)
    ) as process:
        assert _until(lambda: all((notes / role).exists() for role in ("child", "parent")), 300)
        assert _until(lambda: all((notes / role).read_text() for role in ("child", "parent")))
        assert len(os.listdir(place)) == len(os.listdir(scratch)) == 1
        process.send_signal(number)
        process.communicate(timeout=30)
    assert process.returncode == (-number if number == signal.SIGKILL else 128 + number)
    running = [int((notes / role).read_text()) for role in ("child", "parent")]
    assert _until(lambda: not any(map(_alive, running)))
    assert _until(lambda: not os.listdir(place) + os.listdir(scratch))


@linux
def test_the_worker_ends_with_its_guard(tmp_path):
    """Without the guard's help: kill -9 of the guard, too, ends Blender."""
    worker = f"""
import sys, time
from meshsplats.blender.inside.worker import end_with_parent
end_with_parent()
print("ready", file=open({str(tmp_path / "ready")!r}, "w"), flush=True)
time.sleep(600)
"""
    guard = "import subprocess, sys, time\n"
    guard += f"p = subprocess.Popen([sys.executable, '-c', {worker!r}], stdin=subprocess.DEVNULL)\n"
    guard += "print(p.pid, flush=True); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", guard], stdout=subprocess.PIPE, text=True) as process:
        child = int(process.stdout.readline())
        assert _until((tmp_path / "ready").exists, 300)
        assert _alive(child)
        process.kill()
    assert _until(lambda: not _alive(child))


def test_the_worker_takes_nothing_from_beside_the_package(tmp_path):
    """Where it is installed from a wheel, NumPy for another Python than Blender's lies there."""
    package = Path(launch.__file__).parents[1]
    beside = tmp_path / "site-packages"
    shutil.copytree(package, beside / "meshsplats", ignore=shutil.ignore_patterns("__pycache__", "page"))
    (beside / "numpy").mkdir()
    (beside / "numpy" / "__init__.py").write_text("raise ImportError('for another Python')\n")
    job = tmp_path / "job.json"
    job.write_text("no job")
    script = beside / "meshsplats" / "blender" / "inside" / "worker.py"
    ran = subprocess.run([sys.executable, "-I", script, "--", job], capture_output=True, text=True)
    assert "for another Python" not in ran.stdout + ran.stderr
    assert "JSONDecodeError" in ran.stdout or "No module named 'bpy'" in ran.stdout


def test_the_pipe_ends_the_worker(monkeypatch):
    """Where the kernel does not see to it; not where standard input is none of ours."""
    code = "import sys; sys.platform = 'other'; from meshsplats.blender.inside.worker import end_with_parent;"
    code += "import time; end_with_parent(); print('ready', flush=True); time.sleep(600)"
    for greeting in (b"\n", b""):
        with subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as process:
            assert process.stdout.readline().strip() == b"ready"
            process.stdin.write(greeting)
            process.stdin.close()
            if greeting:
                assert process.wait(20) == 1
            else:
                time.sleep(0.3)
                assert process.poll() is None
                process.kill()


def test_leftovers_of_crashes_are_removed(program, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left, used, other = (tmp_path / f"meshsplats-blender-{name}" for name in ("left", "used", "other"))
    for folder in (left, used, other):
        folder.mkdir()
    (left / "lock").write_bytes(b"")
    (left / "colors.npy").write_bytes(b"much")
    with locked(used / "lock") as ours:
        assert ours
        with pytest.raises(BlenderError):
            draw(
                random_mesh(3),
                cameras()[:1],
                images=[tmp_path / "a.png"],
                executable=program("Blender 5.0.1", "exit 3"),
            )
        assert sorted(path.name for path in tmp_path.iterdir()) == [
            "blender",
            "meshsplats-blender-other",
            "meshsplats-blender-used",
        ]


def test_a_full_disk_inside_blender_is_a_full_disk(program, tmp_path):
    line = launch.worker.MARK + json.dumps({"error": [errno.ENOSPC, "no space left", "/disk/a.png"]})
    blender = program("Blender 5.0.1", f"echo '{line}'; exit 1")
    with pytest.raises(OSError, match="no space left") as caught:
        draw(random_mesh(3), cameras()[:1], images=[tmp_path / "a.png"], executable=blender)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, "/disk/a.png")


def test_what_blender_says_is_passed_on(program, tmp_path):
    stages = [
        {"stage": "Sample 4/16", "share": 0.25, "left": "00:10.1"},
        {"image": "a", "seconds": 1, "processor": 1},
    ]
    lines = "\n".join(f"echo '{launch.worker.MARK}{json.dumps(stage)}'" for stage in stages)
    ahead, seen = [], []
    with pytest.raises(BlenderError):
        draw(
            random_mesh(3),
            cameras()[:1],
            images=[tmp_path / "a.png"],
            executable=program("Blender 5.0.1", lines + "\nexit 1"),
            announce=ahead.append,
            progress=seen.append,
        )
    assert [(at.done, at.share, at.left) for at in seen] == [(0, 0.25, "00:10.1"), (1, 0.0, None)]
    camera = cameras()[0]
    assert ahead[0]["pixels"] == camera.width * camera.height
    assert (ahead[0]["triangles"], ahead[0]["samples"]) == (3, 1)
    assert ahead[0]["harmonics"] == 0
    assert 0 < ahead[0]["mean_layers"] <= ahead[0]["layers"] <= 3


@pytest.mark.parametrize(
    ("text", "share", "left"),
    [
        (
            "Fra:1 Mem:1M | Time:00:00.02 | Remaining:00:10.05 | Scene, ViewLayer | Sample 4/16",
            0.25,
            "00:10.05",
        ),
        ("Remaining: 00:00.10 | Mem: 3M | Sample 1/8", 0.125, "00:00.10"),
        ("Mem: 1M | Updating Scene BVH | Building BVH 40%", 0.0, None),
        ("Mem: 3M | Finished", None, None),
    ],
)
def test_blenders_words_are_understood(text, share, left, capsys):
    """As versions 4.2 and 5.0 print them."""
    launch.worker.report_stage(text)
    said = capsys.readouterr().out
    if share is None:
        assert said == ""
        return
    message = json.loads(said.removeprefix(launch.worker.MARK))
    assert (message["share"], message["left"]) == (share, left)
    assert message["stage"] in text


@linux
def test_missing_graphics_libraries_are_named(program, monkeypatch, tmp_path):
    def absent(name, *_, **__):
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", absent)
    eevee = SceneOptions(engine="eevee")
    with (
        pytest.raises(MissingDependencyError, match=r"libEGL\.so\.1.*apt install libegl1.*--engine cycles"),
        launch.begun(eevee, executable=program("Blender 5.0.1")),
    ):
        pass


@linux
def test_missing_system_libraries_are_named(monkeypatch, tmp_path):
    """bpy is there, but a library that it is linked with is not."""
    (tmp_path / "bpy.py").write_text("raise ImportError('libSM.so.6: cannot open shared object file')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDependencyError, match=r"libSM\.so\.6: cannot open.*apt install .*libsm6"):
        draw(random_mesh(3), cameras()[:1], images=[tmp_path / "a.png"])
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "a.jpg"], "must end in .png, .exr, .blend"),
        (["-o", "a.png", "--mirror"], "the options of light need --lit"),
        (["-o", "a.png", "--max-splats", "5"], "--max-splats is for splats: this is a mesh already"),
        (["-o", "a.png", "--no-denoise"], "--no-denoise is for --lit"),
        (["-o", "a.png", "--lit", "--engine", "eevee", "--no-denoise"], "--no-denoise is for --lit"),
        (["-o", "a.png", "--transparent", "--background", "black"], "exclude each other"),
        (["-o", "a.png", "--orbit", "3"], "3 views do not fit one .png"),
        (["-o", "a.blend", "--samples", "2"], "one sample per pixel"),
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
    assert main(["blender", "mesh.npz", *arguments, "--executable", str(blender)]) in (1, 2, 3)
    assert words in " ".join(capsys.readouterr().err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == before
