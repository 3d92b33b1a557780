"""View-dependent colours on the GPU: the images of the core, from one upload."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _gpu import assert_same_image, both, need_gpu
from _local import shared_data
from _rendering import camera
from test_webgpu_render import random_fans

from meshsplats import SplatMesh, convert, load_gaussians, orbit, render
from meshsplats.webgpu.device import open_device
from meshsplats.webgpu.frames import MeshFrames
from meshsplats.webgpu.renderer import MeshRenderer
from meshsplats.webgpu.settings import DrawSettings


@pytest.fixture(autouse=True)
def _gpu():
    need_gpu()


def with_harmonics(mesh: SplatMesh, terms: int, strength: float = 0.4) -> SplatMesh:
    random = np.random.default_rng(terms)
    return replace(mesh, harmonics=random.normal(0, strength, (len(mesh.splats), terms, 3)))


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("order", ["fragment", "splat"])
@pytest.mark.parametrize("terms", [3, 8, 15])
def test_equal_to_the_core(terms, order):
    mesh = with_harmonics(random_fans(150), terms)
    view = camera(61, 43, near=0.3)
    gpu, core = both(mesh, view, order=order, depth=True, normals=True, samples=2)
    assert_same_image(gpu, core)
    plain = render(replace(mesh, harmonics=None), view, order=order, samples=2)
    assert np.abs(core.color - plain.color).max() > 0.2


def test_vertices_of_no_triangle_and_filters():
    mesh = with_harmonics(random_fans(80), 8)
    mesh = replace(
        mesh,
        vertices=np.concatenate([[[0, 0, 3]], mesh.vertices]),
        colors=np.concatenate([[[1, 1, 1, 1]], mesh.colors]),
        faces=mesh.faces + 1,
        filter_px2=0.3,
    )
    assert_same_image(*both(mesh, camera(61, 43, near=0.3)), least=95, most=1e-3)


def test_colours_above_one_and_below_zero():
    mesh = with_harmonics(random_fans(60), 15, strength=3)
    mesh = replace(mesh, colors=mesh.colors * [4, 4, 4, 1])
    gpu, core = both(mesh, camera(61, 43, near=0.3))
    assert core.color.max() > 1.5
    assert_same_image(gpu, core)


def test_a_mesh_is_uploaded_once(monkeypatch):
    uploads = []
    upload = MeshFrames.upload
    monkeypatch.setattr(
        MeshFrames, "upload", lambda self, name, array: (uploads.append(name), upload(self, name, array))
    )
    mesh = with_harmonics(random_fans(20), 3)
    renderer = MeshRenderer(open_device(), mesh)
    seen = [renderer.draw(view, DrawSettings()).color for view in orbit(mesh, 3, width=32, height=32)]
    assert uploads.count("harmonics") == uploads.count("base") == uploads.count("vertices") == 1
    assert "values" not in uploads
    assert np.abs(seen[0] - seen[1]).max() > 0.05


@pytest.mark.parametrize(
    ("name", "degree"), [("playbot_lod5_3k_sh2.ply", 2), ("trained/lego_60k_sh3.ply", 3)]
)
def test_real_splats(name, degree):
    cloud = load_gaussians(shared_data(f"splats/{name}"))
    mesh = convert(cloud.take(np.arange(len(cloud)) % max(1, len(cloud) // 5000) == 0))
    assert mesh.sh_degree == degree
    for view in orbit(mesh, 2, width=120, height=120):
        assert_same_image(*both(mesh, view), most=1e-4)
