"""Fixtures of all tests, and which tests run."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from _needs import lacking, skipped_lines
from _tiers import TIERS, has_none, of_tier
from hypothesis import settings

if TYPE_CHECKING:
    from _browser import Browser

# There are as many workers of pytest-xdist as processors. Threads of BLAS and of PyTorch for each of them,
# which wait for work in loops, would take a seventh of the time of all.
if "PYTEST_XDIST_WORKER" in os.environ:
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

examples = int(os.environ.get("MESHSPLATS_EXAMPLES", 25))
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=examples)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def node_package() -> Callable[[str], Path]:
    """Gives the folder where a package of npm is installed, which no test installs itself."""

    def found(name: str) -> Path:
        own = Path(__file__).parents[1] / "build" / "node"
        folder = Path(os.environ.get("MESHSPLATS_NODE_FOLDER") or own)
        if shutil.which("node") is None or not (folder / "node_modules" / name).exists():
            lacking("node", f"{name} is not here")
        return folder

    return found


VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
(async () => {
  const reports = [];
  for (const file of process.argv.slice(1))
    reports.push((await validator.validateBytes(new Uint8Array(fs.readFileSync(file)))).issues);
  console.log(JSON.stringify(reports));
})();
"""


@pytest.fixture(scope="session")
def gltf_issues(node_package: Callable[[str], Path]) -> Callable[..., list[dict[str, Any]]]:
    """Gives what the Khronos validator has to say of each of some files."""
    folder = node_package("gltf-validator")

    def found(*files: Path) -> list[dict[str, Any]]:
        command = ["node", "-e", VALIDATE, *map(str, files)]
        done = subprocess.run(command, cwd=folder, capture_output=True, check=True, timeout=60)
        reports: list[dict[str, Any]] = json.loads(done.stdout)
        assert len(reports) == len(files)
        return reports

    return found


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--tier", choices=TIERS, default="all", help="which tests, see tests/_tiers.py")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """To import all files takes each worker half a minute."""
    return has_none(collection_path, config.getoption("tier")) or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    items[:], others = of_tier(items, config.getoption("tier"))
    if others:
        config.hook.pytest_deselected(items=others)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says what was left out or skipped, and how to get it."""
    if (tier := terminalreporter.config.getoption("tier")) != "all":
        commands = {"quick": "make test", "slow": "make test-slow", "nightly": "make test-nightly"}
        others = ", ".join(command for other, command in commands.items() if tier != other)
        terminalreporter.write_line(f"tests of other tiers are left out: {others}")
    skipped = [report.longrepr for report in terminalreporter.stats.get("skipped", [])]
    for line in skipped_lines(str(where[2]) for where in skipped if isinstance(where, tuple)):
        terminalreporter.write_line(line)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A headless Chromium, for the tests of the viewer; skips where there is none."""
    from _browser import PROGRAM, Browser

    if PROGRAM is None:
        lacking("browser", "Chromium is not installed here")
    if not hasattr(os, "posix_spawn"):
        pytest.skip("Chromium is driven through pipes, which needs a POSIX system")
    try:
        running = Browser()
        running.send("Browser.getVersion", timeout=120)
    except (OSError, TimeoutError, ConnectionError) as error:
        lacking("browser", f"Chromium does not start here: {error}")
    yield running
    running.close()


@pytest.fixture(scope="session")
def write_page(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """Writes the page of a mesh under a name and returns its address on the disk."""
    from meshsplats.viewer.page import make_page

    folder = tmp_path_factory.mktemp("pages")

    def write(mesh: Any, name: str = "scene", **arguments: Any) -> str:
        path = folder / f"{name}.html"
        path.write_text(make_page(mesh, **arguments).html, encoding="utf-8")
        return path.as_uri()

    return write


def pytest_runtest_teardown() -> None:
    """tyro 0.9.16 keeps the options that a command does not know, and prints them again for the next command
    in the same process."""
    if (module := sys.modules.get("tyro._argparse_formatter")) is not None:
        module.global_unrecognized_arg_and_prog = []
