"""What captures are drawn over: named, given, or found by the photographs."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from _datasets import simple_colmap
from _photographs import write_photographs
from _profiles import profile
from PIL import Image, ImageCms

from meshsplats._common import toml
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.silhouettes import outline_brightness
from meshsplats.datasets.splat_targets import splat_views
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DataWarning
from meshsplats.evaluation.backgrounds import find_background, model_background, warn_of_frame_mismatch
from meshsplats.evaluation.metrics import psnr
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.meshes import load_mesh
from meshsplats.rendering import render_splats
from meshsplats.rendering.looks import image_of
from meshsplats.training.config import TrainConfig
from meshsplats.training.photographs import PhotographOptions

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@pytest.fixture(scope="module")
def cloud():
    return make_scene(300)


@pytest.mark.parametrize("how", ["given", "named"])
@pytest.mark.parametrize("color", [(2, 0, 0), (0, 0), (0, float("nan"), 0)])
def test_a_background_out_of_range_is_refused(cloud, how, color):
    with pytest.raises(ValueError, match="a background must be RGB from 0 to 1, got"):
        find_background(photographs(cloud, (0, 0, 0)), {"splats": cloud}, **{how: color})


def photographs(scene, color, count=3) -> Dataset:
    """Of splats, or of a mesh, over ``color``; there is no alpha in them."""
    views = []
    for camera in orbit(scene, count, width=32, height=32):
        if hasattr(scene, "faces"):
            image = image_of(scene, camera, color)[0]
        else:
            image = render_splats(scene, camera, background=color).color
        views.append(View(camera, ViewImage(np.clip(image, 0, 1).astype(np.float32))))
    return Dataset(tuple(views))


@pytest.mark.parametrize("name", COLORS)
def test_photographs_show_what_splats_were_trained_over(cloud, name):
    data = photographs(cloud, COLORS[name])
    found = find_background(data, {"splats": cloud, "mesh": convert(cloud)})
    assert (found.color, found.name, found.reason, found.judge) == (COLORS[name], name, "best for", "splats")
    other = "white" if name == "black" else "black"
    direct = [
        psnr(np.clip(render_splats(cloud, view.camera, background=COLORS[other]).color, 0, 1), view.image)
        for view in data.train
    ]
    assert found.psnr["splats"][other] == pytest.approx(np.mean(direct), abs=1e-3)
    assert found.psnr["splats"][name] > 100
    assert found.psnr["mesh"][name] > found.psnr["mesh"][other]
    assert f"{name}, which fits the splats best" in found.describe()
    assert {view.background for view in data.over(found.color).views} == {COLORS[name]}


def test_meshes_of_linear_light_are_judged_as_they_are_drawn(cloud):
    mesh = replace(convert(cloud, colors="base"), blending="linear")
    found = find_background(photographs(mesh, COLORS["white"]), {"mesh": mesh})
    assert found.name == "white"
    assert found.psnr["mesh"]["white"] > 60
    grey = (0.5, 0.5, 0.5)
    assert find_background(photographs(mesh, grey), {"mesh": mesh}, given=grey).psnr["mesh"]["#808080"] > 60


def test_what_is_named_and_given_goes_before_with_a_warning_where_it_matters(cloud):
    data = photographs(cloud, COLORS["black"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_background(data, {"splats": cloud}, named=(0, 0, 0)).reason == "model folder"
    with pytest.warns(DataWarning, match=r"over white the splats scores .* over black .* made for"):
        found = find_background(data, {"splats": cloud}, named=(1, 1, 1))
    assert (found.name, found.reason) == ("white", "model folder")
    with pytest.warns(DataWarning, match="over #ff8000 the splats"):
        found = find_background(data, {"splats": cloud}, named=(1, 1, 1), given=(1, 0.5, 0))
    assert (found.name, found.reason) == ("#ff8000", "given")
    assert set(found.psnr["splats"]) == {"black", "white", "#ff8000"}
    # A mesh that was made for something else than the splats is named, too.
    painted = convert(cloud, colors="base")
    painted = replace(painted, colors=np.concatenate([1 - painted.colors[:, :3], painted.colors[:, 3:]], 1))
    mixed = Dataset(photographs(cloud, (0, 0, 0)).train + photographs(painted, (1, 1, 1)).train * 2)
    with pytest.warns(DataWarning, match="the mesh scores"):
        find_background(mixed, {"splats": cloud, "mesh": painted}, given=(0, 0, 0))


def test_a_training_says_whose_choice_its_background_is(tmp_path):
    folder = simple_colmap(tmp_path, 4)
    for name, expected in (("mixed", "black, which fans cover"), ("white", "white, as given")):
        _, found = PhotographOptions().load(folder, TrainConfig(background=name))
        assert found.describe() == expected


def test_a_bright_subject_is_trained_over_black(tmp_path):
    """A masked one, as its brightness along its outline is, whatever its middle, and whatever the outermost
    pixels, which are mixed with what was behind. Photographs with alpha of their own are for white."""
    inside, other = np.zeros((48, 64), bool), np.ones((48, 64), bool)
    inside[6:42, 8:56] = True
    other[8:40, 10:54] = False
    other[10:38, 12:52] = True
    for at_rim, name, words in (
        (200, "black", "black, as the subject is bright"),
        (60, "white", "white, as usual"),
    ):
        folder = simple_colmap(tmp_path / name, 3, (64, 48))
        (folder / "masks").mkdir()
        for path in sorted((folder / "images").iterdir()):
            pixels = np.full((48, 64, 3), at_rim, np.uint8)
            pixels[other] = 255 - at_rim
            Image.fromarray(pixels).save(path)
            Image.fromarray(inside).save(folder / "masks" / f"{path.name}.png")
        dataset, found = PhotographOptions(masks="subject").load(folder, TrainConfig())
        assert found.describe() == words
        assert dataset.train[0].background == found.color
        assert outline_brightness(dataset.train) == pytest.approx(at_rim / 255, abs=0.02)
        own = tuple(View(v.camera, v.load()) for v in dataset.train)
        assert find_background(Dataset(own), {}).name == "white"


def test_alpha_goes_over_white_unless_something_else_is_said(cloud):
    data = Dataset(splat_views(cloud, orbit(cloud, 2, width=32, height=32)))
    found = find_background(data, {"splats": cloud})
    assert (found.name, found.reason) == ("white", "usual")
    assert set(found.psnr["splats"]) == {"white"}
    assert find_background(data, {"splats": cloud}, named=(0, 0, 0)).name == "black"
    assert find_background(data, {}).name == "white"
    # Alpha that is 1 everywhere leaves nothing open: a photograph after all.
    solid = [
        View(v.camera, ViewImage(np.float32(v.load().over((0, 0, 0))), np.ones((32, 32), np.float32)))
        for v in data.train
    ]
    assert find_background(Dataset(tuple(solid)), {"splats": cloud}).name == "black"


def test_masked_views_do_not_count(cloud):
    data = photographs(cloud, COLORS["black"])
    white = photographs(cloud, COLORS["white"]).train[0]
    hidden = View(white.camera, ViewImage(white.image, None, np.zeros((32, 32), bool)))
    assert find_background(Dataset((hidden, *data.train)), {"splats": cloud}).psnr["splats"]["black"] > 100


def test_images_of_something_else_are_reported(cloud):
    data = photographs(cloud, COLORS["black"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_frame_mismatch(find_background(data, {"splats": cloud}))
    noise = np.random.default_rng(0)
    other = [View(v.camera, ViewImage(noise.random((32, 32, 3), np.float32))) for v in data.train]
    found = find_background(Dataset(tuple(other)), {"splats": cloud})
    with pytest.warns(DataWarning, match=r"splats shows almost nothing of the photographs \(\d+\.\d dB\)"):
        warn_of_frame_mismatch(found)


def test_model_folders_name_their_background(tmp_path):
    model = tmp_path / "model"
    splats = model / "point_cloud" / "iteration_7" / "point_cloud.ply"
    splats.parent.mkdir(parents=True)
    assert model_background(model) is None
    assert model_background(tmp_path / "nothing.ply") is None
    written = "Namespace(data_device='cuda', sh_degree=3, white_background={}, source_path='x')"
    for said, color in (("True", COLORS["white"]), ("False", COLORS["black"]), ("maybe", None)):
        (model / "cfg_args").write_text(written.format(said))
        assert model_background(model) == color
        assert model_background(splats) == color
    (model / "cfg_args").write_bytes(b"\xff\x00white_background=True")
    assert model_background(model) == COLORS["white"]


@pytest.mark.parametrize("ignored", [True, False])
def test_splats_of_a_training_that_ignored_colour_profiles_are_named(cloud, tmp_path, ignored):
    """As for iPhone photographs in Display P3."""
    cameras = orbit(cloud, 4, width=32, height=32)
    images = [render_splats(cloud, c, background=(0, 0, 0)).color for c in cameras]
    folder = write_photographs(tmp_path / "photos", cameras, images)
    kept = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes() if not ignored else profile()
    for path in (folder / "images").iterdir():
        with Image.open(path) as image:
            image.load()
            image.save(path, icc_profile=kept)
    dataset = load_dataset(folder)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        find_background(dataset, {"splats": cloud}, named=(0, 0, 0))
    told = [str(warning.message) for warning in found if "profile" in str(warning.message)]
    assert len(told) == ignored
    if ignored:
        assert "converted from another colour profile to sRGB" in told[0]
        assert "its scores are too low" in told[0]


# ---- Commands


@pytest.fixture(scope="module")
def capture(cloud, tmp_path_factory):
    """Splats, photographs of them over black, and their mesh."""
    folder = tmp_path_factory.mktemp("capture")
    save_gaussians(cloud, folder / "scene.ply")
    cameras = orbit(cloud, 9, width=32, height=32)
    write_photographs(
        folder / "photos", cameras, [render_splats(cloud, c, background=(0, 0, 0)).color for c in cameras]
    )
    assert main(["convert", str(folder / "scene.ply"), "-o", str(folder / "mesh.npz"), "--no-preview"]) == 0
    return folder


def run(*arguments) -> int:
    return main([*map(str, arguments)])


def test_evaluate_finds_it_and_says_so_everywhere(capture, tmp_path, capsys):
    options = ("--data", capture / "photos", "--splats", capture / "scene.ply", "--strips", "0")
    assert run("evaluate", capture / "mesh.npz", *options, "-o", tmp_path / "a") == 0
    assert "Background: black, which fits the splats best" in capsys.readouterr().out
    assert "Background: black" in (tmp_path / "a" / "table.md").read_text()
    report = json.loads((tmp_path / "a" / "report.json").read_text())
    assert report["background"] == [0, 0, 0]
    assert report["methods"]["splats"]["mean"]["psnr"] > 50
    assert set(report["background_psnr"]) == {"splats", "mesh"}
    white = (*options, "--background", "white")
    assert run("evaluate", capture / "mesh.npz", *white, "-o", tmp_path / "b") == 0
    output = capsys.readouterr()
    assert "over white the splats scores" in output.err
    assert "Background: white, as given" in output.out
    assert json.loads((tmp_path / "b" / "report.json").read_text())["background"] == [1, 1, 1]


@pytest.mark.slow
def test_finetune_trains_over_it(capture, tmp_path, capsys):
    arguments = ("finetune", capture / "scene.ply", "--data", capture / "photos", "--steps", "3")
    assert run(*arguments, "-o", tmp_path / "found.npz") == 0
    output = capsys.readouterr()
    assert "background: black, which fits the splats best" in output.err
    assert "--background black" in output.out  # of the command that scores it
    assert toml.load(tmp_path / "found.npz.config.toml")["result"]["background"] == [0, 0, 0]
    for name in ("black", "white"):
        assert run(*arguments, "-o", tmp_path / f"{name}.npz", "--background", name) == 0
    found, black, white = (load_mesh(tmp_path / f"{name}.npz").colors for name in ("found", "black", "white"))
    assert np.array_equal(found, black)
    assert not np.array_equal(found, white)


def test_compare_and_render_draw_over_it(capture, tmp_path, capsys):
    from meshsplats.images.reading import load_image

    data = ("--data", capture / "photos")
    assert run("compare", capture / "scene.ply", *data, "--downscale", "2", "-o", tmp_path / "c") == 0
    assert json.loads((tmp_path / "c" / "results.json").read_text())["background"] == [0, 0, 0]
    assert json.loads((tmp_path / "c" / "cameras.json").read_text())[0]["width"] == 16
    assert "background: black" in capsys.readouterr().out
    for name, options, corner in (
        ("photographs", data, 0),
        ("given", (*data, "--background", "white"), 255),
        ("alone", ("--orbit", "2", "--width", "32"), 255),
    ):
        out = tmp_path / name
        arguments = ("--as-splats", "--animation", "none", *options)
        assert run("render", capture / "scene.ply", *arguments, "-o", out) == 0
        assert load_image(out / "view_0000.png")[0, 0].tolist() == [corner] * 3
        color = toml.load(out / "config.toml")["result"]["background"]
        assert color == [corner / 255] * 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--downscale", "2"], "--downscale has no effect without --data"),
        (["--data", "d", "--downscale", "2", "--width", "9"], "give --downscale or --width"),
    ],
)
def test_options_that_would_do_nothing_are_refused(capture, tmp_path, capsys, options, message):
    assert run("compare", capture / "scene.ply", "-o", tmp_path / "out", *options) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
