"""``meshsplats compare``, run in this process on a small cloud."""

from __future__ import annotations

import json

import numpy as np
import pytest
from _splats import few_splats
from PIL import Image

from meshsplats._common import toml
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.evaluation.comparison import compare
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.meshes import save_mesh
from meshsplats.images.writing import CAPTION, GAP


@pytest.fixture
def splats(tmp_path):
    cloud = few_splats()
    save_gaussians(cloud, tmp_path / "scene.ply")
    save_cameras(orbit(cloud, 2, width=40, height=30), tmp_path / "two.json")
    return tmp_path / "scene.ply"


def run(*arguments) -> int:
    return main(["compare", *map(str, arguments)])


def test_scores_and_strips(splats, tmp_path, capsys):
    out = tmp_path / "out"
    options = ("--cameras", tmp_path / "two.json", "--samples", "1", "--preset", "paper", "--amplify", "2")
    assert run(splats, "-o", out, *options, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    stored = json.loads((out / "results.json").read_text())
    assert printed == stored
    cloud, cameras = load_gaussians(splats), load_cameras(tmp_path / "two.json")
    mesh = convert(cloud, preset="paper", cameras=cameras)
    expected = compare(cloud, mesh, cameras, samples=1)
    assert stored["views"] == expected.to_dict()["views"]
    assert stored["mean"] == expected.to_dict()["mean"]
    assert (stored["splats"], stored["triangles"]) == (40, len(mesh.faces))
    assert stored["error_amplified"] == 2
    names = ["cameras.json", "config.toml", "results.json", "view_0000.png", "view_0001.png"]
    assert sorted(p.name for p in out.iterdir()) == names
    with Image.open(out / "view_0000.png") as image:
        strip = np.asarray(image).astype(int)
    a, b, error = (strip[CAPTION:-GAP, GAP + i * (40 + GAP) :][:, :40] for i in range(3))
    np.testing.assert_allclose(error, np.minimum(2 * np.abs(a - b), 255), atol=3)
    assert toml.load(out / "config.toml")["options"]["preset"] == "paper"


def test_table_and_a_given_mesh(splats, tmp_path, capsys):
    save_mesh(convert(load_gaussians(splats), preset="paper"), tmp_path / "mesh.npz")
    cameras = ("--cameras", tmp_path / "two.json")
    assert run(splats, tmp_path / "mesh.npz", "-o", tmp_path / "out", *cameras) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:4]] == ["view", "view_0000", "view_0001", "mean"]
    mean = json.loads((tmp_path / "out" / "results.json").read_text())["mean"]
    assert lines[3].split()[1:] == [f"{mean['psnr']:.2f}", f"{mean['ssim']:.4f}"]


def test_default_views(splats, tmp_path):
    assert run(splats, "-o", tmp_path / "out", "--width", "16") == 0
    assert [(c.width, c.height) for c in load_cameras(tmp_path / "out" / "cameras.json")] == [(16, 16)] * 8


def test_mistakes(splats, tmp_path, capsys):
    cameras = ("--cameras", tmp_path / "two.json")
    assert run(splats, splats, "-o", tmp_path / "out", *cameras) == 1
    assert "not a mesh" in capsys.readouterr().err
    assert run(splats, "-o", tmp_path / "out", *cameras, "--preset", "nonsense") != 0
    assert "nonsense" in capsys.readouterr().err
    assert run(splats, "-o", tmp_path / "out", *cameras, "--amplify", "0") == 2
    assert run(splats, *cameras) == 2
    assert run(tmp_path / "two.json", "-o", tmp_path / "out") == 1
    assert not (tmp_path / "out").exists()
    assert run(splats, "-o", tmp_path / "out", *cameras) == 0
    before = (tmp_path / "out" / "results.json").read_bytes()
    capsys.readouterr()
    assert run(splats, "-o", tmp_path / "out", *cameras, "--sh-degree", "0") == 3
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / "out" / "results.json").read_bytes() == before


def test_a_mesh_in_place_of_splats_is_sent_to_evaluate(splats, tmp_path, capsys):
    save_mesh(convert(load_gaussians(splats)), tmp_path / "mesh.npz")
    assert run(tmp_path / "mesh.npz", "-o", tmp_path / "out") == 1
    assert "'meshsplats evaluate' compares a mesh with photographs" in capsys.readouterr().err
