"""The images decide: meshes against the splats they were made from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data

from meshsplats.cameras.files import load_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.metrics import psnr
from meshsplats.formats.gaussians import load_gaussians
from meshsplats.rendering import render
from meshsplats.rendering.looks import draw_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

MARGIN_WITHOUT = 1.5
"""How much better the default must be than paper where no cameras are known, dB."""


def one_color_each(cloud: GaussianCloud) -> GaussianCloud:
    """What a mesh can hold: colours of degree 0."""
    return replace(cloud, sh=cloud.sh[:, :1])


def likeness(mesh: SplatMesh, cloud: GaussianCloud, cameras: list[Camera], look: str = "area") -> float:
    """Mean PSNR in dB, 2 x 2 samples a pixel on white."""
    images = [render(mesh, camera, samples=2).color for camera in cameras]
    truths = [draw_splats(cloud, camera, look).color for camera in cameras]
    return float(np.mean([psnr(a, b) for a, b in zip(images, truths, strict=True)]))


@pytest.fixture(scope="module")
def scene() -> tuple[GaussianCloud, list[Camera], list[Camera]]:
    cloud = one_color_each(make_scene(8000))
    close, mid = (orbit(cloud, 3, azimuth=20, width=240, height=240, distance=d) for d in (0.7, 1.4))
    return cloud, close, mid


@pytest.mark.slow
@pytest.mark.parametrize("look", ["area", "splats"])
def test_default_beats_paper_at_no_more_triangles(scene, look):
    cloud, close, mid = scene
    paper, default = convert(cloud, preset="paper"), convert(cloud, cameras=close, look=look)
    assert len(default.faces) <= 8 * len(cloud)
    assert likeness(default, cloud, close, look) > likeness(paper, cloud, close, look) + 2
    assert likeness(default, cloud, mid, look) > likeness(paper, cloud, mid, look) + 1.5


@pytest.mark.slow
def test_each_look_is_what_its_conversion_is_best_at(scene):
    cloud, close, _ = scene
    area, viewer = (convert(cloud, cameras=close, look=look) for look in ("area", "splats"))
    assert likeness(area, cloud, close, "area") > likeness(viewer, cloud, close, "area") + 2
    assert likeness(viewer, cloud, close, "splats") > likeness(area, cloud, close, "splats") + 2


@pytest.mark.slow
def test_each_ingredient_helps(scene):
    cloud, close, _ = scene
    full = likeness(convert(cloud, cameras=close), cloud, close)
    for options in (dict(mode="flat"), dict(rim_opacity=0.2), dict(rim_radius=2.0)):
        assert likeness(convert(cloud, cameras=close, **options), cloud, close) < full - 0.3, options
    wide = likeness(convert(cloud, cameras=close, look="splats"), cloud, close, "splats")
    assert likeness(convert(cloud, footprint="none"), cloud, close, "splats") < wide - 0.3


@pytest.mark.slow
@pytest.mark.parametrize("count", [300, 8000])
def test_without_cameras(count):
    """Better than paper on coarse and fine clouds, at the distance of images of the whole and nearer."""
    cloud = one_color_each(make_scene(count))
    paper, default = convert(cloud, preset="paper"), convert(cloud)
    assert len(default.faces) <= 8 * len(cloud)
    for distance in (0.6, 1.0):
        cameras = orbit(cloud, 2, azimuth=20, width=600, height=600, distance=distance)
        assert likeness(default, cloud, cameras) > likeness(paper, cloud, cameras) + MARGIN_WITHOUT, distance


def test_more_triangles_help(scene):
    cloud, close, _ = scene
    eight = likeness(convert(cloud, cameras=close), cloud, close)
    rings = likeness(convert(cloud, cameras=close, sides=6, rings=2), cloud, close)
    assert rings > eight + 0.3


def test_limits_leave_out_what_shows_least(scene):
    cloud, close, _ = scene
    best = convert(cloud, cameras=close, max_splats=len(cloud) // 2, budget="drop")
    rest = np.setdiff1d(np.arange(len(cloud)), best.face_splat)
    worst = convert(cloud.take(rest), cameras=close)
    assert likeness(best, cloud, close) > likeness(worst, cloud, close) + 3


def test_kernels():
    """Each kernel's own image, with meshes made for it and for the plain kernel."""
    cloud = one_color_each(make_scene(8000))
    cameras = orbit(cloud, 2, azimuth=20, width=240, height=240, distance=1.2)
    options = dict(cameras=cameras, look="splats")
    thin = replace(cloud, kernel="antialiased", scales=cloud.scales * np.float32(0.4))
    right = likeness(convert(thin, **options), thin, cameras, "splats")
    wrong = likeness(convert(replace(thin, kernel="3dgs"), **options), thin, cameras, "splats")
    assert right > wrong + 3
    flat = np.take_along_axis(cloud.scales, np.argsort(-cloud.scales, axis=1), axis=1)
    order = cloud.scales[:, 2] <= cloud.scales[:, :2].min(axis=1)
    surfels = replace(cloud, scales=flat * [1, 1, 0], kernel="2dgs").take(order)
    assert len(surfels) > 1000
    filtered = likeness(convert(surfels, **options), surfels, cameras, "splats")
    assert filtered > likeness(convert(surfels, preset="paper"), surfels, cameras, "splats") + 1


@pytest.mark.nightly
def test_real_splats():
    """The paper's conversion has the figures that were measured independently; the default beats it."""
    cloud = one_color_each(load_gaussians(shared_data("splats/playbot_lod3_31k_sh2.ply")))
    close, mid, far = (
        load_cameras(shared_data(f"cameras/playbot_{d}.json")) for d in ("close", "mid", "far")
    )
    paper, wide = convert(cloud, preset="paper"), convert(cloud, cameras=close, look="splats")
    measured = likeness(paper, cloud, mid, "splats"), likeness(paper, cloud, far, "splats")
    assert measured == pytest.approx((26.49, 29.71), abs=0.1)
    assert likeness(wide, cloud, mid, "splats") > measured[0] + 1.5
    assert likeness(wide, cloud, far, "splats") > measured[1] - 0.1
    near = close[:2]
    assert likeness(wide, cloud, near, "splats") > likeness(paper, cloud, near, "splats") + 2
    assert likeness(convert(cloud, cameras=close), cloud, near) > likeness(paper, cloud, near) + 2
