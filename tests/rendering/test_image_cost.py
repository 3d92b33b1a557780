"""The cost of an image is known before it is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats import Camera, DataWarning, GaussianCloud, SplatMesh, convert, orbit, save_gaussians
from meshsplats.cli import main
from meshsplats.evaluation import viewers
from meshsplats.evaluation.viewers import AlphaChoice, choose_alpha
from meshsplats.rendering import previews
from meshsplats.rendering.drawing import announce_cost
from meshsplats.rendering.layers import affordable, fragments, layers


def facing(n, side, depth=2.0):
    """``n`` squares of two triangles each, side by side in depth before a camera at 0."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2
    z = depth + 1e-3 * np.arange(n)
    vertices = np.concatenate([np.tile(corners, (n, 1)), np.repeat(z, 4)[:, None]], axis=1)
    faces = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(n)[:, None, None]).reshape(-1, 3)
    return SplatMesh(vertices, faces, np.full((4 * n, 4), 0.5))


CAMERA = Camera(width=100, height=80, fx=100, fy=100, cx=50, cy=40, world_to_camera=np.eye(4))


def test_layers_of_triangles_are_their_area_by_that_of_the_image():
    assert layers(facing(10, 1.0), CAMERA) == pytest.approx(10 * 50 * 50 / (100 * 80), rel=0.02)
    assert fragments(facing(10, 1.0), CAMERA, 2) == pytest.approx(10 * 50 * 50 * 4, rel=0.02)
    assert layers(facing(10, 1.0, depth=-3), CAMERA) == 0  # behind the camera
    # Larger than the image: no more than it, for each of its two triangles.
    assert 10 < layers(facing(10, 1000.0), CAMERA) <= 20


def test_layers_of_splats_are_their_squares():
    n = 50
    cloud = GaussianCloud(
        np.tile([0, 0, 2], (n, 1)), np.tile([1, 0, 0, 0], (n, 1)), np.full((n, 3), 0.1), np.ones(n),
        np.zeros((n, 1, 3)),
    )  # fmt: skip
    assert layers(cloud, CAMERA) == pytest.approx(n * 30 * 30 / (100 * 80), rel=0.01)


def test_images_become_smaller_before_none_is_left():
    mesh = facing(1000, 10.0)
    cost = fragments(mesh, CAMERA, 1)
    assert affordable(mesh, CAMERA, 1, cost) is CAMERA
    assert affordable(mesh, CAMERA, 1, cost / 2).width == 50
    assert affordable(mesh, CAMERA, 1, cost / 16).width == 25
    assert affordable(mesh, CAMERA, 1, cost / 1000) is None


def runaway(path, count=20_000):
    """Splats of about the size of the scene, as scales stored without their logarithm are read."""
    rng = np.random.default_rng(0)
    v = rng.normal(size=(count, 3))
    v /= np.linalg.norm(v, axis=1)[:, None]
    sh = rng.normal(size=(count, 1, 3))
    cloud = GaussianCloud(
        v, np.tile([1, 0, 0, 0], (count, 1)), np.full((count, 3), 1.018), np.full(count, 0.95), sh
    )
    save_gaussians(cloud, path)
    return cloud


def test_nobody_waits_for_the_preview_of_a_runaway_scene(tmp_path, capsys, monkeypatch):
    """Of few splats, with limits as much lower."""
    runaway(tmp_path / "a.ply", 5000)
    monkeypatch.setattr(previews, "FRAGMENTS", previews.FRAGMENTS / 20)
    monkeypatch.setattr(viewers, "FRAGMENTS", viewers.FRAGMENTS / 10)
    measured = []

    def measure(views, **_):
        measured.extend(views)
        return AlphaChoice("blend")

    monkeypatch.setattr(viewers, "choose_by_views", measure)
    assert main(["convert", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.glb")]) == 0
    assert measured
    assert all(fragments(mesh, view, 4) <= viewers.FRAGMENTS for mesh, view in measured)
    said = capsys.readouterr().err
    assert "no preview: about" in said
    assert (tmp_path / "a.glb").exists()
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.slow
def test_long_images_are_announced(tmp_path, capsys):
    runaway(tmp_path / "a.ply", 2000)
    # One thread, so that the estimate is the same on all machines; the image itself is small.
    words = ["--width", "8", "--threads", "1", "--orbit", "1", "--animation", "none"]
    assert main(["render", str(tmp_path / "a.ply"), "-o", str(tmp_path / "few"), *words]) == 0
    assert "layers" not in capsys.readouterr().err


def test_costs_are_said_with_their_minutes():
    mesh, said = facing(20_000, 100.0), []
    announce_cost(mesh, [CAMERA.scaled(10)], 4, 2, said.append)
    assert "layers overlap at each pixel (overdraw): this may take" in said.pop()
    announce_cost(mesh, [CAMERA], 1, 2, said.append)
    assert said == []


def test_a_large_image_is_announced_however_few_layers_it_has():
    mesh, said = facing(20, 100.0), []
    huge = replace(CAMERA.scaled(200), width=16_384, height=16_384)
    announce_cost(mesh, [huge], 4, 1, said.append)
    assert said.pop().startswith("16,384 x 16,384 pixels of 4 x 4 samples take about ")
    announce_cost(mesh, [CAMERA] * 100_000, 1, 1, said.append)  # of which progress tells
    assert said == []


def test_the_alpha_of_real_scenes_is_measured(tmp_path):
    cloud = runaway(tmp_path / "a.ply", 300)
    small = GaussianCloud(cloud.means, cloud.quaternions, cloud.scales * 0.05, cloud.opacities, cloud.sh)
    mesh = convert(small)
    assert layers(mesh, orbit(mesh, 1, width=400, height=400)[0]) < 100
    assert choose_alpha(mesh).blend is not None
    with pytest.warns(DataWarning, match="the alpha mode is 'blend', without measurement"):
        assert choose_alpha(facing(200_000, 100.0), [CAMERA.scaled(4)]).blend is None
