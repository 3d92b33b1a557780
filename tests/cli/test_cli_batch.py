"""``meshsplats convert`` of several inputs, of folders, of meshes and of standard input."""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _local import make_link
from _splats import few_splats

from meshsplats._common import toml
from meshsplats._common.words import naming
from meshsplats.cameras.files import save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.evaluation.comparison import compare
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.formats.splat_paths import subject_name
from meshsplats.formats.streaming import stream_gaussians
from meshsplats.operations.batches import jobs, sources


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
    save_gaussians(cloud.take(np.arange(30)), folder / "b.compressed.ply")
    model = folder / "chair" / "point_cloud" / "iteration_7"
    model.mkdir(parents=True)
    save_gaussians(cloud.take(np.arange(20)), model / "point_cloud.ply")
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
        (
            ["scans/a.ply", "scans/../scans/a.ply", "-o", "out"],
            2,
            f"would both become {Path('out/a.ply.glb')}",
        ),
        (["-o", "out"], 2, "give a splat file, a mesh or a folder"),
        (["scans/empty", "-o", "out"], 1, "a folder without splats"),
        (["scans/none.ply", "scans/a.ply", "-o", "no/out"], 1, "no"),
        (["scans", "-o", "out", "--lit", "--formats", "npz"], 2, "--lit is for .glb"),
        (["scans", "-o", "out", "--as-splats", "--formats", "obj"], 2, "splats are written as .ply"),
        (["scans", "-o", "out", "--set", "sides=2"], 2, "sides"),
        (
            ["scans", "-o", "out", "--formats", "glb", "compressed.ply"],
            2,
            ".glb would be meshes, .compressed.ply splats: write one of the two by a second command, or all"
            " as splats: --as-splats",
        ),
        (["scans", "-o", "out", "--formats", "usdz", "obj"], 2, "a second command (see meshsplats convert"),
        (["-", "-", "-o", "out"], 2, "can be read once"),
        (["scans/a.ply", "-o", "-"], 2, "-o must end in"),
        (["scans/a.ply", "-o", "a.glb", "--fidelity", "0"], 2, "--fidelity must be"),
    ],
)
def test_mistakes_are_reported_first(scans, tmp_path, capsys, arguments, code, words):
    before = sorted(path.name for path in tmp_path.iterdir())
    assert run(*arguments) == code
    assert words in " ".join(capsys.readouterr().err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_files_that_cannot_be_read_are_not_passed_over(tmp_path, monkeypatch, capsys):
    """Links that lead nowhere, and zip archives: of splats, of photographs, torn."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "scans"
    folder.mkdir()
    save_gaussians(few_splats(), tmp_path / "a.ply")
    make_link(folder / "b.ply", tmp_path / "gone.ply")
    for name, members in (("one", ["a.ply"]), ("two", ["a.ply", "b.ply"]), ("photos", ["a.jpg"])):
        with zipfile.ZipFile(folder / f"{name}.zip", "w") as archive:
            for member in members:
                archive.write("a.ply", member)
    (folder / "torn.zip").write_bytes((folder / "one.zip").read_bytes()[:2000])
    assert sources([folder]) == [folder / name for name in ("b.ply", "one.zip", "torn.zip", "two.zip")]
    assert run("scans", "-o", "out", "--no-sidecar") == 1
    out, err = capsys.readouterr()
    assert out.endswith("1 of 4 converted: out/\n")
    assert os.listdir("out") == ["one.glb"]
    link, torn, two = err.splitlines()
    assert link.endswith("gone.ply, which does not exist")
    assert torn.startswith("meshsplats: error: scans/torn.zip: a broken zip archive")
    assert two.endswith("2 files of splats in one archive (a.ply, b.ply): unpack it, and give one")
    (folder / "b.ply").unlink()
    for name in ("two", "torn"):
        (folder / f"{name}.zip").unlink()
    assert [path.name for path in stream_gaussians(folder).paths] == ["one.zip"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_pipes_and_folders_that_are_named_as_files_are_not_passed_over_in_silence(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("scans", "sub.ply").mkdir(parents=True)
    save_gaussians(few_splats(), "scans/a.ply")
    os.mkfifo("scans/pipe.ply")
    Path("scans/torn.ply").write_bytes(b"ply\nformat")
    assert run("scans", "-o", "out", "--no-sidecar", "--json") == 1
    out, err = capsys.readouterr()
    assert err.count("scans/sub.ply: a folder, and no model: passed over") == 1
    assert "scans/pipe.ply: a pipe, not a file" in err
    assert [line["error"]["path"] for line in lines(out)[1:]] == ["scans/pipe.ply", "scans/torn.ply"]


def test_messages_about_one_of_several_inputs_name_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cloud = few_splats()
    faint = replace(cloud, opacities=np.full(len(cloud), 0.001, np.float32))
    far = replace(cloud, means=np.concatenate([cloud.means[:-1], [[1e5, 0, 0]]]))
    for name, one in {
        "a": far,
        "b": far,
        "faint": faint,
        "map": replace(cloud, origin=[5e5, 4e6, 0]),
    }.items():
        save_gaussians(one, tmp_path / f"{name}.ply")
    names = ("a.ply", "b.ply", "faint.ply", "map.ply")
    assert run(*names, "-o", "out", "--no-preview") == 1
    lines = capsys.readouterr().err.splitlines()
    for start in (
        "warning: a.ply: some splats lie",
        "warning: b.ply: some splats lie",
        "error: faint.ply: no splat is left",
        "map.ply: origin: 500000",
    ):
        assert any(line.startswith(f"meshsplats: {start}") for line in lines), start
    assert all(sum(name in line for name in names) == 1 for line in lines)
    assert run("faint.ply", "-o", "faint.glb", "--no-preview") == 1  # whose name the user has just written
    assert "error: no splat is left" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("error: no splat", "error: a.ply: no splat"),
        ("origin: 1 2 3", "a.ply: origin: 1 2 3"),
        ("error: scans/a.ply: torn", "error: scans/a.ply: torn"),
        ("warning: a.obj: no opacity", "warning: a.obj: no opacity"),
        ("error: data.ply: torn", "error: a.ply: data.ply: torn"),
    ],
)
def test_a_name_is_put_before_what_lacks_it(text, shown):
    assert naming(text, ("a.ply", "a.obj")) == shown
    assert naming(text, ()) == text


@pytest.mark.slow
def test_inputs_of_one_name_keep_their_endings(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    os.makedirs("scans/same")
    cloud = few_splats()
    save_gaussians(cloud, "one.ply")
    one = Path("one.ply").read_bytes()
    names = ("same.ply", "same.compressed.ply", "same.ply.gz", "same.ply.ply", "Same.splat.ply", "other.ply")
    for name in names:
        Path("scans", name).write_bytes(gzip.compress(one) if name.endswith(".gz") else one)
    Path("scans/same/point_cloud.ply").write_bytes(one)
    stems = ["same", *(n for n in names if n.lower() < "same.s" and n != "other.ply"), "Same.splat", "other"]
    for name in ("out", "again"):  # and again: the names do not depend on what is there
        assert run("scans", "-o", name, "--no-sidecar") == 0
        assert run("scans", "-o", name, "--no-sidecar", "--skip-existing") == 0
        assert capsys.readouterr().out.endswith(f"0 of 7 converted, 7 kept: {name}/\n")
        assert sorted(os.listdir(name)) == sorted(f"{stem}.glb" for stem in stems)
    assert run("scans/same.ply", "-o", "alone", "--formats", "glb", "--no-sidecar") == 0
    assert os.listdir("alone") == ["same.glb"]


def test_names_do_not_depend_on_the_case_of_letters(tmp_path):
    paths = [tmp_path / name for name in ("Same.ply", "same.sog", "a.spz")]
    made = jobs(paths, tmp_path, ["glb"], preview=False, sidecars=False)
    assert [job.outputs[0].name for job in made] == ["Same.ply.glb", "same.sog.glb", "a.glb"]


def test_archives_take_no_names_from_files(tmp_path):
    """What a.ply became keeps its name when an a.zip comes beside it."""
    paths = [tmp_path / name for name in ("a.ply", "a.zip", "b.ply", "b.spz", "b.zip", "c.zip")]
    made = jobs(paths, tmp_path, ["glb"], preview=False, sidecars=False)
    names = [job.outputs[0].name for job in made]
    assert names == ["a.glb", "a.zip.glb", "b.ply.glb", "b.spz.glb", "b.zip.glb", "c.glb"]


@pytest.mark.slow
def test_results_in_the_folder_of_the_inputs_are_no_inputs(scans):
    os.remove("scans/broken.ply")
    save_mesh(convert(few_splats()), "scans/mesh.npz")
    for skip in ([], ["--skip-existing"]):
        assert run("scans", "-o", "scans", "--formats", "glb", *skip) == 0
        found = sorted(path.name for path in Path("scans").glob("*.glb"))
        assert found == ["a.glb", "b.glb", "chair.glb", "mesh.glb"]
    assert run("scans", "-o", "scans", "--formats", "glb") == 3
    # A file that is named is an input, whatever it is.
    assert run("scans/mesh.npz", "scans/mesh.glb", "-o", "scans", "--formats", "ply") == 0
    assert {"mesh.npz.ply", "mesh.glb.ply"} <= set(os.listdir("scans"))


@pytest.mark.slow
def test_a_folder_that_was_interrupted(scans, tmp_path, capsys):
    os.remove("scans/broken.ply")
    assert run("scans", "-o", "out") == 0
    first = {path.name: path.stat().st_mtime_ns for path in Path("out").iterdir()}
    gone = {"b.glb", "b.glb.config.toml", "b.glb.preview.png", "chair.glb.preview.png"}
    for name in gone:
        os.remove(Path("out", name))
    capsys.readouterr()
    assert run("scans", "-o", "out", "--skip-existing", "--json") == 0
    printed = lines(capsys.readouterr().out)
    assert [line["skipped"] for line in printed] == [True, False, False]
    assert [line.get("splats") for line in printed] == [None, 30, 20]
    assert all(line["outputs"][0]["bytes"] and line["preview"] and not line["warnings"] for line in printed)
    again = {path.name: path.stat().st_mtime_ns for path in Path("out").iterdir()}
    assert again.keys() == first.keys()
    assert {name for name in again if again[name] != first[name]} == gone
    assert run("scans", "-o", "out", "--skip-existing") == 0
    assert capsys.readouterr().out.endswith("0 of 3 converted, 3 kept: out/\n")
    assert run("scans", "-o", "out", "--skip-existing", "--force") == 2
    assert "not both" in capsys.readouterr().err


def test_what_is_kept_but_may_be_wrong_is_named(scans, capsys):
    assert run("scans/a.ply", "-o", "a.glb", "--max-splats", "30") == 0
    before = Path("a.glb").read_bytes()
    capsys.readouterr()
    assert run("scans/a.ply", "-o", "a.glb", "--skip-existing") == 0
    out, err = capsys.readouterr()
    assert out.startswith("a.glb (")
    assert out.endswith("): kept\n")
    assert "a.glb: kept, though made with other options: --max-splats was 30 and is not given" in err
    os.utime("a.glb", (1, 1))
    assert run("scans/a.ply", "-o", "a.glb", "--max-splats", "30", "--skip-existing", "--json") == 0
    (warning,) = lines(capsys.readouterr().out)[0]["warnings"]
    assert warning == "a.glb: kept, though older than its input; --force makes it anew"
    # Its preview, if that is missing, would be one of another mesh.
    os.remove("a.glb.preview.png")
    assert run("scans/a.ply", "-o", "a.glb", "--max-splats", "30") == 3
    assert "exists already (and 1 more), older than its input; --force" in capsys.readouterr().err
    assert run("scans/a.ply", "-o", "a.glb", "--skip-existing", "--json") == 0
    assert lines(capsys.readouterr().out)[0]["preview"] is None
    assert not os.path.exists("a.glb.preview.png")
    assert Path("a.glb").read_bytes() == before


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf8_are_no_other_options(scans, capsys):
    name = os.fsdecode(b"caf\xe9.ply")
    os.rename("scans/a.ply", name)
    assert run(name, "-o", "a.glb", "--no-preview") == 0
    capsys.readouterr()
    assert run(name, "-o", "a.glb", "--no-preview", "--skip-existing") == 0
    assert "other options" not in capsys.readouterr().err


def test_a_further_format_beside_what_is_there(scans, capsys):
    options = ["-o", "out", "--no-sidecar", "--json"]
    assert run("scans/a.ply", *options, "--formats", "glb") == 0
    stamp = os.stat("out/a.glb").st_mtime_ns
    assert run("scans/a.ply", *options, "--formats", "glb", "npz") == 3
    assert "--skip-existing makes only the meshes that are missing" in capsys.readouterr().err
    assert run("scans/a.ply", *options, "--formats", "glb", "npz", "--skip-existing") == 0
    assert sorted(os.listdir("out")) == ["a.glb", "a.npz"]
    assert os.stat("out/a.glb").st_mtime_ns == stamp


@pytest.mark.slow
@pytest.mark.parametrize("skip", [[], ["--skip-existing"]])
def test_records_of_another_run_stay(scans, capsys, skip):
    """Where the mesh itself is gone, they are all that is left of it."""
    assert run("scans/a.ply", "-o", "a.glb", "--max-splats", "30") == 0
    os.remove("a.glb")
    left = {name: Path(name).read_bytes() for name in ("a.glb.config.toml", "a.glb.preview.png")}
    assert run("scans/a.ply", "-o", "a.glb", *skip) == 3
    assert "made with other options: --max-splats was 30 and is not given" in capsys.readouterr().err
    os.remove("a.glb.config.toml")
    assert run("scans/a.ply", "-o", "a.glb", *skip) == 3
    assert "a.glb.preview.png: the output exists already" in capsys.readouterr().err
    assert Path("a.glb.preview.png").read_bytes() == left["a.glb.preview.png"]
    Path("a.glb.config.toml").write_bytes(left["a.glb.config.toml"])
    assert run("scans/a.ply", "-o", "a.glb", "--max-splats", "30", *skip) == 0
    assert os.path.exists("a.glb")
    assert Path("a.glb.preview.png").read_bytes() == left["a.glb.preview.png"]


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
    wanted = compare(cloud, load_mesh("a.npz"), cameras[:2])
    assert printed["views"] == 2
    assert printed["psnr"] == pytest.approx(wanted.psnr, abs=1e-6)
    assert printed["ssim"] == pytest.approx(wanted.ssim, abs=1e-6)


def test_the_records_in_the_documents_are_like_real_ones(scans, capsys):
    page = Path(__file__).parents[2] / "docs" / "pipelines.md"
    text = page.read_text("utf-8").partition("```json\n")[2].partition("```")[0]
    documented = [json.loads("{" + record) for record in re.split(r"^\{", text, flags=re.MULTILINE)[1:]]
    options = ["--formats", "glb", "--fidelity", "1", "--json", "--no-sidecar"]
    assert run("scans/a.ply", "scans/broken.ply", "-o", "out", *options) == 1
    made, failed = lines(capsys.readouterr().out)
    assert [set(record) for record in documented] == [set(made), set(failed)]
    assert set(documented[1]["error"]) == set(failed["error"])
    for part in ("alpha", "seconds", "fidelity"):
        assert set(documented[0][part]) == set(made[part])


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
    # What was piped then is not known now.
    monkeypatch.setattr(sys, "stdin", _Piped(content))
    assert run("-", "-o", "a.npz", "--skip-existing", "--json") == 0
    assert "another standard input" in lines(capsys.readouterr().out)[0]["warnings"][0]
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


@pytest.mark.parametrize("ending", [".usda", ".usdc"])
def test_standard_input_may_be_usd(tmp_path, monkeypatch, capsys, ending):
    """Whose library goes by the name of the file."""
    pytest.importorskip("pxr", reason="install meshsplats[usd]")
    save_mesh(convert(few_splats()), tmp_path / f"a{ending}")
    monkeypatch.setattr(sys, "stdin", _Piped((tmp_path / f"a{ending}").read_bytes()))
    assert main(["info", "-", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "mesh"


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
