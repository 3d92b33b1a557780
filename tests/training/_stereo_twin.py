"""Stereo in NumPy: slow twins of csrc/, for small images; and photographs of planes, without any renderer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from meshsplats.datasets.views import View, ViewImage
from meshsplats.scene.camera import Camera

PLAIN, LONE, SIMILAR = 2.0, 0.12, 30.0


def pattern(points: np.ndarray) -> np.ndarray:
    """(..., 3) RGB of a texture at points (..., 3): waves in all directions."""
    rng = np.random.default_rng(5)
    waves, mix = rng.normal(0, 5, (3, 30)), rng.normal(0, 0.1, (30, 3))
    return np.clip(0.5 + np.sin(points @ waves) @ mix, 0, 1)


def camera_at(place: Sequence[float], side: tuple[int, int] = (64, 48), name: str = "") -> Camera:
    """A camera at ``place`` that looks along z."""
    matrix = np.eye(4)
    matrix[:3, 3] = -np.asarray(place, float)
    width, height = side
    return Camera(matrix, 1.1 * width, 1.1 * width, width / 2, height / 2, width, height, name=name)


def cameras_on_a_grid(step: float = 0.35, side: tuple[int, int] = (64, 48)) -> list[Camera]:
    """3 x 3 of them."""
    places = [(step * x, step * y, 0) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    return [camera_at(place, side, f"{i:02d}") for i, place in enumerate(places)]


def rays(camera: Camera) -> np.ndarray:
    """(h, w, 3) directions through the middles of the pixels, of depth 1, in the world."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    return local @ camera.world_to_camera[:3, :3]


def inverse_of_plane(camera: Camera, normal: Sequence[float], offset: float) -> np.ndarray:
    """(h, w) true inverse depths of the plane normal . p = offset."""
    n = np.asarray(normal, float)
    return rays(camera) @ n / (offset - n @ camera.center)


def view_of(
    camera: Camera,
    normal: Sequence[float],
    offset: float,
    color: Callable[[np.ndarray], np.ndarray] = pattern,
) -> View:
    """The photograph of a plane, at 3 x 3 samples a pixel."""
    fine = camera.scaled(3)
    places = fine.center + rays(fine) / inverse_of_plane(fine, normal, offset)[..., None]
    image = color(places).reshape(camera.height, 3, camera.width, 3, 3).mean(axis=(1, 3))
    return View(camera, ViewImage(image.astype(np.float32), None))


def grey(color: np.ndarray) -> np.ndarray:
    """(h, w) whole grey values of (h, w, 3) uint8."""
    r, g, b = np.moveaxis(color.astype(int), -1, 0)
    return ((77 * r + 153 * g + 26 * b) >> 8).astype(np.float64)


def halved(values: np.ndarray) -> np.ndarray:
    """(h, w) grey values at half the size."""
    height, width = values.shape
    even = np.pad(values, ((0, height % 2), (0, width % 2)), mode="edge")
    return (even.reshape(len(even) // 2, 2, -1, 2).sum(axis=(1, 3)) + 2) // 4


def warped(
    x: np.ndarray, y: np.ndarray, inverse: np.ndarray, camera: Camera, other: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where what ``camera`` sees at (x, y) and inverse depth lies in ``other``, and its depth there times
    that inverse depth."""
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x), inverse])
    relative = other.world_to_camera @ np.linalg.inv(camera.world_to_camera)
    u, v, z = np.einsum("ij,j...->i...", relative[:3], local)
    return other.fx * u / z + other.cx, other.fy * v / z + other.cy, z


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    height, width = image.shape
    u, v = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    column, row = u.astype(int), v.astype(int)
    a, b = u - column, v - row
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    top = image[row, column] * (1 - a) + image[row, right] * a
    bottom = image[below, column] * (1 - a) + image[below, right] * a
    return top * (1 - b) + bottom * b


def within(image: np.ndarray, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
    height, width = image.shape
    return (z > 1e-5) & (u >= 1) & (v >= 1) & (u <= width - 1) & (v <= height - 1)


def best_two(correlations: Sequence[np.ndarray]) -> np.ndarray:
    """Their mean; of the only one that sees the place a little less than its own."""
    ordered = np.sort(np.stack([*correlations, np.full_like(correlations[0], -1)]), axis=0)
    return np.where(ordered[-2] > -0.99, (ordered[-1] + ordered[-2]) / 2, ordered[-1] - LONE)


def box(values: np.ndarray) -> np.ndarray:
    """Means over 5 x 5, the border repeated."""
    height, width = values.shape
    wide = np.pad(values, 2, mode="edge")
    return sum(wide[i : i + height, j : j + width] for i in range(5) for j in range(5)) / 25


def swept(
    own: np.ndarray,
    camera: Camera,
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    inverse: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) best of the planes at ``inverse`` depths (n,), between them by a parabola, and their scores."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    mean = box(own)
    deviation = np.sqrt(np.maximum(box(own**2) - mean**2, PLAIN))
    scores = []
    for q in inverse:
        found = []
        for image, other in zip(images, cameras, strict=True):
            u, v, z = warped(x, y, np.full_like(x, q), camera, other)
            inside = within(image, u, v, z)
            values = np.where(inside, bilinear(image, u, v), 0)
            theirs = box(values)
            spread = np.sqrt(np.maximum(box(values**2) - theirs**2, PLAIN))
            correlation = (box(values * own) - theirs * mean) / (spread * deviation)
            found.append(np.where(box((~inside).astype(float)) > 1e-9, -1, correlation))
        scores.append(best_two(found))
    table = np.stack(scores)
    at = table.argmax(axis=0)
    edge = np.full((1, *own.shape), -1.0)
    beside = np.concatenate([edge, table, edge])
    before, here, after = (np.take_along_axis(beside, (at + k)[None], axis=0)[0] for k in range(3))
    bend = before - 2 * here + after
    shift = np.where(bend < -1e-6, 0.5 * (before - after) / np.minimum(bend, -1e-6), 0)
    step = inverse[1] - inverse[0]
    return inverse[0] + step * (at + np.clip(shift, -0.5, 0.5)), here


def slanted_scores(
    own: np.ndarray,
    camera: Camera,
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    planes: Sequence[np.ndarray],
) -> np.ndarray:
    """(h, w) how well the windows of ``planes`` fit: inverse depth and its slopes along x and y, (h, w)."""
    height, width = own.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    wide = np.pad(own, 3, mode="edge")
    offsets = [(i, j) for j in range(-3, 4) for i in range(-3, 4) if (i + j) % 2 == 0]
    values = np.stack([wide[3 + j : 3 + j + height, 3 + i : 3 + i + width] for i, j in offsets])
    weights = 1 / (1 + np.square((values - own) / SIMILAR))
    total = weights.sum(axis=0)
    mean = (weights * values).sum(axis=0) / total
    deviation = np.sqrt(np.maximum((weights * values**2).sum(axis=0) / total - mean**2, PLAIN))
    found = []
    for image, other in zip(images, cameras, strict=True):
        q, along_x, along_y = planes
        u, v, z = warped(x, y, q, camera, other)
        step = 1e-4  # derivatives of the place by differences
        right = warped(x + step, y, q + step * along_x, camera, other)
        below = warped(x, y + step, q + step * along_y, camera, other)
        u_x, v_x = (right[0] - u) / step, (right[1] - v) / step
        u_y, v_y = (below[0] - u) / step, (below[1] - v) / step
        theirs = np.stack([bilinear(image, u + i * u_x + j * u_y, v + i * v_x + j * v_y) for i, j in offsets])
        their_mean = (weights * theirs).sum(axis=0) / total
        spread = np.sqrt(np.maximum((weights * theirs**2).sum(axis=0) / total - their_mean**2, PLAIN))
        correlation = ((weights * theirs * values).sum(axis=0) / total - their_mean * mean) / (
            spread * deviation
        )
        found.append(np.where(within(image, u, v, z), correlation, -1))
    return best_two(found)


def consistency(
    inverse: np.ndarray,
    camera: Camera,
    maps: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    limits: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) how many of ``maps`` agree with each of the ``inverse`` depths (h, w), and see past it."""
    agree, past = np.zeros((2, *inverse.shape), int)
    for row, column in zip(*np.nonzero(inverse), strict=True):
        q = float(inverse[row, column])
        for other_map, other in zip(maps, cameras, strict=True):
            place = np.array([column + 0.5, row + 0.5])
            u, v, z = warped(place[:1], place[1:], np.array([q]), camera, other)
            if z[0] <= 0 or not (0 <= u[0] < other.width and 0 <= v[0] < other.height):
                continue
            known = other_map[int(v[0]), int(u[0])]
            if known == 0:
                continue
            ahead = warped(place[:1], place[1:], np.array([q + 1e-7]), camera, other)
            pixel = 1e-7 / max(np.hypot(ahead[0] - u, ahead[1] - v)[0], 1e-12) / q
            ratio, slack = z[0] / q * known, min(pixel, 4 * limits[0])
            agree[row, column] += abs(ratio - 1) < max(limits[0], slack)
            past[row, column] += ratio < 1 - limits[1] - slack
    return agree, past
