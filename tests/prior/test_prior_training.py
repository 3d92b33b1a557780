"""Training a mesh prior: the loop of fine-tuning on the weights of a binding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _priors import bumpy, cube, rotation
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import Dataset, SplatMesh, orbit, psnr, render
from meshsplats.datasets.views import View, ViewImage
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.report import evaluate
from meshsplats.finetuning import RunOptions, make_config
from meshsplats.finetuning.bound import BoundPositions, project_to_simplex, weight_units
from meshsplats.finetuning.checkpoint import load_checkpoint, mesh_arrays, stored_mesh
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step
from meshsplats.prior import MeshPrior, bind, train_prior

triples = st.tuples(*[st.floats(-10, 10, width=32)] * 3)


def views_of(mesh, count=6, side=40) -> tuple[View, ...]:
    """What cameras around ``mesh`` see of it, with alpha."""
    views = []
    for camera in orbit(mesh, count, width=side, height=side, elevation=35):
        drawn = render(mesh, camera, background=(0, 0, 0))
        views.append(View(camera, ViewImage(drawn.color, drawn.alpha)))
    return tuple(views)


@pytest.fixture(scope="module")
def task():
    """A base whose colours are wrong, and images of it with the right ones."""
    base = bumpy(6)
    right = np.random.default_rng(7).random((len(base.vertices), 3)).astype(np.float32)
    truth = SplatMesh(base.vertices, base.faces, np.column_stack([right, base.colors[:, 3]]), up=base.up)
    views = views_of(truth, 8)
    return base, Dataset(views[::2] + views[1::4], views[3::4])


def check_constraint(binding) -> None:
    """No weight below 0, and sums of 1 within the rounding of float32; SplatMesh and Binding look, too."""
    assert binding.weights.min() >= 0
    assert np.abs(binding.weights.sum(axis=1, dtype=np.float64) - 1).max() <= 6e-8


@given(st.lists(triples, min_size=1, max_size=20))
def test_projection_is_the_nearest_point_of_the_simplex(rows):
    given_weights = np.array(rows, np.float32)
    found = project_to_simplex(given_weights)
    assert found.min() >= 0
    assert np.abs(found.sum(axis=1, dtype=np.float64) - 1).max() <= 6e-8
    # Nearest: from it, no corner of the simplex lies in the direction of the given point.
    towards = given_weights.astype(np.float64) - found
    for corner in np.eye(3):
        assert (np.einsum("ij,ij->i", towards, corner - found) <= 1e-5).all()


def test_projection_leaves_corners_edges_and_the_inside_alone():
    kept = np.array([[1, 0, 0], [0, 0, 1], [0.25, 0, 0.75], [0.25, 0.25, 0.5]], np.float32)
    np.testing.assert_array_equal(project_to_simplex(kept), kept)
    rounded = project_to_simplex(
        np.random.default_rng(0).dirichlet((1, 1, 1), 10_000).astype(np.float32) * 1.1
    )
    assert np.abs(rounded.sum(axis=1, dtype=np.float64) - 1).max() <= 6e-8
    moved = project_to_simplex(np.array([[2, 0, 0], [0.6, 0.6, -1], [0, 0, 0]], np.float32))
    np.testing.assert_allclose(moved, [[1, 0, 0], [0.5, 0.5, 0], [1 / 3, 1 / 3, 1 / 3]], atol=1e-7)


@pytest.mark.parametrize("spacing", [0.0, -0.1])
def test_the_gradient_of_weights_is_the_slope_along_the_face(spacing):
    """Against differences of a linear function of the positions, along directions that keep the sum."""
    prior = bind(cube(), triangles=4, layers=2, spacing=spacing)
    rng = np.random.default_rng(0)
    inside = rng.dirichlet((1, 1, 1), len(prior.mesh.vertices))
    binding = replace(prior.mesh.binding, weights=inside)
    slope = rng.normal(size=prior.mesh.vertices.shape).astype(np.float32)
    rows = np.arange(0, len(slope), 3)
    found = BoundPositions(binding).gradient(slope, rows)
    assert np.abs(found.sum(axis=1)).max() < 1e-5
    for direction in ([1, -1, 0], [0, 1, -1]):
        step = 1e-2 * np.array(direction)
        moved = np.einsum("k,vkc->vc", step, binding.corners(slice(None)))
        wanted = np.einsum("vc,vc->v", moved, slope)
        np.testing.assert_allclose((found @ step)[rows], wanted[rows], atol=1e-6)
    others = np.setdiff1d(np.arange(len(slope)), rows)
    np.testing.assert_array_equal(found[others], 0)


def test_what_is_on_an_edge_slides_along_it():
    """Weights that are 0 have no gradient and stay 0, and the others go on as if they alone were there."""
    base = bumpy(2)
    mesh = bind(base, triangles=9, layers=1).mesh
    bound = BoundPositions(mesh.binding)
    rng, rows = np.random.default_rng(1), np.arange(len(mesh.vertices))
    slope = rng.normal(size=mesh.vertices.shape).astype(np.float32)
    found = bound.gradient(slope, rows)
    zero = mesh.binding.weights == 0
    assert (found[zero] == 0).all()
    assert np.abs(found.sum(axis=1)).max() < 1e-6
    assert (found[zero.sum(axis=1) == 1] != 0).sum(axis=1).max() == 2
    before = bound.weights.copy()
    bound.weights += rng.normal(size=before.shape).astype(np.float32) * 0.3
    positions = mesh.vertices.copy()
    bound.project(before, rows, positions)
    after = bound.binding()
    check_constraint(after)
    assert (after.weights[zero] == 0).all()
    np.testing.assert_array_equal(positions, after.positions())
    np.testing.assert_array_equal(after.weights[zero.sum(axis=1) == 2], before[zero.sum(axis=1) == 2])
    assert (after.weights != before).any()


def test_training_opens_no_gaps(task):
    """However far vertices go, an opaque layer goes on covering the base, but for folds."""
    base, data = task
    prior = bind(base, triangles=9)
    config = make_config(steps=30, position_rate=0.02)
    state = State.begin(prior.mesh, len(data.train), config, 1)
    for step in range(30):
        make_step(state, data.train, step, step / 30, Blended(config))
    mesh = state.result()
    moved = np.abs(mesh.binding.weights - prior.mesh.binding.weights).max(axis=1)
    assert moved.max() > 0.02
    solid = np.concatenate([mesh.colors[:, :3], np.ones((len(mesh.colors), 1))], axis=1)
    for view in data.test:
        before, after = (
            render(replace(m, colors=solid), view.camera, threads=1).alpha for m in (prior.mesh, mesh)
        )
        np.testing.assert_allclose(after, before, atol=1e-5)


def test_units_are_shares_of_the_face_whatever_its_shape():
    base = bumpy(3)
    mesh = bind(base, triangles=9).mesh
    np.testing.assert_allclose(weight_units(mesh, per_scene_unit=False), 1 / 3, rtol=1e-5)
    squeezed = MeshPrior(mesh).pose(base.vertices * (1, 0.01, 7))
    np.testing.assert_allclose(weight_units(squeezed, per_scene_unit=False), 1 / 3, rtol=1e-5)
    large = MeshPrior(mesh).pose(base.vertices * 10)
    ratio = weight_units(mesh, per_scene_unit=True) / weight_units(large, per_scene_unit=True)
    np.testing.assert_allclose(ratio, 10, rtol=1e-4)


@pytest.mark.parametrize(("layers", "spacing"), [(2, 0.0), (3, -0.02)])
def test_the_constraint_holds_after_every_step(task, layers, spacing):
    base, data = task
    prior = bind(base, triangles=4, layers=layers, spacing=spacing)
    config = make_config(steps=40, position_rate=1.0, color_rate=0.05)  # far beyond what is sensible
    state = State.begin(prior.mesh, len(data.train), config, 1)
    moved = 0.0
    for step in range(40):
        make_step(state, data.train, step, step / 40, Blended(config))
        mesh = state.result()
        check_constraint(mesh.binding)
        np.testing.assert_allclose(mesh.vertices, mesh.binding.positions(), atol=1e-6)
        moved = max(moved, float(np.abs(mesh.binding.weights - prior.mesh.binding.weights).max()))
    assert moved > 0.3, "they did move"
    assert (
        (mesh.binding.weights == 0).any(axis=1)
        & (prior.mesh.binding.weights != mesh.binding.weights).any(axis=1)
    ).any()


def test_training_brings_the_images_closer_and_moves_with_the_base(task, tmp_path):
    base, data = task
    prior = bind(base, triangles=4, layers=2, spacing=0)
    config = make_config(steps=60, position_rate=0.005, color_rate=0.05, prune_epochs=0)
    trained = train_prior(
        prior, data, config, run=RunOptions(folder=tmp_path / "run", threads=1, report_every=20)
    )
    before, after = (evaluate(p.mesh, data, threads=1).methods[0].mean("psnr") for p in (prior, trained))
    assert after > before + 6
    check_constraint(trained.mesh.binding)
    assert (trained.mesh.binding.weights != prior.mesh.binding.weights).any()
    np.testing.assert_array_equal(trained.pose().vertices, trained.mesh.vertices)
    np.testing.assert_array_equal(trained.base_vertices, base.vertices)
    assert trained.mesh.normals is not None
    # The same from a moved base and moved cameras: nothing depends on where the world's origin is.
    rng = np.random.default_rng(2)
    turn, shift = rotation(rng), np.array([30.0, -20, 10])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    away = replace(base, vertices=(base.vertices @ turn.T + shift).astype(np.float32))
    views = [
        View(replace(v.camera, world_to_camera=v.camera.world_to_camera @ np.linalg.inv(motion)), v.source)
        for v in data.train
    ]
    elsewhere = train_prior(
        bind(away, triangles=4, layers=2, spacing=0), Dataset(views), config, run=RunOptions(threads=1)
    )
    moved = elsewhere.pose(base.vertices)
    camera = data.test[0].camera
    images = [render(mesh, camera).color for mesh in (trained.mesh, moved)]
    assert psnr(*images) > 25


def test_stopped_and_resumed_to_the_same_bits(task, tmp_path):
    base, data = task
    prior = bind(base, triangles=4, layers=2, spacing=-0.02)
    config = make_config(steps=24, prune_epochs=1, prune_opacity=0.27)
    folder = tmp_path / "run"
    whole = train_prior(prior, data, config, run=RunOptions(folder=tmp_path / "whole", threads=1))
    assert len(whole.mesh.faces) < len(prior.mesh.faces), "something was pruned"

    class Enough(Exception):
        pass

    def stop(progress) -> None:
        if progress.step == 15:
            raise Enough

    run = RunOptions(folder=folder, threads=1, checkpoint_seconds=1e-9)
    with pytest.raises(Enough):
        train_prior(prior, data, config, run=run, on_progress=stop)
    again = train_prior(prior, data, config, run=replace(run, resume=True))
    for name in ("vertices", "faces", "colors", "depth_group", "normals"):
        np.testing.assert_array_equal(getattr(again.mesh, name), getattr(whole.mesh, name))
    np.testing.assert_array_equal(again.mesh.binding.weights, whole.mesh.binding.weights)
    # A checkpoint of another binding is not taken for this one's.
    turned = replace(prior.mesh.binding, weights=np.roll(prior.mesh.binding.weights, 1, axis=0))
    with pytest.raises(ValueError, match="began with another mesh"):
        train_prior(
            MeshPrior(replace(prior.mesh, binding=turned)), data, config, run=replace(run, resume=True)
        )


def test_a_checkpoint_with_a_broken_binding_is_refused(task, tmp_path):
    base, data = task
    train_prior(bind(base), data, make_config(steps=1), run=RunOptions(folder=tmp_path / "run", threads=1))
    arrays = dict(load_checkpoint(tmp_path / "run" / "checkpoint.safetensors").arrays)
    assert set(mesh_arrays(stored_mesh(arrays, "display", "fragment"))) <= set(arrays)
    lacking = {k: v for k, v in arrays.items() if k != "mesh.binding.weights"}
    with pytest.raises(FileFormatError, match=r"lacks 'mesh.binding.weights'"):
        stored_mesh(lacking, "display", "fragment")
    arrays["mesh.binding.vertex_face"] = arrays["mesh.binding.vertex_face"] + 10**6
    with pytest.raises(FileFormatError, match="vertex_face must be indices"):
        stored_mesh(arrays, "display", "fragment")
