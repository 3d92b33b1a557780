"""Fine-tuning through the order of a file: what it gains in an independent viewer, and what a run keeps."""

from __future__ import annotations

import signal
from dataclasses import replace

import numpy as np
import pytest
from _stock_viewer import stock_image

from meshsplats import convert, drawing_order, finetune, finetune_ordered, psnr, save_mesh, splat_dataset
from meshsplats.cameras.framing import scene_bounds
from meshsplats.cameras.trajectories import look_around, orbit
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning import Interrupted, RunOptions, make_config
from meshsplats.finetuning.cells import check_for_cells
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.ordered import ordering_views
from meshsplats.rendering.looks import image_of
from meshsplats.rendering.ordering import VIEWS

CONFIG = make_config(steps=48, order="file", prune_epochs=1, prune_opacity=0.02, samples=1)


@pytest.fixture(scope="module", name="scene")
def scene_fixture():
    cloud = make_scene(400)
    dataset = splat_dataset(cloud, train=16, test=3, width=48, sh_degree=0, below=True)
    mesh = convert(cloud, colors="base")
    return mesh, drawing_order(mesh, nodes=2), dataset


@pytest.mark.nightly
def test_viewers_show_the_gain_and_it_is_more_than_by_the_fragment(scene, tmp_path):
    mesh, order, dataset = scene
    tuned = finetune_ordered(mesh, order, dataset, CONFIG)
    exact = finetune(mesh, dataset, replace(CONFIG, order="mesh", prune_epochs=0))
    scores = []
    for number, (shown, listing) in enumerate(((mesh, order), (exact, order), tuned)):
        path = tmp_path / f"{number}.glb"
        save_mesh(shown, path, order=listing)
        images = []
        for view in dataset.test:
            near = view.camera.with_near_plane(shown.vertices)
            images.append(stock_image(path, near))
            # Scores of a run are those of what it writes.
            own, _ = image_of(shown, near, view.background, listing=listing)
            assert psnr(images[-1], own) > 42
        scores.append(np.mean([psnr(i, v.image) for i, v in zip(images, dataset.test, strict=True)]))
    assert scores[2] > scores[1] + 0.3 > scores[0] + 0.3, scores


def test_orders_are_solved_for_what_is_seen(scene):
    """Around an object also from sides that nothing trains from, which of a room are the backs of walls."""
    mesh, _, around = scene
    bounds = scene_bounds(mesh)
    cameras = look_around(mesh, 6, width=48, height=48)
    assert max(np.linalg.norm(camera.center - bounds.center) for camera in cameras) < bounds.radius
    within = splat_dataset(make_scene(400), cameras=cameras, train=5, test=1, width=48)
    given = splat_dataset(
        make_scene(400), cameras=orbit(mesh, 6, width=48, height=48), train=5, test=1, width=48
    )
    found = replace(given, placed="a room")
    for dataset, others in ((around, True), (given, True), (within, False), (found, False)):
        centers = {tuple(view.camera.center) for view in dataset.train}
        views = ordering_views(mesh, dataset)
        assert centers >= {tuple(view.center) for view in views} or others
        assert len(views) == min(len(dataset.train), VIEWS // 2 if others else VIEWS) + others * VIEWS // 2


def test_pruning_keeps_the_order_of_the_rest(scene):
    mesh, order, dataset = scene
    tuned = finetune_ordered(mesh, order, dataset, CONFIG)
    assert 0 < len(tuned.mesh.faces) < len(mesh.faces)
    assert 2 * len(tuned.mesh.faces) == len(tuned.order.copies)
    # Splats, which keep their numbers, come in the order in which they came.
    before = mesh.face_splat[order.copies % len(mesh.faces)]
    after = tuned.mesh.face_splat[tuned.order.copies % len(tuned.mesh.faces)]
    kept = np.isin(before, after)
    first = [np.unique(part, return_index=True)[1] for part in (before[kept], after)]
    assert (np.argsort(first[0]) == np.argsort(first[1])).all()


def test_a_resumed_run_ends_with_the_same_bits(scene, tmp_path):
    mesh, order, dataset = scene
    whole = finetune_ordered(mesh, order, dataset, CONFIG)

    def stop(progress):
        if progress.step == 13:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):
        finetune_ordered(mesh, order, dataset, CONFIG, run=RunOptions(tmp_path / "run"), on_progress=stop)
    tuned = finetune_ordered(mesh, order, dataset, CONFIG, run=RunOptions(tmp_path / "run", resume=True))
    np.testing.assert_array_equal(tuned.order.copies, whole.order.copies)
    np.testing.assert_array_equal(tuned.mesh.colors, whole.mesh.colors)
    np.testing.assert_array_equal(tuned.mesh.vertices, whole.mesh.vertices)
    lines = Journal(tmp_path / "run").metrics()
    own = [
        psnr(
            image_of(tuned.mesh, v.camera, v.background, listing=tuned.order)[0].clip(0, 1),
            v.image.clip(0, 1),
        )
        for v in dataset.test
    ]
    assert lines[-1]["psnr"] == pytest.approx(np.mean(own), abs=1e-3)


def test_files_have_plain_colours(scene):
    _, _, dataset = scene
    mesh = convert(make_scene(200))
    assert mesh.sh_degree > 0
    order = drawing_order(mesh, quick=True)
    tuned, _ = finetune_ordered(mesh, order, dataset, steps=1)
    assert tuned.sh_degree == 0
    same = finetune_ordered(mesh.plain, order, dataset, steps=1).mesh
    np.testing.assert_array_equal(tuned.colors, same.colors)
    view = dataset.test[0]
    shown, plain = (image_of(m, view.camera, (1, 1, 1), listing=order)[0] for m in (mesh, mesh.plain))
    np.testing.assert_array_equal(shown, plain)


def test_what_it_is_not_for(scene):
    mesh, order, dataset = scene
    with pytest.raises(ValueError, match="call finetune_ordered"):
        finetune(mesh, dataset, order="file", steps=1)
    with pytest.raises(ValueError, match=r"the order is of .* triangles, the mesh has"):
        finetune_ordered(mesh.take(slice(3, None)), order, dataset, steps=1)
    with pytest.raises(ValueError, match="not for blending 'linear'"):
        finetune_ordered(mesh, order, dataset, steps=1, blending="linear")
    with pytest.raises(ValueError, match="viewers, which have no filter"):
        finetune_ordered(replace(mesh, filter_px2=0.3), order, dataset, steps=1)
    with pytest.raises(ValueError, match="order 'file' needs device 'cpu'"):
        finetune_ordered(mesh, order, dataset, steps=1, run=RunOptions(device="gpu"))
    with pytest.raises(ValueError, match="order 'file' is for opacity 'blended'"):
        make_config(order="file", opacity="cutoff")
    with pytest.raises(ValueError, match="order is for a whole scene, not for cells"):
        check_for_cells(make_config(order="file"))
