"""Files with an order in three.js, with its stock loader: what the emulations say of them holds there."""

from __future__ import annotations

import pytest

import meshsplats as ms
from meshsplats.demo_scene import make_scene
from meshsplats.rendering.viewers import ordered_image

pytest.importorskip("PIL", reason="Pillow is not installed")
from _stock_viewer import stock_image
from _three import three_js


@pytest.fixture(scope="module")
def drawing(tmp_path_factory, node_package):
    """The file that is drawn, and what draws it."""
    folder = tmp_path_factory.mktemp("three")
    with three_js(folder, node_package) as draw:
        yield folder / "mesh.glb", draw


@pytest.mark.nightly
@pytest.mark.parametrize("nodes", [1, 5])
def test_three_js_draws_the_order_as_both_emulations_do(drawing, nodes):
    """An image of the file alone (stock_image) and our own are as near to the sorted mesh as three.js is.
    Without an order, that is far from it."""
    path, draw = drawing
    mesh = ms.convert(make_scene(400), colors="base")
    order = ms.drawing_order(mesh, nodes=nodes)
    for camera in ms.orbit(mesh, 2, azimuth=35, elevation=20, width=96, height=80):
        near = camera.with_near_plane(mesh.vertices)
        truth = ms.render(mesh, camera).color
        ms.save_mesh(mesh, path, order=order)
        shown = draw(camera)
        images = [stock_image(path, near), ordered_image(mesh, order, near, multisample=False)]
        scores = [ms.psnr(image, truth) for image in (shown, *images)]
        assert max(scores) - min(scores) < 0.7, scores
        for image in images:
            assert ms.psnr(image, shown) > 40
        ms.save_mesh(mesh, path, alpha="blend")
        assert ms.psnr(draw(camera), truth) < scores[0] - 3
