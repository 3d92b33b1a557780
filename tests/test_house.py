"""Limits that keep the source readable: lengths of files and lines, parameters, a thin command line."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "meshsplats"
LONGEST_FILE = 450
LONGEST_LINE = 110
MOST_PARAMETERS = 8
MOST_LINES_OF_THE_COMMAND_LINE = 3500
KINDS = {".py", ".h", ".cpp", ".js", ".wgsl", ".html", ".css"}

WIDER = {
    "cameras/trajectories.py: dome": "public",
    "cameras/trajectories.py: orbit": "public",
    "datasets/splat_targets.py: splat_dataset": "public",
    "evaluation/benchmarks.py: run_benchmark": "public",
    "evaluation/comparison.py: compare": "public",
    "evaluation/comparison.py: compare_views": "public",
    "evaluation/report.py: evaluate": "public",
    "formats/gltf/writer.py: write_glb": "as public",
    "formats/meshes.py: save_mesh": "public",
    "rendering/api.py: render": "public",
    "rendering/autograd.py: rasterize": "public",
    "rendering/reference.py: render": "as in the library",
    "rendering/reference_autograd.py: rasterize": "as in the library",
}
"""Functions of more parameters, and why."""


def sources() -> dict[str, str]:
    return {
        path.relative_to(SOURCE).as_posix(): path.read_text("utf-8")
        for path in sorted(SOURCE.rglob("*"))
        if path.suffix in KINDS
    }


def too_many_parameters(text: str) -> list[str]:
    """Names of the functions."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            given = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
            if sum(each.arg not in ("self", "cls") for each in given) > MOST_PARAMETERS:
                found.append(node.name)
    return found


def with_line_ends_of_the_system(text: str) -> list[str]:
    """Calls that write text to files, with \\r\\n on Windows."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call) or {key.arg for key in node.keywords} & {"newline", "force_zip64"}:
            continue
        called = ast.unparse(node.func)
        values = [*node.args, *(key.value for key in node.keywords)]
        modes = {value.value for value in values if isinstance(value, ast.Constant)}
        opened = called.rpartition(".")[2] in ("open", "fdopen") and modes & {"a", "w", "x"}
        if (opened or called.endswith(".write_text")) and "devnull" not in ast.unparse(node):
            found.append(ast.unparse(node))
    return found


def test_files_are_short():
    longer = [name for name, text in sources().items() if len(text.splitlines()) > LONGEST_FILE]
    assert longer == []


def test_lines_are_short():
    """Formatters see to Python and C++; nothing else does to WGSL and JavaScript. Remarks to tools may stand
    beyond the limit."""
    remark = re.compile(r"  # (noqa|type: ignore).*")
    wide = [
        f"{name}:{number}"
        for name, text in sources().items()
        if not name.endswith((".html", ".css"))
        for number, line in enumerate(text.splitlines(), 1)
        if len(remark.sub("", line)) > LONGEST_LINE
    ]
    assert wide == []


def test_functions_take_few_parameters_or_are_named_with_a_reason():
    wider = {
        f"{name}: {function}"
        for name, text in sources().items()
        if name.endswith(".py")
        for function in too_many_parameters(text)
    }
    assert wider == set(WIDER), "name what takes more, and take out what does not"


def test_parameters_are_counted_without_self():
    names = [f"p{i}" for i in range(MOST_PARAMETERS)]
    few = f"class A:\n    def f(self, {', '.join(names)}): ..."
    assert too_many_parameters(few) == []
    assert too_many_parameters(few.replace("p0", "p0, *, more")) == ["f"]


def test_text_has_the_same_line_ends_on_every_system():
    assert len(with_line_ends_of_the_system("p.write_text(a)\nopen(p, 'a')\np.open(mode='w')")) == 3
    assert (
        with_line_ends_of_the_system("open(p, 'wb')\nopen(p)\nwrite_text(p, a)\nopen(p, 'x', newline='')")
        == []
    )
    written = {
        name: with_line_ends_of_the_system(text) for name, text in sources().items() if name[-3:] == ".py"
    }
    assert {name: calls for name, calls in written.items() if calls} == {}


def test_the_command_line_is_thin():
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in (SOURCE / "cli").rglob("*.py"))
    assert lines <= MOST_LINES_OF_THE_COMMAND_LINE


def test_only_the_command_itself_imports_the_command_line():
    """Benchmarks, tools and Blender's extension use the library. One page lists the command's options."""
    users = [*ROOT.glob("benchmarks/**/*.py"), *ROOT.glob("tools/**/*.py"), *ROOT.glob("examples/**/*.py")]
    users += ROOT.glob("blender_extension/**/*.py")
    assert len(users) > 20
    found = [path.name for path in users if "meshsplats.cli" in path.read_text("utf-8")]
    assert found == ["options_page.py"]
