"""MeshSplats as a method of nerfbaselines: one iteration trains the whole mesh."""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np
from nerfbaselines import Method

import meshsplats as ms
from meshsplats.datasets.points import ScenePoints

DEFAULTS = {"minutes": 30.0, "max_splats": 200_000, "samples": 2}
"""Options that ``--set`` of nerfbaselines changes; ``samples``: a side, for images."""


class MeshSplats(Method):
    """Trains with ``meshsplats.train`` and draws with ``meshsplats.render``."""

    def __init__(self, *, checkpoint=None, train_dataset=None, config_overrides=None):
        self.checkpoint = checkpoint
        self.options: dict[str, Any] = dict(DEFAULTS)
        self.mesh, self.step = None, 0
        if checkpoint is not None:
            with open(os.path.join(checkpoint, "options.json"), encoding="utf-8") as file:
                self.options |= json.load(file)
            self.mesh, self.step = ms.load_mesh(os.path.join(checkpoint, "mesh.npz")), 1
        for name, value in (config_overrides or {}).items():
            if name not in DEFAULTS:
                raise ValueError(f"no option {name!r}: there are {', '.join(DEFAULTS)}")
            self.options[name] = type(DEFAULTS[name])(value)
        self._dataset = train_dataset

    @classmethod
    def get_method_info(cls):
        return {
            "method_id": "",
            "supported_camera_models": frozenset(("pinhole",)),
            "required_features": frozenset(("color", "points3D_xyz", "points3D_rgb")),
            "supported_outputs": ("color", "accumulation"),
        }

    def get_info(self):
        return {
            **self.get_method_info(),
            "num_iterations": 1,
            "loaded_step": self.step or None,
            "loaded_checkpoint": self.checkpoint,
            "hparams": self.options,
        }

    def train_iteration(self, step):
        data = self._dataset
        views = [
            ms.View(_camera(data["cameras"][i], str(i)), _image(image))
            for i, image in enumerate(data["images"])
        ]
        options = {name: self.options[name] for name in ("minutes", "max_splats")}
        self.mesh = ms.train(ms.Dataset(tuple(views)), points=_points(data), **options)
        self.step = step + 1
        return {"triangles": float(len(self.mesh.faces))}

    def save(self, path):
        os.makedirs(path, exist_ok=True)
        ms.save_mesh(self.mesh, os.path.join(path, "mesh.npz"))
        with open(os.path.join(path, "options.json"), "w", encoding="utf-8") as file:
            json.dump(self.options, file)

    def render(self, camera, *, options=None):
        drawn = ms.render(self.mesh, _camera(camera), background=(0, 0, 0), samples=self.options["samples"])
        return {"color": np.clip(drawn.color, 0, 1), "accumulation": drawn.alpha}


def _camera(camera, name="") -> ms.Camera:
    """Poses are from camera to world, with OpenCV's axes; pixels have their centres at halves."""
    matrix = np.eye(4)
    matrix[:3] = camera.poses[:3]
    fx, fy, cx, cy = (float(x) for x in camera.intrinsics)
    width, height = (int(x) for x in camera.image_sizes)
    return ms.Camera(np.linalg.inv(matrix), fx, fy, cx, cy, width, height, name=name)


def _image(image: np.ndarray) -> ms.ViewImage:
    """Photographs, or RGBA, whose colours are to be those on black."""
    if image.dtype != np.uint8:
        image = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    if image.shape[2] == 3:
        return ms.ViewImage(np.ascontiguousarray(image))
    alpha = np.ascontiguousarray(image[..., 3])
    color = np.rint(image[..., :3] * (alpha[..., None] / 255)).astype(np.uint8)
    return ms.ViewImage(color, alpha)


def _points(data) -> ScenePoints | None:
    places, colors = data.get("points3D_xyz"), data.get("points3D_rgb")
    if places is None or not len(places):
        return None
    colors = np.full((len(places), 3), 128, np.uint8) if colors is None else np.asarray(colors, np.uint8)
    return ScenePoints(np.asarray(places, np.float64), colors, np.full(len(places), 3, np.int64))
