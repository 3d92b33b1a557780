"""The side of an object that is shown first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data

from meshsplats._common.geometry import quaternions_of
from meshsplats.cameras.trajectories import direction, front_axes, orbit
from meshsplats.conversion import convert
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.formats.gaussians import load_gaussians
from meshsplats.rendering.previews import USUAL
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.viewpoints import opening
from meshsplats.viewpoints.opening import opening_azimuth, opening_camera

UP = (0.0, -1.0, 0.0)


def ball(azimuth: float | None, count: int = 4000) -> GaussianCloud:
    """A grey ball; a patch of stripes of many colours on the side that ``azimuth`` looks at."""
    index = np.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    level = np.sqrt(1 - height**2)
    means = np.stack([level * np.cos(turn), height, level * np.sin(turn)], axis=1)
    colors = np.full((count, 3), 0.5)
    if azimuth is not None:
        striped = means @ direction(front_axes(np.array(UP)), azimuth, 0) > 0.6
        band = np.floor(8 * means[:, 1]).astype(int)
        colors[striped] = np.stack([band % 2, band // 2 % 2, band // 4 % 2], axis=1)[striped]
    return GaussianCloud(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.03),
        np.full(count, 0.95),
        ((colors - 0.5) / SH_C0)[:, None],
    )


@pytest.mark.parametrize("azimuth", [0, 120, 270])
def test_it_is_the_one_with_most_to_see(azimuth):
    cloud = ball(azimuth)
    assert opening_azimuth(cloud) == opening_azimuth(convert(cloud)) == azimuth
    camera = opening_camera(cloud)
    np.testing.assert_allclose(camera.center, orbit(cloud, 1, azimuth=azimuth)[0].center)


def test_a_turned_object_opens_with_the_same_side():
    cloud, turn = ball(0), np.radians(60)
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    quaternions = np.tile(quaternions_of(rotation[None]), (len(cloud), 1))
    turned = replace(cloud, means=cloud.means @ rotation.T, quaternions=quaternions)
    assert opening_azimuth(turned) in (60, 300)
    assert opening_azimuth(turned) != opening_azimuth(cloud)


def test_what_is_alike_from_all_sides_opens_as_usual(monkeypatch):
    assert opening_azimuth(ball(None)) == USUAL
    assert opening_azimuth(replace(ball(120), opacities=np.zeros(4000, np.float32))) == USUAL
    monkeypatch.setattr(opening, "MOST_FRAGMENTS", 1)  # what would take long is not looked at
    monkeypatch.setattr(opening, "_shown", None)
    assert opening_azimuth(ball(120)) == USUAL


def test_a_few_of_many_splats_tell(monkeypatch):
    monkeypatch.setattr(opening, "SPLATS", 500)
    assert opening_azimuth(ball(120)) in (90, 120, 150)
    assert opening_azimuth(convert(ball(120))) in (90, 120, 150)


def test_single_images_show_it_and_rounds_begin_in_front(tmp_path):
    cloud = ball(120)

    def first(views: SceneViews, count: int) -> np.ndarray:
        return views.make(cloud, tmp_path / "a.ply", count=count, side=100)[0].center

    def seen_from(azimuth: float) -> np.ndarray:
        return orbit(cloud, 1, azimuth=azimuth, elevation=15, width=100, height=100)[0].center

    np.testing.assert_allclose(first(SceneViews(), 1), seen_from(120))
    np.testing.assert_allclose(first(SceneViews(azimuth=0), 1), seen_from(0))
    for views, count in ((SceneViews(orbit=4), 1), (SceneViews(), 8)):
        np.testing.assert_allclose(
            first(views, count) / np.linalg.norm(first(views, count)),
            seen_from(0) / np.linalg.norm(seen_from(0)),
            atol=1e-3,
        )


@pytest.mark.parametrize(
    ("name", "front"),
    [("guitar_sh0.ply", (60, 90, 120)), ("playcanvas_logo_307k_sh0.ply", (150, 180, 210))],
)
def test_real_objects_open_with_their_front(name, front):
    cloud = load_gaussians(shared_data(f"splats/{name}"))
    assert opening_azimuth(cloud) in front
