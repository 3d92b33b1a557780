"""compare: scores against a calculation by hand, on images from the renderer's own functions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from meshsplats import DataWarning, convert, splat_dataset
from meshsplats.cameras.trajectories import orbit
from meshsplats.evaluation.comparison import Comparison, ViewSimilarity, compare, compare_views
from meshsplats.evaluation.metrics import ssim
from meshsplats.rendering import render
from meshsplats.rendering.looks import draw_splats
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


def scene() -> tuple[GaussianCloud, SplatMesh, list]:
    rng = np.random.default_rng(0)
    n = 60
    quaternions = rng.normal(size=(n, 4))
    cloud = GaussianCloud(
        rng.normal(size=(n, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        rng.uniform(0.05, 0.3, (n, 3)),
        rng.uniform(0.2, 1, n),
        rng.normal(size=(n, 4, 3)),
    )
    vertices = rng.normal(size=(30, 3))
    mesh = SplatMesh(vertices, np.arange(30).reshape(10, 3), rng.uniform(0, 1, (30, 4)))
    return cloud, mesh, orbit(cloud, 3, width=40, height=30)


@pytest.mark.parametrize("look", ["area", "splats"])
def test_scores_are_those_of_the_images(look):
    cloud, mesh, cameras = scene()
    options = {"look": look, "background": (0, 0.5, 1)}
    views = list(compare_views(cloud, mesh, cameras, sh_degree=0, **options))
    assert [view.score.name for view in views] == ["view_0000", "view_0001", "view_0002"]
    for view, camera in zip(views, cameras, strict=True):
        a = np.clip(draw_splats(cloud, camera, look, sh_degree=0, background=(0, 0.5, 1)).color, 0, 1)
        samples = {"area": 2, "splats": 1}[look]
        b = np.clip(render(mesh, camera, samples=samples, background=(0, 0.5, 1)).color, 0, 1)
        np.testing.assert_array_equal(view.splats, a)
        np.testing.assert_array_equal(view.mesh, b)
        error = np.mean((a.astype(float) - b) ** 2)
        assert view.score.psnr == pytest.approx(-10 * np.log10(error), abs=1e-6)
        assert view.score.ssim == pytest.approx(ssim(a, b), abs=1e-6)
    result = compare(cloud, mesh, cameras, sh_degree=0, **options)
    assert result.views == tuple(view.score for view in views)
    assert result.psnr == pytest.approx(np.mean([view.score.psnr for view in views]))
    assert result.ssim == pytest.approx(np.mean([view.score.ssim for view in views]))


def test_a_mesh_for_linear_blending_is_compared_as_it_is_shown():
    cloud, mesh, cameras = scene()
    mesh = replace(mesh, colors=mesh.colors * np.float32([0.5, 0.5, 0.5, 1]), blending="linear")
    background = (0.1, 0.5, 1)
    behind = srgb_to_linear(np.float32(background))
    for view in compare_views(cloud, mesh, cameras, samples=1, background=background):
        drawn = render(mesh, view.camera, background=behind).color
        np.testing.assert_allclose(view.mesh, linear_to_srgb(drawn), atol=1e-6)


def test_options_reach_the_images():
    cloud, mesh, cameras = scene()
    full, flat = (next(compare_views(cloud, mesh, cameras, sh_degree=d)) for d in (None, 0))
    assert np.abs(full.splats - flat.splats).max() > 0.05
    peeled = next(compare_views(cloud, mesh, cameras, max_layers=1))
    assert np.abs(peeled.mesh - full.mesh).max() > 0.05


def test_equal_images_in_json():
    """JSON has no infinity; a mean over views of which one is perfect has no figure either."""
    result = Comparison((ViewSimilarity("a", float("inf"), 1.0), ViewSimilarity("b", 30.0, 0.5)))
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False)) == {
        "views": [{"name": "a", "psnr": None, "ssim": 1.0}, {"name": "b", "psnr": 30.0, "ssim": 0.5}],
        "mean": {"psnr": None, "ssim": 0.75},
    }


def test_nothing_to_compare():
    cloud, mesh, _ = scene()
    with pytest.raises(ValueError, match="at least one camera"):
        compare(cloud, mesh, [])


def test_cameras_that_see_nothing_are_told_of():
    cloud, mesh, cameras = scene()
    away = [replace(camera, cx=camera.cx + 1e4) for camera in cameras]
    unseen = r"none of the 3 cameras sees any of the 60 splats: are they of one scene, and do the matrices"
    for use in (compare, lambda cloud, _, cameras: splat_dataset(cloud, cameras=cameras, train=3)):
        with pytest.raises(ValueError, match=unseen):
            use(cloud, mesh, away)
        with pytest.warns(DataWarning, match=r"2 of 3 cameras see none .*\(view_0001, view_0002\)"):
            use(cloud, mesh, [cameras[0], *away[1:]])
        near = [replace(camera, near=99) for camera in cameras]
        with pytest.raises(ValueError, match="sees any of the 60 splats: what they look at is nearer"):
            use(cloud, mesh, near)
    # A camera may see a splat whose centre is beside its image.
    one = cloud.take([0])
    beside = orbit(one, 1, width=64, height=64)[0].window(-40, 0, 62, 64)
    assert not beside.sees(one.means).any()
    assert compare(one, convert(one), [beside]).psnr < 100
