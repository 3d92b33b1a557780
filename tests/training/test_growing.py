"""The images of a training: those of the size that it is at are kept."""

from __future__ import annotations

import numpy as np
from _balls import ball_view, cameras_around

from meshsplats.datasets import reduced
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training import train_config
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
