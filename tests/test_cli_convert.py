"""``meshsplats convert``, run in this process on a small cloud."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from meshsplats.camera import orbit, save_cameras
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.formats.meshes import load_mesh
from meshsplats.formats.splats import load_gaussians, save_gaussians
from meshsplats.gaussians import GaussianCloud


@pytest.fixture
def splats(tmp_path):
    rng = np.random.default_rng(0)
    n = 40
    cloud = GaussianCloud(
        rng.normal(size=(n, 3)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        rng.uniform(0.05, 0.3, (n, 3)),
        rng.uniform(0.2, 0.95, n),
        rng.normal(size=(n, 1, 3)),
    )
    save_gaussians(cloud, tmp_path / "my scene.ply")
    return tmp_path / "my scene.ply"


def run(*arguments) -> int:
    return main(["convert", *map(str, arguments)])


@pytest.mark.parametrize("suffix", ["npz", "ply", "glb"])
def test_mesh_preview_and_configuration(splats, tmp_path, capsys, suffix):
    out = tmp_path / f"mesh.{suffix}"
    assert run(splats, "-o", out, "--preset", "paper") == 0
    expected = convert(load_gaussians(splats), preset="paper")
    mesh = load_mesh(out)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    with Image.open(tmp_path / "mesh.preview.png") as image:
        picture = np.asarray(image)
    assert picture.shape == (800, 800, 3)
    assert (picture[0] == 255).all()
    assert picture[200:600, 200:600].mean() < 240
    assert json.loads((tmp_path / "mesh.config.json").read_text())["options"]["preset"] == "paper"
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith("mesh")) == sorted(
        ["mesh.config.json", f"mesh.{suffix}", "mesh.preview.png"]
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"40 splats -> {len(mesh.faces)} triangles, {len(mesh.vertices)} vertices"
    assert lines[-1].startswith("next: meshsplats compare '")  # the space in the name is quoted


def test_json(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "mesh.npz", "--json", "--no-preview") == 0
    result = json.loads(capsys.readouterr().out)
    mesh = load_mesh(tmp_path / "mesh.npz")
    assert (result["splats"], result["triangles"]) == (40, len(mesh.faces))
    assert result["vertices"] == len(mesh.vertices)
    assert result["bytes"] == (tmp_path / "mesh.npz").stat().st_size
    assert result["preview"] is None
    assert not (tmp_path / "mesh.preview.png").exists()


def test_up(splats, tmp_path):
    """From the option, else from the cameras, else y points down."""
    save_cameras(orbit(np.eye(3), 3, up=(0, 0, 1)), tmp_path / "cameras.json")
    plain = (splats, "-o", tmp_path / "mesh.npz", "--no-preview", "--force")
    for options, up in [
        ((), (0, -1, 0)),
        (("--up", "-x"), (-1, 0, 0)),
        (("--cameras", tmp_path / "cameras.json"), (0, 0, 1)),
        (("--cameras", tmp_path / "cameras.json", "--up", "y"), (0, 1, 0)),
    ]:
        assert run(*plain, *options) == 0
        np.testing.assert_allclose(load_mesh(tmp_path / "mesh.npz").up, up, atol=1e-6)


@pytest.mark.parametrize("taken", ["mesh.glb", "mesh.preview.png", "mesh.config.json"])
def test_nothing_is_overwritten(splats, tmp_path, capsys, taken):
    (tmp_path / taken).write_bytes(b"mine")
    assert run(splats, "-o", tmp_path / "mesh.glb") == 1
    assert taken in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith("mesh")] == [taken]
    assert (tmp_path / taken).read_bytes() == b"mine"
    assert run(splats, "-o", tmp_path / "mesh.glb", "--force") == 0
    assert (tmp_path / taken).read_bytes() != b"mine"


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["-o", "mesh.obj"], 2, ".glb"),
        (["-o", "mesh"], 2, ".glb"),
        (["-o", "mesh.npz", "--lit"], 2, "--lit"),
        (["-o", "mesh.npz", "--preset", "best"], 2, "--preset"),
        ([], 2, "output"),
        (["-o", "mesh.npz", "--up", "w"], 1, "--up"),
        (["-o", "mesh.npz", "--cameras", "none.json"], 1, "none.json: No such file"),
        (["-o", "no/such/mesh.npz"], 1, "no/such"),
    ],
)
def test_mistakes(splats, tmp_path, capsys, monkeypatch, options, code, words):
    monkeypatch.chdir(tmp_path)
    assert run(splats, *options) == code
    assert words in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["my scene.ply"]


def test_not_splats(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "mesh.ply") == 0
    assert run(tmp_path / "mesh.ply", "-o", tmp_path / "again.ply") == 1
    assert "not splats" in capsys.readouterr().err
