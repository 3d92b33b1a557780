"""The numbered examples run as they are."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from meshsplats import demo_scene
from meshsplats.errors import MissingDependencyError

ARGUMENTS = {"08_photographs": ["12", "64", "20"], "10_surface": ["64"]}
"""Fewer and smaller images, and fewer steps, run the same lines."""
EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, tmp_path, monkeypatch, capsys):
    # A smaller scene takes less time and runs the same lines.
    small = demo_scene.make_scene(2_000)
    monkeypatch.setattr(demo_scene, "make_scene", lambda: small)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example), *ARGUMENTS.get(example.stem, [])])
    try:
        runpy.run_path(str(example), run_name="__main__")
    except MissingDependencyError as error:
        pytest.skip(str(error))
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        pytest.skip(f"{example.name} needs torch")
    printed = capsys.readouterr().out
    assert printed, "an example prints its results"
    for written in (tmp_path / "example-output").glob("*"):
        assert written.stat().st_size > 0
        assert written.name in printed


def test_examples_are_here():
    assert len(EXAMPLES) >= 4
