"""What documents tell users to type and to look for: options, files of a run, ways to install."""

from __future__ import annotations

import importlib
import re
from functools import cache
from pathlib import Path

import pytest

from meshsplats._common.options import settings
from meshsplats._core import library
from meshsplats.cli import COMMANDS
from meshsplats.cli.arguments import options_of
from meshsplats.cli.messages import flag
from meshsplats.cli.train import Train
from meshsplats.finetuning import cells, journal, pace
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.training import run as training
from meshsplats.training.config import USUAL_SPLATS

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "SECURITY.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "integrations").rglob("*.md")),
]
PROSE = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
COLUMNS = 120
FENCE = re.compile(r"^ *(`{3,}|~{3,}).*?^ *\1", re.MULTILINE | re.DOTALL)
WHOLE = re.compile(r" *(\|| {4}|!\[|<|(?:[-*] )?\[[^]]*\]\([^)]*\)[.,;:]?$|\S+$)")
"""Lines that cannot be broken: rows of tables, indented code, images, HTML, a link or a word alone."""
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9_-]*")
COMMAND = re.compile(r"meshsplats (\w+)((?:\\\n|[^`\n#])*)")
OF_ALL_COMMANDS = {"--help", "--help-all", "--config", "--set"}
OF_OTHERS = {
    *("--repeat", "--replay", "--save", "--seconds", "--tier", "--rehearsal", "--wheel"),  # of our scripts
    *("--command", "--enable", "--python", "--repo"),  # Blender
    *("--memory-limit", "--nthreads", "--nworkers"),  # Dask
    *("--editable", "--index-url", "--no-deps", "--no-install-recommends", "--platform"),  # pip, apt
    *("--algorithm", "--eval", "--no_points", "--scale_min"),  # the code of MeshSplats' paper and of 3DGS
    *("--backend", "--cpus", "--directory", "--keep-crs", "--method"),  # nerfbaselines, Docker, OpenSplat
}
FILES_OF_A_RUN = {
    *(journal.CHECKPOINT, journal.METRICS, journal.CONFIGURATION, journal.PREVIEWS),
    *(RunFiles(Path("a")).command.name, RunFiles(Path("a")).held_out.name, pace.RECORD, cells.CELLS),
    *(training.START, training.SO_FAR, training.COVERAGE),
}


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def options(command: str) -> dict[str, bool]:
    """The options of a command by their names, and whether they have flags."""
    module, _, attribute = COMMANDS[command][0].partition(":")
    known = options_of(getattr(importlib.import_module(module), attribute))
    return {name: option.has_flag for name, option in known.items()}


def flags(command: str) -> set[str]:
    return OF_ALL_COMMANDS | {flag(name) for name, has_flag in options(command).items() if has_flag}


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_options_in_documents_exist(path):
    text = path.read_text("utf-8")
    known = set().union(*map(flags, COMMANDS)) | OF_OTHERS
    assert set(FLAG.findall(text)) <= known
    for command, words in COMMAND.findall(text):
        if command in COMMANDS:
            assert set(FLAG.findall(words)) <= flags(command), f"{command}{words}"
            assert set(re.findall(r"--set (\w+)=", words)) <= set(options(command)), f"{command}{words}"


def test_files_of_a_run_in_documents_are_written():
    named = {
        (name_of(path), name)
        for path in DOCUMENTS
        for name in re.findall(r"\.run/(\w[\w.]*\w)", path.read_text("utf-8"))
    }
    assert len(named) > 4
    assert [each for each in sorted(named) if each[1] not in FILES_OF_A_RUN] == []


def test_help_and_page_say_how_many_fans_become_splats():
    text = (ROOT / "docs" / "training.md").read_text("utf-8").partition("`--as-splats splats.ply`")[2]
    for said in (settings(Train)["as_splats"].help, text):
        assert f"{USUAL_SPLATS:,}" in said


def test_no_index_is_asked_for_a_package_that_is_on_none(monkeypatch):
    """Where the package is there already, pip adds an extra by its name."""
    by_name = re.compile(r"""pip install ["']?meshsplats(?!\[)|-env/bin/pip install ["']?meshsplats""")
    for path in [*DOCUMENTS, *(ROOT / "integrations").rglob("*.py")]:
        found = by_name.findall(path.read_text("utf-8"))
        assert len(found) == (path.name == "releasing.md"), path  # after the upload
    monkeypatch.delenv("MESHSPLATS_LIBRARY", raising=False)
    monkeypatch.setattr(library, "available_variants", list)
    with pytest.raises(ImportError, match=r"a clone or a wheel \(pip install /path/to/meshsplats\)"):
        library.load_core.__wrapped__()


def test_what_pip_installs_is_in_quotes_that_every_shell_takes():
    """Single ones are part of the name in cmd."""
    sources = [*(ROOT / "src").rglob("*.py"), *(ROOT / "integrations").rglob("*.py")]
    single = re.compile(r"pip[\"'f\s]+install[\"f\s]+'[^\s\"]+\[")
    assert [path for path in [*DOCUMENTS, *sources] if single.search(path.read_text("utf-8"))] == []


def long_lines(text: str) -> list[str]:
    """Lines of prose that are longer than ``COLUMNS``."""
    lines = FENCE.sub("", text).splitlines()
    return [line for line in lines if len(line) > COLUMNS and not WHOLE.match(line)]


def test_long_lines_are_found_in_prose_alone():
    long = "word " * 30
    wholes = [
        f"| {long}|",
        f"    {long}",
        f"![{long}](a.png)",
        f"- [{long}](a.md)",
        "word" * 40,
        f"```\n{long}\n```",
    ]
    assert long_lines("\n".join(wholes)) == []
    assert len(long_lines(f"- {long}\n[a](b.md) {long}\n```sh\n```\n{long}")) == 3


@pytest.mark.parametrize("path", PROSE, ids=name_of)
def test_lines_of_prose_are_short(path):
    assert long_lines(path.read_text("utf-8")) == []
