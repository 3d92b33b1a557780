"""Help and configuration files of the command line."""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path

import numpy as np
import pytest
from _splats import few_splats

from meshsplats import _toml as toml
from meshsplats.cli import COMMANDS, main
from meshsplats.cli.arguments import INVOCATION, Command, options_of
from meshsplats.cli.messages import flag
from meshsplats.formats.gaussians import save_gaussians

SMALL = ("--views", "4", "--held-out", "2", "--width", "32", "--steps", "3")


def command(name: str) -> type[Command]:
    module, _, attribute = COMMANDS[name][0].partition(":")
    return getattr(importlib.import_module(module), attribute)


def printed_help(name: str, option: str, capsys) -> str:
    assert main([name, option]) == 0
    return capsys.readouterr().out


def flags_in(text: str) -> set[str]:
    """Options that have an entry of their own."""
    entries = re.findall(r"^(?:│ |  )(-.*)", text, re.MULTILINE)
    names = {name for entry in entries for name in re.findall(r"--[a-z][a-z0-9-]*", entry.split("  ")[0])}
    return names - {"--help"}


@pytest.fixture
def splats(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkdir("in")
    save_gaussians(few_splats(), "in/scene.ply")
    return "in/scene.ply"


# ---- Help


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_the_common_options_and_help_all_shows_all(name, capsys):
    kind = command(name)
    every, common = set(options_of(kind)), set(kind.COMMON)
    assert common <= every
    positional = {"compare": {"splats", "mesh"}, "evaluate": {"mesh"}}.get(name, {"input"})

    def flags(names):
        return {flag(option) for option in names if option not in positional}

    whole = printed_help(name, "--help-all", capsys)
    assert "``" not in whole
    assert flags_in(whole) == flags(every)
    short = printed_help(name, "--help", capsys)
    assert flags_in(short) == flags(common or every)
    last = short.splitlines()[-1]
    hidden = len(every - common) if common else 0
    assert (f"{hidden} more options: --help-all." in last) == bool(hidden)
    assert ("--config FILE" in last) == kind.CONFIGURABLE


def test_help_names_options_by_their_flags(capsys):
    text = " ".join(printed_help("convert", "--help", capsys).replace("│", " ").split())
    assert "see --budget. In mode 'flat', unless --sides, --rings, --rim-radius or --center-opacity" in text


def test_the_help_of_finetune_fits_a_screen(capsys):
    assert len(printed_help("finetune", "--help", capsys).splitlines()) < 60


# ---- Configuration files


def content(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


@pytest.mark.parametrize(
    ("arguments", "result"),
    [
        (["finetune", "in/scene.ply", *SMALL, "--seed", "3", "--sides", "6"], "made.npz"),
        (
            ["convert", "in/scene.ply", "--preset", "paper", "--crop", "-1", "-1", "-1", "9", "9", "9"],
            "made.glb",
        ),
        (["render", "in/scene.ply", "--width", "40", "--as-splats", "--up=-z"], "made.png"),
        (["simplify", "in/scene.ply", "--share", "0.5", "--no-preview"], "made.ply"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else value,
)
def test_a_run_is_repeated_from_its_configuration(splats, tmp_path, monkeypatch, arguments, result):
    os.mkdir("out")
    assert main([*arguments, "-o", f"out/{result}"]) == 0
    first = content(f"out/{result}")
    config = f"out/{result}.config.toml"
    again = [arguments[0], "--config", config]
    assert main(again) == 3  # nothing is overwritten
    assert main([*again, "-o", f"again-{result}"]) == 0
    assert content(f"again-{result}") == first
    # Paths in it are relative to its folder: it works from everywhere.
    monkeypatch.chdir(tmp_path / "in")
    assert main([arguments[0], f"--config=../{config}", "--force"]) == 0
    assert content(f"../out/{result}") == first
    before, after = toml.load(tmp_path / config), toml.load(tmp_path / f"again-{result}.config.toml")
    for record in (before, after):
        del record["invocation"], record["options"]["input"], record["options"]["output"]
    assert before == after


@pytest.mark.parametrize(
    ("arguments", "results"),
    [
        (["render", "in/scene.ply", "--orbit", "2", "--width", "16"], ["view_0001.png", "turntable.webp"]),
        (["compare", "in/scene.ply", "--orbit", "2", "--width", "16"], ["view_0001.png"]),
        (["levels", "in/scene.ply", "--no-tune", "--levels", "2", "--width", "32"], ["level_1.glb"]),
    ],
    ids=lambda value: value[0],
)
def test_a_folder_of_results_is_repeated_from_its_configuration(splats, arguments, results):
    assert main([*arguments, "-o", "first"]) == 0
    assert main([arguments[0], "--config", "first/config.toml", "-o", "second"]) == 0
    for name in results:
        assert content(f"first/{name}") == content(f"second/{name}")
    assert main([arguments[0], "--config", "second/config.toml", "--force"]) == 0


def test_each_output_of_several_formats_is_repeated_alone(splats):
    assert main(["convert", "in", "-o", "out", "--formats", "glb", "npz", "--lit", "--max-splats", "9"]) == 0
    for name in ("scene.glb", "scene.npz"):
        assert main(["convert", "--config", f"out/{name}.config.toml", "-o", f"again-{name}"]) == 0
        assert content(f"again-{name}") == content(f"out/{name}")


def test_an_interrupted_run_is_resumed_from_its_configuration(splats, capsys):
    """Its folder has one from the start, with paths relative to that."""
    assert main(["finetune", splats, "-o", "made.npz", *SMALL]) == 0
    again = ["finetune", "--config", "made.npz.run/command.toml", "--resume", "--force"]
    assert main([*again, "--steps", "4"]) == 0
    assert main([*again, "--steps", "5", "--sides", "6"]) == 1
    assert "--sides was not given and is 6" in capsys.readouterr().err


def test_the_command_line_wins(splats):
    assert main(["convert", splats, "-o", "a.npz", "--sides", "6", "--no-preview", "--mode", "flat"]) == 0
    save_gaussians(few_splats().take(np.arange(9)), "nine.ply")
    again = ["convert", "nine.ply", "--config", "a.npz.config.toml", "--sides", "8", "-o", "b.npz"]
    assert main([*again, "--no-no-preview"]) == 0
    options = toml.load(Path("b.npz.config.toml"))["options"]
    assert (options["input"], options["sides"], options["mode"]) == (["nine.ply"], 8, "flat")
    assert os.path.exists("b.npz.preview.png")


def test_one_option_of_an_exclusive_group_replaces_another(splats):
    assert main(["simplify", splats, "-o", "a.ply", "--count", "9", "--no-preview"]) == 0
    assert main(["simplify", "--config", "a.ply.config.toml", "-o", "b.ply", "--share", "0.5"]) == 0
    options = toml.load(Path("b.ply.config.toml"))["options"]
    assert options["share"] == 0.5
    assert "count" not in options


def test_a_configuration_written_by_hand(splats, capsys):
    with open("run.toml", "w") as file:
        file.write('[options]\ninput = ["in/scene.ply"]\noutput = "mesh.npz"\ncenter_opacity = 1\n')
    assert main(["convert", "--config", "run.toml", "--json"]) == 0
    assert toml.load(Path("mesh.npz.config.toml"))["options"]["center_opacity"] == 1.0


def test_changed_records_are_not_taken_for_options(splats, capsys):
    assert main(["convert", splats, "-o", "a.npz", "--preset", "paper", "--no-preview"]) == 0
    text = content("a.npz.config.toml").decode().replace("rim_radius = 2.7", "rim_radius = 3.0")
    with open("a.npz.config.toml", "w") as file:
        file.write(text)
    capsys.readouterr()
    assert main(["convert", "--config", "a.npz.config.toml", "-o", "b.npz"]) == 0
    assert "rim_radius is 2.7 now, and was 3.0" in capsys.readouterr().err


def test_a_run_from_standard_input_needs_its_input_again(splats, capsys):
    with open("run.toml", "w") as file:
        file.write('[options]\ninput = ["-"]\noutput = "a.npz"\n')
    assert main(["convert", "--config", "run.toml"]) == 2
    assert main(["convert", splats, "--config", "run.toml"]) == 0


HOSTILE = {
    "huge": ("#" * 99 + "\n") * 1000,
    "long line": "a = [" + "1, " * 3000 + "]",
    "deep": "a = " + "[" * 4000,
    "deep keys": "a" + ".a" * 2000 + " = 1",
    "a long number": "a = " + "9" * 4900,
    "many digits": "[options]\nminutes = 0x" + "f" * 4900,
    "many digits of a whole number": "[options]\nsteps = 0x" + "f" * 4900,
    "no TOML": "<html>",
    "binary": "\0\1\2",
    "unknown table": "[option]\nwidth = 3",
    "unknown option": "[options]\nwidht = 3",
    "unknown option with control characters": '[options]\n"\\u001b[2J\\n" = 3',
    "text for a number": '[options]\nsteps = "3"',
    "a number for text": "[options]\nup = 3",
    "a boolean for a number": "[options]\nsteps = true",
    "a fraction for a whole number": "[options]\nsteps = 1.5",
    "no such choice": '[options]\npreset = "best"',
    "too few values": "[options]\ncrop = [1.0, 2.0]",
    "a table for a value": "[options.width]\na = 1",
    "deep keys of an option": "[options]\nwidth" + ".a" * 2000 + " = 1",
    "lists in lists": "[options]\ncrop = [[1], [2], [3], [4], [5], [6]]",
    "a date": "[options]\nsteps = 1979-05-27",
    "a path with NUL": '[options]\noutput = "a\\u0000.npz"',
    "options that are none": 'options = "x"',
    "another command": 'command = "convert"',
    "a command that is none": "command = [1]",
    "overwriting": "[options]\nforce = true",
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_hostile_configurations_end_in_one_clear_line(splats, capsys, text):
    with open("run.toml", "w") as file:
        file.write(text)
    assert main(["finetune", splats, "-o", "t.npz", "--config", "run.toml"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("meshsplats: error: run.toml: ")
    assert err.count("\n") == 1
    assert len(err) < 400
    assert err[:-1].isprintable()
    assert sorted(os.listdir()) == ["in", "run.toml"]


@pytest.mark.parametrize("option", INVOCATION)
def test_a_configuration_neither_overwrites_nor_names_programs(splats, capsys, option):
    with open("run.toml", "w") as file:
        file.write(f"[options]\n{option} = true")
    name = "blender" if option == "executable" else "finetune"
    assert main([name, splats, "-o", "a.png", "--config", "run.toml"]) == 2
    assert f"{flag(option)} is for the command line only" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["convert", "--config", "none.toml"], 1, "none.toml: No such file"),
        (["convert", "--config", "in"], 1, "in: Is a directory"),
        (["convert", "--config"], 2, "--config needs a file"),
        (["convert", "--config", "a", "--config", "b"], 2, "give one --config"),
        (["info", "in/scene.ply", "--config", "a"], 2, "--config has no effect"),
    ],
)
def test_wrong_usage_of_configurations(splats, capsys, arguments, code, words):
    assert main(arguments) == code
    assert words in capsys.readouterr().err


def test_every_configuration_can_be_read_again(tmp_path):
    record = {
        "text": 'a "b" \\ \t \n \x00 \x7f ü 漢 \U0001f600',
        "numbers": [1, -2.5, 1e-15, 1e300, 2**62],
        "many": [f"name {i}" for i in range(50)],
        "nothing": None,
        "empty": [],
        "table": {"yes": True, "a key": {"deeper": 1}, "b": {"c": {"d": "e"}}},
    }
    (tmp_path / "a.toml").write_text(toml.dumps(record), encoding="utf-8")
    del record["nothing"]
    assert toml.load(tmp_path / "a.toml") == record
    assert toml.dumps({"path": "a\udcff"}) == 'path = "a\ufffd"\n'


def test_large_files_are_not_read(tmp_path):
    with open(tmp_path / "a.toml", "wb") as file:
        file.truncate(1 << 33)
    with pytest.raises(ValueError, match="larger than 64 KiB"):
        toml.load(tmp_path / "a.toml")


@pytest.mark.parametrize("name", [name for name in COMMANDS if command(name).CONFIGURABLE])
def test_exclusive_groups_name_options(name):
    kind = command(name)
    known = options_of(kind)
    assert [option for group in kind.EXCLUSIVE for option in group if option not in known] == []
    assert {"json", "force"} <= set(INVOCATION) & set(known)
