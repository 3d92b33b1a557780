"""Tilesets whose colours depend on the view: as the whole mesh of the splats, read back from 8 bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _cities import COUNT, SMALL, digest

from meshsplats import convert, load_gaussians, orbit, psnr, render, save_gaussian_blocks, stream_gaussians
from meshsplats.cli import main
from meshsplats.conversion import ConversionOptions
from meshsplats.demo_scene.city import city_blocks
from meshsplats.operations.inspection import describe
from meshsplats.tiles import building
from meshsplats.tiles.building import build_tiles
from meshsplats.tiles.drawing import render_tiles, tiles_mesh
from meshsplats.tiles.tileset import Tileset

VIEW = replace(SMALL, alpha="mask", conversion=ConversionOptions(colors="view"))


@pytest.fixture(autouse=True)
def small_buckets(monkeypatch):
    monkeypatch.setattr(building, "BUCKET", 3000)


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    """A city of degree 1."""
    path = tmp_path_factory.mktemp("city") / "city.ply"
    save_gaussian_blocks(city_blocks(COUNT, degree=1), path, COUNT, degree=1)
    return path


@pytest.fixture(scope="module")
def tileset(splats, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles") / "tileset"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "BUCKET", 3000)
        build_tiles(stream_gaussians(splats, block=1000), folder, VIEW)
    return folder


@pytest.mark.slow
def test_leaves_have_the_harmonics_of_the_whole_mesh(splats, tileset):
    mesh = convert(load_gaussians(splats))
    assert mesh.sh_degree == 1
    rows = np.unique(mesh.face_splat)
    seen = 0
    for tile, _ in Tileset(tileset).tiles():
        part = tile.load()
        assert part.sh_degree == 1  # inner ones, too
        if not tile.children:
            own = np.searchsorted(rows, part.splats.numbers)
            error = np.abs(part.harmonics - mesh.harmonics[own]).max()
            assert error <= np.abs(part.harmonics).max() / 127 * 0.501
            seen += len(own)
    assert seen == len(rows)


def test_images_are_those_of_the_whole_mesh(splats, tileset):
    mesh = convert(load_gaussians(splats))
    for camera in orbit(mesh, 2, elevation=30, width=96, height=72):
        image = render(mesh, camera).color
        drawn = render_tiles(Tileset(tileset), camera, max_error=0).color
        base = render(mesh.of_degree(0), camera).color
        assert psnr(drawn.clip(0, 1), image.clip(0, 1)) > psnr(base.clip(0, 1), image.clip(0, 1)) + 15
    joined, _ = tiles_mesh(Tileset(tileset), [camera])
    assert joined.sh_degree == 1


@pytest.mark.slow
def test_opaque_tiles_have_them_too(splats, tmp_path):
    build_tiles(stream_gaussians(splats), tmp_path / "t", replace(VIEW, alpha="opaque"))
    root = Tileset(tmp_path / "t").root.load()
    assert (root.colors[:, 3] == 1).all()
    assert root.sh_degree == 1


@pytest.mark.slow
def test_they_are_left_out_unless_asked_for(splats, tileset, tmp_path, capsys):
    base, none = tmp_path / "base", tmp_path / "none"
    assert main(["tiles", str(splats), "-o", str(base), "--max-triangles", "4096", "--alpha", "mask"]) == 0
    without = stream_gaussians(splats), none, replace(SMALL, alpha="mask", conversion=ConversionOptions())
    build_tiles(*without)
    assert digest(none) == digest(base)
    assert Tileset(base).root.load().sh_degree == 0
    assert [describe(t)["sh_degree"] for t in (base, tileset)] == [0, 1]
    assert "Blender" in describe(tileset)["harmonics_drawn_by"]
    words = ["tiles", str(splats), "-o", str(tmp_path / "v"), "--max-triangles", "4096", "--alpha", "mask"]
    assert main([*words, "--colors", "view"]) == 0
    assert digest(tmp_path / "v") == digest(tileset)
    assert main([*words, "--color-degree", "1", "--force"]) == 0  # a degree asks for them, too
    assert digest(tmp_path / "v") == digest(tileset)
    assert main([*words, "--colors", "base", "--color-degree", "1", "--force"]) == 2
    assert "--color-degree has no effect without --colors view" in capsys.readouterr().err


def test_files_of_different_degrees(tmp_path):
    """Splats that have no harmonics get some of 0."""
    clouds = list(city_blocks(800, degree=3))
    flat = [cloud.of_degree(0) for cloud in city_blocks(600, degree=0, seed=1)]
    for name, blocks, count, degree in (("a", clouds, 800, 3), ("b", flat, 600, 0)):
        save_gaussian_blocks(blocks, tmp_path / f"{name}.ply", count, degree=degree)
    source = stream_gaussians([tmp_path / "a.ply", tmp_path / "b.ply"])
    options = replace(VIEW, conversion=ConversionOptions(colors="view", color_degree=2))
    build_tiles(source, tmp_path / "t", options)
    leaves = [tile.load() for tile, _ in Tileset(tmp_path / "t").tiles() if not tile.children]
    assert {mesh.sh_degree for mesh in leaves} == {2}
    for mesh in leaves:
        of_flat = mesh.splats.numbers >= 800
        assert not mesh.harmonics[of_flat].any()
    assert any(mesh.harmonics.any() for mesh in leaves)
