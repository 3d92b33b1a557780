"""Photographs that are blurred or double: named when they are, and no others."""

from __future__ import annotations

import io
from dataclasses import replace
from math import erf, sqrt

import numpy as np
import pytest
from _balls import ball_view, cameras_around
from PIL import Image

from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.errors import DataWarning
from meshsplats.training import train, train_config
from meshsplats.training.suspects import REACH, Suspects, _are_low, alike, find_suspects, steepness

SIZE = {"start_splats": 1500, "max_splats": 1500, "growth_events": 0, "sh_degree": 0}


def sharp_view(camera) -> View:
    """A photograph of a ball in a sphere, whose patterns have two shades in each channel, and so edges."""
    view = ball_view(camera, backdrop=True)
    color = np.round(40 + 170 * np.round(view.load().color)).astype(np.uint8)
    return replace(view, source=ViewImage(color))


@pytest.fixture(scope="module")
def photographs():
    return [sharp_view(camera) for camera in cameras_around(20, side=96)]


def with_color(view: View, color: np.ndarray, **changes) -> View:
    return replace(view, source=replace(view.load(), color=color), **changes)


def smeared(color: np.ndarray, count: int, *axes: int) -> np.ndarray:
    """``color``, each pixel the mean of ``count`` along each of ``axes``."""
    values = color.astype(np.float32)
    for axis in axes:
        values = np.mean([np.roll(values, k - count // 2, axis) for k in range(count)], axis=0)
    return values.astype(color.dtype)


# ---- All of them


def test_photographs_without_a_fault_are_not_named(photographs):
    assert find_suspects(photographs) == Suspects()


@pytest.mark.parametrize("axes", [(0, 1), (0,), (1,)], ids=["out of focus", "shaken upwards", "sideways"])
def test_blurred_ones_are_named(photographs, axes):
    views = list(photographs)
    for i in (3, 11):
        views[i] = with_color(views[i], smeared(views[i].load().color, 7, *axes))
    assert find_suspects(views) == Suspects(blurred=("003", "011"))


@pytest.mark.parametrize("kind", ["a copy", "JPEG", "smaller"])
def test_the_same_photograph_twice_is_named(photographs, kind):
    view = photographs[4]
    picture, camera = Image.fromarray(view.load().color), replace(view.camera, name="copy")
    if kind == "JPEG":
        file = io.BytesIO()
        picture.save(file, "JPEG", quality=98, subsampling=0)
        picture = Image.open(file)
    if kind == "smaller":
        picture = picture.resize((32, 32), Image.Resampling.BOX)
        camera = replace(camera.within(32), name="copy")
    again = View(camera, ViewImage(np.asarray(picture)))
    found = find_suspects([*photographs, again])
    assert found == Suspects(duplicates=(("004", "copy"),))
    moved = View(camera, ViewImage(np.roll(np.asarray(picture), 1, axis=1)))
    assert find_suspects([*photographs, moved]) == Suspects(), "a neighbour is another photograph"


def test_clear_pixels_do_not_make_neighbours_the_same(photographs):
    """A tenth of the image shows the subject, as in lego, where two are a third of a degree apart."""
    alpha = np.zeros((96, 96), np.uint8)
    alpha[33:63, 33:63] = 255
    views = [
        replace(view, source=ViewImage(np.minimum(view.load().color, alpha[..., None]), alpha))
        for view in photographs
    ]
    color = views[4].load().color
    copy = replace(views[4], camera=replace(views[4].camera, name="copy"))
    assert find_suspects([*views, copy]) == Suspects(duplicates=(("004", "copy"),))
    neighbour = with_color(copy, np.where(alpha[..., None] > 0, color + 7, color).astype(np.uint8))
    assert find_suspects([*views, neighbour]) == Suspects()


def test_photographs_of_unlike_things_are_not_blurred_beside_each_other():
    """A quarter lies far below the median where all are spread as widely."""
    spread = np.linspace(0.2, 1.8, 20)[:, None]
    assert not _are_low(spread).any()
    assert _are_low(np.append(np.full(19, 1.0), 0.3)[:, None]).tolist() == [False] * 19 + [True]


def test_few_photographs_do_not_tell_what_is_usual(photographs):
    blurred = with_color(photographs[0], smeared(photographs[0].load().color, 7, 0, 1))
    views = [blurred, *photographs[1:4]]
    assert find_suspects(views) == Suspects()


# ---- One at a time


@pytest.mark.parametrize("sigma", [1.0, 2.0])
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_the_steepness_of_an_edge_follows_from_its_blur(sigma, kind):
    """A step blurred by a Gaussian is an error function."""
    at = (np.arange(80) - 39.5) / (sigma * sqrt(2))
    profile = np.array([0.5 + 0.4 * erf(x) for x in at])
    steep = [erf(k / 2 / (sigma * sqrt(2))) for k in (1, REACH)]
    color = np.repeat(np.repeat(profile[None, :, None], 300, axis=0), 3, axis=2)
    color = np.round(255 * color).astype(np.uint8) if kind == np.uint8 else color.astype(kind)
    # One place in eighty is the middle of the edge: those beside it count, too.
    rows, columns = steepness(ViewImage(color))
    assert rows == pytest.approx(steep[0] / steep[1], abs=0.06)
    assert np.isnan(columns)
    assert steepness(ViewImage(color.swapaxes(0, 1).copy())) == pytest.approx([columns, rows], nan_ok=True)


def test_a_sharp_edge_has_a_steepness_of_one_in_any_light():
    color = np.zeros((300, 80, 3), np.uint8)
    color[:, 40:] = 200
    assert steepness(ViewImage(color))[0] == 1
    assert steepness(ViewImage(color // 5))[0] == 1


def test_a_wall_tells_nothing(photographs):
    grey = with_color(photographs[2], np.full_like(photographs[2].load().color, 120))
    assert np.isnan(steepness(grey.load())).all()
    assert find_suspects([*photographs[:2], grey, *photographs[3:]]) == Suspects()


def test_pairs_are_those_of_equal_rows():
    rows = np.random.default_rng(0).random((6, 300))
    rows[4] = rows[1] + 0.001
    rows[2] = rows[5] = 0.5  # walls, which may be two
    assert alike(rows).tolist() == [[1, 4]]


def test_messages_count_and_name():
    names = tuple(f"{i}.jpg" for i in range(7))
    lines = Suspects(names, (("a.jpg", "b.jpg"),)).messages()
    named = "0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg, ..."
    assert lines[0].startswith(f"7 photographs are blurred beside the others: {named}")
    assert lines[1].startswith("duplicate photographs: a.jpg and b.jpg.")
    assert len(lines) == 2
    assert Suspects().messages() == []


@pytest.mark.slow
def test_a_training_names_them_before_its_first_step(photographs, tmp_path):
    views = list(photographs)
    views[3] = with_color(views[3], smeared(views[3].load().color, 7, 0, 1))
    seen = []
    with pytest.warns(DataWarning, match=r"^1 photograph is blurred beside the others: 003\."):
        train(
            Dataset(tuple(views)).over((0, 0, 0)),
            train_config(steps=1, exposure=False, **SIZE),
            on_progress=seen.append,
        )
