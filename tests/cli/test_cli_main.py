"""The command line as a whole: overview, errors, exit codes, info, doctor."""

from __future__ import annotations

import errno
import io
import json
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from _datasets import simple_colmap
from _photographs import write_photographs

import meshsplats
from meshsplats._common.words import command_line, parse_color, parse_up, quoted
from meshsplats.cameras.files import save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import COMMANDS, main, messages
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import print_table
from meshsplats.cli.messages import one_line
from meshsplats.demo_scene import make_scene
from meshsplats.errors import PACKAGE, DataWarning, FileFormatError, MissingDependencyError
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.meshes import save_mesh
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


def cloud(n: int = 30) -> GaussianCloud:
    rng = np.random.default_rng(0)
    return GaussianCloud(
        rng.uniform(-1, 1, (n, 3)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.tile([0.1, 0.2, 0.05], (n, 1)),
        np.linspace(0, 1, n),
        np.zeros((n, 4, 3)),
    )


def test_overview_and_version(capsys):
    assert main([]) == 0
    overview = capsys.readouterr().out
    assert main(["--help"]) == 0
    assert capsys.readouterr().out == overview
    assert all(name in overview for name in COMMANDS)
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"meshsplats {meshsplats.__version__}\n"


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name, capsys):
    assert main([name, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"usage: meshsplats {name}" in out
    assert "json" in out or name == "demo"
    assert main([name, "--help-all"]) == 0
    assert "{None" not in out + capsys.readouterr().out


def test_unknown_commands(capsys):
    assert main(["rendr"]) == 2
    assert "did you mean 'render'?" in capsys.readouterr().err
    assert main(["zzz"]) == 2
    assert "commands: demo, convert" in capsys.readouterr().err


def test_version_is_quick_and_needs_nothing():
    """No NumPy, no tyro, no rich: a script may ask for the version often."""
    code = (
        "import sys; from meshsplats.cli import main; main(['--version']);"
        "print([m for m in ('numpy', 'tyro', 'rich', 'PIL') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[1] == "[]"


@dataclass
class Raises(Command):
    """A command that ends in the error given."""

    error: ClassVar[BaseException] = ValueError()
    json: bool = False

    def execute(self) -> None:
        raise type(self).error


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ValueError("two\n lines"), 1, "meshsplats: error: two lines"),
        (FileFormatError("a.ply: broken"), 1, "meshsplats: error: a.ply: broken"),
        (MissingDependencyError("install x"), 5, "meshsplats: error: install x"),
        (FileNotFoundError(2, "No such file", "a.ply"), 1, "meshsplats: error: a.ply: No such file"),
        (FileExistsError(17, "there already", "a.ply"), 3, "meshsplats: error: a.ply: there already"),
        (OSError(28, "no space", "a.ply"), 4, "meshsplats: error: a.ply: no space"),
        (MemoryError(), 5, "meshsplats: error: out of memory"),
        (KeyboardInterrupt(), 130, "meshsplats: interrupted"),
    ],
)
def test_errors_are_one_line(monkeypatch, capsys, error, code, line):
    monkeypatch.setitem(COMMANDS, "raises", (f"{__name__}:Raises", ""))
    monkeypatch.setattr(Raises, "error", error)
    assert main(["raises"]) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(line)
    assert err.count("\n") == 1
    if code < 128:
        kinds = {1: "input", 3: "exists", 4: "space", 5: "missing"}
        assert main(["raises", "--json"]) == code
        printed = json.loads(capsys.readouterr().out)["error"]
        named = (printed["kind"], printed["code"], printed["type"])
        assert named == (kinds[code], code, type(error).__name__)
        assert line.endswith(printed["message"])
        assert printed["path"] == getattr(error, "filename", None)
        with pytest.raises(type(error)):
            main(["raises", "--debug"])


@pytest.mark.parametrize(
    ("platform", "word", "written"),
    [
        ("linux", "my scan.ply", "'my scan.ply'"),
        ("linux", "torch>=2.4", "'torch>=2.4'"),
        ("linux", "a/b.ply", "a/b.ply"),
        ("win32", r"C:\scans\a.ply", r"C:\scans\a.ply"),
        ("win32", r"C:\my scans\a.ply", r'"C:\my scans\a.ply"'),
        ("win32", "C:\\my scans\\", '"C:\\my scans\\\\"'),
        ("win32", "torch>=2.4", '"torch>=2.4"'),
        ("win32", "", '""'),
        ("win32", "activated=scales,colors", '"activated=scales,colors"'),
        ("win32", "@new.ply", '"@new.ply"'),
        ("win32", r"~\a.ply", r'"~\a.ply"'),
        ("win32", r"C:\PROGRA~1\a@b.ply", r"C:\PROGRA~1\a@b.ply"),
    ],
)
def test_commands_are_quoted_for_the_shell_of_the_system(monkeypatch, platform, word, written):
    monkeypatch.setattr(sys, "platform", platform)
    assert quoted(word) == written
    assert command_line(["meshsplats", Path("info"), word]) == f"meshsplats info {written}"


def test_errors_of_files_know_them(tmp_path):
    path = tmp_path / "a: b.ply"
    for message in (f"{path}: broken", f"{path}: property x: twice"):
        assert messages.error_record(FileFormatError(message))["path"] is None
    path.touch()
    for message in (f"{path}: broken", f"{path}: property x: twice"):
        assert messages.error_record(FileFormatError(message))["path"] == str(path)
    assert messages.error_record(ValueError("empty"))["path"] is None


def test_a_folder_in_place_of_a_file_is_named_as_one(monkeypatch, tmp_path):
    """Windows says that the permission is denied."""
    error = PermissionError(errno.EACCES, "Permission denied", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "win32")
    assert messages.one_line(error) == f"{tmp_path}: Is a directory"
    other = PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "a"))
    assert messages.one_line(other) == f"{tmp_path / 'a'}: Permission denied"


def test_what_terminals_obey_is_escaped(tmp_path, capsys):
    """Names in files from strangers could set the title of a window, hide lines or turn their direction."""
    path = tmp_path / "a.ply"
    names = [*"xyz", "opacity", "f_dc_0", "rot_0", "scale_0", "\x1b]0;owned\7\x1b[2J"]
    properties = "".join(f"property float {name}\n" for name in names)
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 0\n{properties}end_header\n")
    assert main(["convert", str(path), "-o", str(tmp_path / "a.npz")]) == 1
    said = capsys.readouterr().err
    assert said.rstrip("\n").isprintable()
    assert r"\x1b]0;owned\x07\x1b[2J" in said
    messages.say("\u202e Fran\u00e7ais, \u65e5\u672c")
    assert capsys.readouterr().err == "meshsplats: \\u202e Fran\u00e7ais, \u65e5\u672c\n"
    Command().finish(None, "a\tb\nc\x1b\r")
    assert capsys.readouterr().out == "a\tb\nc\\x1b\\r\n"
    names = ["a[/b].png", "[red]", ":cat:"]
    print_table(("view", "dB"), [("\x1b[2Ja", "30"), *((name, "31") for name in names)])
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines()] == ["view", r"\x1b[2Ja", *names]


def test_the_mesh_of_train_is_not_replaced_by_its_splats(tmp_path, monkeypatch, capsys):
    """By whatever path they are named."""
    monkeypatch.chdir(tmp_path)
    assert main(["train", "photos", "-o", "mesh.ply", "--as-splats", str(tmp_path / "mesh.ply")]) == 2
    assert "--as-splats must not be the mesh itself" in capsys.readouterr().err


def test_bugs_are_not_hidden(monkeypatch):
    monkeypatch.setitem(COMMANDS, "raises", (f"{__name__}:Raises", ""))
    monkeypatch.setattr(Raises, "error", AttributeError("a bug"))
    with pytest.raises(AttributeError):
        main(["raises"])


@dataclass
class Warns(Command):
    """A command that warns."""

    def execute(self) -> None:
        warnings.warn("3 splats were\nleft out", DataWarning, stacklevel=1)
        print("done")


def test_warnings_are_one_line(monkeypatch, capsys):
    monkeypatch.setitem(COMMANDS, "warns", (f"{__name__}:Warns", ""))
    before = warnings.showwarning
    for _ in range(2):  # each time, not only the first
        assert main(["warns"]) == 0
        assert capsys.readouterr() == ("done\n", "meshsplats: warning: 3 splats were left out\n")
    assert warnings.showwarning is before


def test_info_on_splats(tmp_path, capsys):
    save_gaussians(cloud(), tmp_path / "scene.ply")
    assert main(["info", str(tmp_path / "scene.ply"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["splats"], found["sh_degree"], found["kernel"]) == ("splats", 30, 1, "3dgs")
    assert found["format"] == "ply"
    assert found["faint_splats"] == 1
    assert found["flatness_median"] == pytest.approx(0.5)
    np.testing.assert_allclose(found["lower"], cloud().means.min(axis=0), rtol=1e-5)
    np.testing.assert_allclose(found["scale_5_50_95_percent"], [0.35 / 3] * 3, rtol=1e-4)
    assert found["bytes"] == (tmp_path / "scene.ply").stat().st_size
    assert found["estimated_triangles"] > 0
    assert main(["info", str(tmp_path / "scene.ply")]) == 0
    assert "sh degree" in capsys.readouterr().out


def test_info_on_a_model_folder(tmp_path, capsys):
    folder = tmp_path / "point_cloud" / "iteration_7"
    folder.mkdir(parents=True)
    save_gaussians(cloud(), folder / "point_cloud.ply")
    save_cameras(orbit(cloud(), 4, up=(0, 0, 1)), tmp_path / "cameras.json")
    assert main(["info", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["splats"], found["cameras"], found["up_by_cameras"]) == (30, 4, [0, 0, 1])
    # A broken camera file there is no reason to refuse the splats.
    (tmp_path / "cameras.json").write_text("{")
    assert main(["info", str(tmp_path), "--json"]) == 0
    out, err = capsys.readouterr()
    assert "cameras" not in json.loads(out)
    assert "not a JSON file" in err


@pytest.mark.parametrize("suffix", ["npz", "ply", "glb"])
def test_info_on_a_mesh(tmp_path, capsys, suffix):
    mesh = SplatMesh(np.eye(3), np.array([[0, 1, 2]]), np.full((3, 4), 0.5), face_splat=np.array([4]))
    save_mesh(mesh, tmp_path / f"mesh.{suffix}")
    assert main(["info", str(tmp_path / f"mesh.{suffix}"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["vertices"], found["triangles"], found["splats"]) == ("mesh", 3, 1, 1)
    assert found["upper"] == [1, 1, 1]
    assert found["up"] == [0, -1, 0]


def test_info_on_data_sets(tmp_path, capsys):
    def printed(path) -> dict:
        assert main(["info", str(path), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    colmap = simple_colmap(tmp_path / "colmap", count=9)
    found = printed(colmap)
    assert (found["kind"], found["layout"], found["images"]) == ("data set", "COLMAP", 9)
    assert (found["training_views"], found["held_out_views"], found["split"]) == (7, 2, "every 8th by name")
    assert (found["lenses"], found["undistorted_when_read"]) == (["PINHOLE"], False)
    assert found["bytes_in_memory"] == 9 * 3 * np.prod(found["image_sizes"][0])
    assert "points" not in found
    model = Path(found["read_from"])
    (model / "points3D.txt").write_text("# a comment\n1 0 0 0 9 9 9 0.5 1 2\n\n2 0 0 1 9 9 9 0.5 1 2\n")
    assert printed(colmap)["points"] == 2
    (model / "points3D.bin").write_bytes((3).to_bytes(8, "little") + bytes(3 * 51))
    assert printed(colmap)["points"] == 3
    (model / "points3D.bin").write_bytes((1 << 60).to_bytes(8, "little"))
    assert "points" not in printed(colmap)
    (model / "test.txt").write_text("p00\n")
    found = printed(colmap)
    assert (found["held_out_views"], found["split"]) == (1, "the data set's own")

    cameras = orbit(make_scene(200), 3, width=16, height=16)
    images = [np.concatenate([np.zeros((16, 16, 3)), np.full((16, 16, 1), 0.5)], axis=2)] * 3
    folder = write_photographs(tmp_path / "studio", cameras, images)
    for path in (folder, folder / "transforms.json"):
        found = printed(path)
        assert (found["layout"], found["with_alpha"], found["with_masks"]) == ("nerfstudio", 3, 0)
        assert found["split"] == "every 8th by name"
    save_cameras(cameras, tmp_path / "cameras.json")
    assert printed(tmp_path / "cameras.json")["kind"] == "cameras"
    (tmp_path / "empty").mkdir()
    assert main(["info", str(tmp_path / "empty")]) == 1


def test_info_on_cameras(tmp_path, capsys):
    save_cameras(orbit(cloud(), 3, width=20, height=10), tmp_path / "c.json")
    assert main(["info", str(tmp_path / "c.json"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["cameras"], found["image_sizes"]) == ("cameras", 3, [[20, 10]])


@pytest.mark.parametrize(
    ("content", "words"), [(b"", "empty"), (b"GIF89a", "neither splats"), (b"ply\nbroken", "x.bin")]
)
def test_info_on_anything_else(tmp_path, capsys, content, words):
    (tmp_path / "x.bin").write_bytes(content)
    assert main(["info", str(tmp_path / "x.bin")]) == 1
    assert words in capsys.readouterr().err
    assert main(["info", str(tmp_path / "missing")]) == 1
    assert "missing: No such file" in capsys.readouterr().err


def test_doctor(capsys, monkeypatch):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["meshsplats"] == meshsplats.__version__
    assert found["core"]["works"]
    assert found["core"]["in_use"] in found["core"]["available"]
    assert found["threads"] >= 1
    assert found["required"]["numpy"] == np.__version__
    assert found["gpu"]["works"] == (found["gpu"]["problem"] is None)
    assert found["gpu"]["adapter"] or not found["gpu"]["works"]
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "in use" in out
    assert f"gpu: {found['gpu']['adapter'] or found['gpu']['problem']}" in out
    assert f"view-dependent colours: drawn by {', '.join(found['harmonics_drawn_by'])}; other" in out

    from meshsplats.operations import installation

    needed = [f"no-such-thing>=1; extra == {extra!r}" for extra in ("gpu", "blender")]
    monkeypatch.setattr(installation.metadata, "requires", lambda _: needed)
    monkeypatch.setattr(installation, "_draws", lambda *_: False)
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert f"pip install {quoted('no-such-thing>=1')}\n" in out
    assert f'from a clone or a wheel: pip install "{PACKAGE}[blender]"\n' in out
    assert "DOES NOT WORK" in out


@pytest.mark.parametrize(
    ("text", "direction"),
    [
        ("-y", (0, -1, 0)),
        ("z", (0, 0, 1)),
        ("+X", (1, 0, 0)),
        ("0,0.5,-1", (0, 0.5, -1)),
        ("-1,0,0", (-1, 0, 0)),
    ],
)
def test_up(text, direction):
    np.testing.assert_array_equal(parse_up(text), direction)


@pytest.mark.parametrize("text", ["", "w", "--y", "yy", "1,2", "1,2,3,4", "nan,0,0", "0,0,0", "a,b,c"])
def test_up_that_is_none(text):
    with pytest.raises(ValueError, match=r"^up must be an axis"):
        parse_up(text)


def test_colors():
    assert parse_color("Black") == (0, 0, 0)
    assert parse_color("#ff8000") == (1, 128 / 255, 0)
    assert parse_color("0.1,0.2,0.3") == (0.1, 0.2, 0.3)
    for text in ("", "mauve", "#ff80", "#gg0000", "1,2,3", "0,0"):
        with pytest.raises(ValueError, match=r"^background must be white"):
            parse_color(text)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted by Linux")
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one processor: BLAS has no threads")
@pytest.mark.parametrize(("variable", "more"), [(None, 0), ("2", 1)])
def test_the_command_leaves_the_processors_to_the_core(variable, more):
    """BLAS has no threads of its own, unless its variable says so."""
    program = (
        "import os\n"
        "from meshsplats.cli import main\n"
        "main(['doctor', '--help'])\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "import numpy\n"
        "print('threads', len(os.listdir('/proc/self/task')) - before)\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    if variable is not None:
        environment["OPENBLAS_NUM_THREADS"] = variable
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == f"threads {more}"


def test_one_splat_that_is_kept_is_no_plural(tmp_path, capsys):
    save_gaussians(cloud(1), tmp_path / "one.ply")
    assert main(["clean", str(tmp_path / "one.ply"), "-o", str(tmp_path / "clean.ply")]) == 0
    assert "\nkept: 1 splat, from [" in capsys.readouterr().out


@pytest.mark.parametrize(("encoding", "written"), [("cp1252", b"\\u573a"), ("utf-8", "\u573a".encode())])
def test_names_that_standard_output_cannot_encode_end_nothing(tmp_path, monkeypatch, encoding, written):
    """Redirected, Windows has a code page there, and Python's surrogateescape."""
    path = tmp_path / "\u573a.ply"
    save_gaussians(make_scene(200), path)
    output = io.TextIOWrapper(io.BytesIO(), encoding, errors="surrogateescape")
    monkeypatch.setattr(sys, "stdout", output)
    assert main(["convert", str(path), "-o", str(tmp_path / "\u573a.npz"), "--no-preview"]) == 0
    output.flush()
    assert written in output.buffer.getvalue()


def test_a_pipe_that_is_closed_on_windows(monkeypatch):
    class Closed(io.StringIO):
        def write(self, text):
            raise OSError(22, "Invalid argument")

    closed = []
    monkeypatch.setattr("meshsplats._common.streams.close_output", lambda: closed.append(1))
    monkeypatch.setattr(sys, "stdout", Closed())
    assert main(["--version"]) == 1
    monkeypatch.setattr(sys, "platform", "win32")
    assert main(["--version"]) == 141
    assert closed == [1]


def test_a_file_without_a_command(tmp_path, capsys):
    path = tmp_path / "my scene.ply"
    path.touch()
    assert main([str(path)]) == 2
    assert f"a file needs a command before it: meshsplats view '{path}'" in capsys.readouterr().err


@pytest.mark.parametrize(("code", "said"), [(None, "Is a directory"), (32, "used by another process")])
def test_folders_in_use_on_windows_are_not_said_to_be_folders(tmp_path, monkeypatch, code, said):
    monkeypatch.setattr(sys, "platform", "win32")
    error = PermissionError(13, "The folder is used by another process", str(tmp_path))
    error.winerror = code
    assert said in one_line(error)
