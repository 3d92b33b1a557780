"""Fine-tuning in cells: against fine-tuning of the whole, with interruptions, on a cluster."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from _photographs import write_photographs

from meshsplats import (
    finetune,
    load_mesh,
    make_config,
    orbit,
    render_splats,
    save_gaussian_blocks,
    splat_dataset,
)
from meshsplats.cli import main
from meshsplats.cluster import ANY_PORT, Shared, Workers, open_workers
from meshsplats.conversion import ConversionOptions
from meshsplats.datasets.views import Dataset, ImageCache, View, ViewImage
from meshsplats.datasets.windows import window_of
from meshsplats.demo_scene import make_scene
from meshsplats.demo_scene.city import city_blocks
from meshsplats.errors import FileFormatError, OtherRunError
from meshsplats.finetuning import Interrupted, RunOptions, starting_mesh
from meshsplats.finetuning import cells as in_cells
from meshsplats.finetuning.cells import CellOptions, CellScene, divide, finetune_cells, waves
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.reports import held_out_scores
from meshsplats.scene.gaussians import GaussianCloud

COUNT, MOST = 3000, 1100
CONFIG = make_config(steps=40)


def scene():
    cloud = GaussianCloud.joined(list(city_blocks(COUNT, degree=0)))
    return CellScene(cloud, splat_dataset(cloud, train=20, test=4, width=56, zooms=(1,), threads=1))


@pytest.fixture(scope="module")
def scheduler():
    """The address of a scheduler with two workers of one thread each."""
    distributed = pytest.importorskip("distributed", reason="Dask is not here: pip install distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=ANY_PORT) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def held():
    return scene()


def tuned(folder, held, *, config=CONFIG, most=MOST, **options):
    shared = Shared(scene)
    shared.hold(held)
    workers = options.pop("workers", None)
    return finetune_cells(
        shared, config, CellOptions(most), RunOptions(folder=folder, threads=1, **options), workers=workers
    )


@pytest.fixture(scope="module")
def whole_run(held, tmp_path_factory):
    return tuned(tmp_path_factory.mktemp("cells") / "run", held)


def digests(run):
    return [hashlib.sha256(file.read_bytes()).hexdigest() for file in run.files]


# ---- Division


@pytest.mark.parametrize(("count", "most"), [(1, 5), (10, 10), (11, 10), (1000, 130), (1000, 1)])
def test_cells_have_equal_counts(count, most):
    means = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32) * [4, 1, 2]
    cells = divide(means, most)
    sizes = np.bincount(cells.owner)
    assert len(sizes) == len(cells.low) == -(-count // most)
    assert sizes.max() <= most
    assert sizes.max() - sizes.min() <= 1
    for cell in range(len(sizes)):
        own = means[cells.own(cell)]
        np.testing.assert_array_equal([own.min(axis=0), own.max(axis=0)], [cells.low[cell], cells.high[cell]])


def test_cells_do_not_overlap():
    means = np.random.default_rng(1).random((500, 3))
    cells = divide(means, 40)
    for i in range(len(cells.low)):
        for j in range(i):
            assert ((cells.low[i] > cells.high[j]) | (cells.low[j] > cells.high[i])).any()


def test_points_in_one_spot_are_divided_by_their_order():
    cells = divide(np.zeros((10, 3)), 5)
    np.testing.assert_array_equal(cells.owner, np.repeat([0, 1], 5))


def test_the_margin_is_what_lies_around_a_cell():
    x = np.arange(20.0)
    means = np.stack([x, 0 * x, 0 * x], axis=1)
    cells = divide(means, 5)  # 0..4, 5..9, ...; a tenth of 4 reaches no further splat
    assert [len(cells.margin(cell, means)) for cell in range(4)] == [0] * 4
    means[:, 0] *= 0.1
    means[5:, 0] -= 0.07
    cells = divide(means, 5)
    assert cells.margin(0, means).tolist() == [5]
    assert cells.margin(1, means).tolist() == [4]
    assert waves(cells, means) == [[0, 2, 3], [1]]


def test_neighbours_are_never_tuned_at_a_time():
    means = np.random.default_rng(2).random((2000, 3)) * [1, 0.1, 1]
    cells = divide(means, 60)
    found = waves(cells, means)
    assert sorted(cell for wave in found for cell in wave) == list(range(len(cells.low)))
    assert len(found) < len(cells.low) / 2
    for wave in found:
        for cell in wave:
            assert not set(np.unique(cells.owner[cells.margin(cell, means)])) & set(wave)


# ---- Windows, frozen vertices


def test_a_window_is_a_part_of_the_image():
    cloud = make_scene(200)
    view = splat_dataset(cloud, train=1, test=0, width=48).train[0]
    image = view.load()
    part = window_of(view, 5, 9, 40, 31, ImageCache(1 << 20))
    assert (part.camera.width, part.camera.height) == (35, 22)
    np.testing.assert_allclose(part.load().color, image.color[9:31, 5:40], atol=1e-3)
    mask = np.random.default_rng(0).random((48, 48)) < 0.5
    photograph = View(view.camera, ViewImage(image.color, image.alpha, mask))
    part = window_of(photograph, 5, 9, 40, 31, ImageCache(0))
    for name, array in (("color", image.color), ("alpha", image.alpha), ("mask", mask)):
        np.testing.assert_array_equal(getattr(part.load(), name), array[9:31, 5:40])
    points = cloud.means[:50]
    np.testing.assert_allclose(
        part.camera.project(points)[0] + [5, 9], view.camera.project(points)[0], rtol=1e-4, atol=1e-3
    )


@pytest.mark.slow
def test_frozen_vertices_stay(held, tmp_path):
    """Also where triangles are pruned, and after a run was interrupted."""
    mesh = starting_mesh(held.cloud, [view.camera for view in held.dataset.train])
    frozen = np.zeros(len(mesh.vertices), bool)
    frozen[mesh.faces[mesh.face_splat < 1500]] = True
    config = make_config(steps=30, prune_epochs=0.3)
    whole = finetune(mesh, held.dataset, config, frozen=frozen, run=RunOptions(threads=1, report_every=0))
    kept = whole.vertices[whole.faces[whole.face_splat < 1500]]
    before = {tuple(v): tuple(c) for v, c in zip(mesh.vertices, mesh.colors, strict=True)}
    corners = whole.faces[whole.face_splat < 1500].ravel()
    assert len(kept) > 1000
    assert all(before[tuple(whole.vertices[i])] == tuple(whole.colors[i]) for i in corners)
    others = whole.faces[whole.face_splat >= 1500].ravel()
    assert sum(tuple(whole.vertices[i]) not in before for i in others) > 1000

    def stop(progress):
        if progress.step == 17:
            signal.raise_signal(signal.SIGINT)

    run = RunOptions(folder=tmp_path / "run", threads=1, report_every=0, preview_every=0)
    with pytest.raises(Interrupted):
        finetune(mesh, held.dataset, config, frozen=frozen, run=run, on_progress=stop)
    with pytest.raises(OtherRunError, match="another mesh"):
        finetune(mesh, held.dataset, config, frozen=~frozen, run=replace(run, resume=True))
    again = finetune(mesh, held.dataset, config, frozen=frozen, run=replace(run, resume=True))
    np.testing.assert_array_equal(again.vertices, whole.vertices)
    np.testing.assert_array_equal(again.colors, whole.colors)
    with pytest.raises(ValueError, match="frozen must have shape"):
        finetune(mesh, held.dataset, config, frozen=frozen[1:])
    with pytest.raises(ValueError, match="not for opacity 'cutoff'"):
        finetune(mesh, held.dataset, replace(config, opacity="cutoff"), frozen=frozen)


# ---- Whole runs


@pytest.mark.slow
def test_each_splat_comes_from_the_cell_that_owns_it(held, whole_run):
    owner = divide(held.cloud.means, MOST).owner
    assert len(whole_run.files) == 3
    for cell, part in enumerate(whole_run.blocks()):
        assert (owner[part.face_splat] == cell).all()
        assert len(np.unique(part.face_splat)) > 0.9 * (owner == cell).sum()
    mesh = whole_run.mesh()
    assert len(mesh.faces) == sum(len(part.faces) for part in whole_run.blocks())
    parts = {tuple(v) for part in whole_run.blocks() for v in part.vertices.tolist()}
    assert {tuple(v) for v in mesh.vertices.tolist()} == parts


@pytest.mark.slow
def test_cells_are_almost_as_good_as_the_whole(held, whole_run):
    """Everywhere, and near the borders of cells."""
    start = starting_mesh(held.cloud, [view.camera for view in held.dataset.train])
    whole = finetune(start, held.dataset, CONFIG, run=RunOptions(threads=1, report_every=0))
    before, _ = held_out_scores(start, held.dataset.test, CONFIG, 1)
    best, _ = held_out_scores(whole, held.dataset.test, CONFIG, 1)
    found, _ = held_out_scores(whole_run.mesh(), held.dataset.test, CONFIG, 1)
    assert best > before + 2
    assert found > best - 0.25 * (best - before)


class Deadly(Workers):
    """Ends a worker once, when the checkpoint of a cell is there."""

    def __init__(self, workers, folder):
        super().__init__(workers.threads)
        self.workers, self.folder = workers, folder

    def run(self, function, tasks):
        return self.workers.run(partial(end_once, self.folder, function), tasks)


def end_once(folder, function, task):
    def watch():
        while not list(folder.glob("run/cells/*/checkpoint.safetensors")):
            time.sleep(0.01)
        (folder / "ended").touch()
        os.kill(os.getpid(), signal.SIGKILL)

    try:
        os.close(os.open(folder / "watched", os.O_CREAT | os.O_EXCL))
        threading.Thread(target=watch, daemon=True).start()
    except FileExistsError:
        pass
    return function(task)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_cells_outlive_a_killed_worker(held, whole_run, scheduler, tmp_path):
    """And have the same bits as in one process."""
    with open_workers(scheduler) as workers:
        run = tuned(tmp_path / "run", held, workers=Deadly(workers, tmp_path))
    assert (tmp_path / "ended").exists()
    assert digests(run) == digests(whole_run)


@pytest.mark.nightly
def test_a_run_that_stops_anywhere_is_resumed(held, whole_run, tmp_path, monkeypatch):
    """Finished cells are not repeated, and a cell goes on from its checkpoint."""
    real = in_cells.finetune
    calls, cut = [], 17

    def stopping(mesh, dataset, config, *, run, frozen):
        steps = []
        calls.append((run.folder.name, run.resume, steps))

        def stop(progress):
            steps.append(progress.step)
            if len(steps) == cut:
                signal.raise_signal(signal.SIGINT)

        return real(mesh, dataset, config, run=run, frozen=frozen, on_progress=stop)

    monkeypatch.setattr(in_cells, "finetune", stopping)
    runs = 0
    while runs < 20:
        try:
            run = tuned(tmp_path / "run", held, resume=runs > 0)
            break
        except Interrupted:
            runs += 1
    assert runs > 3
    assert digests(run) == digests(whole_run)
    taken = {}
    for name, resumed, steps in calls:
        first = steps[0] if steps else None
        assert resumed == (name in taken)
        if resumed and first is not None:
            assert first == taken[name] + 1
        taken[name] = steps[-1] if steps else taken.get(name, 0)
    metrics = [Journal(folder).metrics() for folder in (tmp_path / "run", whole_run.files[0].parents[1])]
    assert [line["step"] for line in metrics[0]] == [line["step"] for line in metrics[1]]
    with pytest.raises(OtherRunError, match="other configuration"):
        tuned(tmp_path / "run", held, config=make_config(steps=41), resume=True)
    with pytest.raises(OtherRunError, match="other cell_splats"):
        tuned(tmp_path / "run", held, most=1000, resume=True)


@pytest.mark.parametrize("content", ["{", "[]", "7", "[" * 100_000, '{"cells": "' + 2**20 * "x" + '"}'])
def test_a_broken_record_is_refused(held, tmp_path, content):
    (tmp_path / "cells.json").write_text(content)
    with pytest.raises(FileFormatError, match=r"cells\.json"):
        tuned(tmp_path, held, resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["cells.json"]


RUN = """
import sys
sys.path[:0] = {path!r}
from pathlib import Path
import test_cells
test_cells.tuned(Path(sys.argv[1]), test_cells.scene(), checkpoint_seconds=0.2)
"""


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_killed_run_is_resumed(held, whole_run, tmp_path):
    """Killed in a cell, after another one."""
    program = RUN.format(path=[p for p in sys.path if p])
    folder = tmp_path / "run"
    process = subprocess.Popen([sys.executable, "-c", program, str(folder)])
    until = time.monotonic() + 120
    while not (list(folder.glob("cells/*.npz")) and list(folder.glob("cells/*/checkpoint.safetensors"))):
        assert process.poll() is None, "it ended before"
        assert time.monotonic() < until
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert digests(tuned(folder, held, resume=True)) == digests(whole_run)


def test_what_is_for_a_whole_scene_is_refused(held, tmp_path):
    for changes, message in (
        ({"minutes": 1.0}, "minutes is for a whole scene"),
        ({"exposure": True}, "exposure is for"),
        ({"opacity": "cutoff"}, "opacity is for"),
        ({"blending": "linear"}, "blending is for"),
    ):
        with pytest.raises(ValueError, match=message):
            tuned(tmp_path / "run", held, config=make_config(**changes))
    with pytest.raises(ValueError, match="limits on splats or triangles"):
        CellOptions(5, ConversionOptions(max_splats=10))
    with pytest.raises(ValueError, match="at least 1 splat"):
        CellOptions(0)
    with pytest.raises(ValueError, match="cells need a folder"):
        tuned(None, held)
    empty = CellScene(held.cloud, Dataset((), held.dataset.test))
    with pytest.raises(ValueError, match="no training views"):
        tuned(tmp_path / "run", empty)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_command_tunes_in_cells(tmp_path, capsys):
    splats, out = tmp_path / "city.ply", tmp_path / "city.npz"
    save_gaussian_blocks(city_blocks(1500, degree=0), splats, 1500)
    words = ["finetune", str(splats), "-o", str(out), "--steps", "20", "--views", "8", "--width", "40"]
    words += ["--held-out", "2"]
    assert main([*words, "--cluster", "local"]) == 2
    assert "--cluster is for the cells" in capsys.readouterr().err
    words += ["--cell-splats", "800"]
    assert main([*words, "--minutes", "1"]) == 2
    assert main([*words, "--json"]) == 0
    printed = capsys.readouterr()
    assert "1,500 splats in 2 cells" in printed.err
    result = json.loads(printed.out)
    assert result["cells"] == 2
    assert result["held_out_psnr"]["before"] is None
    assert result["held_out_psnr"]["after"] > 20
    mesh = load_mesh(out)
    assert mesh.splat_count > 1300
    assert main(words) == 3
    assert "cells.json is left from an earlier run" in capsys.readouterr().err
    assert main([*words, "--resume", "--force"]) == 0
    np.testing.assert_array_equal(load_mesh(out).vertices, mesh.vertices)
    cells = out.with_name("city.npz.run") / "cells"
    foreign = [cells / "notes.txt", cells / "cell-plan.npz", cells / "cell-00000" / "notes.txt"]
    for path in foreign:
        path.write_text("of someone else")
    before = (cells / "cell-00000.npz").stat().st_mtime_ns
    assert main([*words, "--force", "--preset", "paper", "--steps", "4"]) == 0
    assert all(path.read_text() == "of someone else" for path in foreign)
    assert (cells / "cell-00000.npz").stat().st_mtime_ns > before


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["splats", "photographs"])
def test_the_command_has_the_same_bits_on_a_cluster(kind, scheduler, tmp_path):
    splats = tmp_path / "city.ply"
    save_gaussian_blocks(city_blocks(700, degree=0), splats, 700)
    words = ["finetune", str(splats), "--steps", "6", "--cell-splats", "350", "--threads", "1"]
    if kind == "photographs":
        cloud = GaussianCloud.joined(list(city_blocks(700, degree=0)))
        cameras = orbit(cloud, 6, width=40, height=40, elevation=30)
        images = [render_splats(cloud, camera, background=(1, 1, 1)).color for camera in cameras]
        write_photographs(tmp_path / "data", cameras, images)
        words += ["--data", str(tmp_path / "data")]
    else:
        words += ["--views", "6", "--width", "40", "--held-out", "0"]
    assert main([*words, "-o", str(tmp_path / "here.npz")]) == 0
    assert main([*words, "-o", str(tmp_path / "there.npz"), "--cluster", scheduler]) == 0
    here, there = (load_mesh(tmp_path / f"{name}.npz") for name in ("here", "there"))
    for name in ("vertices", "colors", "faces", "face_splat"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
