"""Outputs when things go wrong: full disks, other writers, signals, pipes that close. Real processes where it
matters."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _splats import few_splats

from meshsplats._common import toml
from meshsplats._files import atomic
from meshsplats._files.atomic import (
    atomic_path,
    promises_kept,
    refuse_existing,
    temporary_beside,
    together,
    write_bytes,
)
from meshsplats._files.locks import lock_of, locked
from meshsplats.cli import main
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DataWarning
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.mesh_formats import written_mesh_suffixes
from meshsplats.formats.meshes import expected_bytes, load_mesh, save_mesh, save_mesh_blocks
from meshsplats.formats.outputs import check_outputs
from meshsplats.images.writing import encode_array, save_animation, save_image
from meshsplats.scene.mesh import SplatMesh

posix = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")
COMMAND = [sys.executable, "-m", "meshsplats"]


def large_mesh(vertices: int = 30_000) -> SplatMesh:
    rng = np.random.default_rng(0)
    corners = rng.integers(0, vertices, (vertices, 3)).astype(np.int32)
    return SplatMesh(rng.normal(size=(vertices, 3)), corners, rng.random((vertices, 4)))


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a disk of 256 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if not sys.platform.startswith("linux") or not shutil.which("mount"):
        pytest.skip("needs mount and tmpfs")
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", folder], capture_output=True)
    if done.returncode:
        pytest.skip("only root may mount a small disk")
    yield folder
    subprocess.run(["umount", folder], check=True)


def message_of(error: OSError, path: Path) -> str:
    assert error.filename == str(path)
    assert error.errno == errno.ENOSPC
    return str(error.strerror)


@pytest.mark.parametrize("suffix", written_mesh_suffixes())
def test_a_full_disk_is_one_line_with_path_and_bytes(small_disk, suffix):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    target = small_disk / f"mesh{suffix}"
    mesh = large_mesh()
    if suffix == ".obj":  # which has no opacity, and would warn
        mesh.colors[:, 3] = 1
    with pytest.raises(OSError) as caught:
        save_mesh(mesh, target)
    needed = atomic.in_words(expected_bytes(mesh, suffix))
    assert message_of(caught.value, target) == (
        f"no space left on the disk: the file needs about {needed}, 262.1 kB are free"
    )
    assert list(small_disk.iterdir()) == []


@pytest.mark.parametrize("splats", [None, 300])
def test_a_mesh_in_parts_on_a_full_disk(small_disk, splats):
    """Twice the file, as its parts lie beside it: that of all splats, or of the parts that came."""
    mesh = large_mesh(9000)
    mesh = replace(mesh, face_splat=np.arange(9000, dtype=np.int32) // 90)
    with pytest.raises(OSError) as caught:
        save_mesh_blocks([mesh], small_disk / "mesh.ply", splats=splats)
    needed = atomic.in_words(2 * expected_bytes(mesh, ".ply") * (3 if splats else 1))
    assert f"the file needs about {needed}, 262.1 kB are free" in message_of(
        caught.value, small_disk / "mesh.ply"
    )
    assert list(small_disk.iterdir()) == []


@pytest.mark.parametrize(
    ("number", "needs", "message"),
    [
        (errno.ENOSPC, None, r"no space left on the disk: [\d.]+ \w+ are free"),
        (errno.ENOSPC, lambda: 2000, r"no space left on the disk: the file needs about 2\.0 kB, .* are free"),
        (errno.EDQUOT, lambda: None, "the disk quota is used up"),
        (errno.EFBIG, None, r"larger than a file may be here \(ulimit -f, or the file system\)"),
    ],
)
def test_what_is_not_known_of_a_file_is_not_said(tmp_path, number, needs, message):
    with pytest.raises(OSError) as caught, atomic_path(tmp_path / "a", needs=needs):
        raise OSError(number, os.strerror(number))
    assert re.fullmatch(message, str(caught.value.strerror))


def test_images_on_a_full_disk(small_disk):
    image = np.random.default_rng(0).random((320, 320, 3))
    frames = [(image * 255).astype(np.uint8), (image[::-1] * 255).astype(np.uint8)] * 2
    for name, save in [
        ("a.png", lambda path: save_image(path, image)),
        ("a.webp", lambda path: save_animation(path, frames)),
        ("a.npy", lambda path: write_bytes(path, encode_array(image))),
    ]:
        with pytest.raises(OSError) as caught:
            save(small_disk / name)
        assert "needs about" in message_of(caught.value, small_disk / name)
    assert list(small_disk.iterdir()) == []


def test_the_command_on_a_full_disk(small_disk, tmp_path, capsys):
    save_gaussians(make_scene(3000), tmp_path / "scene.ply")
    arguments = ["convert", str(tmp_path / "scene.ply"), "-o", str(small_disk / "mesh.glb"), "--json"]
    assert main(arguments) == 4
    out, err = capsys.readouterr()
    assert err.startswith(f"meshsplats: error: {small_disk / 'mesh.glb'}: no space left on the disk")
    assert err.count("\n") == 1
    error = json.loads(out)["error"]
    assert (error["kind"], error["code"], error["path"]) == ("space", 4, str(small_disk / "mesh.glb"))


@posix
@pytest.mark.parametrize("suffix", [".usdc", ".glb"])
def test_a_limit_on_files_is_told(tmp_path, suffix):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    save_mesh(large_mesh(), tmp_path / "in.npz")
    code = (
        "import resource, sys; from meshsplats.formats.meshes import *;"
        "mesh = load_mesh(sys.argv[1]); resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000));"
        "save_mesh(mesh, sys.argv[2])"
    )
    target = tmp_path / f"mesh{suffix}"
    command = [sys.executable, "-c", code, str(tmp_path / "in.npz"), str(target)]
    done = subprocess.run(command, capture_output=True, text=True)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("OSError: [Errno 27] larger than a file may be here"), done.stderr
    assert last.endswith(f"'{target}'")
    assert [path.name for path in tmp_path.iterdir()] == ["in.npz"]


@pytest.mark.parametrize("suffix", written_mesh_suffixes())
def test_sizes_are_about_right(tmp_path, suffix):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    from dataclasses import replace

    plain = large_mesh(3000)
    rich = replace(
        plain,
        normals=np.tile(np.float32([0, 0, 1]), (3000, 1)),
        face_splat=np.arange(3000, dtype=np.int32),
        attributes={"heat": np.linspace(0, 1, 3000)},
    )
    for mesh in (plain, rich):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            save_mesh(mesh, tmp_path / f"mesh{suffix}")
        size = (tmp_path / f"mesh{suffix}").stat().st_size
        assert 0.6 < expected_bytes(mesh, suffix) / size < 1.6


def test_of_two_writers_exactly_one_wins(tmp_path):
    """Both have found the name free; the second to finish must not touch what the first wrote."""

    def both(target: Path) -> None:
        with atomic_path(target) as ours:
            ours.write_bytes(b"ours")
            target.write_bytes(b"theirs")

    target = tmp_path / "mesh.glb"
    with promises_kept():
        refuse_existing([target], force=False)
        with pytest.raises(FileExistsError, match="another process has written"):
            both(target)
        with pytest.raises(FileExistsError, match="another process has written"):
            both(target)  # now before the work
    assert target.read_bytes() == b"theirs"
    assert os.listdir(tmp_path) == ["mesh.glb"]


@pytest.mark.parametrize("links", [True, False], ids=["hard links", "no hard links"])
def test_many_writers(tmp_path, monkeypatch, links):
    if not links:

        def refused(*_, **__):
            raise PermissionError(errno.EPERM, "no hard links here")

        monkeypatch.setattr(os, "link", refused)
    target, ready, won = tmp_path / "mesh.glb", threading.Barrier(8), []

    def write(number: int) -> None:
        try:
            with atomic_path(target, new=True) as temporary:
                temporary.write_bytes(b"%d" % number)
                ready.wait()
            won.append(number)
        except FileExistsError:
            pass

    threads = [threading.Thread(target=write, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert target.read_bytes() == b"%d" % won[0]
    assert os.listdir(tmp_path) == ["mesh.glb"]


def test_a_command_may_write_its_own_output_again(tmp_path):
    with promises_kept():
        refuse_existing([tmp_path / "a"], force=False)
        for content in (b"1", b"2"):
            with atomic_path(tmp_path / "a") as temporary:
                temporary.write_bytes(content)
        refuse_existing([tmp_path / "a"], force=True)
    assert (tmp_path / "a").read_bytes() == b"2"


def test_force_takes_back_the_promise(tmp_path):
    with promises_kept():
        refuse_existing([tmp_path / "a"], force=False)
        (tmp_path / "a").write_bytes(b"theirs")
        refuse_existing([tmp_path / "a"], force=True)
        with atomic_path(tmp_path / "a") as temporary:
            temporary.write_bytes(b"ours")
    assert (tmp_path / "a").read_bytes() == b"ours"
    with atomic_path(tmp_path / "a"):
        pass  # and outside of a command, files are replaced


@pytest.mark.slow
@posix
def test_two_processes_one_output(tmp_path):
    save_gaussians(make_scene(3000), tmp_path / "scene.ply")
    arguments = [*COMMAND, "convert", "scene.ply", "-o", "mesh.glb"]
    both = [
        subprocess.Popen([*arguments, "--max-splats", n], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        for n in ("100", "3000")
    ]
    errors = [process.communicate()[1] for process in both]
    codes = [process.returncode for process in both]
    assert sorted(codes) == [0, 3], errors
    kept = ("100", "3000")[codes.index(0)]
    recorded = toml.load(tmp_path / "mesh.glb.config.toml")["options"]["max_splats"]
    assert str(recorded) == kept
    names = {"scene.ply", "mesh.glb", "mesh.glb.config.toml", "mesh.glb.preview.png"}
    assert {path.name for path in tmp_path.iterdir()} == names


_HANGING_PREVIEW = """
import sys, time, meshsplats.cli, meshsplats.{0}
def hang(*_, **__):
    print("drawing", flush=True)
    time.sleep(60)
meshsplats.{0}.{1} = hang
sys.exit(meshsplats.cli.main(sys.argv[1:]))
"""


def killed_in_the_preview(
    folder: Path, *arguments: str, function: str = "draw_preview", module: str = ""
) -> None:
    """Runs a command there that is killed when its result is written and its preview is not."""
    code = _HANGING_PREVIEW.format(module or f"cli.{arguments[0]}", function)
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=folder, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "drawing\n"
        process.kill()


@pytest.mark.slow
@posix
@pytest.mark.parametrize("option", [[], ["--skip-existing"]])
def test_a_kill_before_the_preview_costs_the_preview_only(tmp_path, capsys, option):
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    killed_in_the_preview(tmp_path, "convert", "scene.ply", "-o", "mesh.glb")
    made = {"mesh.glb", "mesh.glb.config.toml"}
    assert {name for name in os.listdir(tmp_path) if name.startswith("mesh")} == made
    stamp = (tmp_path / "mesh.glb").stat().st_mtime_ns
    arguments = ["convert", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "mesh.glb")]
    assert main([*arguments, "--max-splats", "30"]) == 3  # another command
    assert "with other options: --max-splats was not given and is 30" in capsys.readouterr().err
    assert main([*arguments, *option]) == 0
    assert set(os.listdir(tmp_path)) == made | {"scene.ply", "mesh.glb.preview.png"}
    assert (tmp_path / "mesh.glb").stat().st_mtime_ns == stamp
    assert main(arguments) == 3  # complete


@pytest.mark.slow
@posix
def test_a_kill_before_the_preview_leaves_nothing_of_quick_commands(tmp_path, monkeypatch):
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    killed_in_the_preview(
        tmp_path, "clean", "scene.ply", "-o", "out.ply", function="save_strip", module="operations.edits"
    )
    killed_in_the_preview(tmp_path, "simplify", "scene.ply", "-o", "out.ply", "--share", "0.5")
    assert [name for name in os.listdir(tmp_path) if not name.startswith(".")] == ["scene.ply"]
    monkeypatch.setattr(atomic, "_swept", set())
    assert main(["clean", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "out.ply")]) == 0
    assert not _temporaries(tmp_path)


@posix
def test_a_job_that_another_process_is_at_is_left_to_it(tmp_path, capsys):
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    code = _HANGING_PREVIEW.format("cli.convert", "draw_preview")
    arguments = ["convert", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "mesh.glb")]
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        for option in ([], ["--skip-existing"]):
            assert main([*arguments, *option]) == 3
            assert "another process is writing this output" in capsys.readouterr().err
        process.kill()
    assert main(arguments) == 0
    assert not _temporaries(tmp_path)


@pytest.mark.slow
@posix
def test_a_run_that_is_killed_in_its_preview_is_resumed_whole(tmp_path):
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    options = ["--steps", "2", "--views", "2", "--held-out", "1", "--width", "16"]
    words = ["finetune", "scene.ply", "-o", "tuned.npz", *options]
    killed_in_the_preview(tmp_path, *words, module="cli.training")
    assert [name for name in os.listdir(tmp_path) if name.startswith("tuned")] == ["tuned.npz.run"]
    words[1], words[3] = str(tmp_path / "scene.ply"), str(tmp_path / "tuned.npz")
    assert main([*words, "--resume"]) == 0
    made = {"tuned.npz", "tuned.npz.config.toml", "tuned.npz.preview.png", "tuned.npz.run"}
    assert {name for name in os.listdir(tmp_path) if name.startswith("tuned")} == made


def test_files_that_belong_together_appear_together(tmp_path):
    (tmp_path / "b").write_bytes(b"old")
    with suppress(KeyboardInterrupt), together():
        write_bytes(tmp_path / "a", b"1")
        write_bytes(tmp_path / "b", b"2")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["b"]
    with promises_kept():
        refuse_existing([tmp_path / "a"], False)
        with together():
            write_bytes(tmp_path / "a", b"1")
            with together():
                write_bytes(tmp_path / "b", b"2")
            assert not (tmp_path / "a").exists()
            assert (tmp_path / "b").read_bytes() == b"old"
        assert ((tmp_path / "a").read_bytes(), (tmp_path / "b").read_bytes()) == (b"1", b"2")
        refuse_existing([tmp_path / "c", tmp_path / "d"], False)
        written = together()
        written.__enter__()
        write_bytes(tmp_path / "c", b"ours")
        write_bytes(tmp_path / "d", b"ours")
        (tmp_path / "c").write_bytes(b"theirs")
        with pytest.raises(FileExistsError, match="another process"):
            written.__exit__(None, None, None)
    assert (tmp_path / "c").read_bytes() == b"theirs"
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "c"]


def _temporaries(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if name.startswith(".")]


_HANGING = """
import sys, time, meshsplats.cli
from dataclasses import dataclass
from meshsplats._files.atomic import atomic_path
from meshsplats.cli.arguments import Command
@dataclass
class Hang(Command):
    def execute(self):
        with atomic_path(sys.argv[1]) as temporary:
            temporary.write_bytes(b"half")
            print("writing", flush=True)
            for _ in range(600):  # a signal that comes just before a sleep begins does not shorten it
                time.sleep(0.1)
sys.modules["hang"] = sys.modules["__main__"]
meshsplats.cli.COMMANDS["hang"] = ("hang:Hang", "")
sys.exit(meshsplats.cli.main(["hang"]))
"""


@pytest.mark.slow
@posix
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_signals_leave_nothing(tmp_path, name):
    number = signal.Signals[name]
    command = [sys.executable, "-c", _HANGING, str(tmp_path / "mesh.glb")]
    # Where the tests run in the background of a shell, it may have signals ignored.
    heed = partial(signal.signal, number, signal.SIG_DFL)
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with subprocess.Popen(command, preexec_fn=heed, **pipes) as process:
        assert process.stdout.readline() == "writing\n"
        assert len(_temporaries(tmp_path)) == 1
        process.send_signal(number)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 128 + number
    assert "no file was left half-written" in err
    assert err.count("\n") == 1
    assert os.listdir(tmp_path) == []


@posix
def test_what_a_kill_leaves_goes_with_the_next_file(tmp_path, monkeypatch):
    command = [sys.executable, "-c", _HANGING, str(tmp_path / "mesh.glb")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "writing\n"
        living = temporary_beside(tmp_path / "other.npz")  # of this process
        living.write_bytes(b"")
        elsewhere = tmp_path / f".mesh.{process.pid:x}-00000000.0123456789abcdef.glb"
        elsewhere.touch()  # a process of another machine on this disk has the same number
        monkeypatch.setattr(atomic, "_swept", set())
        with atomic_path(tmp_path / "first.npz"):
            pass
        assert len(_temporaries(tmp_path)) == 3  # all of them are being written, as far as we know
        process.kill()
    monkeypatch.setattr(atomic, "_swept", set())
    with atomic_path(tmp_path / "mesh.npz"):
        pass
    left = [living.name, elsewhere.name]
    assert sorted(_temporaries(tmp_path)) == sorted(left)


def test_locks_of_killed_processes_go_with_the_next_file(tmp_path, monkeypatch):
    held, left = (lock_of(tmp_path / name) for name in ("a.glb", "b.glb"))
    left.touch()
    with locked(held):
        monkeypatch.setattr(atomic, "_swept", set())
        write_bytes(tmp_path / "c.glb", b"")
        assert sorted(os.listdir(tmp_path)) == sorted([held.name, "c.glb"])


@pytest.mark.slow(keep=2)
@posix
@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["convert", "--help"],
        ["doctor"],
        ["info", "scene.ply"],
        ["info", "scene.ply", "--json"],
        ["convert", "scene.ply", "-o", "a.npz", "--no-sidecar"],
        ["convert", "scene.ply", "-o", "out", "--formats", "npz", "--no-sidecar", "--json"],
        ["clean", "scene.ply", "-o", "clean.ply", "--min-opacity", "0.001"],
        ["simplify", "scene.ply", "-o", "few.ply", "--share", "0.5", "--no-preview"],
        ["render", "scene.ply", "-o", "images", "--orbit", "2", "--width", "16", "--json"],
    ],
)
def test_a_reader_that_goes_away(tmp_path, arguments):
    """As of any program that SIGPIPE ends: no message, and the code is not that of a wrong input."""
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    no_gpu = {
        "VK_DRIVER_FILES": os.devnull,
        "VK_ICD_FILENAMES": os.devnull,
    }  # trying one takes seconds
    streams = [subprocess.PIPE]
    if arguments in (["info", "scene.ply"], ["convert", "--help"]):
        streams.append(subprocess.STDOUT)  # as well gone: main() is all that knows of it
    for stderr in streams:
        reading, writing = os.pipe()
        os.close(reading)
        with os.fdopen(writing, "wb") as pipe:
            done = subprocess.run(
                [*COMMAND, *arguments, *["--force"] * ("-o" in arguments)],
                cwd=tmp_path,
                env=os.environ | no_gpu,
                stdout=pipe,
                stderr=stderr,
            )
        assert not done.stderr
        assert done.returncode == 141


@pytest.mark.slow(keep=1)
@posix
@pytest.mark.parametrize("closed", [">&-", "2>&-"])
def test_streams_that_are_closed(tmp_path, closed):
    """Messages go nowhere, never to the other stream or into a file that took its number."""
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    for arguments, code in (["convert scene.ply -o a.npz --force", 0], ["info none.ply", 1], ["--help", 0]):
        line = f'"{sys.executable}" -m meshsplats {arguments} {closed}'
        done = subprocess.run(["sh", "-c", line], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        assert "none.ply" not in done.stdout
    assert len(load_mesh(tmp_path / "a.npz").faces) == 320


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")
def test_standard_output_that_is_full(tmp_path):
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [*COMMAND, "info", "scene.ply", "--json"],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.stderr == "meshsplats: error: standard output: No space left on device\n"
    assert done.returncode == 4


@posix
def test_locks_end_with_their_process(tmp_path):
    path = tmp_path / "lock"
    code = "import sys, time; from pathlib import Path; from meshsplats._files.locks import lock_of, locked\n"
    code += "with locked(Path(sys.argv[1])) as ours: print(ours, flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "True\n"
        with locked(path) as ours:
            assert not ours
        process.kill()
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        with locked(path) as ours:
            if ours:
                break
    assert ours
    assert not path.exists()


@pytest.mark.skipif(not hasattr(os, "statvfs"), reason="no such question here")
@pytest.mark.parametrize(("flags", "why"), [(1, "read-only file system"), (0, "no permission")])
def test_a_folder_that_nothing_may_be_written_in_says_why(tmp_path, monkeypatch, flags, why):
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=flags))
    with pytest.raises(OSError, match=why):
        check_outputs([tmp_path / "a.glb"], False)


@pytest.mark.parametrize("error", [PermissionError, FileNotFoundError])
def test_folders_of_windows_are_tried(tmp_path, monkeypatch, error):
    """access() knows nothing of the rights of users there."""
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(os, "access", lambda *_: True)
    check_outputs([tmp_path / "a.glb"], False)
    assert os.listdir(tmp_path) == []
    real = os.open

    def refused(path, flags, *mode):
        if flags & os.O_CREAT:
            raise error(13, "Access is denied", str(path))
        return real(path, flags, *mode)

    monkeypatch.setattr(os, "open", refused)
    with pytest.raises(PermissionError, match="no permission to write in this folder"):
        check_outputs([tmp_path / "a.glb"], False)


def test_a_full_disk_of_windows_is_no_lack_of_permission(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(os, "open", full)
    assert atomic.may_write_in(tmp_path)
