"""The folder of a run, from Python: what is the user's stays, runs do not meet in it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from meshsplats._files.locks import locked
from meshsplats.cluster import Shared
from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning import RunOptions, finetune, finetune_ordered, make_config
from meshsplats.finetuning.cells import CellOptions, CellScene, finetune_cells
from meshsplats.finetuning.checkpoint import load_checkpoint
from meshsplats.finetuning.journal import CHECKPOINT, CONFIGURATION, LOCK, METRICS
from meshsplats.rendering.ordering import drawing_order


@pytest.fixture(scope="module")
def scene():
    cloud = make_scene(200)
    dataset = splat_dataset(cloud, train=2, test=0, width=24, sh_degree=0)
    return cloud, dataset, convert(cloud, sides=4)


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (CONFIGURATION, "mine"),
        (CONFIGURATION, '{"preset": "mine"}'),
        (METRICS, '{"step": 1}\n'),
        (CHECKPOINT, ""),
        ("previews/step_0000001.png", ""),
    ],
)
def test_files_that_are_not_of_a_run_stay(scene, tmp_path, name, text):
    _, dataset, mesh = scene
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text, "utf-8")
    before = contents(tmp_path)
    for options in (RunOptions(tmp_path), RunOptions(tmp_path, replace_old=True)):
        with pytest.raises(FileExistsError, match="not of an earlier run and would be replaced"):
            finetune(mesh, dataset, steps=1, run=options)
    assert contents(tmp_path) == before


def test_an_earlier_run_is_resumed_or_replaced_on_demand_only(scene, tmp_path):
    _, dataset, mesh = scene
    folder = tmp_path / "run"
    finetune(mesh, dataset, steps=2, run=RunOptions(folder))
    (folder / "mesh.npz").write_text("mine", "utf-8")
    before = contents(folder)
    with pytest.raises(FileExistsError, match="left from an earlier run: resume continues it, replace_old"):
        finetune(mesh, dataset, steps=1, run=RunOptions(folder))
    assert contents(folder) == before
    finetune(mesh, dataset, steps=1, run=RunOptions(folder, replace_old=True))
    assert load_checkpoint(folder / CHECKPOINT).step == 1
    assert json.loads((folder / CONFIGURATION).read_text("utf-8"))["steps"] == 1
    finetune(mesh, dataset, steps=2, run=RunOptions(folder, resume=True))
    assert load_checkpoint(folder / CHECKPOINT).step == 2
    assert (folder / "mesh.npz").read_text("utf-8") == "mine"


def test_one_process_at_a_time_writes_a_folder(scene, tmp_path):
    cloud, dataset, mesh = scene
    shared = Shared(lambda: CellScene(cloud, dataset))
    config = make_config(steps=1)
    with locked(tmp_path / LOCK):
        for options in (RunOptions(tmp_path), RunOptions(tmp_path, resume=True)):
            with pytest.raises(FileExistsError, match="another process is writing this run"):
                finetune(mesh, dataset, config, run=options)
            with pytest.raises(FileExistsError, match="another process is writing this run"):
                finetune_ordered(mesh.plain, drawing_order(mesh.plain), dataset, config, run=options)
            with pytest.raises(FileExistsError, match="another process is writing this run"):
                finetune_cells(shared, config, CellOptions(50), options)
    assert contents(tmp_path) == {}


def test_a_run_that_cannot_begin_leaves_folders_as_they_were(scene, tmp_path):
    _, dataset, mesh = scene
    frozen = np.zeros(1, bool)
    (tmp_path / "empty").mkdir()
    for folder in ("run", "empty"):
        with pytest.raises(ValueError, match="frozen"):
            finetune(mesh, dataset, steps=1, frozen=frozen, run=RunOptions(tmp_path / folder))
    assert [path.name for path in tmp_path.rglob("*")] == ["empty"]
