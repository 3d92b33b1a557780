"""Views for which splats are merged where nobody names any."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats import convert, orbit
from meshsplats.cameras.framing import guess_up
from meshsplats.conversion import merging
from meshsplats.conversion.merging_views import (
    SIDE,
    VIEWS,
    convert_within_limits,
    merged_within_limits,
    merging_views,
)
from meshsplats.conversion.options import ConversionOptions
from meshsplats.demo_scene import make_scene
from meshsplats.demo_scene.room import HALF, MIDDLE, make_room


@pytest.fixture(scope="module")
def room():
    return make_room(4000)


def same(one, other):
    for name in ("vertices", "faces", "colors", "harmonics", "up"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_an_object_is_seen_from_all_around():
    cloud = make_scene(2000)
    views = merging_views(cloud)
    assert len(views) == VIEWS
    assert {(view.width, view.height) for view in views} == {(SIDE, SIDE)}
    heights = [(view.center - cloud.means.mean(axis=0)) @ guess_up(cloud) for view in views]
    assert min(heights) < 0 < max(heights)


@pytest.mark.slow
def test_a_room_is_seen_from_within(room):
    views = merging_views(room)
    inside = [(np.abs(view.center - MIDDLE) < HALF).all() for view in views]
    assert len(views) > VIEWS // 2
    assert np.mean(inside) > 0.9


@pytest.mark.slow
def test_nothing_but_the_merging_follows_from_the_views(room):
    limit = ConversionOptions(max_splats=700)
    made = convert_within_limits(room, limit)
    seen = {"cameras": merging_views(room), "up": guess_up(room)}
    same(made, convert(room, limit, footprint="framing", **seen))
    assert not np.array_equal(made.vertices, convert(room, limit).vertices)


def test_without_merging_no_views_are_looked_for(room, monkeypatch):
    monkeypatch.setattr("meshsplats.conversion.merging_views.merging_views", None)
    same(convert_within_limits(room), convert(room))
    generous = ConversionOptions(max_splats=len(room))
    same(convert_within_limits(room, generous), convert(room))
    dropping = ConversionOptions(max_splats=100, budget="drop")
    same(convert_within_limits(room, dropping), convert(room, dropping))
    cameras = orbit(room, 3, width=50, height=50)
    limit = ConversionOptions(max_splats=700)
    same(convert_within_limits(room, limit, cameras=cameras), convert(room, limit, cameras=cameras))


@pytest.mark.slow
def test_many_splats_are_merged_in_blocks(room, monkeypatch):
    monkeypatch.setattr(merging, "LARGE", 1000)
    monkeypatch.setitem(merging.simplify_in_blocks.__kwdefaults__, "block", 500)
    views = merging_views(room)[:8]
    many = merging.simplify_large(room, 800, views)
    np.testing.assert_array_equal(many.means, merging.simplify_in_blocks(room, 800, cameras=views).means)
    assert not np.array_equal(many.means, merging.simplify(room, 800, cameras=views).means)
    alone = merging.simplify_large(room, 800, None)
    np.testing.assert_array_equal(alone.means, merging.simplify(room, 800).means)


@pytest.mark.slow(keep=2)
@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    "limits",
    [
        ConversionOptions(max_splats=700),
        ConversionOptions(max_triangles=5000),
        ConversionOptions(max_triangles=5000, mode="flat"),
        ConversionOptions(max_triangles=20_000, mode="flat"),
        ConversionOptions(max_triangles=5000, mode="flat", sides=4),
    ],
)
def test_merged_once_a_conversion_keeps_to_the_limits(room, limits):
    views = merging_views(room)[:8]
    merged, options = merged_within_limits(room, limits, views)
    made = convert(merged, options)
    for_views = convert(room, limits, cameras=views, footprint="framing")
    assert made.splat_count == for_views.splat_count == len(merged) < len(room)
    assert len(made.faces) == len(for_views.faces)
    np.testing.assert_array_equal(merged.means, merging.simplify(room, len(merged), cameras=views).means)


def test_nothing_is_merged_without_a_limit_that_wants_it(room):
    views = orbit(room, 3, width=50, height=50)
    for options in (ConversionOptions(max_splats=len(room)), ConversionOptions(max_splats=9, budget="drop")):
        assert merged_within_limits(room, options, views) == (room, options)
