"""``meshsplats convert`` of several inputs, of folders, of meshes and of standard input."""

from __future__ import annotations

import io
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _splats import few_splats

from meshsplats.cameras.files import save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main, toml
from meshsplats.conversion import convert
from meshsplats.evaluation.comparison import compare
from meshsplats.formats.gaussians import load_gaussians, save_gaussians, subject_name
from meshsplats.formats.meshes import load_mesh, save_mesh


def run(*arguments) -> int:
    return main(["convert", *map(str, arguments)])


def lines(text: str) -> list[dict]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture
def scans(tmp_path, monkeypatch):
    """A folder with two splat files, a trained model, a broken file, and what is none of these."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "scans"
    folder.mkdir()
    cloud = few_splats()
    save_gaussians(cloud, folder / "a.ply")
    save_gaussians(cloud.select(np.arange(30)), folder / "b.compressed.ply")
    model = folder / "chair" / "point_cloud" / "iteration_7"
    model.mkdir(parents=True)
    save_gaussians(cloud.select(np.arange(20)), model / "point_cloud.ply")
    (folder / "broken.ply").write_bytes((folder / "a.ply").read_bytes()[:700])
    (folder / "notes.txt").write_text("ignored")
    (folder / ".hidden.ply").write_bytes(b"")
    (folder / "empty").mkdir()
    return folder


def test_a_folder_into_a_folder(scans, tmp_path, capsys):
    assert run("scans", "-o", "out", "--formats", "glb", "npz", "--json", "--no-sidecar") == 1
    out, err = capsys.readouterr()
    printed = lines(out)
    assert [line["input"] for line in printed] == [
        str(Path("scans", n)) for n in ("a.ply", "b.compressed.ply", "broken.ply", "chair")
    ]
    assert err.count("\n") == 1
    assert "broken.ply" in err
    assert printed[2]["error"]["kind"] == "input"
    assert printed[2]["error"]["message"] in err
    whole = [line for line in printed if "error" not in line]
    assert [line["splats"] for line in whole] == [40, 30, 20]
    names = {f"{name}.{suffix}" for name in ("a", "b", "chair") for suffix in ("glb", "npz")}
    assert set(os.listdir("out")) == names
    for line in whole:
        for output in line["outputs"]:
            assert output["bytes"] == (tmp_path / output["path"]).stat().st_size
            assert len(load_mesh(output["path"]).faces) == line["triangles"]
    # Again, two are there and one is broken: two kinds of failure.
    assert run("scans", "-o", "out", "--json", "--no-sidecar") == 1
    kinds = [line["error"]["kind"] for line in lines(capsys.readouterr().out)]
    assert kinds == ["exists", "exists", "input", "exists"]
    assert run("scans/a.ply", "scans/chair", "-o", "out", "--no-sidecar") == 3


def test_several_files_and_their_records(scans, tmp_path, capsys):
    assert run("scans/a.ply", "scans/chair", "-o", "out") == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith(f"{Path('scans/a.ply')}: 40 splats -> 320 triangles, 280 vertices: a.glb (")
    assert out[2] == "2 of 2 converted: out/"
    wanted = {f"{n}.{s}" for n in ("a", "chair") for s in ("glb", "glb.preview.png", "glb.config.toml")}
    assert set(os.listdir("out")) == wanted
    options = toml.load(tmp_path / "out/chair.glb.config.toml")["options"]
    assert (options["input"], options["output"]) == (["../scans/chair"], "chair.glb")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["scans", "-o", "out.glb"], 2, "need a folder: -o out, say"),
        (["scans/a.ply", "-o", "out.glb", "--formats", "npz"], 2, "need a folder"),
        (["scans/a.ply", "scans/../scans/a.ply", "-o", "out"], 2, f"would both become {Path('out/a.glb')}"),
        (["-o", "out"], 2, "give a splat file, a mesh or a folder"),
        (["scans/empty", "-o", "out"], 1, "a folder without splats"),
        (["scans/none.ply", "scans/a.ply", "-o", "no/out"], 1, "no"),
        (["scans", "-o", "out", "--lit", "--formats", "npz"], 2, "--lit is for .glb"),
        (["scans", "-o", "out", "--as-splats", "--formats", "glb"], 2, "--as-splats writes .ply"),
        (["scans", "-o", "out", "--sides", "2"], 1, "sides"),
        (["-", "-", "-o", "out"], 2, "can be read once"),
        (["scans/a.ply", "-o", "-"], 2, "-o must end in"),
        (["scans/a.ply", "-o", "a.glb", "--fidelity", "0"], 1, "--fidelity must be"),
    ],
)
def test_mistakes_are_reported_first(scans, tmp_path, capsys, arguments, code, words):
    before = sorted(path.name for path in tmp_path.iterdir())
    assert run(*arguments) == code
    assert words in " ".join(capsys.readouterr().err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_folder_of_failures_leaves_no_folder(scans, capsys):
    assert run("scans/broken.ply", "scans/none.ply", "-o", "out") == 1
    assert not os.path.exists("out")
    assert capsys.readouterr().out.startswith("0 of 2 converted")


def test_splats_of_a_folder_as_splats(scans):
    assert run("scans/a.ply", "scans/chair", "-o", "out", "--as-splats", "--no-sidecar") == 0
    assert sorted(os.listdir("out")) == ["a.ply", "chair.ply"]
    assert len(load_gaussians("out/chair.ply")) == 20


def test_fidelity_is_that_of_compare(scans, tmp_path, capsys):
    cloud = load_gaussians("scans/a.ply")
    cameras = orbit(cloud, 3, width=60, height=60, elevation=60)
    save_cameras(cameras, "cameras.json")
    options = ["--fidelity", "2", "--json", "--no-sidecar", "--cameras", "cameras.json"]
    assert run("scans/a.ply", "-o", "a.npz", *options) == 0
    printed = lines(capsys.readouterr().out)[0]["fidelity"]
    wanted = compare(cloud, load_mesh("a.npz"), cameras[::2][:2])
    assert printed["views"] == 2
    assert printed["psnr"] == pytest.approx(wanted.psnr, abs=1e-6)
    assert printed["ssim"] == pytest.approx(wanted.ssim, abs=1e-6)


def test_what_is_cut_off_does_not_count(scans, capsys):
    options = ["--fidelity", "1", "--json", "--no-sidecar", "--crop", "-1", "-1", "-1", "1", "1", "1"]
    assert run("scans/a.ply", "-o", "a.npz", *options) == 0
    assert lines(capsys.readouterr().out)[0]["fidelity"]["psnr"] > 20  # against all splats: 17


def test_a_mesh_in_another_format(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mesh = convert(few_splats())
    save_mesh(mesh, "a.npz")
    assert run("a.npz", "-o", "b.ply", "--json", "--no-sidecar") == 0
    assert lines(capsys.readouterr().out)[0]["triangles"] == 320
    again = load_mesh("b.ply")
    for name in ("vertices", "faces", "colors", "face_splat", "up"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    save_mesh(replace(mesh, blending="linear"), "linear.npz")
    assert run("linear.npz", "-o", "linear.ply", "--up", "0,0,2") == 0
    assert load_mesh("linear.ply").blending == "linear"
    np.testing.assert_array_equal(load_mesh("linear.ply").up, (0, 0, 1))
    assert "resolved" not in toml.load(tmp_path / "linear.ply.config.toml")
    assert (tmp_path / "linear.ply.preview.png").is_file()
    for options in (["--max-splats", "3"], ["--preset", "paper"], ["--fidelity", "2"]):
        assert run("a.npz", "-o", "c.glb", *options) == 2
        assert f"a.npz is a mesh: {options[0]} would have no effect" in capsys.readouterr().err
    assert run("a.npz", "-o", "a.npz", "--force") == 2
    assert "is read by this command" in capsys.readouterr().err


def test_warnings_are_in_the_line_and_shown(tmp_path, capsys):
    save_mesh(convert(few_splats()), tmp_path / "a.npz")
    assert run(tmp_path / "a.npz", "-o", tmp_path / "a.obj", "--json", "--no-sidecar") == 0
    out, err = capsys.readouterr()
    (warning,) = lines(out)[0]["warnings"]
    assert warning.startswith(".obj files have no opacity")
    assert err == f"meshsplats: warning: {warning}\n"


class _Piped:
    def __init__(self, content: bytes) -> None:
        self.buffer = io.BytesIO(content)

    def isatty(self) -> bool:
        return False


def test_standard_input(scans, tmp_path, monkeypatch, capsys):
    content = (scans / "a.ply").read_bytes()
    monkeypatch.setattr(sys, "stdin", _Piped(content))
    assert run("-", "-o", "a.npz", "--json") == 0
    printed = lines(capsys.readouterr().out)[0]
    assert (printed["input"], printed["splats"]) == ("-", 40)
    assert toml.load(tmp_path / "a.npz.config.toml")["options"]["input"] == ["-"]
    monkeypatch.setattr(sys, "stdin", _Piped(content[:300]))
    assert run("-", "-o", "b.npz", "--json") == 1
    out, err = capsys.readouterr()
    assert err.startswith("meshsplats: error: standard input: ")
    assert lines(out)[0]["error"]["message"].startswith("standard input: ")
    monkeypatch.setattr(sys, "stdin", _Piped(b""))
    assert run("-", "-o", "b.npz") == 1
    assert "standard input: the file is empty" in capsys.readouterr().err
    monkeypatch.setattr(sys, "stdin", _Piped(content))
    assert main(["info", "-", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["path"] == "-"
    monkeypatch.setattr(sys, "stdin", None)
    assert run("-", "-o", "b.npz") == 2


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("a.ply", "a"),
        ("a.b.spz", "a.b"),
        ("garden.compressed.ply", "garden"),
        ("garden.ply.gz", "garden"),
        ("Garden.COMPRESSED.PLY.GZ", "Garden"),
        ("chair/point_cloud/iteration_7/point_cloud.ply.gz", "chair"),
        ("chair/point_cloud/iteration_30000/point_cloud.ply", "chair"),
        ("chair/point_cloud.ply", "chair"),
        ("room/meta.json", "room"),
        ("noname", "noname"),
        (".ply", ".ply"),
    ],
)
def test_subjects_have_names(tmp_path, path, name):
    assert subject_name(tmp_path / path) == name
