"""The benchmarks' scripts and the files that their figures are recorded in."""

from __future__ import annotations

import argparse
import re
import runpy
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from _local import script

pytest.importorskip("resource", reason="the benchmarks measure memory as POSIX systems count it")

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "benchmarks"
SCRIPTS = sorted(path for path in FOLDER.rglob("*.py") if not path.name.startswith("_"))
if not SCRIPTS:
    pytest.skip("the benchmarks are not here", allow_module_level=True)

common = script("benchmarks/_common.py")

ASKED = argparse.Namespace(save=True)


def name_of(script: Path) -> str:
    return script.relative_to(FOLDER).as_posix()


def results_of(script: Path) -> str:
    return name_of(script).replace("/", "_").replace(".py", ".md")


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(common, "RESULTS", tmp_path / "results")
    return tmp_path / "results"


def record(*words: str, figure: object, script: str = "rendering.py") -> None:
    with common.Report(ASKED, [str(FOLDER / script), *words, "--save"]) as report:
        report.table("scene", "ms")
        report.row("small", figure)


@pytest.mark.parametrize("script", SCRIPTS, ids=name_of)
def test_a_script_names_its_command_and_shares_what_is_common(script):
    _, docstring, text = script.read_text("utf-8").split('"""', 2)
    assert f" benchmarks/{name_of(script)}" in docstring
    assert "arguments(__doc__" in text
    assert "Report(" in text
    assert "meshsplats.cli" not in text
    scenes = {scene.splats for scene in (common.SCENES | common.PHOTOGRAPHED).values()}
    for own in ("ArgumentParser(", "perf_counter", "process_time", "    print(", *scenes):
        assert own not in text, f"{own}: benchmarks/_common.py has it"


@pytest.mark.parametrize("script", SCRIPTS, ids=name_of)
def test_help_needs_no_data_and_no_extra(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])
    for extra in ("torch", "bpy", "wgpu"):
        monkeypatch.setitem(sys.modules, extra, None)
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(script), run_name="__main__")
    assert end.value.code == 0
    assert "--save" in capsys.readouterr().out


def test_a_saved_run_replaces_its_own_figures_alone(results):
    record("--repeat", "7", figure=198)
    record("--growth", figure=395)
    record("--repeat", "7", figure=201)
    text = (results / "rendering.md").read_text("utf-8")
    assert "198" not in text
    assert text.count("| small | 201 |") == text.count("| small | 395 |") == 1
    assert text.index("201") < text.index("395")
    assert text.count(common.BEGIN) == text.count(common.END) == 2
    assert "\n`python benchmarks/rendering.py --repeat 7`:\n20" in text
    assert common.machine().split(",")[0] in text


def test_what_is_said_around_figures_stays(results):
    record(figure=1)
    path = results / "rendering.md"
    path.write_text("# Rendering\n\nBefore.\n\n" + path.read_text("utf-8") + "\nAfter, and *why*.\n", "utf-8")
    record(figure=2)
    text = path.read_text("utf-8")
    assert text.startswith("# Rendering\n\nBefore.\n")
    assert text.endswith("\nAfter, and *why*.\n")
    assert "| small | 2 |" in text
    assert "| small | 1 |" not in text


def test_nothing_is_recorded_unasked_or_of_a_run_that_failed(results):
    with common.Report(argparse.Namespace(save=False), ["rendering.py"]) as report:
        report.say("a line")
    with pytest.raises(ZeroDivisionError), common.Report(ASKED, ["rendering.py", "--save"]):
        _ = 1 / 0
    assert not results.exists()


def test_a_row_is_as_wide_as_its_table():
    report = common.Report(argparse.Namespace(save=False), ["rendering.py"])
    report.table("scene", "ms")
    with pytest.raises(AssertionError, match="1 cells in a table of 2 columns"):
        report.row("small")


def test_places_of_this_machine_are_not_recorded(results):
    script = str(FOLDER / "viewers" / "alpha.py")
    words = [script, "/home/me/guitar.ply", "--data", "/home/me", "--only", "layers=2 spacing=0", "--save"]
    report = common.Report(ASKED, words)
    assert report.command == (
        "python benchmarks/viewers/alpha.py guitar.ply --data DATA --only 'layers=2 spacing=0'"
    )
    assert report.path == results / "viewers_alpha.md"


def test_works_take_turns_after_a_warm_up():
    done = []
    times = common.in_turns([lambda: done.append("a"), lambda: done.append("b")], 2)
    assert "".join(done) == "ababab"
    assert [len(each.wall) for each in times] == [len(each.processor) for each in times] == [2, 2]


def test_splats_of_other_trainers_are_scored_as_evaluate_does(monkeypatch):
    """Clipped, and the better one of two backgrounds is that of the higher number."""
    monkeypatch.syspath_prepend(FOLDER)
    trainers = script("benchmarks/trainers.py")
    data = argparse.Namespace(test=[argparse.Namespace(camera=None, image=np.ones((16, 16, 3)))])
    assert trainers.scores(lambda _: np.full((16, 16, 3), 1.5), data) == ("inf (inf)", "1.000")
    assert max([("9.87 (9.50)", "0.9"), ("14.49 (14.58)", "0.8")], key=trainers.psnr_of)[1] == "0.8"


def test_recorded_files_belong_to_scripts_and_are_linked_from_the_first_screen():
    first = (FOLDER / "RESULTS.md").read_text("utf-8")
    names = {results_of(script) for script in SCRIPTS}
    for path in sorted((FOLDER / "results").iterdir()):
        assert path.name in names, f"{path.name} belongs to no script"
        assert f"](results/{path.name}" in first, f"RESULTS.md does not lead to {path.name}"
        text = path.read_text("utf-8")
        commands = re.findall(f"{common.BEGIN}\n`(python benchmarks/.*?)`:\\s", text)
        assert len(commands) == text.count(common.BEGIN) == text.count(common.END), path.name
        assert max(Counter(commands).values(), default=1) == 1, f"{path.name} has figures twice"
        for command in commands:
            script = ROOT / command.split()[1]
            assert results_of(script) == path.name, f"{path.name} has figures of {script.name}"


def test_the_first_screen_says_where_scripts_without_a_file_have_their_figures():
    first = (FOLDER / "RESULTS.md").read_text("utf-8")
    alone = [script for script in SCRIPTS if not (FOLDER / "results" / results_of(script)).exists()]
    assert [name_of(script) for script in alone if f"`{name_of(script)}`" not in first] == []


def test_the_source_names_results_that_exist():
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "tools").rglob("*.py")]:
        for name in re.findall(r"benchmarks/[\w/]+\.\w+", path.read_text("utf-8")):
            assert (ROOT / name).exists(), f"{path} names {name}"
