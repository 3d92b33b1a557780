"""Fine-tuning for programs with a depth buffer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _rendering import camera, layers

from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.report import evaluate
from meshsplats.finetuning import Interrupted, Progress, RunOptions, finetune, make_config
from meshsplats.finetuning.opaque import expected_error, expected_share, ramp_of, visible_faces
from meshsplats.finetuning.state import Gradients, State
from meshsplats.formats.cutting import cut_mesh
from meshsplats.mesh import SplatMesh


@pytest.fixture(scope="module")
def scene():
    cloud = make_scene(400)
    dataset = splat_dataset(cloud, train=12, test=4, width=48, sh_degree=0)
    return dataset, convert(cloud, cameras=[view.camera for view in dataset.train])


def score(mesh: SplatMesh, dataset: Dataset) -> float:
    return evaluate(mesh, dataset, samples=2).method("mesh").mean("psnr")


def test_it_beats_a_blended_mesh_that_is_cut(scene):
    dataset, mesh = scene
    tuned = finetune(mesh, dataset, make_config(steps=96, opacity="cutoff"))
    assert (tuned.colors[:, 3] == 1).all()
    blended = finetune(mesh, dataset, make_config(steps=96))
    best = max(score(cut_mesh(blended, c), dataset) for c in (0.1, 0.2, 0.3, 0.5))
    assert score(tuned, dataset) > best + 2
    assert score(tuned, dataset) > score(cut_mesh(mesh, 0.2), dataset) + 4


def test_the_reported_score_is_that_of_the_cut_mesh(scene):
    dataset, mesh = scene
    seen: list[Progress] = []
    tuned = finetune(mesh, dataset, make_config(steps=8, opacity="cutoff"), on_progress=seen.append)
    # Of images clipped to [0, 1].
    assert seen[-1].held_out == pytest.approx(score(tuned, dataset), abs=0.02)


def test_a_resumed_run_ends_with_the_same_bits(scene, tmp_path, monkeypatch):
    dataset, mesh = scene
    config = make_config(steps=20, opacity="cutoff", settle_share=0.5)
    whole = finetune(mesh, dataset, config)
    for stop in (6, 13):  # before hidden triangles go, and after

        def halt(progress: Progress, stop: int = stop) -> None:
            if progress.step == stop:
                raise Interrupted(stop, 2)

        folder = tmp_path / str(stop)
        options = RunOptions(folder, checkpoint_seconds=1e-6)
        with pytest.raises(Interrupted):
            finetune(mesh, dataset, config, run=options, on_progress=halt)
        again = finetune(mesh, dataset, config, run=replace(options, resume=True))
        for name in ("vertices", "faces", "colors"):
            assert getattr(again, name).tobytes() == getattr(whole, name).tobytes()


def test_the_schedule_goes_from_blended_to_cut():
    config = make_config(opacity="cutoff", cutoff=0.3, anneal_share=0.5, expected_share=0.4)
    begin, half, end = (ramp_of(config, f) for f in (0.0, 0.25, 0.5))
    assert (begin.height, begin.slope, begin.cutoff) == (0.3, 1, 0.3)
    assert half.height == pytest.approx(0.4)
    assert begin.leak > half.leak > end.leak == 0
    assert (end.height, end.width) == (0.5, 1)
    assert end.slope > 1e5
    assert [expected_share(config, f) for f in (0, 0.25, 0.5, 1)] == pytest.approx([0, 0.2, 0.4, 0.4])
    assert ramp_of(make_config(), 0.7) is None
    assert expected_share(make_config(), 0.7) == 0


def test_masked_pixels_do_not_count():
    mask = np.array([[True, False], [True, True]])
    target = np.full((2, 2, 3), 0.5, np.float32)
    target[0, 1] = np.nan
    found = expected_error(target, mask, make_config(l2_weight=18), 0.5)
    assert np.array_equal(found.weight, np.where(mask, np.float32(1), 0))
    assert np.isfinite(found.target).all()


def test_visible_triangles_are_those_in_front():
    view = camera(8, 6)
    mesh = layers([2, 3, 4], [0.1, 0.5, 0.9])
    views = [View(view, ViewImage(np.zeros((6, 8, 3), np.float32)))]
    assert visible_faces(mesh, views, 0.2, 1).tolist() == [False, True, False]
    assert visible_faces(mesh, views, 0.2, 4 * 48).tolist() == [False, True, False]
    assert not visible_faces(mesh, views, 0.2, 4 * 48 + 1).any()
    assert visible_faces(mesh, views, 0.6, 1).tolist() == [False, False, True]


def test_a_vertex_with_a_gradient_of_its_colour_alone_moves(scene):
    _, mesh = scene
    for opacity, moves in (("cutoff", True), ("blended", False)):
        state = State.begin(mesh, 1, make_config(opacity=opacity), 1)
        before = state.colors.copy()
        gradients = Gradients(np.zeros((len(before), 3), np.float32), np.zeros((len(before), 4), np.float32))
        gradients.colors[5, 0] = -1 if before[5, 0] < 0.5 else 1
        state.step(gradients, 0.02, 0.02, 0)
        assert (state.colors[5, 0] != before[5, 0]) == moves
        assert (np.delete(state.colors, 5, axis=0) == np.delete(before, 5, axis=0)).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"exposure": True}, "exposure is for opacity 'blended'"),
        ({"relocate_share": 0.1}, "relocate_share is for opacity 'blended'"),
        ({"prune_importance": 2.0}, "prune_importance is for opacity 'blended'"),
        ({"blending": "linear"}, "opaque triangles are not blended"),
        ({"l2_weight": 0.0}, "expected_share is a share of l2_weight"),
        ({"cutoff": 1.5}, "cutoff"),
    ],
)
def test_options_that_need_blending_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_config(opacity="cutoff", **changes)


def test_options_without_effect_are_refused():
    with pytest.raises(ValueError, match="settle_share has no effect without opacity 'cutoff'"):
        make_config(settle_share=0.3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"filter_px2": 0.3}, "without a filter"), ({"blending": "linear"}, "display colours")],
)
def test_meshes_that_cannot_become_opaque_are_refused(scene, changes, message):
    dataset, mesh = scene
    with pytest.raises(ValueError, match=message):
        finetune(replace(mesh, **changes), dataset, steps=1, opacity="cutoff")
