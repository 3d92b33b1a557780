"""What a newcomer meets: imports that are quick, a package that is whole, documents that are true."""

from __future__ import annotations

import ast
import contextlib
import importlib
import pkgutil
import re
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from _photographs import write_photographs

import meshsplats
from meshsplats import cli, demo_scene
from meshsplats._common import toml
from meshsplats._core import library
from meshsplats.cameras.trajectories import orbit
from meshsplats.errors import MissingDependencyError
from meshsplats.formats.gaussians import load_gaussians
from meshsplats.rendering import render_splats

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(
    (ROOT / "docs").glob("*.md")
)

NUMPY_ALONE = """
import sys
class OnlyNumpy:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in ("numpy", "meshsplats"):
            raise ModuleNotFoundError(f"{name} is not needed for this")
sys.meta_path.insert(0, OnlyNumpy())
"""


def run(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_loads_no_module_of_ours_before_it_is_used():
    loaded = run("import sys, meshsplats; print(*[m for m in sys.modules if m.startswith('meshsplats')])")
    assert set(loaded.split()) == {"meshsplats", "meshsplats._common", "meshsplats._common.lazy"}


def test_everything_public_needs_numpy_alone():
    """Inside other programs' Python, Blender's say, there is nothing else."""
    run(NUMPY_ALONE + "import meshsplats\nfor name in meshsplats.__all__: getattr(meshsplats, name)")


def test_converting_drawing_and_saving_need_numpy_alone(tmp_path):
    program = f"""
import meshsplats as ms
from meshsplats.demo_scene import make_scene
cloud = make_scene(200)
ms.save_gaussians(cloud, {str(tmp_path / "s.ply")!r})
mesh = ms.convert(ms.load_gaussians({str(tmp_path / "s.ply")!r}))
for name in ("m.npz", "m.ply", "m.glb"):
    ms.save_mesh(mesh, {str(tmp_path)!r} + "/" + name)
    mesh = ms.load_mesh({str(tmp_path)!r} + "/" + name)
camera = ms.orbit(mesh, 1, width=32, height=32)[0]
print(ms.psnr(ms.render(mesh, camera).color, ms.render_splats(cloud, camera).color) > 10)
"""
    assert run(NUMPY_ALONE + program).strip() == "True"


def test_public_names_are_there_and_others_are_not():
    for name in meshsplats.__all__:
        assert getattr(meshsplats, name) is not None
    assert set(meshsplats.__all__) <= set(dir(meshsplats))
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = meshsplats.no_such_name


def test_every_module_imports():
    for module in pkgutil.walk_packages(meshsplats.__path__, "meshsplats."):
        # The core's variants are libraries for ctypes, not modules, and __main__ runs a command.
        if not re.search(r"\._core\.meshsplats_\w+$|\.__main__$", module.name):
            with contextlib.suppress(MissingDependencyError):  # extras need not be installed
                importlib.import_module(module.name)


def test_package_holds_its_core_its_kernels_and_its_type_marker():
    kernels = ("common", "lists", "sorting", "raster", "triangles", "image", "tape", "gradients", "filter")
    for name in (*kernels, "training"):
        assert (Path(meshsplats.__file__).parent / "webgpu" / f"{name}.wgsl").is_file()
    assert library.library_path("baseline") is not None
    assert (Path(meshsplats.__file__).parent / "py.typed").is_file()
    assert "baseline" in library.available_variants()


def test_metadata_asks_for_little_and_caps_nothing():
    required = [line.partition(";") for line in metadata.requires("meshsplats") or [] if "extra" not in line]
    names = {re.match(r"[\w.-]+", need)[0].lower() for need, _, marker in required if not marker}  # type: ignore[index]
    assert names == {"numpy", "pillow", "tyro", "rich"}
    assert {need.partition(">")[0] for need, _, marker in required if marker} <= {"tomli"}
    assert not [need for need, _, _ in required if "<" in need or "==" in need]


def test_the_lowest_versions_are_tested():
    """The first line of a package in lowest-constraints.txt, which make test-lowest installs, is the lowest
    version of it that pyproject.toml allows."""
    required = toml.load(ROOT / "pyproject.toml")["project"]["dependencies"]
    allowed = dict(re.match(r"([\w-]+)>=([\d.]+)(?:;.*)?$", line).groups() for line in required)  # type: ignore[union-attr]
    text = (ROOT / "lowest-constraints.txt").read_text(encoding="utf-8")
    tested = dict(reversed(re.findall(r"^([\w-]+)==([\d.]+)", text, re.MULTILINE)))
    assert tested == allowed


# ---- The documents


def code_blocks(path: Path, language: str) -> list[str]:
    text = path.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def resolves(dotted: str) -> bool:
    """Whether a dotted name can be imported and looked up."""
    parts = dotted.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except MissingDependencyError:
            return True  # it is there, but what it holds can be seen with its extra only
        except ImportError:
            continue
        for part in parts[cut:]:
            if not hasattr(found, part) and part not in getattr(found, "__dataclass_fields__", {}):
                return False
            found = getattr(found, part, None)
        return True
    return False


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_names_in_documents_exist(path):
    text = path.read_text(encoding="utf-8")
    # `meshsplats.module.name`, and `GaussianCloud.colors` of a public class.
    names = set(re.findall(r"`(meshsplats(?:\.\w+)+)", text))
    classes = [name for name in meshsplats.__all__ if name[0].isupper()]
    names |= {"meshsplats." + n for n in re.findall(rf"`((?:{'|'.join(classes)})\.\w+)", text)}
    assert [name for name in sorted(names) if not resolves(name)] == []
    # Files of the project by name or link; what commands write is not among them.
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text) + re.findall(r'src="([^":]+)"', text)
    assert [link for link in links if not (path.parent / link).exists()] == []


def test_architecture_names_files_that_exist():
    package = ROOT / "src" / "meshsplats"
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:\w+/)*\w+\.(?:py|h|cpp)|(?:\w+/)+)`", text))
    assert len(named) > 10
    assert [n for n in sorted(named) if not (package / n).exists() and not (ROOT / n).exists()] == []


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    demo_scene.main([str(path), "300"])
    return path


@pytest.mark.nightly
@pytest.mark.parametrize("page", ["docs/commands.md", "README.md"])
def test_commands_of_the_documents_work(page, scene_file, tmp_path, monkeypatch, capsys):
    """One after the other in one folder, on a small scene and with small images."""
    for name in ("skimage", "uvunwrap"):
        pytest.importorskip(name, reason="surface needs its extra: pip install 'meshsplats[base]'")
    lines = "".join(code_blocks(ROOT / page, "sh")).replace("\\\n", " ").splitlines()
    commands = [shlex.split(line, comments=True) for line in lines if line.startswith("meshsplats ")]
    # blender needs an environment of its own, where tests/blender runs it; demo runs some of these commands.
    least = (
        set(cli.COMMANDS) - {"blender", "demo"} if page != "README.md" else {"view", "convert", "finetune"}
    )
    assert {command[1] for command in commands} >= least
    monkeypatch.chdir(tmp_path)
    for name in ("scene.ply", "city.ply"):
        (tmp_path / name).write_bytes(scene_file.read_bytes())
    cameras = orbit(load_gaussians(scene_file), 9, width=32, height=32)
    images = [render_splats(load_gaussians(scene_file), camera).color for camera in cameras]
    write_photographs(tmp_path / "photos", cameras, images)
    for command in commands:
        small = ["--width", "48"] if command[1] in ("render", "compare") and "--width" not in command else []
        if command[1] == "finetune":
            at = command.index("--minutes")
            command[at : at + 2] = []
            small = ["--width", "48", "--views", "3", "--held-out", "1", "--steps", "2"]
        if command[1] == "train":
            at = command.index("--minutes")
            command[at : at + 2] = ["--steps", "2"]
        if command[1] == "evaluate":
            small = ["--strips", "1"]
        if command[1] == "levels":
            small = ["--no-tune", "--width", "48", "--levels", "2"]
        if command[1] == "surface":
            small = ["--resolution", "16", "--views", "6", "--size", "96", "--rounds", "1"]
            small += [] if "--texture" in command else ["--texture", "128"]
        if command[1] == "deform":
            (tmp_path / "edited.obj").write_bytes((tmp_path / "base.obj").read_bytes())
        if command[1] == "prior":
            small = ["--width", "48", "--views", "3", "--held-out", "1", "--steps", "2"]
        assert cli.main([*command[1:], *small]) == 0, f"{shlex.join(command)}\n{capsys.readouterr().err}"


@pytest.mark.parametrize("page", ["docs/python.md", "README.md"])
def test_python_of_the_documents_runs(page, scene_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.ply").write_bytes(scene_file.read_bytes())
    blocks = code_blocks(ROOT / page, "python")
    assert blocks
    scope: dict = {}
    for block in blocks:
        exec(compile(ast.parse(block), page, "exec"), scope)


def test_make_targets_of_the_documents_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for path in DOCUMENTS:
        for target in re.findall(r"(?:^ *|`)make ([\w-]+)", path.read_text(encoding="utf-8"), re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{path.name} has make {target}"
