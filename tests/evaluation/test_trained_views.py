"""Scores on views that were trained on are named as such, by the records beside what is scored."""

from __future__ import annotations

import json
import shutil
import warnings
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from _datasets import simple_colmap
from _photographs import write_photographs

from meshsplats.cameras.files import save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cluster import Workers
from meshsplats.conversion import convert
from meshsplats.datasets.folder import load_dataset
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DataWarning
from meshsplats.evaluation.trained_views import find_trained_on, find_trained_width, warn_of_trained_on
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.meshes import save_mesh
from meshsplats.operations.options import ScoringOptions
from meshsplats.operations.scoring import Scoring
from meshsplats.rendering import render_splats

MANY = "is scored on views that it was trained on"


def record(path: Path, command: str, **options: object) -> Path:
    """Writes a record beside ``path``, as commands do; returns ``path``."""
    lines = [f"{key} = {json.dumps(value)}" for key, value in options.items()]
    head = f'command = "{command}"\n[options]\n'
    path.with_name(f"{path.name}.config.toml").write_text(head + "\n".join(lines) + "\n")
    return path


def seen(scene: Path, data: Path, test_every: int = 4):
    load = partial(load_dataset, data)
    found = find_trained_on(scene, load(test_every=test_every), test_every, lambda n: load(test_every=n))
    if found is not None:
        warn_of_trained_on({scene.name: found})
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A mesh and photographs of it."""
    folder = tmp_path_factory.mktemp("trained")
    cloud = make_scene(200)
    cameras = orbit(cloud, 5, width=24, height=24)
    images = [np.clip(render_splats(cloud, camera).color, 0, 1) for camera in cameras]
    write_photographs(folder / "train", cameras, images)
    save_mesh(convert(cloud), folder / "mesh.npz")
    return folder


def scored(folder: Path, out: Path, **options):
    """The report of the mesh on the photographs, its table and the file of it."""
    chosen = ScoringOptions(data=folder / "train", background="white", strips=0, samples=1, **options)
    report = Scoring(chosen, out).run([folder / "mesh.npz"])
    return report.about, (out / "table.md").read_text(), json.loads((out / "report.json").read_text())


def test_the_split_of_the_training_tells_which_views_were_trained_on(tmp_path):
    data = simple_colmap(tmp_path / "data", 12)
    mesh = tmp_path / "mesh.npz"
    assert seen(mesh, data) is None  # without a record
    for option, command in (("input", "train"), ("data", "finetune"), ("data", "prior")):
        given = {"input": "base.obj", option: "data"}
        assert seen(record(mesh, command, **given, test_every=4), data) is None
        with pytest.warns(DataWarning, match=rf"{MANY}: 3 of the 3 views, .* \(test_every = 0\)$"):
            found = seen(record(mesh, command, **given, test_every=0), data)
        assert (found.count, found.sure) == (3, True)
        with pytest.warns(DataWarning, match=r"1 of the 3 views, .*toml says \(test_every = 8\)"):
            seen(record(mesh, command, **given, test_every=8), data)  # 4 was not held out
    assert seen(record(mesh, "finetune", input="s.ply", test_every=0), data) is None  # on images of splats
    for wrong in (1, -1, 10**12, True, "0"):
        assert seen(record(mesh, "train", input="data", test_every=wrong), data) is None


def test_photographs_of_another_name_may_be_others(tmp_path):
    data = simple_colmap(tmp_path / "data", 12)
    mesh = record(tmp_path / "mesh.npz", "train", input="/server/garden", test_every=0)
    with pytest.warns(
        DataWarning, match="3 of the 3 views, .* if the photographs are those of '/server/gard"
    ):
        assert not seen(mesh, data).sure
    (tmp_path / "cfg_args").write_text("Namespace(eval=False)")
    with pytest.warns(DataWarning, match="if the photographs are those of its training"):
        assert not seen(tmp_path, data).sure


def test_a_split_of_the_data_sets_own_holds_out_whatever_was_chosen(tmp_path):
    data = simple_colmap(tmp_path / "data", 12)
    (data / "sparse/0/test.txt").write_text("p03.png\n")
    assert seen(record(tmp_path / "mesh.npz", "train", input="data", test_every=0), data) is None


def test_what_a_mesh_was_made_from_counts(tmp_path):
    """A copy with fewer triangles of a mesh that was fine-tuned, on splats of the 3DGS code."""
    data = simple_colmap(tmp_path / "data", 12)
    model = tmp_path / "model"
    splats = model / "point_cloud" / "iteration_7" / "point_cloud.ply"
    splats.parent.mkdir(parents=True)
    record(tmp_path / "mesh.npz", "convert", input=[str(splats)])
    mesh = record(tmp_path / "small.npz", "bake", input="mesh.npz")
    for path in (mesh, model, splats):
        (model / "cfg_args").write_text("Namespace(eval=True, source_path='/x/data')")
        assert seen(path, data, 8) is None
        with pytest.warns(DataWarning, match=r"1 of the 3 views, as .*cfg_args says \(eval = True\)$"):
            seen(path, data, 4)
        (model / "cfg_args").write_text("Namespace(eval=False, source_path='/x/data')")
        with pytest.warns(DataWarning, match=r"2 of the 2 views, as .*cfg_args says \(eval = False\)$"):
            seen(path, data, 8)
    # A circle, and no names of a file.
    for source in ("small.npz", "point_cloud/iteration_7/\0", 300 * "a", 2000 * "a/"):
        record(tmp_path / "mesh.npz", "convert", input=source)
        assert seen(mesh, data) is None


def test_scores_on_training_views_say_so_everywhere(scene, tmp_path):
    with pytest.warns(DataWarning, match="train: no view is held out, so all 5 training views are scored"):
        about, table, saved = scored(scene, tmp_path / "all", test_every=0)
    assert about["held_out"] is saved["held_out"] is False
    assert "Views: 5 training views, as none is held out." in table
    about, table, saved = scored(scene, tmp_path / "some", test_every=2)
    assert about["held_out"] is saved["held_out"] is True
    assert "trained_on" not in saved
    assert table.count("\n\n") == 2  # notes on the ground truth and the background, as ever


@pytest.mark.parametrize(("folder", "held_out"), [("train", False), ("elsewhere", None)])
def test_scores_of_a_mesh_that_was_trained_on_the_views_say_so_everywhere(scene, tmp_path, folder, held_out):
    files = shutil.copytree(scene, tmp_path / "files")
    record(files / "mesh.npz", "train", input=folder, test_every=0)
    with pytest.warns(DataWarning, match=rf"mesh\.npz {MANY}: 3 of the 3 views"):
        about, table, saved = scored(files, tmp_path / "out", test_every=2)
    assert about["held_out"] is saved["held_out"] is held_out
    (text,) = saved["trained_on"].values()
    assert text.startswith("3 of the 3 views, as ")
    assert f"Not held out: {files / 'mesh.npz'} was trained on {text}." in table


def test_one_warning_names_all_that_one_training_made(scene, tmp_path):
    """The splats of a model folder, and the mesh that was converted from them."""
    files = shutil.copytree(scene, tmp_path / "files")
    splats = files / "model" / "point_cloud" / "iteration_7" / "point_cloud.ply"
    splats.parent.mkdir(parents=True)
    save_gaussians(make_scene(200), splats)
    (files / "model" / "cfg_args").write_text("Namespace(eval=False, source_path='/x/train')")
    record(files / "mesh.npz", "convert", input=[str(splats)])
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        _, table, saved = scored(files, tmp_path / "out", splats=files / "model")
    (said,) = [str(one.message) for one in warned if "trained on" in str(one.message)]
    assert f"mesh.npz, {files / 'model'} are scored on views that they were trained on: 1 of the 1" in said
    assert len(saved["trained_on"]) == table.count("Not held out: ") == 2


@pytest.mark.filterwarnings("ignore:Tanks and Temples. scene truck is left out")
def test_scenes_of_a_benchmark_are_looked_up_too(scene, tmp_path):
    (tmp_path / "models").mkdir()
    shutil.copy(scene / "mesh.npz", tmp_path / "models" / "train.npz")
    record(tmp_path / "models" / "train.npz", "train", input="train", test_every=0)
    chosen = ScoringOptions(data=scene, protocol="tanks-and-temples", strips=0, samples=1)
    with pytest.warns(DataWarning, match=rf"train\.npz {MANY}: 1 of the 1 views"):
        (report,) = Scoring(replace(chosen, background="white"), tmp_path / "out").run_benchmark(
            tmp_path / "models", lambda threads: nullcontext(Workers(threads))
        )
    assert report.about["held_out"] is False
    assert "was trained on 1 of the 1 views" in (tmp_path / "out" / "table.md").read_text()


@pytest.mark.parametrize(
    ("settings", "scale", "width"),
    [
        ("images='images', resolution=-1", 1, None),
        ("images='images', resolution=-1", 2, 12),  # the photographs are 12 pixels wide
        ("images='images', resolution=2", 2, None),
        ("images='images_2', resolution=-1", 2, None),
        ("images='images_2', resolution=2", 1, 3),
        ("images='images', resolution=6", 1, 6),  # other numbers are widths
        ("images='images'", 2, None),
    ],
)
def test_splats_are_no_baseline_at_another_size_than_that_of_their_training(tmp_path, settings, scale, width):
    data = load_dataset(simple_colmap(tmp_path / "data", 3), downscale=scale)
    (tmp_path / "cfg_args").write_text(f"Namespace({settings})")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        assert find_trained_width(tmp_path, data, scale) == width
    assert [f"images {width} pixels wide, as" in str(one.message) for one in warned] == [True] * bool(width)


def test_cameras_of_the_training_tell_its_size(tmp_path):
    data = load_dataset(simple_colmap(tmp_path / "data", 3))
    (tmp_path / "cfg_args").write_text("Namespace(resolution=-1)")
    save_cameras([view.camera.scaled(200) for view in data.views], tmp_path / "cameras.json")
    with pytest.warns(DataWarning, match="images 1600 pixels wide"):  # the most that the 3DGS code takes
        assert find_trained_width(tmp_path, data, 1) == 1600


def test_upright_photographs_among_others_are_of_no_other_size(tmp_path):
    data = load_dataset(simple_colmap(tmp_path / "data", 3))
    (tmp_path / "cfg_args").write_text("Namespace(resolution=-1)")
    cameras = [replace(view.camera, width=8 + 4 * (view in data.train)) for view in data.views]
    views = [replace(view, camera=camera) for view, camera in zip(data.views, cameras, strict=True)]
    mixed = replace(data, train=tuple(views[:2]), test=tuple(views[2:]))
    save_cameras(cameras, tmp_path / "cameras.json")
    assert find_trained_width(tmp_path, mixed, 1) is None


def test_the_size_of_the_training_is_below_the_table(scene, tmp_path):
    model = tmp_path / "model"
    (model / "point_cloud" / "iteration_7").mkdir(parents=True)
    save_gaussians(make_scene(200), model / "point_cloud" / "iteration_7" / "point_cloud.ply")
    (model / "cfg_args").write_text("Namespace(eval=True, images='images', resolution=-1)")
    with pytest.warns(DataWarning, match="images 24 pixels wide, .* of 12: splat viewers blur"):
        about, table, saved = scored(scene, tmp_path / "out", test_every=8, splats=model, downscale=2)
    assert about["splats_trained_width"] == saved["splats_trained_width"] == 24
    assert "at this size, not at that of their training, 24 pixels wide." in table
