"""Folders of data sets made for tests, written independently of the readers."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

# Numbers of COLMAP's models and how many parameters each has.
COLMAP_MODELS = {"SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "OPENCV": (4, 8)}
COLMAP_MODELS |= {"OPENCV_FISHEYE": (5, 8), "EQUIRECTANGULAR": (17, 2)}


def sky(directions: np.ndarray) -> np.ndarray:
    """(..., 3) RGB in [0, 1]: a smooth image at infinity, for directions (..., 3) in the world."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    waves = np.array([[5.0, 1, 2], [-1, 6, 3], [2, -3, 5]])
    return 0.5 + 0.45 * np.sin(unit @ waves.T)


def pinhole_rays(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """(h, w, 3) rays through pixel centres, OpenCV axes."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)


def save(path: Path, pixels: np.ndarray) -> None:
    """Writes float pixels in [0, 1] or uint8 ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if pixels.dtype != np.uint8:
        pixels = np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(path)


def rotation(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A quaternion wxyz and its matrix by Rodrigues' formula, which the readers do not use."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angle = rng.uniform(0.2, 2.5)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)]), matrix


def colmap_bytes(cameras: list[tuple], images: list[tuple]) -> tuple[bytes, bytes]:
    """cameras.bin and images.bin: (id, model, width, height, parameters), (name, quaternion, t, camera)."""
    head = struct.pack("<Q", len(cameras))
    for number, model, width, height, parameters in cameras:
        head += struct.pack("<iiQQ", number, COLMAP_MODELS[model][0], width, height)
        head += struct.pack(f"<{len(parameters)}d", *parameters)
    body = struct.pack("<Q", len(images))
    for i, (name, quaternion, translation, camera) in enumerate(images):
        body += struct.pack("<i7di", i + 1, *quaternion, *translation, camera) + name.encode() + b"\0"
        points = i % 3  # some have points, which are skipped
        body += struct.pack("<Q", points) + struct.pack("<ddq", 1.5, 2.5, -1) * points
    return head, body


def colmap_text(cameras: list[tuple], images: list[tuple]) -> tuple[bytes, bytes]:
    head = "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    for number, model, width, height, parameters in cameras:
        head += f"{number} {model} {width} {height} {' '.join(map(repr, map(float, parameters)))}\n"
    body = "# Image list with two lines of data per image:\n"
    for i, (name, quaternion, translation, camera) in enumerate(images):
        pose = " ".join(repr(float(v)) for v in (*quaternion, *translation))
        body += f"{i + 1} {pose} {camera} {name}\n" + "1.5 2.5 -1 " * (i % 3) + "\n"
    return head.encode(), body.encode()


def write_colmap(
    folder: Path, cameras: list[tuple], images: list[tuple], *, place: str = "sparse/0", text: bool = False
) -> Path:
    """Writes a sparse model; returns ``folder``."""
    model = folder / place
    model.mkdir(parents=True, exist_ok=True)
    suffix = ".txt" if text else ".bin"
    contents = (colmap_text if text else colmap_bytes)(cameras, images)
    for name, content in zip(("cameras", "images"), contents, strict=True):
        (model / (name + suffix)).write_bytes(content)
    return folder


def simple_colmap(folder: Path, count: int = 3, size: tuple[int, int] = (12, 8), **options) -> Path:
    """A data set of one pinhole camera with ``count`` plain images; image i has the grey value 10 i."""
    width, height = size
    cameras = [(1, "PINHOLE", width, height, (10.0, 11.0, 6.5, 3.5))]
    names = [f"p{i:02d}.png" for i in range(count)]
    for i, name in enumerate(names):
        save(folder / "images" / name, np.full((height, width, 3), 10 * i, np.uint8))
    poses = [(name, rotation(i)[0], (i, 0.5, -1.0), 1) for i, name in enumerate(names)]
    return write_colmap(folder, cameras, poses[::-1], **options)


def write_json(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path
