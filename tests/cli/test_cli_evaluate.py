"""``meshsplats evaluate``, run in this process on small scenes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from _datasets import simple_colmap
from _photographs import write_photographs
from PIL import Image

from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.datasets.folder import load_dataset
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.metrics import psnr
from meshsplats.evaluation.report import evaluate
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.images.writing import save_image
from meshsplats.rendering import render, render_splats
from meshsplats.rendering.looks import draw_splats


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("evaluate")
    cloud = make_scene(300)
    save_gaussians(cloud, folder / "scene.ply")
    cameras = orbit(cloud, 3, width=40, height=32)
    save_cameras(cameras, folder / "cameras.json")
    mesh = convert(cloud, cameras=cameras)
    save_mesh(mesh, folder / "mesh.npz")
    (folder / "rendered").mkdir()
    for camera in cameras:
        save_image(folder / "rendered" / f"{camera.name}.png", render(mesh, camera).color)
    return folder


PROTOCOL = ["models", "--data", "d", "--protocol", "mipnerf360"]


def run(*arguments) -> int:
    return main(["evaluate", *map(str, arguments)])


def test_against_the_splats_own_pictures(scene, tmp_path, capsys):
    out = tmp_path / "out"
    splats = ("--splats", scene / "scene.ply", "--cameras", scene / "cameras.json", "--sh-degree", "0")
    before = ("--before", scene / "mesh.npz")
    images = ("--images", scene / "rendered")
    options = (*splats, *before, *images, "--strips", "2", "--fit-exposure", "--samples", "1", "--json")
    assert run(scene / "mesh.npz", "-o", out, *options) == 0
    printed = json.loads(capsys.readouterr().out)["scenes"][0]
    results = json.loads((out / "results.json").read_text())
    assert set(results) == {"mesh", "before", "images"}
    assert results["mesh"] == results["before"]
    assert results["images"]["PSNR"] == pytest.approx(results["mesh"]["PSNR"], abs=0.02)  # 8 bits
    assert set(results["mesh"]) == {"SSIM", "PSNR", "LPIPS"}
    report = json.loads((out / "report.json").read_text())
    assert report == printed
    assert report["methods"]["mesh"]["mean"]["psnr"] == results["mesh"]["PSNR"]
    assert report["methods"]["mesh"]["mean"]["psnr_exposure"] >= results["mesh"]["PSNR"] - 1e-6
    assert (report["lpips_network"], report["lpips_convention"]) == (None, None)
    assert len(json.loads((out / "per_view.json").read_text())["mesh"]["PSNR"]) == 3
    assert sorted(p.name for p in (out / "strips").iterdir()) == ["view_0000.png", "view_0002.png"]
    assert sorted(p.name for p in (out / "crops").iterdir()) == ["view_0000.png", "view_0002.png"]
    with Image.open(out / "strips" / "view_0000.png") as image:
        assert image.width == 8 + 5 * 48  # truth, three methods, error
    table = (out / "table.md").read_text()
    assert "| splats | mesh |" in table
    assert "Ground truth: splats as means over each pixel's area; meshes with 1 x 1 samples" in table


def test_what_degree_0_shows_of_splats_with_more_is_scored_beside_a_mesh(scene, tmp_path, capsys):
    cloud = load_gaussians(scene / "scene.ply")
    sh = np.zeros((len(cloud), 4, 3), np.float32)
    sh[:, 0], sh[:, 2] = cloud.sh[:, 0], 0.5
    save_gaussians(replace(cloud, sh=sh), tmp_path / "more.ply")
    cameras = ("--cameras", scene / "cameras.json")
    assert (
        run(scene / "mesh.npz", "-o", tmp_path / "a", "--splats", tmp_path / "more.ply", *cameras, "--json")
        == 0
    )
    report = json.loads(capsys.readouterr().out)["scenes"][0]
    assert set(report["methods"]) == {"mesh", "splats_sh0"}
    camera = load_cameras(scene / "cameras.json")[0]
    both = [draw_splats(replace(cloud, sh=sh), camera, sh_degree=d).color for d in (0, None)]
    printed = report["methods"]["splats_sh0"]["views"][0]["psnr"]
    assert printed == pytest.approx(psnr(*(np.clip(p, 0, 1) for p in both)), abs=0.01)
    assert report["held_out"] is None  # given cameras may have been trained on


def test_several_meshes_in_one_table(scene, tmp_path, capsys):
    (tmp_path / "other").mkdir()
    for copy in ("first.npz", "other/first.npz"):
        (tmp_path / copy).write_bytes((scene / "mesh.npz").read_bytes())
    options = ("--splats", scene / "scene.ply", "--cameras", scene / "cameras.json", "--strips", "0")
    meshes = (scene / "mesh.npz", tmp_path / "first.npz")
    assert run(*meshes, *options, "-o", tmp_path / "a") == 0
    assert set(json.loads((tmp_path / "a" / "results.json").read_text())) == {"mesh", "first", "splats_sh0"}
    printed = capsys.readouterr().out
    assert "LPIPS" not in printed
    assert "fitted" not in printed
    meshes = (tmp_path / "first.npz", tmp_path / "other" / "first.npz")
    assert run(*meshes, *options, "-o", tmp_path / "b") == 0
    names = {f"{tmp_path.name}/first.npz", "other/first.npz"}
    assert set(json.loads((tmp_path / "b" / "results.json").read_text())) == {*names, "splats_sh0"}
    assert run(meshes[0], meshes[0], *options, "-o", tmp_path / "c") == 2
    assert "given twice" in capsys.readouterr().err


def test_against_photographs(scene, tmp_path, capsys):
    data = simple_colmap(tmp_path / "data", count=5)
    out = tmp_path / "out"
    options = ("--data", data, "--splats", scene / "scene.ply", "--test-every", "2", "--background", "0,0,1")
    assert run(scene / "mesh.npz", "-o", out, *options) == 0
    printed = capsys.readouterr().out
    assert "splats_sh0" in printed
    note = "Ground truth: photographs; meshes with 2 x 2 samples per pixel."
    assert note in printed
    assert "Splats: as a 3DGS viewer renders them at this size." in printed
    assert note in (out / "table.md").read_text()
    results = json.loads((out / "results.json").read_text())
    assert set(results) == {"mesh", "splats_sh0", "splats"}
    dataset = load_dataset(data, test_every=2, background=(0, 0, 1))
    expected = evaluate(load_mesh(scene / "mesh.npz"), dataset)
    assert results["mesh"]["PSNR"] == expected.method("mesh").mean("psnr")
    assert json.loads((out / "report.json").read_text())["background"] == [0, 0, 1]


def test_a_protocol_scores_every_scene_that_is_there(scene, tmp_path, capsys):
    data, models = tmp_path / "data", tmp_path / "models"
    data.mkdir()
    models.mkdir()
    simple_colmap(data / "train", count=9)
    (models / "train.npz").write_bytes((scene / "mesh.npz").read_bytes())
    out = tmp_path / "out"
    assert run(models, "--data", data, "--protocol", "tanks-and-temples", "-o", out) == 0
    printed = capsys.readouterr()
    assert "scene truck is left out" in printed.err
    report = json.loads((out / "report.json").read_text())
    assert (report["scenes"], report["missing"]) == (["train"], ["truck"])
    assert report["reports"][0]["views"] == 2  # views 0 and 8 of 9
    table = (out / "table.md").read_text()
    assert "1 scene of 2" in table
    assert "| reported | MeshSplats paper | 21.71 |" in table
    assert (out / "train" / "results.json").is_file()
    assert run(models, "--data", data, "--protocol", "deep-blending", "-o", tmp_path / "none") == 1
    assert not (tmp_path / "none").exists()


def test_a_protocol_converts_splats(scene, tmp_path):
    data, models = tmp_path / "data", tmp_path / "models"
    data.mkdir()
    models.mkdir()
    cloud = make_scene(300)
    cameras = orbit(cloud, 3, width=32, height=32)
    write_photographs(data / "train", cameras, [render_splats(cloud, camera).color for camera in cameras])
    (models / "train.ply").write_bytes((scene / "scene.ply").read_bytes())
    out = tmp_path / "out"
    assert run(models, "--data", data, "--protocol", "tanks-and-temples", "-o", out) == 0
    assert set(json.loads((out / "results.json").read_text())) == {"mesh", "splats_sh0", "splats"}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ([], 2, "nothing to score"),
        (["mesh.npz"], 2, "nothing to compare with"),
        (["mesh.npz", "--data", "d", "--sh-degree", "0"], 2, "no effect with --data"),
        (["mesh.npz", "--splats", "scene.ply", "--downscale", "2"], 2, "--downscale has no effect without"),
        (["mesh.npz", "--splats", "scene.ply", "--test-every", "4"], 2, "--test-every has no effect without"),
        (["mesh.npz", "--data", "d", "--network", "alex"], 2, "--network has no effect without --lpips"),
        (["mesh.npz", "--lpips-convention", "3dgs"], 2, "--lpips-convention has no effect without --lpips"),
        (["mesh.npz", "--splats", "scene.ply", "--tune", "paper"], 2, "--tune is for --protocol"),
        (["mesh.npz", "--protocol", "mipnerf360"], 2, "--data with the scenes"),
        ([*PROTOCOL, "--test-every", "4"], 2, "--test-every has no effect with --protocol"),
        ([*PROTOCOL, "--masks", "subject"], 2, "--masks has no effect with --protocol"),
        ([*PROTOCOL, "--missing", "skip"], 2, "--missing has no effect with --protocol, which needs every"),
        ([*PROTOCOL, "--look", "splats"], 2, "--look has no effect with --protocol"),
        ([*PROTOCOL, "--network", "alex"], 2, "--network has no effect without --lpips"),
        (["scene.ply", "--splats", "scene.ply"], 1, "splats, not a mesh"),
        (["mesh.npz", "--splats", "mesh.npz"], 1, "a mesh, not splats"),
        (["mesh.npz", "--data", "nowhere"], 1, "no such data set"),
    ],
)
def test_wrong_usage_writes_nothing(scene, tmp_path, monkeypatch, capsys, arguments, code, message):
    monkeypatch.chdir(scene)
    assert run(*arguments, "-o", tmp_path / "out") == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_existing_results_stay(scene, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "results.json").write_text("kept")
    assert run(scene / "mesh.npz", "--splats", scene / "scene.ply", "-o", out) == 3
    assert "--force" in capsys.readouterr().err
    assert (out / "results.json").read_text() == "kept"


@pytest.mark.slow
def test_default_views_are_those_that_finetune_holds_out(scene, tmp_path):
    from meshsplats.finetuning.targets import Targets

    out = tmp_path / "out"
    assert run(scene / "mesh.npz", "--splats", scene / "scene.ply", "-o", out, "--strips", "0") == 0
    names = list(json.loads((out / "per_view.json").read_text())["mesh"]["PSNR"])
    data = Targets().make(make_scene(300), scene / "scene.ply", (1, 1, 1), None)
    assert names == [v.name for v in data.test]
    assert not (out / "strips").exists()
    assert np.isfinite(json.loads((out / "results.json").read_text())["mesh"]["SSIM"])
