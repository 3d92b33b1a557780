"""Triangles by what cameras show: as many in all, more where more shows and is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats import GaussianCloud, SplatMesh, convert, draw_splats, render
from meshsplats._common.arrays import subsample
from meshsplats.cameras.trajectories import look_at
from meshsplats.conversion.detail import (
    FEWEST_IMAGES,
    HIDDEN,
    IMAGES,
    LEAST,
    LEVELS,
    MIN_VIEWS,
    TRIANGLES,
    choose_levels,
    visibility,
)

shares = st.lists(st.floats(0, 1e4), min_size=1, max_size=40).map(np.array)


def scene(seed: int, n: int = 80) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(n, 4))
    return GaussianCloud(
        rng.normal(size=(n, 3)),
        turns / np.linalg.norm(turns, axis=1, keepdims=True),
        np.exp(rng.normal(size=(n, 3)) - 2),
        rng.uniform(0.1, 1, n),
        rng.normal(size=(n, 1, 3)),
    )


def cameras(count: int = 3) -> list:
    return [
        look_at((6 * np.sin(a), 0.5, -6 * np.cos(a)), (0, 0, 0), up=(0, -1, 0), width=64, height=48, fov=50)
        for a in range(count)
    ]


@settings(max_examples=200, deadline=None, derandomize=True)
@given(shares, st.integers(3, 90), st.integers(0, 10).map(lambda power: 4.0**power))
def test_levels(shown, mean, factor):
    """Within the budget, and not wasteful; who shows more has no less; only ratios count."""
    budget = mean * len(shown)
    levels = choose_levels(shown, budget)
    assert TRIANGLES[levels].sum() <= budget
    order = np.argsort(shown, kind="stable")
    # Of splats that show the same, the first may be one step ahead when the budget ends between them.
    strict = np.diff(shown[order]) > 1e-9 * shown[order][1:]
    assert (np.diff(levels[order])[strict] >= 0).all()
    assert (levels[shown == 0] == 0).all()
    could_rise = (shown > 0) & (levels < len(LEVELS) - 1)
    if could_rise.any():
        assert budget - TRIANGLES[levels].sum() < np.diff(TRIANGLES).max()
    np.testing.assert_array_equal(levels, choose_levels(shown * factor, budget))  # its root rounds nothing


def test_levels_of_a_hand_worked_case():
    """Of 1 and 100 pixels, the second climbs to 8 (5 more), 24 (16 more) and 36, before the first has 4."""
    shown = np.array([1.0, 100.0])
    assert TRIANGLES[choose_levels(shown, 26)].tolist() == [3, 8]
    assert TRIANGLES[choose_levels(shown, 27)].tolist() == [3, 24]
    assert TRIANGLES[choose_levels(shown, 39)].tolist() == [3, 36]
    assert TRIANGLES[choose_levels(shown, 40)].tolist() == [4, 36]
    assert TRIANGLES[choose_levels(shown, 6)].tolist() == [3, 3]
    with pytest.raises(ValueError, match="2 splats need at least 6 triangles, not 5"):
        choose_levels(shown, 5)


@pytest.mark.parametrize("look", ["area", "splats"])
def test_shown_pixels_are_the_opacity_of_the_image(look):
    """What all splats show adds up to the opacity of the images; one before the other hides it."""
    cloud = scene(0)
    mesh = convert(cloud, mode="flat", footprint="none")
    views = cameras()
    shown = visibility(mesh, cloud.means, cloud, views, look).pixels
    samples = {"area": 2, "splats": 1}[look]
    drawn = [render(mesh, view, background=(0, 0, 0), samples=samples) for view in views]
    alpha = np.mean([image.alpha.sum(dtype=np.float64) for image in drawn])
    np.testing.assert_allclose(shown.sum(), alpha, rtol=1e-4)
    one = mesh.take(mesh.face_splat == 7)
    alone = render(one, views[0], background=(0, 0, 0), samples=samples).alpha.sum(dtype=np.float64)
    only = visibility(one, cloud.means, cloud, views[:1], look).pixels
    np.testing.assert_allclose(only[7], alone, rtol=1e-4)
    assert (np.delete(only, 7) == 0).all()


@pytest.mark.parametrize("look", ["area", "splats"])
def test_error_is_that_of_the_image(look):
    """Of a mesh that fills every pixel, the squared differences of colour and opacity add up."""
    cloud = scene(5, 1)
    sheet = SplatMesh(
        np.array([[-90, -90, 0], [90, -90, 0], [0, 90, 0.0]]),
        np.array([[0, 1, 2]]),
        np.array([[0.2, 0.5, 0.4, 1]] * 3),
        face_splat=np.zeros(1, np.int32),
    )
    (view,) = cameras(1)
    truth = draw_splats(cloud, view, look, background=(0, 0, 0), samples={"area": 2, "splats": 1}[look])
    square = np.square(truth.color - [0.2, 0.5, 0.4]).sum() + np.square(1 - truth.alpha).sum()
    seen = visibility(sheet, cloud.means, cloud, [view], look)
    np.testing.assert_allclose(seen.error, square, rtol=1e-4)
    np.testing.assert_allclose(seen.pixels, 64 * 48, rtol=1e-4)
    np.testing.assert_allclose(seen.need, np.sqrt(square * 64 * 48), rtol=1e-4)


def test_pixels_are_those_of_the_camera():
    """Cameras of twelve times the size: their images are looked at smaller, and show 144 times as many
    pixels."""
    cloud = scene(1)
    mesh = convert(cloud, mode="flat", footprint="none")
    small = [replace(view) for view in cameras()]
    large = [view.scaled(12) for view in small]
    a, b = (visibility(mesh, cloud.means, cloud, views, "area").pixels for views in (small, large))
    np.testing.assert_allclose(b.sum() / a.sum(), 144, rtol=0.02)


def test_what_is_hidden_gets_no_triangles():
    """Behind an opaque wall, out of all images, and before too few cameras to tell."""
    wall = GaussianCloud(
        np.array([[0, 0, 0], [0, 0, 3.0], [0, 40, 0], [0.3, 0, -1]]),
        np.array([[1.0, 0, 0, 0]] * 4),
        np.array([[9, 9, 0.01], [0.1, 0.1, 0.1], [0.1, 0.1, 0.1], [0.1, 0.1, 0.1]]),
        np.array([1, 1, 1, 0.5]),
        np.zeros((4, 1, 3)),
    )
    views = [
        look_at((x, 0, -6), (x, 0, 0), up=(0, -1, 0), width=40, height=40, fov=40)
        for x in np.linspace(-0.5, 0.5, MIN_VIEWS)
    ]
    mesh = convert(wall, cameras=views, detail="cameras", footprint="none")
    assert np.unique(mesh.face_splat).tolist() == [0, 2, 3]
    assert len(mesh.faces) <= 8 * 4
    assert (mesh.face_splat == 0).sum() > 8
    assert (mesh.face_splat == 2).sum() == LEAST
    even = convert(wall, mode="flat", footprint="none")
    assert visibility(even, wall.means, wall, views, "area").hidden.tolist() == [False, True, False, False]
    assert visibility(even, wall.means, wall, views[1:], "area").hidden.tolist() == [False] * 4
    pixels = visibility(even, wall.means, wall, views, "area").pixels
    assert pixels[1] < HIDDEN < pixels[3]


@pytest.mark.parametrize("mean", [3, 8, 20])
def test_as_many_triangles_in_all(mean):
    cloud, views = scene(2), cameras()
    mesh = convert(cloud, cameras=views, detail="cameras", sides=mean)
    even = convert(cloud, cameras=views, mode="flat", sides=mean)
    assert len(mesh.faces) <= len(even.faces)
    assert len(mesh.faces) > 0.9 * len(even.faces)
    counts = np.bincount(mesh.face_splat, minlength=len(cloud))
    assert set(counts) <= set(TRIANGLES.tolist())
    if mean == LEAST:
        assert (counts == LEAST).all()
        return
    need = visibility(even, cloud.means, cloud, views, "area").need
    assert (np.diff(counts[np.argsort(need)]) >= 0).all()


def test_a_splat_has_the_fan_of_its_level():
    """Without stars, each splat is what an even conversion to its own number of triangles makes of it."""
    cloud, views = scene(3), cameras()
    mesh = convert(cloud, cameras=views, detail="cameras", flat_below=1)
    counts = np.bincount(mesh.face_splat, minlength=len(cloud))
    assert len(set(counts)) >= 4
    for (sides, rings), triangles in zip(LEVELS, TRIANGLES, strict=True):
        even = convert(cloud, cameras=views, mode="flat", sides=sides, rings=rings)
        for splat in np.flatnonzero(counts == triangles):
            a, b = (m.take(m.face_splat == splat) for m in (mesh, even))
            assert (a.faces == b.faces).all()
            # BLAS rounds the product of a single row otherwise than that of many.
            np.testing.assert_allclose(a.vertices, b.vertices, rtol=1e-6, atol=1e-6)
            np.testing.assert_array_equal(a.colors, b.colors)


def test_max_triangles_is_kept():
    cloud, views = scene(4), cameras()
    options = dict(cameras=views, detail="cameras", max_triangles=200)
    mesh = convert(cloud, **options, sides=8)
    assert 150 < len(mesh.faces) <= 200
    assert mesh.splat_count == 25
    finer = convert(cloud, **options)
    assert 150 < len(finer.faces) <= 200
    assert finer.splat_count == 50  # of 4 triangles in the mean


def test_images_end_early_where_there_is_no_time():
    """After six, evenly spread: what they show is about what all show."""
    cloud, views = scene(3), cameras(18)
    calls: list[tuple[int, int]] = []
    mesh = convert(cloud, mode="flat")

    def hurried(done, total):
        calls.append((done, total))
        return False

    some = visibility(mesh, cloud.means, cloud, views, "area", on_image=hurried)
    total = len(subsample(views, IMAGES[0]))
    assert calls == [(n, total) for n in range(1, FEWEST_IMAGES + 1)]
    every = visibility(mesh, cloud.means, cloud, views, "area", on_image=lambda done, total: True)
    whole = visibility(mesh, cloud.means, cloud, views, "area")
    assert np.array_equal(every.pixels, whole.pixels)
    np.testing.assert_allclose(some.pixels.sum(), whole.pixels.sum(), rtol=0.2)
    assert not some.hidden.any()  # six images do not tell
