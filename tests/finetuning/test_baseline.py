"""The conversion as the baseline of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats import convert, make_config, orbit, plain_colors_of, psnr, render, splat_dataset
from meshsplats.conversion import ConversionOptions
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning.baseline import SizeScores, converted, measure_baseline, partly

CONFIG = make_config(steps=5)


@pytest.fixture(scope="module", name="cloud")
def cloud_fixture():
    return make_scene(300)


@pytest.fixture(scope="module", name="baseline")
def baseline_fixture(cloud):
    data = splat_dataset(cloud, train=2, test=3, width=32)
    return measure_baseline(convert(cloud), cloud, data, CONFIG, threads=1)


def test_sizes_at_which_a_mesh_is_worse():
    scores = SizeScores({200: 30.0, 400: 30.0, 800: 30.0}, {200: 31.0, 400: 29.96, 800: 29.9})
    assert scores.worse_at == [800]  # differences of up to 0.05 dB do not count
    assert scores.loses
    assert not SizeScores({200: 30.0}, {200: 30.0}).loses


def test_the_conversion_is_scored_at_four_sizes(cloud, baseline):
    """From half the width of the views to four times as wide, in windows as large as a view."""
    assert list(baseline.scores) == list(baseline.views) == [16, 32, 64, 128]
    assert {len(views) for views in baseline.views.values()} == {3}
    assert {view.camera.width for view in baseline.views[128]} == {32}
    focal = baseline.views[32][0].camera.fx
    np.testing.assert_allclose(
        [views[0].camera.fx / focal for views in baseline.views.values()], [0.5, 1, 2, 4]
    )
    mesh, view = convert(cloud), baseline.views[64][0]
    image = np.clip(render(mesh, view.camera, samples=2).color, 0, 1)
    alone = replace(baseline, views={64: (view,)}, scores={64: 0.0}).compare(mesh, CONFIG, threads=1)
    assert alone.tuned[64] == pytest.approx(psnr(image, np.clip(view.image, 0, 1)), abs=1e-3)


def test_the_same_mesh_does_not_lose_and_a_grey_one_does(cloud, baseline):
    mesh = convert(cloud)
    same = baseline.compare(mesh, CONFIG, threads=1)
    assert same.tuned == same.converted
    assert not same.loses
    grey = replace(
        mesh, colors=np.concatenate([np.full_like(mesh.colors[:, :3], 0.5), mesh.colors[:, 3:]], 1)
    )
    assert baseline.compare(grey, CONFIG, threads=1).worse_at == [16, 32, 64, 128]


def test_as_few_views_as_there_is_time_for(cloud):
    data = splat_dataset(cloud, train=2, test=3, width=32)
    hurried = measure_baseline(convert(cloud), cloud, data, CONFIG, threads=1, seconds=0)
    assert {len(views) for views in hurried.views.values()} == {1}
    without = splat_dataset(cloud, train=2, test=0, width=32)
    assert list(measure_baseline(convert(cloud), cloud, without, CONFIG, threads=1).scores) == [
        16,
        32,
        64,
        128,
    ]


def test_what_convert_makes_of_splats(cloud):
    plain = converted(cloud, CONFIG, ConversionOptions(detail="cameras"))
    assert np.array_equal(plain.vertices, convert(cloud).vertices)
    assert converted(cloud, CONFIG, ConversionOptions(look="splats")).filter_px2 > 0
    opaque = converted(cloud, make_config(steps=5, opacity="cutoff"), ConversionOptions())
    assert (opaque.colors[:, 3] == 1).all()


def test_part_of_the_way(cloud):
    start = convert(cloud)
    end = replace(start, vertices=start.vertices + 2, colors=np.zeros_like(start.colors))
    half = partly(start, end, 0.5)
    np.testing.assert_allclose(half.vertices, start.vertices + 1, atol=1e-6)
    np.testing.assert_allclose(half.colors, start.colors / 2, atol=1e-6)
    assert partly(start, end.take(np.arange(len(end.faces)) > 0), 0.5) is None


def test_part_of_the_way_of_plain_colours():
    """Means over the same views are linear in colours and harmonics, as long as none is held at 0."""
    start = convert(make_scene(200))
    assert start.harmonics is not None
    faint = 0.1 / np.abs(start.harmonics).max()
    start = replace(start, colors=start.colors.clip(0.4, 0.6), harmonics=faint * start.harmonics)
    end = replace(start, colors=start.colors + np.array([0.1, -0.1, 0, 0]), harmonics=1.5 * start.harmonics)
    cameras = orbit(start, 3, width=24, height=24)
    start, end = (replace(m, plain_colors=plain_colors_of(m, cameras)) for m in (start, end))
    for share in (0.25, 1.0):
        part = partly(start, end, share)
        np.testing.assert_allclose(part.plain_colors, plain_colors_of(part, cameras), atol=1e-5)
    assert partly(start, replace(end, plain_colors=None), 0.5).plain_colors is None
