"""A few splats far away, or of any size, cost all others nothing."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _gpu import need_gpu
from _local import shared_data

import meshsplats as ms
from meshsplats.cameras.framing import STRAY, UNSEEN, scene_bounds, warn_of_strays, warn_of_unseen
from meshsplats.cli import main
from meshsplats.conversion.cleaning import find
from meshsplats.errors import DataWarning, StraysWarning
from meshsplats.rendering import render, render_splats
from meshsplats.tiles.building import TileOptions, build_tiles
from meshsplats.tiles.drawing import choose_tiles, render_tiles
from meshsplats.tiles.tileset import Tileset
from meshsplats.viewer.quantise import quantise_mesh


def ball(count: int = 1500, size: float = 0.05) -> ms.GaussianCloud:
    rng = np.random.default_rng(0)
    places = rng.normal(size=(count, 3))
    places /= np.linalg.norm(places, axis=1)[:, None]
    turns = rng.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    return ms.GaussianCloud(places, turns, np.full((count, 3), size), np.full(count, 0.95), places[:, None])


def beside(cloud: ms.GaussianCloud, places: np.ndarray, size: float) -> ms.GaussianCloud:
    n = len(places)
    return ms.GaussianCloud(
        np.concatenate([cloud.means, places]),
        np.concatenate([cloud.quaternions, np.tile([0.6, 0.8, 0, 0], (n, 1))]),
        np.concatenate([cloud.scales, np.full((n, 3), size)]),
        np.concatenate([cloud.opacities, np.full(n, 0.95)]),
        np.concatenate([cloud.sh, np.zeros((n, 1, 3))]),
    )


FAR = {
    "one at 1e8": (np.array([[1e8, 0, 0]]), 0.05),
    "one at 1e30": (np.array([[1e30, 0, 0]]), 0.05),
    "twelve over 4e7": (np.random.default_rng(3).uniform(-1.8e7, 2.2e7, (12, 3)), 0.05),
    "large and far": (np.array([[0, 3e7, 0]]), 1e4),
}
LARGE = {f"e{power}": (np.array([[0.6, 0, 0.8]]), np.exp(power)) for power in (10, 20, 40, 60, 88)}


@pytest.fixture(scope="module")
def camera():
    return ms.orbit(ball(), 1, azimuth=30, width=120, height=120)[0]


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("strays", [*FAR.values(), *LARGE.values()], ids=[*FAR, *LARGE])
def test_pages_are_as_exact_as_without(strays, camera):
    mesh = ms.convert(beside(ball(), *strays))
    for one in (mesh, replace(mesh, face_splat=None)):
        quantised = quantise_mesh(one)
        images = [render(m, camera, samples=2).color for m in (one, quantised.decoded)]
        assert 255 * np.abs(images[0] - images[1]).max() < 0.5
        assert quantised.relative_error < 1e-6


@pytest.mark.parametrize("strays", FAR.values(), ids=list(FAR))
def test_far_splats_change_no_image(strays, camera):
    cloud = beside(ball(), *strays)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = ms.convert(cloud)
    np.testing.assert_allclose(
        render_splats(cloud, camera).color, render_splats(ball(), camera).color, atol=1e-6
    )
    # The limit of the footprint follows the spacing, which cells tell within a factor of two.
    plain = render(ms.convert(ball()), camera, samples=2).color
    assert ms.psnr(render(mesh, camera, samples=2).color, plain) > 40


@pytest.mark.parametrize("power", [30, 40, 60, 80, 88])
def test_a_splat_of_any_size_is_drawn_as_a_plane(power, camera):
    """From e^40 on its triangles were stripes: edge functions overflowed float32."""
    place = np.array([[0.3, 2, 1]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        images = [
            render(ms.convert(beside(ball(), place, np.exp(p))), camera, samples=2).color for p in (20, power)
        ]
    np.testing.assert_allclose(images[1], images[0], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("power", [40, 80])
def test_a_splat_of_any_size_on_the_gpu(power, camera):
    need_gpu()
    mesh = ms.convert(beside(ball(), np.array([[0.3, 2, 1]]), np.exp(power)))
    images = [render(mesh, camera, samples=2, device=device).color for device in ("cpu", "gpu")]
    assert np.mean(np.abs(images[0] - images[1]) > 0.01) < 1e-3


@pytest.mark.parametrize("strays", [*FAR.values(), *LARGE.values()], ids=[*FAR, *LARGE])
def test_clean_removes_them_and_nothing_else(strays):
    cloud = beside(ball(), *strays)
    for scene in (cloud, ms.convert(cloud)):
        kept = find(scene).kept
        assert kept[:1500].all()
        assert not kept[1500:].any()


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("strays", [*FAR.values(), LARGE["e20"]], ids=[*FAR, "e20"])
def test_tiles_of_the_rest_are_as_fine(strays, camera, tmp_path):
    cloud = beside(ball(9000, 0.02), *strays)
    ms.save_gaussians(cloud, tmp_path / "c.ply")
    with pytest.warns(StraysWarning):
        build_tiles(ms.stream_gaussians(tmp_path / "c.ply"), tmp_path / "t", TileOptions(max_triangles=8000))
    tiles = Tileset(tmp_path / "t")
    whole = render(ms.convert(cloud), camera, samples=2).color
    assert ms.psnr(render_tiles(tiles, camera, max_error=0.25, samples=2).color, whole) > 45
    away = replace(ms.look_at((0, 0, -400), (0, 0, 0), width=100, height=100))
    if strays is not LARGE["e20"]:  # its box holds any camera
        assert sum(tile.triangles for tile in choose_tiles(tiles, [away])[0]) < 40_000


@pytest.mark.slow
def test_one_line_names_clean(tmp_path, capsys):
    ms.save_gaussians(beside(ball(), *FAR["one at 1e8"]), tmp_path / "far.ply")
    ms.save_gaussians(beside(ball(), *LARGE["e20"]), tmp_path / "large.ply")
    ms.save_gaussians(ball(), tmp_path / "plain.ply")
    for name, words in (("far", "lie about 10^8 radii away"), ("large", "are about 10^9 radii")):
        assert main(["info", str(tmp_path / f"{name}.ply")]) == 0
        said = capsys.readouterr().err
        assert said.count("meshsplats clean") == 1
        assert words in said
    assert main(["info", str(tmp_path / "plain.ply")]) == 0
    assert "clean" not in capsys.readouterr().err
    words = [str(tmp_path / "far.ply"), "-o", str(tmp_path / "clean.ply")]
    assert main(["clean", *words]) == 0
    assert "warning" not in capsys.readouterr().err
    assert main(["info", str(tmp_path / "clean.ply")]) == 0
    assert "clean removes" not in capsys.readouterr().err


def test_captures_need_no_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error", StraysWarning)
        for name in ("guitar_sh0.ply", "truck.splat", "places/building_300k_sh3", "trained/miku_58k_sh0.ply"):
            cloud = ms.load_gaussians(Path(shared_data("splats")) / name)
            size = float(cloud.scales.max())
            warn_of_strays(cloud, cloud.means.min(axis=0), cloud.means.max(axis=0), size)


def test_the_threshold():
    cloud = ball()
    for factor, warned in ((0.9, False), (1.1, True)):
        high = cloud.means.max(axis=0) + np.array([factor * STRAY, 0, 0])
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            warn_of_strays(cloud, cloud.means.min(axis=0), high, 0.0)
        assert bool(found) == warned


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scales": np.full((1500, 3), 0.002, np.float32)}, "so small for their distances (usually 0.002"),
        ({"opacities": np.full(1500, 0.001, np.float32)}, "so faint (95% have an opacity below 0.001)"),
    ],
)
def test_splats_that_pictures_do_not_show(change, words, tmp_path, capsys):
    """By hand: 1500 balls of 0.05 have 2 pi 1500 0.05^2 = 23.6 of area, over pi: 7.5 times the disc."""
    plain = ball()
    ms.save_gaussians(plain, tmp_path / "plain.ply")
    ms.save_gaussians(replace(plain, **change), tmp_path / "unseen.ply")
    assert main(["info", str(tmp_path / "plain.ply")]) == 0
    assert capsys.readouterr().err == ""
    for words_of in (["info"], ["cameras", "-o", str(tmp_path / "c.json")]):
        assert main([words_of[0], str(tmp_path / "unseen.ply"), *words_of[1:]]) == 0
        said = capsys.readouterr().err
        assert said.count("hardly anything can be seen") == 1
        assert words in said


def test_how_much_is_seen():
    """Shares on both sides of the limit, by hand."""
    at = np.sqrt(UNSEEN / 0.95 / 0.9 / (2 * 1500)) * scene_bounds(ball()).radius
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_unseen(ball(size=1.02 * at))
        warn_of_unseen(ball(count=999, size=0.001))
    with pytest.warns(DataWarning, match="about 5% of the pictures"):
        warn_of_unseen(ball(size=0.98 * at))
