"""Objects of the package in other processes, and as copies."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from _meshes import assert_same, random_mesh
from _priors import cube
from _rendering import camera, splats

from meshsplats import Dataset, SplatMesh, bind, render, splat_dataset
from meshsplats.finetuning.interruption import Interrupted


def by_pickle(thing):
    return pickle.loads(pickle.dumps(thing))


def same_views(one: Dataset, two: Dataset) -> None:
    for mine, theirs in zip(one.views, two.views, strict=True):
        assert mine.name == theirs.name
        np.testing.assert_array_equal(mine.image, theirs.image)


@pytest.mark.parametrize("copied", [by_pickle, copy.deepcopy])
def test_a_mesh_and_its_copy_are_alike(copied):
    mesh = random_mesh(np.random.default_rng(0))
    made = copied(mesh)
    assert_same(made, mesh)
    assert made.attributes
    with pytest.raises(TypeError):
        made.attributes["more"] = mesh.vertices  # as in any mesh
    made.vertices[:] = 0
    assert mesh.vertices.any()


@pytest.mark.parametrize("copied", [by_pickle, copy.deepcopy])
def test_a_prior_and_its_copy_are_posed_alike(copied):
    prior = bind(cube(), triangles=4)
    posed = prior.base_vertices * np.float32(2)
    np.testing.assert_array_equal(copied(prior).pose(posed).vertices, prior.pose(posed).vertices)


@pytest.mark.parametrize("copied", [by_pickle, copy.deepcopy])
def test_a_data_set_and_its_copy_have_the_same_images(copied):
    dataset = splat_dataset(splats(0, 20), width=16, height=12, train=2, test=1)
    before = copied(dataset)  # nothing is rendered yet
    same_views(before, dataset)
    same_views(copied(dataset), dataset)


def test_images_in_memory_are_not_sent_along():
    dataset = splat_dataset(splats(0, 20), width=16, height=12, train=2, test=1)
    size = len(pickle.dumps(dataset))
    source = dataset.train[0].source
    image = source.load()
    assert len(pickle.dumps(dataset)) == size
    again = by_pickle(source)
    assert again.store.find(again) is None
    again.store.keep(again, image)  # its room is the same
    assert again.store.find(again) is image


@pytest.mark.parametrize("copied", [by_pickle, copy.deepcopy])
def test_an_interruption_keeps_its_step(copied):
    made = copied(Interrupted(7, 2))
    assert (made.step, made.signal, str(made)) == (7, 2, "stopped after step 7")


def first_pixel(mesh: SplatMesh) -> float:
    return float(render(mesh, camera(), threads=1).color[0, 0, 0])


def test_a_mesh_is_rendered_in_another_process():
    mesh = random_mesh(np.random.default_rng(0))
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert pool.submit(first_pixel, mesh).result() == first_pixel(mesh)
