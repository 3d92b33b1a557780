"""The shader of docs/viewers.md in three.js: its images are those of ``render``."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshsplats as ms
from meshsplats.demo_scene import make_scene

pytest.importorskip("PIL", reason="Pillow is not installed")
from _three import three_js

DOCS = Path(__file__).parents[2] / "docs" / "viewers.md"


@pytest.fixture(scope="module")
def drawing(tmp_path_factory, node_package):
    """Draws a mesh with three.js: (h, w, 3) in [0, 1]."""
    snippet = re.search(r"```js\n(.*?)```", DOCS.read_text("utf-8"), re.DOTALL)[1]
    folder = tmp_path_factory.mktemp("three")
    with three_js(folder, node_package, snippet + "window.prepare = showHarmonics;") as draw:

        def drawn(mesh, camera, *, harmonics=True, before=None, order=None):
            how = {"alpha": "opaque", "cutoff": 0.5} if order is None else {"order": order}
            ms.save_mesh(mesh, folder / "mesh.glb", **how)
            if before is not None:
                ms.save_mesh(before, folder / "before.glb", **how)
            return draw(camera, harmonics, before is not None)

        yield drawn


@pytest.fixture(scope="module")
def mesh():
    return ms.convert(make_scene(1500))


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_images_are_those_of_render(drawing, mesh, degree):
    mesh = mesh.of_degree(degree)
    if not degree:
        mesh = replace(mesh, plain_colors=np.full((len(mesh.vertices), 3), 0.5))
    camera = ms.orbit(mesh, 1, azimuth=30, elevation=20, width=160, height=120)[0]
    wanted = ms.render(ms.cut_mesh(mesh, 0.5), camera).color
    shown, plain = drawing(mesh, camera), drawing(mesh, camera, harmonics=False)
    # Where two triangles lie within rounding of one depth, the depth buffer may choose the other.
    same = np.abs(shown - wanted).max(axis=2) < 0.02
    share, with_it, without = same.mean(), *(ms.psnr(image[same], wanted[same]) for image in (shown, plain))
    print(f"degree {degree}: {with_it:.1f} dB in {share:.1%} of the pixels, without the shader {without:.1f}")
    assert share > 0.97
    assert with_it > 55
    assert without < 40


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("degree", [0, 1])
def test_the_model_before_has_a_shader_of_its_own(drawing, mesh, degree):
    camera = ms.orbit(mesh, 1, azimuth=30, elevation=20, width=80, height=60)[0]
    own, other = mesh.of_degree(1), mesh.of_degree(degree)
    if degree:
        other = replace(other, harmonics=3 * other.harmonics)
    alone = drawing(own, camera)
    np.testing.assert_array_equal(drawing(own, camera, before=other), alone)
    assert ms.psnr(drawing(other, camera), alone) < 40


def test_all_nodes_of_an_order_have_the_shader(drawing, mesh):
    mesh = mesh.of_degree(1)
    mesh = replace(mesh, harmonics=4 * mesh.harmonics)
    camera = ms.orbit(mesh, 1, azimuth=30, elevation=20, width=80, height=60)[0]
    order, wanted = ms.drawing_order(mesh, nodes=3, quick=True), ms.render(mesh, camera).color
    shown, plain = (drawing(mesh, camera, harmonics=own, order=order) for own in (True, False))
    assert ms.psnr(shown, wanted) > 3 + ms.psnr(plain, wanted)
