"""``meshsplats simplify``, run in this process."""

from __future__ import annotations

import json

import numpy as np
import pytest
from _local import shared_data
from _splats import few_splats

from meshsplats import load_gaussians, orbit, save_cameras, save_gaussians, simplify
from meshsplats._common import toml
from meshsplats.cli import main
from meshsplats.conversion.merging_views import merging_views


@pytest.fixture
def splats(tmp_path):
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def run(*arguments) -> int:
    return main(["simplify", *map(str, arguments)])


def test_count_share_and_cameras(splats, tmp_path, capsys):
    cloud = load_gaussians(splats)
    cameras = orbit(cloud, 2, width=30, height=30)
    save_cameras(cameras, tmp_path / "cameras.json")
    out = tmp_path / "small.ply"
    assert run(splats, "-o", out, "--share", 0.25) == 0
    assert capsys.readouterr().out.startswith("40 splats -> 10 (25.0%) in ")
    same(load_gaussians(out), simplify(cloud, 10, cameras=merging_views(cloud)))
    assert (tmp_path / "small.ply.preview.png").is_file()
    assert toml.load(tmp_path / "small.ply.config.toml")["options"]["share"] == 0.25
    assert run(splats, "-o", out, "--count", 10, "--cameras", tmp_path / "cameras.json", "--force") == 0
    same(load_gaussians(out), simplify(cloud, 10, cameras=cameras))


def same(a, b):
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-5, atol=1e-6)


def test_json_without_a_preview(splats, tmp_path, capsys):
    out = tmp_path / "small.ply"
    assert run(splats, "-o", out, "--count", 99, "--json", "--no-preview") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["read"], printed["written"], printed["preview"]) == (40, 40, None)
    assert printed["bytes"] == out.stat().st_size
    assert not (tmp_path / "small.ply.preview.png").exists()


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    "name", ["guitar.compressed.ply", "truck.splat", "playcanvas-logo-sog", "monkey_0001.sog"]
)
def test_every_format(tmp_path, name):
    """With cameras, but for the smallest: views of its own take long."""
    out, path = tmp_path / "small.ply", shared_data(f"splats/{name}")
    options = ["--share", 0.02, "--no-preview"]
    if not name.startswith("monkey"):
        save_cameras(orbit(load_gaussians(path), 2, width=100, height=100), tmp_path / "cameras.json")
        options += ["--cameras", tmp_path / "cameras.json"]
    assert run(path, "-o", out, *options) == 0
    assert 500 < len(load_gaussians(out)) < 8000


@pytest.mark.parametrize(
    ("options", "printed"),
    [
        ([], "give --count or --share, one of them"),
        (["--count", "3", "--share", "0.5"], "give --count or --share, one of them"),
        (["--count", "0"], "--count must be at least 1, got 0"),
        (["--share", "1.5"], "--share must be above 0 and at most 1, got 1.5"),
        (["--share", "nan"], "--share must be above 0 and at most 1, got nan"),
        (["--count", "3", "--cameras", "a.json", "--data", "b"], "give --cameras or --data, not both"),
    ],
)
def test_wrong_options(splats, tmp_path, capsys, options, printed):
    assert run(splats, "-o", tmp_path / "small.ply", *options) == 2
    assert printed in capsys.readouterr().err
    assert not (tmp_path / "small.ply").exists()


def test_outputs_and_inputs(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "small.obj", "--count", 3) == 2
    assert "splats are written as .ply" in capsys.readouterr().err
    assert run(splats, "-o", splats, "--count", 3, "--force") == 2
    assert "is read by this command" in capsys.readouterr().err
    (tmp_path / "small.ply.config.toml").write_text("mine")
    assert run(splats, "-o", tmp_path / "small.ply", "--count", 3) == 3
    assert (tmp_path / "small.ply.config.toml").read_text() == "mine"
