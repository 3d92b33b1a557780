"""Options have one name in the library, in double backquotes; only the command line writes flags."""

from __future__ import annotations

import ast
import re
import warnings
from pathlib import Path

import pytest

import meshsplats
from meshsplats.cli import main
from meshsplats.errors import DataWarning, FileFormatError, OptionsError, with_options
from meshsplats.formats.outputs import check_outputs

ROOT = Path(meshsplats.__file__).parent
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
NOT_OURS = {
    "_common/foreign.py": {"--load-config", "--output-dir"},  # nerfstudio
    "errors.py": {"--index-url"},  # pip
    "formats/mesh_formats.py": {"--lit"},  # the table of docs/files.md
    "formats/meshes.py": {"--colors"},  # of bake: a whole command to type, whoever says it
    "blender/launch.py": {"--version", "--background", "--factory-startup", "--python-exit-code", "--python"},
}
"""Flags of other programs, of a page, and of another command."""
STILL = {
    "blender/__init__.py": {"--max-triangles"},
    "blender/launch.py": {"--executable", "--engine"},
    "blender/inside/__init__.py": {"--executable"},
    "surfaces/atlas.py": {"--texture"},
}
"""Ours that are left. Take out what does not stand there any more; put nothing in."""


def texts(tree: ast.AST) -> list[str]:
    """The string literals of a source, without docstrings and other strings that nothing reads."""
    idle = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in idle]
    return [node.value for node in found if isinstance(node.value, str)]


def flags() -> dict[str, set[str]]:
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        if not name.startswith("cli/"):
            tree = ast.parse(path.read_text("utf-8"))
            found[name] = {flag for text in texts(tree) for flag in FLAG.findall(text)}
    return {name: names - NOT_OURS.get(name, set()) for name, names in found.items()}


@pytest.mark.slow
def test_messages_of_the_library_name_no_flags():
    assert {name: names for name, names in flags().items() if names} == STILL


def test_flags_are_found_in_any_text_but_docstrings():
    tree = ast.parse(
        'def f(x):\n    """Not --this."""\n    raise E(f"{x}: give --that" " --or-this") # --nor\n'
    )
    assert [FLAG.findall(text) for text in texts(tree)] == [["--that", "--or-this"]]
    assert FLAG.findall("a---b, x--y, -- z") == []


@pytest.mark.parametrize("kind", [OptionsError, FileFormatError, DataWarning])
def test_errors_and_warnings_name_options_as_the_program_that_shows_them(kind):
    error = kind("give ``max_splats``, not ``crop``")
    assert str(error) == "give max_splats, not crop"
    assert error.spelled(str.upper) == "give MAX_SPLATS, not CROP"
    assert with_options("``a b`` and `c` stay", str.upper) == "``a b`` and `c` stay"


def test_the_command_line_writes_flags_in_errors_and_in_warnings(tmp_path, capsys):
    cameras = tmp_path / "cameras.json"
    cameras.write_text("[]", "utf-8")
    assert main(["render", str(cameras), "-o", str(tmp_path / "image.png")]) == 1
    assert "(--cameras takes cameras)" in capsys.readouterr().err
    ply = tmp_path / "activated.ply"
    kinds = {"f_dc": 3, "scale": 3, "rot": 4}
    of = {kind: [f"{kind}_{i}" for i in range(count)] for kind, count in kinds.items()}
    names = [*"xyz", *of["f_dc"], "opacity", *of["scale"], *of["rot"]]
    header = "".join(f"property float {name}\n" for name in names)
    rows = "".join(f"{i} 0.2 0.3 1 0 0.5 0.5 0.01 0.02 0.03 1 0 0 0\n" for i in range(400))
    ply.write_text(f"ply\nformat ascii 1.0\nelement vertex 400\n{header}end_header\n{rows}", "ascii")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        meshsplats.load_gaussians(ply)
    assert any("; if so, activated=" in str(warning.message) for warning in caught)
    assert main(["info", str(ply)]) == 0
    assert "; if so, --set activated=" in capsys.readouterr().err
    mesh = str(tmp_path / "mesh.npz")
    assert main(["convert", str(ply), "-o", mesh]) == 0
    capsys.readouterr()
    assert main(["convert", str(ply), "-o", mesh]) == 3
    assert "--force overwrites it" in capsys.readouterr().err
    with pytest.raises(FileExistsError, match="give ``force`` to overwrite it"):
        check_outputs([Path(mesh)], False)
