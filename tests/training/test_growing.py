"""A training on its way: what it says before its first step, and which images it keeps."""

from __future__ import annotations

import numpy as np
import pytest
from _balls import ball_view, cameras_around

from meshsplats.datasets import reduced
from meshsplats.datasets.views import Dataset
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training import train, train_config
from meshsplats.training.growing import REDUCED_PART, Growing


def test_images_of_a_size_that_is_over_leave_their_place(monkeypatch):
    views = [ball_view(camera) for camera in cameras_around(6)]
    fan = SplatMesh(np.eye(3), [[0, 1, 2]], np.ones((3, 4)), face_splat=np.zeros(1, np.int32))
    config = train_config(steps=10, quarter_share=0.2, half_share=0.6)
    half = 6 * 32 * 32 * 9  # colour and alpha as float16
    growing = Growing(config, fan, views, 0.0, REDUCED_PART * half)
    made = []
    original = reduced.reduced_image
    monkeypatch.setattr(reduced, "reduced_image", lambda *given: made.append(1) or original(*given))
    for fraction, count in ((0.1, 6), (0.1, 6), (0.3, 12), (0.5, 12)):
        for view in growing.views(views, fraction):
            view.load()
        assert len(made) == count
    assert [view.camera.width for view in growing.views(views, 0.7)] == [64] * 6


@pytest.mark.filterwarnings("ignore:the photographs differ")
def test_it_says_what_it_does_before_the_first_step(tmp_path):
    views = tuple(ball_view(camera) for camera in cameras_around(8))
    said: list[str] = []
    config = train_config(steps=1, start_splats=50, max_splats=50)

    def step(_progress):
        said.append("step")

    train(Dataset(views), config, run=RunOptions(tmp_path / "run"), on_progress=step, on_phase=said.append)
    started = said[: said.index("step")]
    assert started[:3] == ["matching photographs", "looking for blurred photographs", "comparing exposures"]
    assert len(started) == 4
    assert set(said[4:]) == {"step"}
