"""Images of many cameras as the contents of files, without the command line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats import convert, orbit, render, render_splats
from meshsplats.cluster import open_workers
from meshsplats.demo_scene import make_scene
from meshsplats.images.writing import encode_image
from meshsplats.renders.frames import FrameOptions, depth_unit, draw_frames


@pytest.fixture(scope="module")
def cloud():
    return make_scene(200)


def contents(scene, cameras, options):
    with open_workers(None, 1) as workers:
        chosen = options.for_scene(scene, cameras)
        return dict(draw_frames(scene, cameras, chosen, workers=workers, load=lambda: scene))


def test_images_are_those_of_render(cloud):
    cameras, mesh = orbit(cloud, 2, width=24, height=16), convert(cloud)
    drawn = contents(mesh, cameras, FrameOptions(samples=2))
    for i, camera in enumerate(cameras):
        image = render(mesh, camera, samples=2, background=(1, 1, 1)).color
        assert drawn[i] == (encode_image("view.png", image), None)
    image = render_splats(cloud, cameras[0], samples=1, sh_degree=0, background=(0, 0, 1)).color
    drawn = contents(cloud, cameras[:1], FrameOptions(background=(0.0, 0.0, 1.0), sh_degree=0))
    assert drawn[0] == (encode_image("view.png", image), None)


def test_depth_comes_with_images_of_meshes(cloud):
    cameras, mesh = orbit(cloud, 1, width=24, height=16), convert(cloud)
    ((_, depth),) = contents(mesh, cameras, FrameOptions(depth="npy")).values()
    assert depth is not None
    assert depth[:6] == b"\x93NUMPY"
    unit = depth_unit(mesh.vertices, cameras)
    ((_, depth),) = contents(mesh, cameras, FrameOptions(depth="png", depth_unit=unit)).values()
    assert depth is not None
    assert depth[:4] == b"\x89PNG"


def test_the_farthest_point_fits_a_depth_image(cloud):
    camera = orbit(cloud, 1, width=24, height=16)[0]
    ahead = camera.center + np.array([[1.0], [3.0]]) * camera.world_to_camera[2, :3]
    assert depth_unit(ahead, [camera]) * 65535 == pytest.approx(3)


def test_samples_and_background_suit_the_scene(cloud):
    cameras = orbit(cloud, 1, width=24, height=16)
    assert FrameOptions().for_scene(cloud, cameras).samples == 1
    mesh = convert(cloud, colors="base")
    assert (FrameOptions().for_scene(mesh, cameras).samples or 0) > 1
    assert FrameOptions(samples=5).for_scene(mesh, cameras).samples == 5
    grey = FrameOptions(background=(0.5,) * 3)
    assert grey.for_scene(mesh, cameras).background == (0.5,) * 3
    linear = grey.for_scene(replace(mesh, blending="linear"), cameras)
    assert linear.background == pytest.approx((0.214,) * 3, abs=1e-3)
