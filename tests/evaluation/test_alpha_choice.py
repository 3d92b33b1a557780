"""choose_alpha: the alpha mode of a file for viewers that do not sort, by what they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data

from meshsplats import GaussianCloud, SplatMesh, convert, load_gaussians, load_mesh, orbit, render, save_mesh
from meshsplats.errors import DataWarning
from meshsplats.evaluation import viewers
from meshsplats.evaluation.viewers import AlphaChoice, area_means, choose_alpha
from meshsplats.rendering.viewers import viewer_images


def shell(radius: float, opacity: float, rgb, n: int = 500) -> GaussianCloud:
    """Round splats evenly on a sphere."""
    height = 1 - 2 * (np.arange(n) + 0.5) / n
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(n)
    ring = np.sqrt(1 - height**2)
    means = radius * np.stack([ring * np.cos(turn), height, ring * np.sin(turn)], axis=1)
    sh = np.broadcast_to((np.asarray(rgb) - 0.5) / 0.28209479177387814, (n, 1, 3))
    scales = np.full((n, 3), 2.2 * radius / np.sqrt(n))
    return GaussianCloud(means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, np.full(n, opacity), sh)


def joined(*clouds: GaussianCloud) -> SplatMesh:
    return convert(GaussianCloud.joined(clouds))


RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def test_what_is_inside_must_not_show_through():
    # Red is inside, and drawn last.
    choice = choose_alpha(joined(shell(1, 0.95, BLUE), shell(0.7, 0.95, RED)))
    assert choice.alpha == "mask"
    assert choice.mask > choice.blend + 5
    assert choice.options == {"alpha": "mask", "cutoff": choice.cutoff}


def test_faint_layers_of_one_colour_need_no_order():
    choice = choose_alpha(joined(shell(1, 0.1, BLUE), shell(0.7, 0.1, BLUE)))
    assert choice.alpha == "blend"
    assert choice.blend > choice.mask + 5
    assert choice.options == {"alpha": "blend"}


@pytest.mark.slow
def test_cutoff_below_the_opacities():
    # Many layers of 0.15 are solid together, and each of them is below the usual cutoff.
    layers = [shell(1 - 0.02 * i, 0.15, BLUE if i < 20 else RED) for i in range(40)]
    mesh = joined(*layers)
    choice = choose_alpha(mesh, orbit(mesh, 4, width=160, height=160))
    assert (choice.alpha, choice.cutoff) == ("mask", 0.1)


def test_nothing_seen_is_no_measurement():
    mesh = joined(shell(1, 0.95, BLUE))
    away = [camera.relative_to(np.full(3, 1e4)) for camera in orbit(mesh, 2, width=50, height=50)]
    with pytest.warns(DataWarning, match="'blend', without measurement: the images show nothing"):
        choice = choose_alpha(mesh, away)
    assert choice == AlphaChoice("blend")
    assert choice.in_words() is None


def test_equal_images_have_no_number():
    line = AlphaChoice("blend", 0.2, 200.0, 31.52).in_words()
    assert line is not None
    assert line.startswith("alpha: blend, equal to the sorted image in viewers that do not sort")
    assert line.endswith("mask with cutoff 0.2: 31.5 dB")
    both = AlphaChoice("blend", 0.2, 200.0, 200.0).in_words()
    assert both is not None
    assert both.endswith("mask with cutoff 0.2: equal")


def test_figures_are_those_of_the_images():
    mesh = joined(shell(1, 0.5, BLUE, 100), shell(0.5, 0.9, RED, 100))
    cameras = orbit(mesh, 3, width=600, height=300)
    choice = choose_alpha(mesh, cameras)
    used = [camera.scaled(400 / 600) for camera in cameras[:2]]  # it is clear
    errors = np.zeros(2)
    for camera in used:
        truth = render(mesh, camera, samples=2).color
        images = viewer_images(mesh, camera, [None, choice.cutoff])
        means = [(image - truth).reshape(50, 4, 100, 4, 3).mean(axis=(1, 3)) for image in images]
        errors += [np.mean(mean**2) for mean in means]
    assert [choice.blend, choice.mask] == pytest.approx(-10 * np.log10(errors / len(used)), abs=0.01)


def test_means_over_areas_by_hand():
    image = np.arange(30.0).reshape(5, 6, 1)
    corner = image[:4, :4].mean()
    expected = [[corner, image[:4, 4:].mean()], [image[4:, :4].mean(), image[4:, 4:].mean()]]
    assert area_means(image)[..., 0] == pytest.approx(np.array(expected))
    assert area_means(image[:1, :1]).tolist() == [[[0.0]]]


def test_solid_meshes_are_not_measured(tmp_path, monkeypatch):
    mesh = joined(shell(1, 0.9, BLUE, 50))
    solid = replace(mesh, colors=np.concatenate([mesh.colors[:, :3], np.ones((len(mesh.colors), 1))], axis=1))
    monkeypatch.setattr(viewers, "render", None)
    assert choose_alpha(solid) == AlphaChoice("opaque")
    assert AlphaChoice("opaque").options == {}  # no cut
    colors = solid.colors.copy()
    colors[solid.faces[:20].ravel(), 3] = 0.3
    mixed = replace(solid, colors=colors)
    assert choose_alpha(mixed).options == {"alpha": "hybrid"}
    save_mesh(mixed, tmp_path / "mixed.glb", **choose_alpha(mixed).options)
    assert len(load_mesh(tmp_path / "mixed.glb").faces) == len(mixed.faces)


@pytest.mark.slow
def test_large_meshes_have_fewer_views(monkeypatch):
    mesh = joined(shell(1, 0.9, BLUE, 50))
    monkeypatch.setattr(viewers, "CLEAR", np.inf)
    counts = []
    for most in (len(mesh.faces), len(mesh.faces) * 3 // 4, len(mesh.faces) // 10):
        drawn = []
        monkeypatch.setattr(viewers, "TRIANGLES", most)
        monkeypatch.setattr(
            viewers, "render", lambda *a, drawn=drawn, **k: drawn.append(0) or render(*a, **k)
        )
        choose_alpha(mesh)
        counts.append(len(drawn))
    assert counts == [4, 3, 2]


def test_two_views_suffice_where_the_choice_is_clear(monkeypatch):
    drawn = []
    monkeypatch.setattr(viewers, "render", lambda *a, **k: drawn.append(a[1]) or render(*a, **k))
    choose_alpha(joined(shell(1, 0.95, BLUE), shell(0.7, 0.95, RED)))
    assert len(drawn) == 2
    gaze = [camera.world_to_camera[2, :3] for camera in drawn]
    assert gaze[0] @ gaze[1] < -0.7


def test_no_triangles():
    with pytest.raises(ValueError, match="without triangles"):
        choose_alpha(SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 4))))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "limit", "alpha"),
    [
        ("splats/guitar_sh0.ply", 50_000, "mask"),
        ("splats/tt_truck_sh0.ply", 50_000, "mask"),
        ("splats/playbot_lod5_3k_sh2.ply", 3000, "mask"),
        ("splats/monkey_0001.sog", 50_000, "blend"),
    ],
)
def test_real_scenes(name, limit, alpha):
    mesh = convert(load_gaussians(shared_data(name)), max_splats=limit)
    choice = choose_alpha(mesh)
    assert choice.alpha == alpha, choice
    # Seen from afar, from other cameras, it is the better one.
    cameras = orbit(mesh, 3, elevation=10, azimuth=25, width=64, height=64)
    scores = np.zeros(2)
    for camera in cameras:
        truth = render(mesh, camera, samples=2).color
        near = viewer_images(mesh, camera.scaled(4), [None, choice.cutoff])
        far = [image.reshape(64, 4, 64, 4, 3).mean(axis=(1, 3)) for image in near]
        scores -= [np.log10(np.mean((image - truth) ** 2)) for image in far]
    assert ("blend", "mask")[int(np.argmax(scores))] == alpha
