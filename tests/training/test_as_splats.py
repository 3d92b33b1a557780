"""Fans as splats, fitted to the photographs as viewers draw splats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _balls import ball_view, cameras_around
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from meshsplats.datasets.views import Dataset
from meshsplats.errors import DataWarning
from meshsplats.finetuning.checkpoint import load_checkpoint
from meshsplats.finetuning.gradients import Gradients
from meshsplats.finetuning.journal import CHECKPOINT
from meshsplats.finetuning.run import TrainingLoop
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.rendering import render_splats
from meshsplats.training import as_splats, train, train_config
from meshsplats.training.as_splats import (
    FITTED_SHARE,
    FITTED_SIDES,
    HALVED,
    _affine,
    _FansOfSplats,
    _fitting,
    _halved,
    fit_splats,
    splats_of_fans,
)
from meshsplats.training.growth import fan_count
from meshsplats.training.initial import fans_of

CONFIG = train_config(steps=60, start_splats=100, max_splats=300, growth_events=2)


@pytest.fixture(scope="module")
def ball():
    views = [tuple(ball_view(c) for c in cameras_around(n, seed=seed)) for n, seed in ((16, 0), (4, 1))]
    return Dataset(*views)


@pytest.fixture(scope="module")
def trained(ball):
    return train(ball, CONFIG)


@pytest.fixture(scope="module")
def fitted(ball, trained):
    return fit_splats(trained, ball, replace(CONFIG, steps=300))


def psnr_of(cloud, views) -> float:
    """As viewers of splats draw it."""
    images = (render_splats(cloud, view.camera, background=view.background).color for view in views)
    squares = (np.square(image - view.image).mean() for image, view in zip(images, views, strict=True))
    return -10 * np.log10(np.mean(list(squares)))


@pytest.mark.parametrize("exposure", [True, False])
def test_exposures_are_those_of_the_training(ball, tmp_path, monkeypatch, exposure):
    """Whether they are fitted is not judged anew, and they are not found anew."""
    config = replace(CONFIG, steps=16, growth_events=0, exposure=exposure)
    run = RunOptions(tmp_path / "run")
    mesh = train(ball, config, run=run)
    begun = []

    class Loop(TrainingLoop):
        def __init__(self, start, *args, **more):
            begun.append(None if start.state.exposures is None else start.state.exposures.copy())
            super().__init__(start, *args, **more)

    monkeypatch.setattr(as_splats, "TrainingLoop", Loop)
    monkeypatch.setattr(as_splats, "exposures_differ", None)
    fit_splats(mesh, ball, replace(config, exposure=None), run=run)
    if not exposure:
        assert begun == [None]
        return
    found = load_checkpoint(tmp_path / "run" / CHECKPOINT).arrays["exposure.values"]
    assert np.abs(found - [1, 1, 1, 0, 0, 0]).max() > 0.01
    assert np.array_equal(begun[0], found)


def test_a_training_without_time_for_a_step_gives_splats(ball, tmp_path):
    config, run = replace(CONFIG, steps=None, minutes=1e-4), RunOptions(tmp_path / "run")
    with pytest.warns(DataWarning, match="spent before the first step"):
        mesh = train(ball, config, run=run)
    assert not (tmp_path / "run" / CHECKPOINT).exists()
    assert len(fit_splats(mesh, ball, config, run=run)) > 0


def test_fitted_splats_are_nearer_to_photographs_that_were_held_out(ball, trained, fitted):
    assert psnr_of(fitted, ball.test) > psnr_of(splats_of_fans(trained), ball.test) + 2


def test_splats_of_a_training_know_which_way_is_up(trained, fitted):
    turned = replace(trained, up=np.array([0, 0.6, 0.8], np.float32))
    np.testing.assert_allclose(splats_of_fans(turned).up, [0, 0.6, 0.8], atol=1e-6)
    np.testing.assert_allclose(fitted.up, trained.up)


def test_half_of_the_fans_become_two_splats_where_their_colours_change(ball, trained):
    count = fan_count(trained)
    more = _halved(trained, ball.train, CONFIG)
    assert fan_count(more) == count + int(HALVED * count)
    colors = trained.colors.reshape(count, -1, 4).copy()
    plain = np.arange(count) % 2 == 0
    colors[plain, :, :3] = colors[plain, :1, :3]  # one colour: nothing to gain
    more = _halved(replace(trained, colors=colors.reshape(-1, 4)), ball.train, CONFIG)
    halves = more.colors.reshape(fan_count(more), -1, 4)[count:, :, :3]
    assert (np.ptp(halves, axis=1).max(axis=1) > 0).mean() > 0.9


def test_a_step_leaves_the_fans_of_splats(ball, trained):
    """Going to splats and back changes nothing, though the gradient pulls each vertex elsewhere."""
    cloud = splats_of_fans(trained)
    fans = replace(fans_of(cloud, FITTED_SIDES), harmonics=trained.harmonics)
    state = _FansOfSplats.begin(fans, len(ball.train), CONFIG, 1)
    random = np.random.default_rng(0)
    for _ in range(3):
        gradients = Gradients(
            random.normal(size=fans.vertices.shape).astype(np.float32),
            random.normal(size=fans.colors.shape).astype(np.float32),
            np.zeros_like(fans.harmonics),
        )
        state.step(gradients, 0.01, 0.05, 0)
    moved = state.result()
    assert np.abs(moved.vertices - fans.vertices).max() > 1e-3
    again = fans_of(splats_of_fans(moved), FITTED_SIDES)
    middle = moved.vertices.reshape(-1, FITTED_SIDES + 1, 3)

    def spread(mesh):
        rim = mesh.vertices.reshape(-1, FITTED_SIDES + 1, 3)
        offset = rim - rim.mean(axis=1, keepdims=True)
        return np.einsum("nki,nkj->nij", offset, offset)

    size = np.linalg.norm(np.ptp(middle, axis=1), axis=1)[:, None]
    assert (np.abs(again.vertices[:: FITTED_SIDES + 1] - middle[:, 0]) < 1e-3 * size).all()
    assert (np.abs(spread(again) - spread(moved)).max(axis=(1, 2)) < 2e-3 * size[:, 0] ** 2).all()
    assert np.allclose(again.colors[:, :3], moved.colors[:, :3], atol=1e-5)


@given(arrays(np.float64, (3, 3), elements=st.floats(-2, 2)), st.integers(3, 9), st.integers(0, 99))
def test_motions_of_a_fan_are_projected_onto_those_of_an_affine_map(matrix, sides, seed):
    angle = 2 * np.pi * np.arange(sides) / sides
    fan = np.vstack([[0, 0, 0], np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])])
    project = _affine(sides + 1)
    affine = fan @ matrix + matrix[0]
    np.testing.assert_allclose(project @ affine, affine, atol=1e-5)
    motion = np.random.default_rng(seed).normal(size=fan.shape)
    rest = motion - project @ motion  # at right angles to all of them
    np.testing.assert_allclose(rest.T @ np.column_stack([np.ones(sides + 1), fan[:, :2]]), 0, atol=1e-5)


@pytest.mark.parametrize(
    ("length", "expected"),
    [
        ({"minutes": 10.0}, {"minutes": FITTED_SHARE * 10, "steps": None, "epochs": None}),
        ({"steps": 100}, {"steps": 20, "minutes": None, "epochs": None}),
        ({"epochs": 2.0}, {"steps": round(FITTED_SHARE * 32), "minutes": None, "epochs": None}),
        ({"steps": 1}, {"steps": 1, "minutes": None, "epochs": None}),
    ],
)
def test_the_fit_takes_a_fifth_of_the_length(ball, trained, length, expected):
    found = _fitting(train_config(exposure=False, **length), trained, ball, 1)
    assert {name: getattr(found, name) for name in expected} == expected


def test_other_meshes_are_refused(ball, trained):
    with pytest.raises(ValueError, match="not a mesh of equal fans"):
        fit_splats(trained.take(np.arange(len(trained.faces)) != 5), ball, CONFIG)
