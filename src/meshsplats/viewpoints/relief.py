"""Reliefs: what one photograph became when a depth was given to each of its pixels.

Their splats stand where the pixels of one image saw them, one or two a pixel, so that from its place they are
spread evenly over a rectangle. Splats that were fitted to several photographs never are: they are dense where
there is detail.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import level_axes
from meshsplats.cameras.placing import STEPS
from meshsplats.cameras.trajectories import look_at
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints.thinning import sizes_of
from meshsplats.viewpoints.views import NEAR_SHARE

SAMPLE = 100_000
FEWEST = 2000
"""Fewer splats do not tell whether they are evenly spread."""
CELL, MOST_CELLS = 60, 20
"""Splats of a cell in which they are counted, at least, and cells along a side of the image, at most."""
NARROWEST = 4
"""Cells along the shorter side, at least: anything is even along a line."""
BORDER = 0.005
"""Share of the splats beyond each border of the image: strays."""
ALIKE = 0.25
"""Cells count as equally dense within this share..."""
EVEN = 0.72
"""...and splats as evenly spread where this share of them lies in such cells. Splats of objects and
places, from all directions: 0.08 to 0.67; those of photographs: 0.9."""
WIDEST = 65.0
"""Greatest angle between the middle of the image and its splats, degrees."""
WITHIN = 0.98
"""Share of the splats that lie within it."""
FRONT = 0.85
"""Share of the splats that nothing hides, of an image that was spread over a plane: a cube of even points has
half of that."""
TURNED = 5.0
"""Degrees from each axis from which on the shortest extent of the splats is a gaze of its own."""
LEANS = 0.3
"""How much nearer the lower part of such an image is than the upper one, in deviations of its depth,
where that tells front from back."""
LYING = 0.7
"""Greatest cosine between up and the gaze that such an image was made with: more, and it is a map."""
SAME_SIZE = 0.2
"""Greatest deviation of the logarithms of sizes that were given and not fitted."""
ONE_SIDE, MORE = 0.75, 0.1
"""Of splats of one size, several images perhaps: share that is seen from the front, and how much more
than from behind, at least."""
FEWER = 30_000
LEVEL = 24
"""Level directions from which such splats are looked at."""
FOV = 40.0
"""Field of view, degrees, of an image without one."""
MARGIN = 1.04
"""How much more than the image a view shows."""
DOUBLE = 0.05
"""Greatest shift of near before far things between a view and the photograph, radians: what is behind
them was never seen..."""
ASIDE = 0.15
"""...and greatest distance between the two, as a share of the mean depth."""
OVER, LAYER = 4.0, 0.03
"""Splats of a cell when hidden ones are told, and how far behind the first they begin to be hidden, as a
share of the extent."""


@dataclass(frozen=True, eq=False)
class Relief:
    """A photograph with depth, in the frame of the splats."""

    place: np.ndarray
    """(3,) where it was taken from."""
    target: np.ndarray
    """(3,) what is in its middle."""
    up: np.ndarray
    """(3,) unit direction towards its upper edge."""
    slopes: tuple[float, float]
    """Tangents of half the angles that its width and height span."""
    aside: float
    """How far from its place it can be looked at, scene units."""
    confidence: float

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """``count`` views of the whole image, the first from its place, the others from a disc around it;
        every run of them is evenly spread."""
        depth = float(np.linalg.norm(self.target - self.place))
        gaze = (self.target - self.place) / depth
        right = np.cross(gaze, self.up)
        half = MARGIN * max(self.slopes[0] / width, self.slopes[1] / height) * min(width, height)
        fov = float(np.clip(2 * np.degrees(np.arctan(half)), 1, 120))
        views = []
        for i in range(count):
            turn, share = (0.5 + np.array(STEPS[:2]) * i) % 1
            away = 0.0 if i == 0 else self.aside * share**0.5
            x, y = away * np.cos(2 * np.pi * turn), away * np.sin(2 * np.pi * turn)
            center = self.place + x * right + y * self.up
            view = look_at(center, self.target, up=self.up, width=width, height=height, fov=fov)
            views.append(replace(view, near=NEAR_SHARE * depth))
        return views


class _Image(NamedTuple):
    """Splats as an image of them has them."""

    even: float
    """Share of the splats that are as dense as most of it."""
    axes: np.ndarray
    """(3, 3) rows right, down, forward."""
    meet: bool
    """Whether the rays meet in the origin; else they are parallel."""


def find_relief(cloud: GaussianCloud, up: np.ndarray) -> Relief | None:
    """The photograph that all splats of a scene come from; None for other scenes, and for maps.

    Args:
        up: (3,) unit direction that points up, perhaps.
    """
    if len(cloud) < FEWEST:
        return None
    rows = np.arange(len(cloud))
    if len(cloud) > SAMPLE:
        rows = np.unique(np.random.default_rng(0).integers(len(cloud), size=SAMPLE))
    points = cloud.means[rows].astype(np.float64)
    if not np.ptp(points, axis=0).any():
        return None
    image = max(_images(points), key=lambda image: image.even)
    if image.even >= EVEN:
        return (_photograph if image.meet else _spread_out)(points, image, up)
    if np.log(sizes_of(cloud.scales[rows])).std() <= SAME_SIZE:
        return _from_one_side(points, up)
    return None


def _images(points: np.ndarray) -> Iterator[_Image]:
    """Images that the splats may be: from the origin, where programs put the camera, and spread over a
    plane."""
    toward = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-300)
    gaze = np.median(toward, axis=0)
    gaze = gaze / max(float(np.linalg.norm(gaze)), 1e-9)
    if (toward @ gaze > np.cos(np.radians(WIDEST))).mean() > WITHIN:
        yield _image(points, _axes(gaze), meet=True)
    for gaze in np.eye(3):
        yield _image(points, _axes(gaze), meet=False)
    off = points - points.mean(axis=0)
    thin = np.linalg.eigh((off[:, :, None] * off[:, None]).mean(axis=0))[1][:, 0]
    if np.abs(thin).max() < np.cos(np.radians(TURNED)):
        yield _image(points, _axes(thin), meet=False)


def _axes(gaze: np.ndarray) -> np.ndarray:
    """(3, 3) rows right, down, forward of a camera that looks along ``gaze``, with the roll of the world."""
    upward = np.eye(3)[1] if abs(gaze[1]) < 0.9 else np.eye(3)[2]
    right = np.cross(gaze, upward)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(gaze, right), gaze])


def _plane(points: np.ndarray, axes: np.ndarray, meet: bool) -> np.ndarray:
    """(n, 2) where the splats are in the image."""
    seen = points @ axes.T
    return seen[:, :2] / np.maximum(seen[:, 2:], 1e-9 * np.abs(seen).max()) if meet else seen[:, :2]


def _image(points: np.ndarray, axes: np.ndarray, meet: bool) -> _Image:
    """The image of the splats along the last of ``axes`` (3, 3), or, where its rays meet, along the gaze for
    which it is most even."""
    plane = _plane(points, axes, meet)
    low, high = np.quantile(plane, [BORDER, 1 - BORDER], axis=0)
    span = np.maximum(high - low, 1e-6 * max(float((high - low).max()), 1e-300))
    cells = float(np.clip(len(points) / CELL, 1, MOST_CELLS**2))
    across = float(np.clip((cells * span[0] / span[1]) ** 0.5, 1, cells))
    shape = [round(across), max(round(cells / across), 1)]
    if min(shape) < NARROWEST:
        return _Image(0.0, axes, meet)
    counts, *edges = np.histogram2d(
        plane[:, 0], plane[:, 1], bins=shape, range=np.stack([low, low + span], 1)
    )
    count = counts.ravel()
    usual = _usual(count)
    expected = np.full(len(count), usual)
    if meet:
        x, y = np.meshgrid(*((edge[1:] + edge[:-1]) / 2 for edge in edges), indexing="ij")
        expected, tilt = _through_a_lens(count, x.ravel(), y.ravel(), usual)
        gaze = axes[2] + tilt @ axes[:2]
        axes = _axes(gaze / np.linalg.norm(gaze))
    alike = np.abs(count / expected - 1) < ALIKE
    return _Image(float(count[alike].sum() / len(points)), axes, meet)


def _usual(count: np.ndarray) -> float:
    """The count of the cell in which the median splat lies."""
    ordered = np.sort(count)
    return float(ordered[np.searchsorted(np.cumsum(ordered), 0.5 * ordered.sum())])


def _through_a_lens(
    count: np.ndarray, x: np.ndarray, y: np.ndarray, usual: float
) -> tuple[np.ndarray, np.ndarray]:
    """(k,) counts of cells at tangents ``x``, ``y`` if the image is even in the plane of another gaze:
    they are in proportion to 1 / (1 + t . (x, y))^3; and that tilt t (2,) of the gaze."""
    terms = np.stack([np.ones(len(count)), x, y], axis=1)
    expected, tilt = np.full(len(count), usual), np.zeros(2)
    near = np.abs(np.log(np.maximum(count, 0.1) / usual)) < 0.7
    for _ in range(3):
        if near.sum() < 8:
            break
        weight = count[near] ** 0.5
        solved = np.linalg.lstsq(terms[near] * weight[:, None], count[near] ** (-1 / 3) * weight, rcond=None)[
            0
        ]
        line = terms @ solved
        if (line <= 0).any():
            break
        expected, tilt = line**-3.0, solved[1:] / solved[0]
        near = np.abs(np.log(np.maximum(count, 0.1) / expected)) < 0.3
    return expected, tilt


def _photograph(points: np.ndarray, image: _Image, up: np.ndarray) -> Relief:
    """The relief of an image whose rays meet in its place."""
    upward = _upper_edge(image.axes[2], up)
    axes = np.stack([np.cross(image.axes[2], upward), -upward, image.axes[2]])
    low, high = np.quantile(_plane(points, axes, image.meet), [BORDER, 1 - BORDER], axis=0)
    middle = np.append((low + high) / 2, 1) @ axes
    ahead = points @ axes[2]
    depth = float(np.median(ahead[ahead > 0]))
    half = (high - low) / 2
    near, far = np.quantile(ahead, [0.05, 0.95])
    aside = min(ASIDE * depth, DOUBLE / max(1 / near - 1 / far, 1e-300)) if near > 0 else ASIDE * depth
    slopes = float(half[0]), float(half[1])
    return Relief(np.zeros(3), depth * middle, upward, slopes, aside, image.even)


def _spread_out(points: np.ndarray, image: _Image, up: np.ndarray) -> Relief | None:
    """The relief of an image that was spread over a plane, each pixel raised by its depth."""
    if abs(image.axes[2] @ up) > LYING:
        return None
    front, behind = (unhidden(points, side * image.axes[2]) for side in (1, -1))
    if max(front, behind) < FRONT:
        return None
    sees_more = front > behind if abs(front - behind) > MORE else _is_front(points, image.axes[2], up)
    return _before(points, image.axes[2] if sees_more else -image.axes[2], up, image.even)


def _is_front(points: np.ndarray, gaze: np.ndarray, up: np.ndarray) -> bool:
    """Whether a sheet of splats, all of which are seen from both sides, is looked at from its front along
    ``gaze`` (3,): in most photographs the ground is nearer than what is above. Else it rises from the
    origin."""
    depth, height = points @ gaze, points @ _upper_edge(gaze, up)
    low, high = np.quantile(height, [0.3, 0.7])
    nearer = float(depth[height > high].mean() - depth[height < low].mean())
    if abs(nearer) < LEANS * depth.std():
        return bool(np.median(depth) < 0)
    return nearer > 0


def _from_one_side(points: np.ndarray, up: np.ndarray) -> Relief | None:
    """What splats of one size show from one side only, several images perhaps; None if there is no such
    side."""
    points = points[:: -(-len(points) // FEWER)]
    first, second = level_axes(up)
    turns = 2 * np.pi * np.arange(LEVEL) / LEVEL
    gazes = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
    seen = np.array([unhidden(points, gaze) for gaze in gazes])
    k = int(seen.argmax())
    more = seen[k] - seen[(k + LEVEL // 2) % LEVEL]
    if seen[k] < ONE_SIDE or more < MORE:
        return None
    return _before(points, gazes[k], up, float(np.clip(more, 0, 0.4)))


def _before(points: np.ndarray, forward: np.ndarray, up: np.ndarray, confidence: float) -> Relief:
    """A relief without a place of its own, seen along ``forward`` from so far that it fits."""
    upward = _upper_edge(forward, up)
    axes = np.stack([np.cross(forward, upward), -upward, forward])
    seen = points @ axes.T
    low, high = np.quantile(seen, [BORDER, 1 - BORDER], axis=0)
    half = (high - low) / 2
    slope = float(np.tan(np.radians(FOV / 2)))
    away = float(half[:2].max()) / slope + float(half[2])
    middle = ((low + high) / 2) @ axes
    near, far = away - float(half[2]), away + float(half[2])
    aside = min(ASIDE * away, DOUBLE / max(1 / near - 1 / far, 1e-300))
    slopes = float(half[0]) / near, float(half[1]) / near
    return Relief(middle - away * forward, middle, upward, slopes, aside, confidence)


def _upper_edge(gaze: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) the direction across ``gaze`` (3,) that is closest to ``up``."""
    upward = up - (up @ gaze) * gaze
    if np.linalg.norm(upward) < 0.2:  # straight down or up: as cameras have it that look along an axis
        upward = -_axes(gaze)[1]
    return upward / np.linalg.norm(upward)


def unhidden(points: np.ndarray, gaze: np.ndarray) -> float:
    """Share of ``points`` (n, 3) that no others are before, seen from afar along ``gaze`` (3,)."""
    seen = points @ _axes(gaze).T
    low, high = np.quantile(seen, [0.02, 0.98], axis=0)
    span = high - low
    side = max(float(np.sqrt(span[0] * span[1] * OVER / len(points))), 1e-9 * float(span.max()), 1e-300)
    for _ in range(5):  # until as many cells as that are not empty
        cells = np.floor((seen[:, :2] - low[:2]) / side).astype(np.int64)
        width = int(np.ptp(cells[:, 0])) + 1
        key = (cells[:, 1] - cells[:, 1].min()) * width + cells[:, 0] - cells[:, 0].min()
        cell = np.unique(key, return_inverse=True)[1]
        count = int(cell.max()) + 1
        side *= float(np.sqrt(OVER * count / len(points)))
    first = np.full(count, np.inf)
    np.minimum.at(first, cell, seen[:, 2])
    return float((seen[:, 2] <= first[cell] + LAYER * np.linalg.norm(span)).mean())
