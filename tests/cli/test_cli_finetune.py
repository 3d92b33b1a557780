"""``meshsplats finetune``, run in this process, and in its own where it is stopped."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from _glb import read_glb
from _local import words_of
from _photographs import write_photographs
from PIL import Image

from meshsplats._common import toml
from meshsplats._files.locks import locked
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main, training
from meshsplats.cli.finetune import Finetune
from meshsplats.cli.training import TargetOptions
from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.errors import FileFormatError
from meshsplats.finetuning import make_config, run_options, worthwhile_views
from meshsplats.finetuning.checkpoint import load_checkpoint
from meshsplats.finetuning.pace import Pace
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.gltf.reader import listed_nodes
from meshsplats.formats.meshes import load_mesh
from meshsplats.rendering import render, render_splats
from meshsplats.rendering.previews import SIDE
from meshsplats.rendering.samples import needed_samples

SMALL = ("--views", "4", "--held-out", "2", "--width", "32")


@pytest.mark.parametrize(
    ("length", "views"),
    [({"steps": 100}, 200), ({"steps": 1200}, 600), ({"steps": 10**6}, 1000), ({"epochs": 15}, 200),
     ({"minutes": 2}, 200), ({"minutes": 15}, 900), ({"minutes": 600}, 1000)],
)  # fmt: skip
def test_long_runs_have_more_views(length, views):
    assert worthwhile_views(make_config(**length)) == views


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    path = tmp_path_factory.mktemp("finetune") / "scene.ply"
    save_gaussians(make_scene(300), path)
    return path


def without_none(values: dict) -> dict:
    return {name: value for name, value in values.items() if value is not None}


def run(*arguments) -> int:
    return main(["finetune", *map(str, arguments)])


def test_from_the_splat_file_alone(splats, tmp_path, capsys):
    out = tmp_path / "tuned.npz"
    assert run(splats, "-o", out, *SMALL, "--steps", "12", "--set", "report_every=6", "--json") == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert result["steps"] == 12
    assert result["held_out_psnr"]["after"] > result["held_out_psnr"]["before"]
    assert (result["look"], result["samples"]) == ("area", 2)
    assert "memory: about" in printed.err
    assert "step 6/12, loss" in printed.err
    mesh = load_mesh(out)
    assert result["triangles"] == len(mesh.faces)
    names = ["tuned.npz", "tuned.npz.config.toml", "tuned.npz.preview.png", "tuned.npz.run"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    config = toml.load(tmp_path / "tuned.npz.config.toml")
    assert config["resolved"] == without_none(make_config(steps=12).to_dict())
    assert config["result"] == {"look": "area", "samples": 2}
    assert config["options"]["width"] == 32
    # Nothing is overwritten, and an older run is not lost.
    assert run(splats, "-o", out, *SMALL, "--steps", "12") == 3
    assert "--resume continues it, --force starts again" in capsys.readouterr().err
    assert run(splats, "-o", out, *SMALL, "--steps", "12", "--force") == 0
    assert np.array_equal(load_mesh(out).vertices, mesh.vertices)
    assert "next: meshsplats evaluate" in capsys.readouterr().out


@pytest.mark.slow
def test_the_preview_of_a_place_is_one_of_its_views(splats, tmp_path):
    """What is seen from given cameras is not shown from elsewhere; an object is, from before it."""
    cloud = load_gaussians(splats)
    cameras = orbit(cloud, 9, elevation=70, azimuth=200, width=60, height=30)
    save_cameras(cameras, tmp_path / "cameras.json")
    shown = {}
    for name, how in (("place", ["--cameras", tmp_path / "cameras.json"]), ("object", SMALL)):
        out = tmp_path / f"{name}.npz"
        assert run(splats, "-o", out, *how, "--steps", "1") == 0
        with Image.open(tmp_path / f"{name}.npz.preview.png") as image:
            shown[name] = np.asarray(image.convert("RGB")) / 255
    (seen,) = load_cameras(tmp_path / "place.npz.run/held_out.cameras.json")[:1]
    large = seen.scaled(SIDE / seen.width)
    mesh = load_mesh(tmp_path / "place.npz")
    truth = render(mesh, large, background=(1, 1, 1), samples=needed_samples(mesh, [large])).color
    assert shown["place"].shape == (400, 800, 3)
    assert np.mean((shown["place"] - truth) ** 2) < 1e-4
    assert shown["object"].shape == (800, 800, 3)


def printed_score(out: str, capsys) -> tuple[float, float]:
    """Of what was held out, as ``finetune`` printed it and as the command scores that it names."""
    printed = float(re.search(r"held out: .* -> ([\d.]+) dB", out)[1])
    command = words_of(re.search(r"next: meshsplats (.*)", out)[1])
    assert main([*command, "--strips", "0", "--json"]) == 0
    methods = json.loads(capsys.readouterr().out)["scenes"][0]["methods"]
    return printed, methods["mesh"]["mean"]["psnr"]


@pytest.mark.parametrize("options", [["--downscale", "2", "--background", "black"], ["--test-every", "3"]])
def test_the_next_command_scores_as_it_was_trained_on_photographs(splats, tmp_path, capsys, options):
    cloud = make_scene(300)
    cameras = orbit(cloud, 9, width=64, height=64)
    images = [render_splats(cloud, c, background=(0.2, 0.5, 0.7)).color for c in cameras]
    data = write_photographs(tmp_path / "photos here", cameras, images)
    out = tmp_path / "tuned.npz"
    assert run(splats, "--data", data, "-o", out, "--steps", "4", *options) == 0
    printed, scored = printed_score(capsys.readouterr().out, capsys)
    assert printed == pytest.approx(scored, abs=0.005)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    "options",
    [
        ["--width", "48", "--sh-degree", "0"],
        ["--width", "48", "--axes", "y-up"],
        ["--width", "40", "--set", "distance=0.4,0.6"],
        ["--cameras", "nine.json"],
    ],
)
def test_the_next_command_scores_as_it_was_trained_on_splats(tmp_path, capsys, options, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cloud = make_scene(300)
    sh = np.zeros((len(cloud), 4, 3), np.float32)
    sh[:, 0], sh[:, 2] = cloud.sh[:, 0], 1
    save_gaussians(replace(cloud, sh=sh), "scene.ply")
    save_cameras(orbit(cloud, 9, width=48, height=48, elevation=50), "nine.json")
    assert run("scene.ply", "-o", "tuned.npz", "--views", "4", "--steps", "2", *options) == 0
    printed, scored = printed_score(capsys.readouterr().out, capsys)
    assert printed == pytest.approx(scored, abs=0.005)


def test_order_is_tuned_recorded_and_drawn(tmp_path, capsys):
    save_gaussians(make_scene(200), tmp_path / "scene.ply")
    options = ["--steps", "2", "--views", "4", "--width", "32"]
    for order in ("fragment", "splat"):
        out = tmp_path / f"{order}.npz"
        assert run(tmp_path / "scene.ply", "-o", out, "--order", order, *options) == 0
        assert load_mesh(out).order == order
    by_splat, exact = (load_mesh(tmp_path / f"{order}.npz") for order in ("splat", "fragment"))
    assert not np.array_equal(by_splat.colors, exact.colors)  # other gradients
    capsys.readouterr()
    cut = ["--opacity", "cutoff", "--order", "splat"]
    assert run(tmp_path / "scene.ply", "-o", tmp_path / "cut.glb", *cut, *options) != 0
    assert "order 'splat' is for opacity 'blended'" in capsys.readouterr().err


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("kernel", "options", "filtered"),
    [
        ("3dgs", [], True),
        ("3dgs", ["--set", "footprint=none"], False),
        ("antialiased", [], False),
        ("3dgs", ["--preset", "paper"], False),
    ],
)
def test_only_a_mesh_with_a_filter_learns_viewers_images_of_several_sizes(
    kernel, options, filtered, tmp_path, capsys, monkeypatch
):
    made = []
    monkeypatch.setattr(Finetune, "next_steps", lambda self, files, config, plan: made.append(plan) or [])
    save_gaussians(replace(make_scene(200), kernel=kernel), tmp_path / "scene.ply")
    options = ["--look", "splats", *options, "--steps", "1", "--views", "6", "--width", "32"]
    assert run(tmp_path / "scene.ply", "-o", tmp_path / "tuned.npz", *options) == 0
    assert "(look splats, 1 x 1 samples)" in capsys.readouterr().out
    assert (load_mesh(tmp_path / "tuned.npz").filter_px2 > 0) == filtered
    focal = np.array([view.camera.fx for view in made[0].dataset.train])
    assert (focal.max() > 1.5 * focal.min()) == filtered


def test_a_part_learns_from_its_own_pictures(splats, tmp_path, capsys):
    cloud = load_gaussians(splats)
    middle = np.median(cloud.means, axis=0)
    box = ["--crop", *middle, *(middle + 10)]
    out = tmp_path / "part.npz"
    assert run(splats, "-o", out, *SMALL, "--steps", "20", "--json", *box) == 0
    scores = json.loads(capsys.readouterr().out)["held_out_psnr"]
    assert min(scores.values()) > 20  # the whole scene's images give 8
    assert (load_mesh(out).vertices[:, 0] > middle[0] - 1).all()
    camera = orbit(cloud, 1, width=24, height=16)[0]
    data = write_photographs(tmp_path / "photos", [camera], [render_splats(cloud, camera).color])
    arguments = ("--data", data, "--test-every", "0", "--steps", "1")
    assert run(splats, "-o", tmp_path / "b.npz", *arguments, *box) == 0
    assert "will be baked into the rest" in capsys.readouterr().err


def test_a_record_of_everything_given(splats, tmp_path):
    given = ("--preset", "paper", "--steps", "2")
    assert run(splats, "-o", tmp_path / "tuned.npz", *SMALL, *given) == 0
    options = toml.load(tmp_path / "tuned.npz.config.toml")["options"]
    assert (options["preset"], options["steps"], options["width"]) == ("paper", 2, 32)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cameras", "c.json", "--placement", "inside"], "--placement has no effect with --cameras"),
        (["--cameras", "c.json", "--up", "z"], "--up has no effect with --cameras"),
        (["--views", "0"], "--views must be at least 1, got 0"),
        (["--exposure", "True"], "--exposure has no effect without --data"),
    ],
)
def test_options_that_would_do_nothing_are_refused(splats, tmp_path, capsys, options, message):
    assert run(splats, "-o", tmp_path / "t.npz", "--steps", "1", *options) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_photographs_that_are_all_held_out_are_nothing_to_learn_from(splats, tmp_path, capsys):
    cloud = make_scene(300)
    camera = orbit(cloud, 1, width=24, height=16)[0]
    data = write_photographs(tmp_path / "photos", [camera], [render_splats(cloud, camera).color])
    assert run(splats, "-o", tmp_path / "t.npz", "--data", data, "--steps", "1") == 1
    assert "all its 1 views are held out" in capsys.readouterr().err
    assert run(splats, "-o", tmp_path / "t.npz", "--data", data, "--steps", "1", "--test-every", "0") == 0
    assert "1 training view, 0 held out, of 24 x 16 pixels" in capsys.readouterr().err


def test_cameras_of_a_model_folder_give_way_to_a_placement(tmp_path):
    cloud = make_scene(300)
    folder = tmp_path / "model"
    (folder / "point_cloud/iteration_7").mkdir(parents=True)
    save_gaussians(cloud, folder / "point_cloud/iteration_7/point_cloud.ply")
    save_cameras(orbit(cloud, 9, width=48, height=48, elevation=50), folder / "cameras.json")
    for name, options in (("own", []), ("placed", ["--set", "distance=0.5,0.5"])):
        out = tmp_path / f"{name}.npz"
        assert run(folder, "-o", out, "--views", "4", "--width", "32", "--steps", "1", *options) == 0
    held = [load_cameras(tmp_path / f"{name}.npz.run/held_out.cameras.json") for name in ("own", "placed")]
    assert [len(cameras) for cameras in held] == [2, 8]
    assert held[0][0].center == pytest.approx(load_cameras(folder)[int(2 * 0.25 * 9 / 2)].center)


def test_what_is_read_is_never_written(splats, tmp_path, capsys):
    before = splats.read_bytes()
    assert run(splats, "-o", splats, *SMALL, "--steps", "1", "--force") == 2
    assert "is read by this command" in capsys.readouterr().err
    assert splats.read_bytes() == before


def test_a_run_that_has_ended_is_not_resumed(splats, tmp_path, capsys):
    out = tmp_path / "tuned.npz"
    assert run(splats, "-o", out, *SMALL, "--steps", "2") == 0
    assert run(splats, "-o", out, *SMALL, "--steps", "2", "--resume") == 3
    assert "the run has ended, or there was one before" in capsys.readouterr().err


def test_without_views_held_out_the_next_command_shows_the_mesh(splats, tmp_path, capsys):
    out = tmp_path / "tuned.npz"
    assert run(splats, "-o", out, "--views", "3", "--held-out", "0", "--width", "32", "--steps", "1") == 0
    assert "next: meshsplats render" in capsys.readouterr().out
    assert not (tmp_path / "tuned.npz.run/held_out.cameras.json").exists()


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sh-degree", "0"], "began with another mesh.*--sh-degree was not given and is 0"),
        (["--held-out", "1"], "other views.*--held-out was 2 and is 1"),
        (["--axes", "y-up"], "another mesh.*options of reading it.*--axes was auto and is y-up"),
    ],
)
def test_another_target_is_not_resumed(tmp_path, capsys, options, message):
    save_gaussians(make_scene(300), tmp_path / "scene.ply")
    arguments = (tmp_path / "scene.ply", "-o", tmp_path / "tuned.npz", *SMALL, "--steps", "2")
    assert run(*arguments) == 0
    assert run(*arguments, *options, "--resume", "--force") == 1
    assert re.search(message, capsys.readouterr().err)
    assert run(*arguments, "--resume", "--force") == 0
    assert run(*arguments[:-1], "1", "--resume", "--force") == 1
    assert "has taken 2 steps already, 1 were requested\n" in capsys.readouterr().err
    save_gaussians(make_scene(301), tmp_path / "scene.ply")
    assert run(*arguments, "--resume", "--force") == 1
    assert "Options that differ: none, so the files have changed" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_is_made_longer(splats, tmp_path, capsys, monkeypatch):
    """Its views and its starting mesh stay, though so long a run would have more; its time counts, too."""
    arguments = [splats, "-o", tmp_path / "t.npz", "--held-out", "2", "--width", "32", "--json"]
    monkeypatch.setattr("meshsplats.finetuning.file_tuning.worthwhile_views", lambda config: config.steps + 1)
    monkeypatch.setattr("meshsplats.finetuning.config.LONG_STEPS", 5)
    monkeypatch.setattr("meshsplats.finetuning.baseline.TOLERANCE", 99)  # the tuned mesh, however few steps
    assert run(*arguments, "--steps", "3") == 0
    first = json.loads(capsys.readouterr().out)
    assert first["seconds_since_resumed"] is None
    begun = load_checkpoint(tmp_path / "t.npz.run" / "checkpoint.safetensors", only_header=True).seconds
    assert 0 < begun <= first["seconds"]
    assert run(*arguments, "--steps", "6", "--resume", "--force") == 0
    second = json.loads(capsys.readouterr().out)
    assert second["steps"] == 6
    assert second["seconds"] == pytest.approx(begun + second["seconds_since_resumed"], abs=0.02)
    assert run(*arguments, "--steps", "7", "--resume", "--force") == 0
    third = json.loads(capsys.readouterr().out)
    assert (third["steps"], third["triangles"]) == (7, second["triangles"])
    assert run(*arguments, "--steps", "6", "--force") == 0
    assert json.loads(capsys.readouterr().out)["triangles"] > 1.9 * third["triangles"]


def test_from_photographs_with_options_of_the_tuning(splats, tmp_path, capsys):
    cloud = make_scene(300)
    cameras = orbit(cloud, 9, width=32, height=32)
    data = write_photographs(tmp_path / "photos", cameras, [render_splats(cloud, c).color for c in cameras])
    out = tmp_path / "tuned.ply"
    options = ("--preset", "paper", "--epochs", "2", "--exposure", "True", "--seed", "3", "--set", "sides=4")
    assert run(splats, "-o", out, "--data", data, *options) == 0
    assert "7 training views, 2 held out" in capsys.readouterr().err
    config = toml.load(tmp_path / "tuned.ply.config.toml")["resolved"]
    assert config == without_none(make_config("paper", epochs=2, exposure=True, seed=3).to_dict())
    mesh = load_mesh(out)
    assert len(mesh.faces) == 300 * 4  # sides went to the conversion
    again = tmp_path / "again.npz"
    assert run(out, "-o", again, "--data", data, "--steps", "2") == 0  # a mesh is tuned further
    assert len(load_mesh(again).faces) == len(mesh.faces)


def test_given_cameras_are_where_the_targets_are_drawn_from(splats, tmp_path, capsys):
    cameras = orbit(make_scene(300), 5, width=64, height=48)
    save_cameras(cameras, tmp_path / "five.json")
    options = ("--cameras", tmp_path / "five.json", "--views", "3", "--held-out", "1", "--width", "32")
    assert run(splats, "-o", tmp_path / "t.npz", *options, "--steps", "1") == 0
    assert "3 training views, 1 held out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--steps", "3", "--minutes", "1"], 2, "give only one of --epochs, --steps and --minutes"),
        (["--data", "d", "--views", "9"], 2, "--views has no effect with --data"),
        (["--downscale", "2"], 2, "--downscale has no effect with splats"),
        (["--resume"], 1, "no checkpoint at"),
        (["--set", "color_rate=7"], 2, "color_rate must be a number"),
        (["--data", "nowhere"], 1, "no such data set"),
        (["--held-out", "-1"], 1, "at least 1 training view"),
    ],
)
def test_wrong_usage_writes_nothing(splats, tmp_path, capsys, arguments, code, message):
    assert run(splats, "-o", tmp_path / "out.npz", *arguments) == code
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_mesh_needs_photographs(splats, tmp_path, capsys):
    assert main(["convert", str(splats), "-o", str(tmp_path / "m.npz"), "--no-preview"]) == 0
    assert run(tmp_path / "m.npz", "-o", tmp_path / "t.npz") == 2
    assert "--data" in capsys.readouterr().err
    assert run(splats, "-o", tmp_path / "t.stl") == 2
    assert "-o must end in" in capsys.readouterr().err


def test_too_little_memory_is_reported_before_the_work(splats, tmp_path, capsys, monkeypatch):
    from meshsplats.finetuning import memory

    monkeypatch.setattr(memory, "available_memory", lambda: 1 << 20)
    assert run(splats, "-o", tmp_path / "t.npz", *SMALL) == 5
    assert "--max-splats" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_neither_torch_nor_safetensors_is_needed(splats, tmp_path):
    program = (
        "import sys\n"
        "class Without:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in ('torch', 'safetensors'):\n"
        "            raise ModuleNotFoundError('gone', name=name)\n"
        "sys.meta_path.insert(0, Without())\n"
        "from meshsplats.cli import main\n"
        f"arguments = ['finetune', {str(splats)!r}, '-o', {str(tmp_path / 't.npz')!r}, '--steps', '2']\n"
        f"sys.exit(main([*arguments, *{SMALL}]))"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    assert (tmp_path / "t.npz.run" / "checkpoint.safetensors").is_file()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_goes_on(splats, tmp_path, capsys, number):
    out = tmp_path / "tuned.npz"
    arguments = [str(splats), "-o", str(out), *SMALL, "--steps", "40", "--set", "report_every=3"]
    command = [sys.executable, "-m", "meshsplats", "finetune", *arguments]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    for line in child.stderr:
        if "step 3/" in line:
            child.send_signal(number)
            break
    printed = child.communicate(timeout=60)[1]
    assert child.returncode == 128 + number
    assert "--resume" in printed
    assert not out.exists()
    assert (tmp_path / "tuned.npz.run" / "checkpoint.safetensors").is_file()
    assert run(*arguments, "--resume") == 0
    whole = tmp_path / "whole.npz"
    assert run(*[str(whole) if a == str(out) else a for a in arguments]) == 0
    for name in ("vertices", "colors", "faces"):
        assert np.array_equal(getattr(load_mesh(out), name), getattr(load_mesh(whole), name))


def test_two_runs_of_one_name(splats, tmp_path, capsys):
    folder = tmp_path / "tuned.npz.run"
    folder.mkdir()
    with locked(folder / ".lock") as ours:
        assert ours
        assert run(splats, "-o", tmp_path / "tuned.npz", *SMALL, "--steps", "1") == 3
        assert "tuned.npz.run: another process is writing this run" in capsys.readouterr().err
        assert [path.name for path in folder.iterdir()] == [".lock"]
    assert run(splats, "-o", tmp_path / "tuned.npz", *SMALL, "--steps", "1") == 0
    assert not (folder / ".lock").exists()


def test_time_before_the_run_counts(splats, tmp_path, monkeypatch):
    """That in which Python starts, and that of all that is done before the first step."""
    now, planned, begun = [0.0], Finetune.plan, []

    def plan(self, *arguments):
        now[0] += 20
        return planned(self, *arguments)

    def options(**given):
        begun.append(given["spent"])
        raise FileFormatError("enough")

    monkeypatch.setattr(training, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(Finetune, "plan", plan)
    monkeypatch.setattr(run_options, "RunOptions", options)
    assert run(splats, "-o", tmp_path / "t.npz", *SMALL, "--steps", "1") == 1
    assert begun == [20 + training.STARTUP_SECONDS]


def test_every_option_of_the_configuration_can_be_given():
    command = Finetune(input=None, output=None, steps=5)  # type: ignore[arg-type]
    assert command.configured() == make_config(steps=5)
    assert TargetOptions().cache_bytes == 2_000_000_000


def alpha_modes(path) -> list[str]:
    return [material["alphaMode"] for material in read_glb(path)[0]["materials"]]


def test_a_mesh_for_engines(splats, tmp_path, capsys):
    out = tmp_path / "tuned.glb"
    options = (*SMALL, "--steps", "8", "--opacity", "cutoff", "--cutoff", "0.3", "--json")
    assert run(splats, "-o", out, *options) == 0
    result = json.loads(capsys.readouterr().out)
    mesh = load_mesh(out)
    assert (mesh.colors[:, 3] == 1).all()
    assert result["triangles"] == len(mesh.faces)
    assert alpha_modes(out) == ["OPAQUE"]
    assert run(splats, "-o", tmp_path / "b.npz", *SMALL, "--cutoff", "0.3") == 2
    assert "--cutoff has no effect without --opacity cutoff" in capsys.readouterr().err


@pytest.mark.slow
def test_a_hybrid_mesh_for_engines(splats, tmp_path):
    options = (*SMALL, "--steps", "8", "--opacity", "cutoff", "--soft-share", "0.3", "--json")
    for suffix in ("glb", "npz"):
        assert run(splats, "-o", tmp_path / f"tuned.{suffix}", *options) == 0
    assert alpha_modes(tmp_path / "tuned.glb") == ["OPAQUE", "BLEND"]
    one, two = (load_mesh(tmp_path / f"tuned.{suffix}") for suffix in ("glb", "npz"))
    assert len(one.faces) == len(two.faces)
    assert len(np.unique(one.colors[:, 3])) > 2


@pytest.mark.slow
def test_the_result_is_never_below_the_conversion(splats, tmp_path, capsys):
    """Rates that ruin a mesh: what is written is what ``convert`` makes, with its score and a sentence."""
    out, ruinous = tmp_path / "t.npz", ("--set", "color_rate=1", "--set", "position_rate=9")
    assert run(splats, "-o", out, *SMALL, "--steps", "4", *ruinous) == 0
    printed = capsys.readouterr().out
    assert "the conversion is written: after 4 steps, the mesh was worse at 16, 32, 64, 128 px" in printed
    conversion = convert(load_gaussians(splats))
    assert np.array_equal(load_mesh(out).vertices, conversion.vertices)
    shown, scored = printed_score(printed, capsys)
    assert shown == pytest.approx(scored, abs=0.005)
    assert run(splats, "-o", out, *SMALL, "--steps", "60", "--json", "--force") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["written"] == "tuned"
    before, after = result["psnr_by_width"]["converted"], result["psnr_by_width"]["tuned"]
    assert list(before) == list(after) == ["16", "32", "64", "128"]
    assert all(after[width] > before[width] for width in before)
    assert not np.array_equal(load_mesh(out).vertices.shape, conversion.vertices.shape)


def test_dense_clouds_begin_as_their_conversion(splats, tmp_path, capsys):
    """Three hundred splats in images of 256 pixels."""
    dense = ("--views", "24", "--held-out", "3", "--width", "16", "--json", "--force")
    conversion = convert(load_gaussians(splats))
    assert run(splats, "-o", tmp_path / "t.npz", *dense, "--steps", "72") == 0
    result = json.loads(capsys.readouterr().out)
    mesh = load_mesh(tmp_path / "t.npz")
    assert result["written"] == "tuned"
    assert np.array_equal(mesh.faces, conversion.faces)
    assert not np.array_equal(mesh.colors, conversion.colors)
    record = json.loads((tmp_path / "t.npz.run" / "start.json").read_text())
    assert record == {"max_splats": None, "images": None, "brief_steps": 72}
    # In the order of a file, small steps gain little.
    assert run(splats, "-o", tmp_path / "t.glb", *dense, "--steps", "2", "--order", "file") == 0
    assert json.loads((tmp_path / "t.glb.run" / "start.json").read_text())["brief_steps"] is None
    # A mesh that the user's own options make is not replaced.
    assert run(splats, "-o", tmp_path / "t.npz", *dense, "--steps", "2", "--set", "mode=flat") == 0
    assert json.loads((tmp_path / "t.npz.run" / "start.json").read_text())["brief_steps"] is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", [("--opacity", "cutoff"), ("--order", "file")])
def test_a_timed_run_is_resumed_with_the_mesh_that_it_began_with(splats, tmp_path, capsys, monkeypatch, kind):
    """Though the machine is as fast as a hundred by then."""
    slow, fast = Pace(1e-4, 1e-4, 1e-9), Pace(1e-6, 1e-9, 1e-9)
    monkeypatch.setattr("meshsplats.finetuning.on_splats.TIMED_SPLATS", 1)
    monkeypatch.setattr("meshsplats.finetuning.pace.FEWEST_SPLATS", 50)
    monkeypatch.setattr("meshsplats.finetuning.pace.FEWEST_STEPS", 1000)
    monkeypatch.setattr("meshsplats.finetuning.on_splats.measure_pace", lambda *_, **__: slow)
    words = (splats, "-o", tmp_path / "t.glb", *SMALL, *kind, "--json", "--force")
    assert run(*words, "--minutes", "0.08") == 0
    record = json.loads((tmp_path / "t.glb.run" / "start.json").read_text())
    assert 50 <= record["max_splats"] < 300
    monkeypatch.setattr("meshsplats.finetuning.on_splats.measure_pace", lambda *_, **__: fast)
    capsys.readouterr()
    assert run(*words, "--minutes", "0.1", "--resume") == 0
    assert json.loads((tmp_path / "t.glb.run" / "start.json").read_text()) == record
    assert run(*words, "--minutes", "0.08") == 0
    assert json.loads((tmp_path / "t.glb.run" / "start.json").read_text())["max_splats"] is None


def test_the_setup_is_shown_in_phases(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "t.npz", *SMALL, "--steps", "2") == 0
    lines = [line.removeprefix("meshsplats: ") for line in capsys.readouterr().err.splitlines()]
    phases = [f"reading {splats}", "converting 300 splats", "scoring the conversion"]
    phases += ["choosing numbers of triangles", "scoring the result"]
    assert [line for line in lines if line in phases] == phases
    assert lines[0] == phases[0]


@pytest.mark.slow
def test_meshes_stand_as_asked_however_they_came_about(tmp_path):
    """Tuned from fans, begun as the conversion, and replaced by it."""
    save_gaussians(make_scene(300), tmp_path / "s.ply")
    ruinous = ("--set", "color_rate=1", "--set", "position_rate=9")
    for options in ((), ("--width", "16"), ruinous):
        words = (tmp_path / "s.ply", "-o", tmp_path / "t.npz", *SMALL, "--steps", "3", "--up", "z", "--force")
        assert run(*words, *options) == 0
        np.testing.assert_allclose(load_mesh(tmp_path / "t.npz").up, (0, 0, 1), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("option", ["colors=mean", "detail=cameras", "footprint=cameras"])
def test_conversion_options_that_need_cameras(splats, tmp_path, option, monkeypatch):
    monkeypatch.setattr("meshsplats.finetuning.on_splats.TIMED_SPLATS", 1)
    words = (splats, "-o", tmp_path / "t.npz", *SMALL, "--set", option, "--force")
    assert run(*words, "--steps", "3") == 0
    assert run(*words, "--minutes", "0.02") == 0


@pytest.mark.slow
def test_a_refused_resumption_changes_nothing(splats, tmp_path, capsys):
    words = (splats, "-o", tmp_path / "t.npz", "--held-out", "2", "--width", "32", "--force")
    assert run(*words, "--views", "20", "--steps", "3") == 0
    record = tmp_path / "t.npz.run" / "start.json"
    before = record.read_bytes()
    assert run(*words, "--views", "9", "--steps", "4", "--resume") == 1
    assert record.read_bytes() == before
    assert run(*words, "--views", "20", "--steps", "4", "--resume") == 0
    # One from before there were records began with all images, whatever the time.
    record.unlink()
    assert run(*words, "--views", "20", "--minutes", "0.01", "--resume") == 0


def test_a_run_without_time_for_steps_is_not_begun(splats, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("meshsplats.finetuning.on_splats.TIMED_SPLATS", 1)
    late = Pace(100.0, 1.0, 1.0)
    monkeypatch.setattr("meshsplats.finetuning.on_splats.measure_pace", lambda *_, **__: late)
    assert run(splats, "-o", tmp_path / "t.npz", *SMALL, "--minutes", "0.02") == 0
    printed = capsys.readouterr().out
    assert "0 steps in" in printed
    assert "there was no time for steps: this is the mesh at the start; more --minutes help" in printed
    assert re.search(
        r"^converted, dB: 16 px [\d.]+, 32 px [\d.]+, 64 px [\d.]+, 128 px [\d.]+$", printed, re.M
    )
    assert "metrics.jsonl" not in printed
    assert "max-triangles" not in printed
    assert np.array_equal(load_mesh(tmp_path / "t.npz").vertices, convert(load_gaussians(splats)).vertices)


def test_a_file_that_is_tuned_through_its_order(splats, tmp_path, capsys):
    path = tmp_path / "ordered.glb"
    assert run(splats, "-o", path, "--order", "file", "--steps", "3", *SMALL) == 0
    assert "web viewers and engines" in capsys.readouterr().out
    assert listed_nodes(path) == 8
    assert len(load_mesh(path).faces) == 300 * 8
    assert 'order = "file"' in (tmp_path / "ordered.glb.config.toml").read_text()
    lines = (tmp_path / "ordered.glb.run/metrics.jsonl").read_text().splitlines()
    assert json.loads(lines[0])["psnr"] > 10


def test_a_file_tuned_through_its_order_is_small_unless_asked_otherwise(splats, tmp_path, monkeypatch):
    monkeypatch.setattr("meshsplats.finetuning.on_splats.FILE_TRIANGLES", 800)
    words = (splats, "--steps", "2", *SMALL, "-o")
    assert run(*words, tmp_path / "a.glb", "--order", "file") == 0
    assert len(load_mesh(tmp_path / "a.glb").faces) == 800
    assert run(*words, tmp_path / "b.glb", "--order", "file", "--max-triangles", "2000") == 0
    assert len(load_mesh(tmp_path / "b.glb").faces) == 2000
    assert run(*words, tmp_path / "c.npz") == 0
    assert len(load_mesh(tmp_path / "c.npz").faces) > 800


def test_what_has_no_order_of_its_own_is_refused_before_the_work(splats, tmp_path, capsys):
    for options, message in (
        (
            ("-o", tmp_path / "x.npz"),
            "order 'file' is for .glb files, which list triangles in an order, not x.npz",
        ),
        (("-o", tmp_path / "x.glb", "--cell-splats", "100"), "order is for a whole scene, not for cells"),
        (("-o", tmp_path / "x.glb", "--look", "splats"), "viewers, which have no filter"),
    ):
        assert run(splats, *options, "--order", "file", "--steps", "3", *SMALL) != 0
        assert message in " ".join(capsys.readouterr().err.split())
        assert not list(tmp_path.iterdir())


def test_splats_too_faint_for_opaque_triangles(tmp_path, capsys):
    cloud = make_scene(1200)
    path = tmp_path / "faint.ply"
    save_gaussians(replace(cloud, opacities=np.full(len(cloud), 0.012, np.float32)), path)
    words = (path, "-o", tmp_path / "t.glb", "--opacity", "cutoff", "--steps", "2", *SMALL)
    assert run(*words) == 2
    assert "no triangle is as opaque as" in capsys.readouterr().err
    assert not (tmp_path / "t.glb").exists()
