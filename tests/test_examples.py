"""The numbered examples run as they are."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

import meshsplats
from meshsplats import BaseMesh, GaussianCloud, demo_scene, surfaces
from meshsplats.errors import MissingDependencyError
from meshsplats.surfaces import make_surface

ARGUMENTS = {
    "06_mesh_prior": ["2"],
    "08_photographs": ["12", "64", "20"],
    "09_own_loop": ["6"],
    "10_surface": ["64"],
}
"""Fewer and smaller images, and fewer steps, run the same lines."""
SURFACES = {"views": 8, "size": 64, "resolution": 48, "texture": 512, "rounds": 1}
"""At most, of the surfaces that examples make."""
QUALITY = Path(__file__).parents[1] / "docs" / "quality.md"
EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))


def small_surface(splats: GaussianCloud, **options: Any) -> BaseMesh:
    """That of ``make_surface``, which takes what the example says, but for the sizes."""
    sizes = {name: min(options.get(name, most), most) for name, most in SURFACES.items()}
    return make_surface(splats, **options | sizes)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, tmp_path, monkeypatch, capsys):
    # A smaller scene takes less time and runs the same lines.
    small = demo_scene.make_scene(2_000)
    monkeypatch.setattr(demo_scene, "make_scene", lambda: small)
    for module in (meshsplats, surfaces):
        monkeypatch.setattr(module, "make_surface", small_surface)
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


@pytest.mark.slow
def test_the_table_of_quality_is_what_the_example_prints(monkeypatch, capsys):
    """Other processors round in another way."""
    (example,) = [path for path in EXAMPLES if path.stem == "03_compare"]
    monkeypatch.setattr(sys, "argv", [str(example)])
    runpy.run_path(str(example), run_name="__main__")
    printed = [float(found) for found in re.findall(r"PSNR ([\d.]+) dB", capsys.readouterr().out)]
    rows = (QUALITY.read_text(encoding="utf-8").partition("| 160,000 triangles |")[2]).split("\n\n")[0]
    written = [float(found) for found in re.findall(r"\b\d\d\.\d\d\b", rows)]
    by_row = [score for scores in zip(printed[:4], printed[4:], strict=True) for score in scores]
    assert by_row == pytest.approx(written, abs=0.02)


def test_examples_are_here():
    assert len(EXAMPLES) >= 4
