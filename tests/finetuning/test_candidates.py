"""Scenes of a benchmark that are fine-tuned before they are scored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning import candidates, starting_mesh


@pytest.fixture
def tuned(monkeypatch):
    """Records the configurations, and returns the mesh in red."""
    configs = []

    def finetune(mesh, dataset, config, *, run):
        configs.append(config)
        return replace(mesh, colors=mesh.colors * np.float32([1, 0, 0, 1]))

    monkeypatch.setattr(candidates, "finetune", finetune)
    return configs


def test_splats_are_converted_by_the_preset_and_scored_beside_both_meshes(tuned):
    cloud = make_scene().take(np.arange(0, 4000, 200))
    dataset = splat_dataset(cloud, train=2, test=1, width=16)
    found = candidates.tuned_candidates(cloud, dataset, "paper", 1)
    assert found.splats is cloud
    start = starting_mesh(cloud, [view.camera for view in dataset.train], preset="paper")
    assert np.array_equal(found.before.vertices, start.vertices)
    assert np.array_equal(found.mesh.colors[:, 0], start.colors[:, 0])
    assert not found.mesh.colors[:, 1].any()
    assert [config.preset for config in tuned] == ["paper"]

    again = candidates.tuned_candidates(start, dataset)
    assert again.before is start
    assert again.splats is None
    assert tuned[-1].preset == "default"
