"""How large photographs are used: by the time there is, in a run that is resumed as before, or as given."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from _balls import cameras_around
from _datasets import write_json
from _photographs import write_photographs
from PIL import Image

from meshsplats._common import toml
from meshsplats.cli import main, train
from meshsplats.demo_scene import make_scene
from meshsplats.errors import FileFormatError
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.rendering import render_splats
from meshsplats.training import image_sizes
from meshsplats.training.image_sizes import worthwhile_downscale
from meshsplats.training.photographs import PhotographOptions

SIDE = 48


@pytest.fixture(scope="module")
def scene():
    return make_scene(200)


@pytest.fixture
def photographs(scene, tmp_path) -> Path:
    """Of 48 x 48 pixels."""
    cameras = cameras_around(5, seed=1, side=SIDE)
    images = [render_splats(scene, camera, background=(1, 1, 1)).color.clip(0, 1) for camera in cameras]
    return write_photographs(tmp_path / "photos", cameras, images)


@pytest.mark.parametrize(
    ("minutes", "threads", "factor"),
    [
        *[(4, 1, 1), (1, 4, 1), (1, 1, 2), (0.25, 1, 4), (1e-9, 1, 48), (None, 1, 1), (1, None, 1)],
        *[(4 / 1.49**2, 1, 1), (4 / 1.51**2, 1, 2)],  # the nearest factor
    ],
)
def test_more_minutes_and_threads_make_larger_images(photographs, monkeypatch, minutes, threads, factor):
    monkeypatch.setattr(image_sizes, "PIXELS_PER_MINUTE", SIDE**2 / 4)
    assert worthwhile_downscale(photographs, minutes, threads) == factor


def test_no_time_is_enough_for_the_largest_photographs(photographs, monkeypatch):
    monkeypatch.setattr(image_sizes, "MOST_PIXELS", SIDE**2 / 9)
    assert worthwhile_downscale(photographs, None, None) == 3


@pytest.mark.parametrize(
    ("size", "minutes", "factor"),
    [
        *[((1080, 1920), 2, 4), ((1080, 1920), 5, 2), ((1080, 1920), None, 1)],
        *[((1600, 1200), None, 1), ((4000, 3000), None, 2)],
    ],
)
def test_measured_sizes_are_kept(monkeypatch, size, minutes, factor):
    """Of a phone's photographs on two processors, and those that 3DGS has."""
    camera = SimpleNamespace(width=size[0], height=size[1])
    data = SimpleNamespace(views=[SimpleNamespace(camera=camera)])
    monkeypatch.setattr(image_sizes, "load_dataset", lambda *_, **__: data)
    assert worthwhile_downscale(Path("photos"), minutes, 2) == factor


def test_one_large_photograph_does_not_make_all_others_small(photographs, monkeypatch):
    monkeypatch.setattr(image_sizes, "MOST_PIXELS", SIDE**2)
    content = json.loads((photographs / "transforms.json").read_text())
    frame = content["frames"][0]
    frame |= {"w": 4 * SIDE, "h": 4 * SIDE, "cx": 2 * SIDE, "cy": 2 * SIDE}
    Image.new("RGB", (4 * SIDE, 4 * SIDE)).save(photographs / frame["file_path"])
    write_json(photographs / "transforms.json", content)
    assert worthwhile_downscale(photographs, None, None) == 1


def test_images_suit_the_minutes_that_the_search_for_cameras_leaves(photographs, tmp_path, monkeypatch):
    asked, now = [], [0.0]

    def late(self, source, say, threads=None, *, resumed=False):
        now[0] += 0.6
        return source

    def sized(folder, minutes, *rest):
        asked.append(minutes)
        raise FileFormatError("enough")

    monkeypatch.setattr(train, "perf_counter", lambda: now[0])
    monkeypatch.setattr(PhotographOptions, "with_cameras", late)
    monkeypatch.setattr(image_sizes, "worthwhile_downscale", sized)
    for minutes in ("0.1", "0.002", None):
        length = ["--steps", "1"] if minutes is None else ["--minutes", minutes]
        assert main(["train", str(photographs), "-o", str(tmp_path / "mesh.npz"), *length]) == 1
    assert asked == [pytest.approx(0.09), 0.0002, None]


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("command", ["train", "finetune"])
def test_a_run_says_its_size_and_keeps_it(command, scene, photographs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(image_sizes, "MOST_PIXELS", SIDE**2 / 4)
    save_gaussians(scene, tmp_path / "scene.ply")
    words = [str(photographs), "--start-splats", "100", "--max-splats", "100", "--sh-degree", "0"]
    if command == "finetune":
        words = [str(tmp_path / "scene.ply"), "--data", str(photographs)]
    words = [command, *words, "-o", str(tmp_path / "mesh.npz")]
    assert main([*words, "--steps", "2"]) == 0
    shown = capsys.readouterr()
    assert "downscaled by 2, to suit the time (--downscale 1: full resolution)" in shown.err
    assert f"of {SIDE // 2} x {SIDE // 2} pixels" in shown.err
    assert "--downscale 2" in shown.out.partition("next: ")[2]
    assert toml.load(tmp_path / "mesh.npz.run/command.toml")["options"]["downscale"] == 2

    monkeypatch.setattr(image_sizes, "MOST_PIXELS", SIDE**2)  # as with more time
    assert main([*words, "--steps", "3", "--resume", "--force"]) == 0  # its images stay
    assert f"of {SIDE // 2} x {SIDE // 2} pixels" in capsys.readouterr().err
    assert main([*words, "--steps", "3", "--force"]) == 0
    shown = capsys.readouterr()
    assert f"of {SIDE} x {SIDE} pixels" in shown.err
    assert "to suit the time" not in shown.err
    assert "--downscale" not in shown.out
    assert main([*words, "--steps", "2", "--downscale", "0", "--force"]) == 2
    assert "downscale must be a whole number from 1 to 64, got 0" in capsys.readouterr().err
    scored = [
        "evaluate",
        str(tmp_path / "mesh.npz"),
        "--data",
        str(photographs),
        "-o",
        str(tmp_path / "scores"),
    ]
    assert main([*scored, "--downscale", "0"]) == 2
    assert "from 1 to 64, got 0" in capsys.readouterr().err
    assert main([*words, "--steps", "2", "--downscale", "3", "--force"]) == 0
    assert f"of {SIDE // 3} x {SIDE // 3} pixels" in capsys.readouterr().err
