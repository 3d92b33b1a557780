# ruff: noqa: E402
"""Unlit images by Cycles are those of ``render``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import cameras, random_mesh, sheets
from _local import shared_data

from meshsplats import convert, load_gaussians, orbit, render
from meshsplats.blender import SceneOptions, draw
from meshsplats.blender.inside.rendering import read_pixels
from meshsplats.cameras.trajectories import look_at
from meshsplats.evaluation.metrics import psnr
from meshsplats.images.reading import load_image
from meshsplats.images.writing import to_bytes
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.mesh import SplatMesh


def images(mesh, views, folder: Path, options: SceneOptions | None = None, suffix=".exr"):
    paths = [folder / f"{i}{suffix}" for i in range(len(views))]
    draw(mesh, views, images=paths, options=options)
    assert sorted(folder.iterdir()) == sorted(paths), "nothing else is left behind"
    return [read_pixels(path) if suffix == ".exr" else load_image(path) for path in paths]


def test_float_images_agree_for_every_lens(tmp_path):
    mesh = random_mesh()
    for camera, drawn in zip(cameras(), images(mesh, cameras(), tmp_path), strict=True):
        expected = render(mesh, camera)
        assert drawn.shape == (camera.height, camera.width, 4)
        assert psnr(drawn[..., :3], expected.color) > 60, camera.name


def test_samples_and_background_and_up_and_threads(tmp_path):
    mesh = random_mesh(up=(0.2, 0.9, -0.3))
    view = cameras()[1]
    options = SceneOptions(samples=3, background=(0.1, 0.6, 0.3), threads=1)
    drawn = images(mesh, [view], tmp_path, options)[0]
    expected = render(mesh, view, samples=3, background=(0.1, 0.6, 0.3)).color
    assert psnr(drawn[..., :3], expected) > 60


def test_transparent_images_composite_to_the_opaque_ones(tmp_path):
    mesh = random_mesh()
    view = cameras()[0]
    drawn = images(mesh, [view], tmp_path, SceneOptions(background=None))[0]
    expected = render(mesh, view, background=(0, 0, 0))
    assert psnr(drawn[..., :3], expected.color) > 60  # premultiplied, as .exr files are
    assert psnr(drawn[..., 3], expected.alpha) > 60


@pytest.mark.parametrize("samples", [1, 2])
def test_png_images_agree_to_a_step(tmp_path, samples):
    mesh = random_mesh()
    view = cameras()[0]
    drawn = images(mesh, [view], tmp_path, SceneOptions(samples=samples), ".png")[0]
    expected = to_bytes(render(mesh, view, samples=samples).color)
    difference = np.abs(drawn.astype(int) - expected)
    assert np.mean(difference > 1) < 2e-3
    assert psnr(drawn / 255, expected / 255) > 55


@pytest.mark.parametrize("samples", [1, 2])
def test_linear_meshes_are_blended_in_linear_light_and_shown_encoded(tmp_path, samples):
    mesh, background = random_mesh(blending="linear"), (0.2, 0.6, 0.9)
    view = cameras()[1]
    options = SceneOptions(samples=samples, background=background)
    expected = render(mesh, view, samples=samples, background=srgb_to_linear(np.array(background))).color
    draw(mesh, [view, view], images=[tmp_path / "a.exr", tmp_path / "a.png"], options=options)
    assert psnr(read_pixels(tmp_path / "a.exr")[..., :3], expected) > 60
    shown = to_bytes(linear_to_srgb(expected)) / 255
    assert psnr(load_image(tmp_path / "a.png") / 255, shown) > 60


def test_many_layers_are_not_cut_off(tmp_path):
    mesh = sheets(600, 0.004)
    view = look_at((0.2, 0.1, -3), (0, 0, 0), width=12, height=12, fov=20)
    drawn = images(mesh, [view], tmp_path)[0]
    assert psnr(drawn[..., :3], render(mesh, view, min_transmittance=0.0).color) > 60


def test_more_layers_than_blender_follows_are_told(tmp_path):
    from meshsplats import DataWarning

    view = look_at((0.2, 0.1, -30), (0, 0, 0), width=12, height=12, fov=2)
    with pytest.warns(DataWarning, match=r"up to 1[3-9]\d\d transparent triangles.*1024.*100\.00%"):
        draw(sheets(1400, 0.001), [view], images=[tmp_path / "a.png"])


def test_points_land_within_a_fiftieth_of_a_pixel(tmp_path):
    """Small bright squares, seen by a lens with its centre off and fx != fy, have their middle where they
    should."""
    rng = np.random.default_rng(5)
    view = replace(cameras()[1], width=96, height=80, cx=30.3, cy=50.8)
    pixels = rng.uniform([8, 8], [88, 72], (40, 2)).astype(int) // 12 * 12 + rng.uniform(3, 9, (40, 2))
    pixels = pixels[np.unique(pixels.astype(int) // 12, axis=0, return_index=True)[1]]
    depth = rng.uniform(2, 4, len(pixels))
    # Askew, so that the grid of samples cuts their edges evenly.
    square = np.array([[-1.7, -0.4], [0.4, -1.7], [1.7, 0.4], [-0.4, 1.7]])
    corners = (pixels[:, None] + square - [view.cx, view.cy]) / [view.fx, view.fy]
    corners = np.concatenate([corners, np.ones_like(corners[..., :1])], axis=2) * depth[:, None, None]
    rotation = view.world_to_camera[:3, :3]
    world = (corners - view.world_to_camera[:3, 3]) @ rotation
    faces = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(pixels))[:, None, None]).reshape(-1, 3)
    mesh = SplatMesh(world.reshape(-1, 3), faces, np.ones((4 * len(pixels), 4)))
    drawn = images(mesh, [view], tmp_path, SceneOptions(samples=16, background=(0, 0, 0)))[0][..., 0]
    rows, columns = np.mgrid[: view.height, : view.width] + 0.5
    for x, y in pixels:
        near = (np.abs(columns - x) < 3) & (np.abs(rows - y) < 3)
        weight = np.where(near, drawn, 0)
        assert abs((weight * columns).sum() / weight.sum() - x) < 0.02
        assert abs((weight * rows).sum() / weight.sum() - y) < 0.02


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", ["playbot_lod5_3k_sh2.ply", "guitar_sh0.ply"])
def test_real_splats(tmp_path, name):
    cloud = load_gaussians(shared_data(f"splats/{name}"))
    mesh = convert(cloud, max_splats=20_000)
    views = orbit(mesh, 3, width=120, height=90)[:2]
    for view, drawn in zip(views, images(mesh, views, tmp_path), strict=True):
        expected = render(mesh, view).color
        assert psnr(np.clip(drawn[..., :3], 0, 1), np.clip(expected, 0, 1)) > 60
