"""Help and configuration files of the command line."""

from __future__ import annotations

import importlib
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Literal, get_args, get_origin

import numpy as np
import pytest
import tyro
from _splats import few_splats

from meshsplats._common import toml
from meshsplats._common.help_titles import Captured
from meshsplats._common.misuse import in_one_line
from meshsplats._common.options import alternatives
from meshsplats.cli import COMMANDS, main
from meshsplats.cli.arguments import (
    _PARSED,
    INVOCATION,
    Command,
    _read_settings,
    _taken_apart,
    options_of,
    parse,
)
from meshsplats.cli.messages import flag
from meshsplats.formats.gaussians import save_gaussians

FIELDS = {"chain", "draw", "files", "laying", "light", "part", "reading", "target", "tuning"}
"""Names of groups of options that mean nothing to a reader: their titles are in words."""
SMALL = ("--views", "4", "--held-out", "2", "--width", "32", "--steps", "3")
NUMBERS = 'numbers with commas are one word, in quotes in PowerShell: "1,2,3"'


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


@pytest.mark.parametrize(
    "line",
    [
        "convert a.ply b/ -o out/ --formats glb npz --max-splats 9 --force",
        "render a.ply -o b.png --look-at 1 -2 3e-1 --up=-z --width 5",
        "view a.ply --no-open --output b.html",
        "evaluate a.npz b.npz -o out/ --data photos --background white",
        "finetune a.ply -o b.glb --minutes 0.5 --opacity cutoff --json --threads 3",
        "blender a.ply -o b.blend --sun 30 -5 --samples 4",
        "surface a.ply -o b.usdc --unlit --collision drawn --levels 2",
    ],
)
def test_options_that_are_not_given_change_nothing(line):
    """Parsed with the given options alone, a line is the command that all options make of it."""
    name, *words = line.split()
    whole = tyro.cli(command(name), args=words, config=_PARSED)
    assert parse(command(name), f"meshsplats {name}", words) == whole


# ---- Help


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_the_common_options_and_help_all_shows_all(name, capsys):
    kind = command(name)
    options = options_of(kind)
    every, common = {name for name in options if options[name].has_flag}, set(kind.COMMON)
    assert common <= every
    positional = {"compare": {"splats", "mesh"}, "evaluate": {"mesh"}}.get(name, {"input"})

    def flags(names):
        return {flag(option) for option in names if option not in positional}

    whole = printed_help(name, "--help-all", capsys)
    assert "``" not in whole
    assert "None" not in whole, "no value of a shell"
    assert flags_in(whole) == flags(every)
    others = [name for name in options if name not in every]
    listed = f"--set NAME=VALUE sets further options (docs/options.md): {', '.join(others)}."
    assert (listed in " ".join(whole.split())) == bool(others)
    short = printed_help(name, "--help", capsys)
    assert flags_in(short) == flags(common or every)
    last = short.splitlines()[-1]  # --config, and how many more there are
    hidden = len(every - common) if common else 0
    assert (f"{hidden} more options: --help-all." in last) == bool(hidden)
    assert ("--config FILE" in last) == kind.CONFIGURABLE


def test_help_names_options_by_their_flags(capsys):
    text = " ".join(printed_help("convert", "--help", capsys).replace("│", " ").split())
    assert "--max-triangles N Largest number" in text
    text = " ".join(printed_help("blender", "--help-all", capsys).replace("│", " ").split())
    assert "Radiance of the even sky; not used with --hdri." in text
    text = " ".join(printed_help("finetune", "--help-all", capsys).replace("│", " ").split())
    cutoff = "--cutoff 0..1 Least opacity that is drawn. Only with --opacity 'cutoff'."
    assert f"{cutoff} (default: 0.2)" in text


@pytest.mark.parametrize("more", [[], ["--set", "sides=5"]])
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--maxtriangles", "5"], "there is no option --maxtriangles; did you mean '--max-triangles'?"),
        (["--order", "best"], "--order must be one of mesh, fragment, splat, file, got 'best'"),
        (["--minutes", "10m"], "--minutes must be a number, such as 10, got '10m'"),
        (["--steps", "2.5"], "--steps must be a whole number, such as 2, got '2.5'"),
        (["--steps"], "--steps needs a whole number"),
        (["--crop", "1", "2"], "--crop needs 6 values, got '1 2'"),
        (["--origin", "here"], "--origin needs one of keep, local or 3 values, got 'here'"),
        (["--force=3"], "--force takes no value, got '3'"),
        (["b.ply"], "unexpected argument 'b.ply'"),
        (["--minutes", "0"], "--minutes must be a number from 0.0001 to 100000, got 0.0"),
        (["--opaque-share", "2"], "--opaque-share must be a number from 0 to 1, got 2.0"),
        (["--cutoff", "0.3"], "--cutoff has no effect without --opacity cutoff, got --opacity blended"),
        (["--threads", "0"], "--threads must be at least 1, got 0"),
    ],
)
def test_wrong_words_end_in_one_clear_line(splats, capsys, words, message, more):
    assert main(["finetune", splats, "-o", "a.npz", *words, *more, "--json"]) == 2
    out, err = capsys.readouterr()
    assert err == f"meshsplats: error: {message} (see meshsplats finetune --help)\n"
    assert json.loads(out)["error"]["message"] == message


def test_what_is_missing_is_named(capsys):
    assert main(["train"]) == 2
    assert "error: the input and --output are missing (see" in capsys.readouterr().err
    assert main(["train", "--output", "a.npz"]) == 2
    assert "error: the input is missing (see" in capsys.readouterr().err


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("compare a b", "--output is missing"),
        ("evaluate x", "--output is missing"),
        ("convert a -o x.glb y.glb", "'y.glb' comes after an option: give all inputs before the options"),
        ("convert a -o x.glb --up 0.1 -1 0", f"'-1' comes after an option; {NUMBERS}"),
        ("view a --up 0.1 -1 0", f"unexpected argument '-1'; {NUMBERS}"),
        ("render a -o a.png --no-force", "there is no option --no-force: leave --force out"),
        ("render a -o=/t/a.png --bogus", "there is no option --bogus"),
        ("render a -ofoo.png --bogus", "there is no option --bogus"),
        ("render a -o a.png -orbit 8", "there is no option -orbit; did you mean '--orbit'?"),
        ("view a --background -1,2,3 --threads x", "--threads must be a whole number, got 'x'"),
        ("view a --title --json", "--title needs text"),
        ("view a --title -draft-", "--title needs text; one that begins with - is written --title=-draft-"),
    ],
)
def test_wrong_words_are_named_on_streams_of_any_encoding(line, message, encoding, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding))
    assert main(line.split()) == 2
    assert capsys.readouterr().err.startswith(f"meshsplats: error: {message} (see ")


@pytest.mark.parametrize(
    "box",
    [
        "╭─ Parsing error ───────╮\n│ It is wrong. │\n│ ──────────── │\n│ For full helptext, run │\n╰─────╯",
        "- Parsing error ---------\nIt is wrong.\n--------------\nFor full helptext, run x\n--------",
        "It is wrong.\nfor full helptext, run x",
    ],
)
def test_a_box_of_any_lines_becomes_one_line(box):
    assert in_one_line(box) == "It is wrong."


@pytest.mark.parametrize("name", ["utf-8", "UTF-8", "utf8", "ascii", "cp1252"])
def test_the_stand_in_has_the_encoding_of_its_stream(name, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), name)
    monkeypatch.setattr("sys.stdout", stream)
    assert (Captured().encoding == "utf-8") == (name.lower().replace("-", "") == "utf8")
    assert Captured().isatty() is False
    stream.isatty = lambda: True
    assert Captured().isatty() is True


@pytest.mark.skipif(tyro.__version__.startswith("0."), reason="this tyro draws lines on every stream")
@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_help_is_legible_on_streams_without_lines(encoding):
    call = [sys.executable, "-m", "meshsplats", "convert", "--help"]
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    text = subprocess.run(call, env=environment, capture_output=True, check=True).stdout.decode(encoding)
    assert "\\u" not in text
    titles = re.findall(r"^ (\S.*?) *\n -----", text, re.MULTILINE)
    assert "output files" in titles
    assert not {f"{name} options" for name in FIELDS} & set(titles)


def test_photographs_are_given_by_their_folder(capsys):
    assert main(["train", "IMG_1.JPG", "IMG_2.JPG", "-o", "a.npz"]) == 2
    assert "give the folder of the photographs, not the photographs themselves" in capsys.readouterr().err


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_titles_for_readers_and_no_default_twice(name, capsys):
    whole = printed_help(name, "--help-all", capsys)
    titles = re.findall(r"╭─ (.+?) ─+╮", whole)
    assert len({len(line) for line in whole.splitlines() if line[:1] in ("╭", "╰")}) == 1
    assert [title for title in titles if " options" in title] == []
    assert FIELDS.isdisjoint(titles)
    for words in re.split(r" (?=--[a-z])", " ".join(whole.replace("│", " ").split())):
        assert not re.search(r"Default: .*\(default: ", words) or "Rules:" in words, words
        values = re.findall(r"\(default: ([^;)]+); paper: ([^;)]+)\)", words)
        assert all(default != paper for default, paper in values), words


@pytest.mark.parametrize(("name", "most"), [("finetune", 45), ("convert", 34), ("train", 30), ("prior", 45)])
def test_commands_have_few_options(name, most, capsys):
    assert len(set(re.findall(r"--[a-z][a-z0-9-]+", printed_help(name, "--help-all", capsys)))) <= most


def test_the_help_of_finetune_fits_a_screen(capsys):
    assert len(printed_help("finetune", "--help", capsys).splitlines()) < 60


# ---- Configuration files


def content(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("arguments", "result"),
    [
        (["finetune", "in/scene.ply", *SMALL, "--seed", "3", "--set", "sides=6"], "made.npz"),
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
    assert main([*again, "--steps", "5", "--set", "sides=6"]) == 1
    assert "--set sides was not given and is 6" in capsys.readouterr().err


def test_the_command_line_wins(splats):
    assert (
        main(["convert", splats, "-o", "a.npz", "--set", "sides=6", "--no-preview", "--set", "mode=flat"])
        == 0
    )
    save_gaussians(few_splats().take(np.arange(9)), "nine.ply")
    again = ["convert", "nine.ply", "--config", "a.npz.config.toml", "--set", "sides=8", "-o", "b.npz"]
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


# ---- --set NAME=VALUE


def test_an_option_without_a_flag_is_set_by_its_name(splats):
    settings = ["rings=2", "center-opacity=1", "shrink_faint=False", "crop=-9,-9,-9,9,9,9"]
    words = [word for setting in settings for word in ("--set", setting)]
    assert main(["convert", splats, "-o", "a.npz", "--no-preview", *words]) == 0
    options = toml.load(Path("a.npz.config.toml"))["options"]
    assert (options["rings"], options["center_opacity"], options["shrink_faint"]) == (2, 1.0, False)
    assert options["crop"] == [-9, -9, -9, 9, 9, 9]
    again = ["convert", "--config", "a.npz.config.toml", "-o", "b.npz", "--set=rings=3"]  # which wins
    assert main(again) == 0
    options = toml.load(Path("b.npz.config.toml"))["options"]
    assert (options["rings"], options["center_opacity"]) == (3, 1.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--set", "beta3=0.5"], "--set: finetune has no option 'beta3'; did you mean 'beta2'?"),
        (["--set", "beta1"], "--set takes NAME=VALUE, got 'beta1'"),
        (["--set"], "--set takes NAME=VALUE, got ''"),
        (["--set", "=3"], "--set takes NAME=VALUE, got '=3'"),
        (["--set", "beta1=high"], "--set: beta1 must be a number, got 'high'"),
        (["--set", "rings=1.5"], "--set: rings must be a whole number, got '1.5'"),
        (["--set", "soft_edges=1"], "--set: soft_edges must be true or false, got '1'"),
        (["--set", "mode=round"], "--set: mode must be one of crossed, flat, 3d, got 'round'"),
        (["--set", "crop=1,2"], "--set: crop must be a list of 6 values, got '1,2'"),
        (["--set", "beta1=2"], "--set beta1 must be a number from 0 to 0.99999, got 2.0"),
        (["--set", "beta1=nan"], "--set beta1 must be a number from 0 to 0.99999, got nan"),
        (["--set", "beta1=0.5", "--set", "beta1=0.6"], "--set beta1 is given twice"),
        (["--steps", "3", "--set", "steps=4"], "give --steps or --set steps, not both"),
        (["--beta1", "0.5"], "--beta1 is not an option of its own: write --set beta1=VALUE"),
        (["--rim-radius=2"], "--rim-radius is not an option of its own: write --set rim_radius=VALUE"),
    ],
)
def test_wrong_settings_end_in_one_clear_line(splats, capsys, words, message):
    assert main(["finetune", splats, "-o", "t.npz", *words]) in (1, 2)
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert f"meshsplats: error: {message}" in err
    assert os.listdir() == ["in"]


def test_every_option_without_a_flag_can_be_set():
    """Whatever its type: its default is understood, written as --set has it."""
    for name in COMMANDS:
        kind = command(name)
        for option, found in options_of(kind).items():
            texts = {bool: "true", int: "1", float: "1", str: "text", Path: "a.txt"}
            if not found.has_flag:
                value = sample(found.hint, texts)
                words = ["in", "-o", "out", "--set", f"{option}={value}"]
                assert _taken_apart(words).settings == {option: value}
                assert _read_settings(kind, {option: value}, (), name)[option] is not None


def sample(hint, texts) -> str:
    kind = next(kind for kind in alternatives(hint) if kind is not type(None))
    if get_origin(kind) is tuple:
        return ",".join(sample(part, texts) for part in get_args(kind) if part is not Ellipsis)
    return str(get_args(kind)[0]) if get_origin(kind) is Literal else texts[kind]


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
