"""``import meshsplats`` as type checkers, editors and ``help`` see it."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

import meshsplats
from meshsplats.conversion.options import ConversionChanges, ConversionOptions
from meshsplats.finetuning.config import FinetuneChanges, FinetuneConfig

ROOT = Path(__file__).parents[1]
EXTRAS = (
    "torch",
    "PIL",
    "tyro",
    "rich",
    "wgpu",
    "pxr",
    "bpy",
    "zstandard",
    "pycolmap",
    "pymeshlab",
    "distributed",
)
"""Modules of the extras, and of the command line."""


def names_for_checkers() -> set[str]:
    """The names that the package's TYPE_CHECKING block imports."""
    tree = ast.parse(Path(meshsplats.__file__).read_text("utf-8"))
    block = next(n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    return {alias.name for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}


def test_checkers_and_python_see_the_same_names():
    assert names_for_checkers() == set(meshsplats._MODULES)
    assert set(meshsplats.__all__) == set(meshsplats._MODULES) | {"__version__"}
    assert meshsplats.__all__ == sorted(meshsplats.__all__)
    assert dir(meshsplats) == meshsplats.__all__


def test_every_public_name_is_there_with_its_documentation():
    for name in sorted(meshsplats._MODULES):
        value = getattr(meshsplats, name)
        assert inspect.getdoc(value), name
        if inspect.isfunction(value):
            assert value.__name__ == name
            for parameter in inspect.signature(value).parameters.values():
                assert parameter.annotation is not parameter.empty, f"{name}: {parameter}"


def alone(code: str) -> str:
    """What Python prints for ``code`` where only NumPy is installed."""
    block = f"import sys; sys.modules.update(dict.fromkeys({EXTRAS}))\nimport meshsplats as ms\n"
    done = subprocess.run([sys.executable, "-c", block + code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_looking_around_needs_no_extra():
    """For ``help``, editors and doctest."""
    shown = alone(
        "import doctest, inspect, pydoc\n"
        "members = dict(inspect.getmembers(ms))\n"
        "assert set(members) == set(ms.__all__) and all(hasattr(ms, name) for name in ms.__all__)\n"
        "print(doctest.testmod(ms).failed)\n"
        "print(inspect.signature(ms.rasterize))\n"
        "from meshsplats import *\n"
        "print(rasterize.__doc__.splitlines()[0])\n"
        "print(pydoc.plain(pydoc.render_doc(ms)))\n"
    )
    failed, signature, doc, *page = shown.splitlines()
    assert failed == "0"
    assert "cameras: 'Camera | Sequence[Camera]'" in signature
    assert doc == "The images that ``render`` gives, differentiable once."
    for name in ("rasterize", "convert", "GaussianCloud"):
        assert any(re.search(rf"^    (class )?{name}\(", line) for line in page), name


def test_what_needs_torch_says_so_when_it_is_called():
    shown = alone(
        "from meshsplats import rasterize\n"
        "try:\n"
        "    rasterize(None, None, None, [])\n"
        "except ms.MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    assert shown.startswith("rasterize needs torch; the build for processors will do: pip install torch")


@pytest.mark.parametrize(
    ("keywords", "options"), [(ConversionChanges, ConversionOptions), (FinetuneChanges, FinetuneConfig)]
)
def test_keywords_are_the_fields_of_their_options(keywords, options):
    typed = {name: hint for name, hint in get_type_hints(options).items() if name != "preset"}
    assert get_type_hints(keywords) == typed, "a new option needs a line in both"


def test_a_name_that_is_not_there():
    with pytest.raises(AttributeError, match="no attribute 'convrt'"):
        meshsplats.convrt  # noqa: B018


# By mypy


def check(folder: Path, sources: dict[str, str], *options: str) -> str:
    """What mypy says of these modules beside the package."""
    if importlib.util.find_spec("mypy") is None:
        pytest.skip("mypy is not installed (extra dev)")
    for name, text in sources.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    paths = [str(folder / f"{name}.py") for name in sources]
    common = ["--follow-imports=silent", "--config-file=", "--ignore-missing-imports", "--check-untyped-defs"]
    result = subprocess.run(
        [
            sys.executable,
            "-m",
            "mypy",
            *common,
            *options,
            f"--cache-dir={ROOT / '.mypy_cache' / 'tests'}",
            *paths,
        ],
        capture_output=True,
        text=True,
        cwd=folder,
        env={"MYPYPATH": str(ROOT / "src"), "PATH": ""},
        timeout=300,
    )
    return result.stdout + result.stderr


def snippets() -> dict[str, str]:
    """The Python of the README and the documents, one module for each file, and the examples."""
    found = {}
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        blocks = re.findall(r"^```python\n(.*?)^```", path.read_text("utf-8"), flags=re.M | re.S)
        if blocks:
            found[f"{path.stem}_md"] = "\n".join(blocks)
    for path in sorted((ROOT / "examples").glob("[0-9]*.py")):
        found[f"example_{path.stem}"] = path.read_text("utf-8")
    return found


@pytest.mark.slow
def test_documents_and_examples_type_check(tmp_path):
    found = snippets()
    assert len(found) > 8
    assert check(tmp_path, found).startswith("Success")


BEGIN = "import meshsplats as ms\n\ncloud = ms.load_gaussians('scene.ply')\nmesh = ms.convert(cloud)\n"
WRONG = {
    "a misspelt function": ("ms.convrt(cloud)", "has no attribute"),
    "a wrong option": ("ms.convert(cloud, no_such=1)", 'Unexpected keyword argument "no_such"'),
    "an option of a wrong type": ("ms.convert(cloud, sides='eight')", "incompatible type"),
    "a value that is not there": ("ms.convert(cloud, mode='round')", "incompatible type"),
    "a wrong field": ("ms.ConversionOptions(sidse=8)", "Unexpected keyword argument"),
    "things exchanged": ("ms.render(cloud, ms.orbit(mesh)[0])", "incompatible type"),
    "a wrong setting": (
        "ms.finetune(mesh, ms.splat_dataset(cloud), minuts=2)",
        "Unexpected keyword argument",
    ),
    "an attribute that is not there": ("ms.render(mesh, ms.orbit(mesh)[0]).colour", "has no attribute"),
}


def test_mistakes_are_refused(tmp_path):
    """Each by the line on which it stands, and nothing else."""
    text = BEGIN + "".join(f"{line}\n" for line, _ in WRONG.values())
    said = check(tmp_path, {"mistakes": text})
    begin = BEGIN.count("\n")
    for number, (line, message) in enumerate(WRONG.values(), begin + 1):
        found = re.findall(rf"^mistakes\.py:{number}: error: (.*)$", said, flags=re.M)
        assert any(message in text for text in found), f"{line}: {found}\n{said}"
    lines = {int(n) for n in re.findall(r"^mistakes\.py:(\d+): error", said, flags=re.M)}
    assert lines == set(range(begin + 1, begin + 1 + len(WRONG)))


def test_values_have_their_types(tmp_path):
    text = BEGIN + (
        "image = ms.render(mesh, ms.orbit(mesh)[0])\n"
        "reveal_type(ms.convert)\n"
        "reveal_type(image)\n"
        "reveal_type(ms.psnr(image.color, image.color))\n"
    )
    said = check(tmp_path, {"hints": text})
    assert "Any" not in re.sub(r"ndarray\[.*?\]\]\]?", "", said)
    assert "ConversionOptions" in said
    assert "rendering.api.Rendering" in said
    assert '"float"' in said or '"builtins.float"' in said
