"""Small good data sets, camera paths and archives, from which the fuzzer starts."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import _splat_encoders as encode
import numpy as np
from _datasets import colmap_bytes, colmap_text
from _splat_files import random_splats, splat_table, write_ply
from fuzz.seeds import Seed
from PIL import Image

from meshsplats import load_cameras, load_dataset
from meshsplats.images.reading import FORMATS, load_image, read_header, read_shot

_NAMES = ["a (1).png", "b/c.png"]
_CAMERAS = [(1, "PINHOLE", 12, 8, (10.0, 11.0, 6.5, 3.5))]
_POSES = [(name, (1, 0, 0, 0), (i, 0.5, -1.0), 1) for i, name in enumerate(_NAMES)]
_EYE = np.eye(4)


def _image(kind: str, **more: Any) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (12, 8), (10, 20, 30)).save(out, kind, **more)
    return out.getvalue()


def _png() -> bytes:
    return _image("PNG")


def _shot(path: Path) -> None:
    read_header(path)
    read_shot(path)
    load_image(path, to_srgb=True)


def _in_zip(method: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        ply = write_ply(Path(folder) / "a.ply", [splat_table(random_splats(5, degree=1))]).read_bytes()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        archive.writestr("scan/a.ply", ply)
        archive.writestr("scan/thumb.jpg", b"\xff\xd8\xff")
    return out.getvalue()


def _poses_bounds() -> bytes:
    down, right, back = -_EYE[:3, 1], _EYE[:3, 0], _EYE[:3, 2]
    matrix = np.stack([down, right, back, [0, 0, 4], [8, 12, 10]], axis=1)
    out = io.BytesIO()
    np.save(out, np.tile(np.append(matrix.ravel(), [1, 9]), (2, 1)))
    return out.getvalue()


def _transforms() -> bytes:
    frames = [{"file_path": name, "transform_matrix": _EYE.tolist(), "k1": None} for name in _NAMES]
    return json.dumps({"w": 12, "h": "8", "fl_x": 10, "frames": frames, "test_filenames": None}).encode()


def _camera_path() -> bytes:
    cameras = [{"camera_to_world": _EYE.ravel().tolist(), "fov": 50, "aspect": 1.5}]
    keys = [{"matrix": json.dumps(_EYE.ravel().tolist()), "fov": 50}]
    size = {"render_width": 12, "render_height": 8, "camera_type": "perspective"}
    return json.dumps(size | {"camera_path": cameras, "keyframes": keys}).encode()


_SPLAT = encode.dot_splat(random_splats(5, degree=0))
_IMAGES = {name: _png() for name in _NAMES}
_BINARY = dict(zip(("cameras.bin", "images.bin"), colmap_bytes(_CAMERAS, _POSES), strict=True))
_TEXT = dict(zip(("cameras.txt", "images.txt"), colmap_text(_CAMERAS, _POSES), strict=True))
_load = partial(load_dataset, missing="skip")
DATA_SEEDS = [
    Seed("zip-ply", {"a.zip": _in_zip(zipfile.ZIP_DEFLATED)}, "a.zip"),
    Seed("zip-ply-stored", {"a.zip": _in_zip(zipfile.ZIP_STORED)}, "a.zip"),
    Seed(
        "zip-splat",
        {"a.zip": encode.bundle({"a.splat": encode.dot_splat(random_splats(5, degree=0))})},
        "a.zip",
    ),
    *(Seed(f"image-{kind.lower()}", {"a": _image(kind)}, "a", load=_shot) for kind in FORMATS),
    Seed("colmap-beside", {**_IMAGES, **_BINARY}, ".", load=_load),
    Seed("colmap-beside-text", {**_IMAGES, **_TEXT}, ".", load=_load),
    Seed("transforms", {**_IMAGES, "transforms.json": _transforms()}, ".", load=_load),
    Seed("llff", {"a.png": _png(), "b.png": _png(), "poses_bounds.npy": _poses_bounds()}, ".", load=_load),
    Seed("camera-path", {"camera_path.json": _camera_path()}, "camera_path.json", load=load_cameras),
]
