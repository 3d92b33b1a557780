"""Which reason is given where a scene shows almost nothing of the photographs: its frame, or another."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from _local import shared_data

import meshsplats as ms
from meshsplats import DataWarning, GaussianCloud
from meshsplats.cameras.framing import scene_bounds
from meshsplats.evaluation.backgrounds import ALIKE, find_background, warn_of_frame_mismatch

FRAMES = "different frames, moved, rotated or scaled"
SAME = "frames of cameras and scene agree, as coarse images are alike"
EMPTY = "nearly empty or faint, or much smaller"


@cache
def captured(name: str) -> tuple[GaussianCloud, ms.Dataset]:
    path, photos, downscale = {
        "statue": ("miku_58k_sh0.ply", "snowmiku", 8),
        "toy": ("lego_60k_sh0.ply", "lego", 4),
    }[name]
    cloud = ms.load_gaussians(shared_data(f"splats/trained/{path}"))
    data = ms.load_dataset(shared_data(f"photos/{photos}"), downscale=downscale)
    return cloud, ms.Dataset(data.train[:: len(data.train) // 4][:4])


def moved(scale: float = 1, turn: np.ndarray | None = None, shift: float = 0) -> Callable:
    """About the middle of the scene, shifts in its radius. Turns are half ones about an axis."""

    def make(cloud: GaussianCloud) -> GaussianCloud:
        bounds = scene_bounds(cloud)
        turned = (cloud.means - bounds.center) * (1 if turn is None else turn) * scale
        means = (turned + bounds.center + [shift * bounds.radius, 0, 0]).astype(np.float32)
        return replace(cloud, means=means, scales=cloud.scales * np.float32(scale))

    return make


def thinned(count: int) -> Callable:
    def make(cloud: GaussianCloud) -> GaussianCloud:
        rows = np.random.default_rng(0).choice(len(cloud), count, replace=False)
        return cloud.take(np.sort(rows))

    return make


CASES = [
    ("statue", moved(shift=1), FRAMES),
    ("statue", moved(shift=2), FRAMES),
    ("statue", moved(shift=3), FRAMES),
    ("statue", moved(scale=0.1), FRAMES),
    ("toy", moved(turn=np.array([1, -1, -1])), FRAMES),
    ("toy", moved(turn=np.array([-1, -1, 1])), FRAMES),
    ("toy", moved(scale=2), FRAMES),
    ("toy", moved(shift=0.5), FRAMES),
    ("statue", lambda cloud: replace(cloud, sh=cloud.sh + np.float32(1.2)), SAME),
    ("statue", lambda cloud: replace(cloud, opacities=cloud.opacities * np.float32(0.1)), SAME),
    ("statue", moved(scale=0.01), EMPTY),
    ("statue", thinned(300), EMPTY),
    ("statue", thinned(5), EMPTY),
    ("toy", moved(scale=0.1), EMPTY),
    ("toy", thinned(5), EMPTY),
]


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(("name", "change", "reason"), CASES)
def test_the_reason_is_the_likely_one(name, change, reason):
    cloud, data = captured(name)
    found = find_background(data, {"splats": change(cloud)})
    assert found.shown is not None
    assert (found.shown.likeness >= ALIKE) == (reason == SAME)
    with pytest.warns(DataWarning, match=reason):
        warn_of_frame_mismatch(found)


@pytest.mark.parametrize("name", ["statue", "toy"])
def test_scenes_in_their_own_frame_need_no_word(name):
    cloud, data = captured(name)
    found = find_background(data, {"splats": cloud})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_frame_mismatch(found)
    assert found.shown is not None
    assert found.shown.likeness > 0.9


def test_empty_and_masked_scenes_have_a_reason(tmp_path):
    """A mesh without any triangle in view, and views of which nothing counts."""
    camera = ms.look_at((0, 0, -3), (0, 0, 0), width=32, height=32)
    noise = np.random.default_rng(0).random((32, 32, 3)).astype(np.float32)
    data = ms.Dataset((ms.View(camera, ms.ViewImage(noise)),))
    corners = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])
    one = ms.SplatMesh(corners, np.array([[0, 1, 2]], np.int32), np.ones((3, 4)))
    with pytest.warns(DataWarning, match=f"the mesh shows almost nothing .* covers 0.0% .* 100% .* {EMPTY}"):
        warn_of_frame_mismatch(find_background(data, {"mesh": one}))
    behind = replace(one, vertices=one.vertices - np.float32([0, 0, 9]))
    with pytest.warns(DataWarning, match=FRAMES):
        warn_of_frame_mismatch(find_background(data, {"mesh": behind}))
    hidden = ms.Dataset((ms.View(camera, ms.ViewImage(noise, None, np.zeros((32, 32), bool))),))
    found = find_background(hidden, {"mesh": one})
    assert found.shown is not None
    assert (found.shown.coverage, found.shown.likeness) == (0, 0)
    assert find_background(data, {}).shown is None
