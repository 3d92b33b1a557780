"""Which way up an object is whose file does not say: things stand, and are photographed from above."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshsplats._common.geometry import level_axes
from meshsplats.cameras.framing import DEFAULT_UP, Bounds, scene_bounds, up_of_survey
from meshsplats.cameras.trajectories import NEAR_SHARE, look_at
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints.kind import FINE, glance, subsample_of
from meshsplats.viewpoints.sample import AllSplats, fibonacci
from meshsplats.viewpoints.thinning import without_harmonics

UPS = (DEFAULT_UP, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
"""Directions that programs which write splats have as up, that of most first."""
OPAQUE = 0.3
"""Opacity of splats, at least, that something stands on."""
FEWEST = 100
"""Number of such splats in the sample of a scene, at least."""
BASE = (0.03, 0.05)
"""What lies within these shares of the height below and above the lowest points touches the ground: below are
strays, and the ends of fur or leaves."""
STRAYS = 0.005
"""Share of the points that may lie outside of an object, at either end."""
OUTLINE = 64
"""Directions in which the outline of a base is measured."""
FIRM, WIDE = 0.2, 0.6
"""Least distance from the centre of mass to the edge of the base, in the larger width of an object, and least
share of its outline from above that the base fills, where it stands firmly."""
TALL = 0.7
"""Height of it, in widths of its base: a mask and a relief lie firmly on their backs, too."""
MOST = 4_000_000
"""Number of splats, at most, that are looked at."""
VIEWS, SIDE, SHARP_SIDE, FOV = 48, 48, 300, 50.0
"""Images from all around in which splats are measured: number, pixels, those of their filter, degrees."""
COARSER, EVENLY, TOWARDS = 0.5, 0.6, 0.94
"""What no photograph saw is coarse: least growth of the logarithm of the size of splats from the middle of an
object to one side, share of its variance that this explains, and cosine to a direction."""
ALONE = 0.5
"""Greatest growth of that logarithm from above to the sides, as a share of that from the sides to below: of
what was seen from its front alone, splats grow all the way to its back."""
CLEARLY = 0.03
"""How much finer an object is from around it, at least, the way up that it was photographed."""
NEARLY = 0.05
"""What a glance at few splats may be wrong by."""
SEEN, STOOD, AS_USUAL = 0.5, 0.4, 0.4
"""How sure up is if coarse splats and the base tell it, if the base alone does, and if the usual way up has
a wide base."""


@dataclass(frozen=True)
class Base:
    """What an object stands on, one way up. Lengths are in its larger width."""

    margin: float
    """Least distance from the centre of mass to the edge, seen from above; negative: it tips over."""
    share: float
    """Of the outline of the object, seen from above."""
    height: float
    """Of the object."""

    @property
    def firm(self) -> bool:
        """Whether nothing tips it over easily."""
        return self.margin >= FIRM and self.share >= WIDE


def thinned(blocks: Iterable[GaussianCloud]) -> GaussianCloud:
    """Every so many of the splats in ``blocks``, at most ``MOST``, the same ones however they are cut; each
    wider, as it stands for others. A single block of no more is given as it is."""
    kept: list[GaussianCloud] = []
    step, start, count = 1, 0, 0
    for block in blocks:
        if not kept and len(block) > MOST:
            step = 1 << (-(-len(block) // MOST) - 1).bit_length()
        whole = step == 1 and not kept
        kept.append(block if whole else without_harmonics(block, slice(-start % step, None, step)))
        start += len(block)
        count += len(kept[-1])
        while count > MOST:
            kept = [_every_other(kept)]
            step, count = 2 * step, len(kept[0])
    few = kept[0] if len(kept) == 1 else _together(kept)
    return few if step == 1 else replace(few, scales=few.scales * np.float32(step**0.5))


def _together(clouds: Sequence[GaussianCloud]) -> GaussianCloud:
    parts = [without_harmonics(cloud, slice(None)) for cloud in clouds]
    return GaussianCloud.joined([replace(part, kernel=parts[0].kernel) for part in parts])


def _every_other(clouds: Sequence[GaussianCloud]) -> GaussianCloud:
    return without_harmonics(_together(clouds), slice(None, None, 2))


def tips_over(cloud: GaussianCloud) -> bool:
    """Whether a scene would not stand the usual way up."""
    bounds = scene_bounds(cloud)
    return _told_by(bounds) and base_of(bounds, _ups(cloud)[0]).margin < 0


def _ups(cloud: GaussianCloud) -> list[np.ndarray]:
    """``UPS``, the usual one of such a scene first."""
    usual = up_of_survey(cloud)
    first = [] if usual is None else [usual]
    return first + [np.array(up) for up in UPS if usual is None or not np.array_equal(up, usual)]


def find_stance(cloud: GaussianCloud, threads: int | None = None) -> tuple[np.ndarray, float]:
    """(3,) unit direction that is up for an object, and how sure, 0 to 1.

    The usual one of the format, or of surveys, unless the object would tip over, and another one of ``UPS``
    is better: it alone stands firmly, or is coarse from below, where nobody photographed it. It looks at
    every so many of many splats."""
    (usual, *unusual), bounds = _ups(cloud), scene_bounds(cloud)
    if not _told_by(bounds):
        return usual, 0.0
    first, *others = (base_of(bounds, up) for up in (usual, *unusual))
    if first.margin >= 0:
        return usual, AS_USUAL if first.share >= WIDE else 0.0
    cloud, directions = subsample_of(cloud), fibonacci(VIEWS)
    cameras = _cameras_around(bounds, directions)
    splats, sizes = AllSplats(cloud, threads), []
    for camera in cameras:
        log_angle, alpha, _ = splats.look(camera, SHARP_SIDE)
        sizes.append((alpha * log_angle).sum() / max(float(alpha.sum()), 1e-6))
    coarse = np.array(sizes)
    for up, base in zip((usual, *unusual), (first, *others), strict=True):
        beside = up @ usual == 0  # where cameras that photographed its front alone would have looked from
        if coarse_beneath(directions, coarse, up, alone=beside) and (base.firm or not beside):
            return up, SEEN
    firm = [up for up, base in zip(unusual, others, strict=True) if base.firm and base.height >= TALL]
    return (firm[0], STOOD) if len(firm) == 1 else (usual, 0.0)


def finer_stance(cloud: GaussianCloud, threads: int | None = None) -> np.ndarray | None:
    """(3,) that of ``UPS`` with which a scene may be an object that is none the usual way up, by a glance:
    upside down or lying, it shows the coarse side that nobody photographed. None where there is none."""
    ups = _ups(cloud)
    usual, *others = (glance(cloud, up, threads) for up in ups)
    best = int(np.argmax(others))
    return ups[1 + best] if others[best] >= max(usual + CLEARLY, FINE - NEARLY) else None


def _told_by(bounds: Bounds) -> bool:
    """Whether there is anything that could stand."""
    return int((bounds.weights > OPAQUE).sum()) >= FEWEST


def _cameras_around(bounds: Bounds, directions: np.ndarray) -> list[Camera]:
    """Cameras in all ``directions`` (n, 3), which show the subject."""
    reach = float(np.linalg.norm(bounds.points - bounds.center, axis=1).max(initial=0))
    away = (min(bounds.radius, reach) or bounds.radius) / np.sin(np.radians(FOV / 2))
    return [
        look_at(
            bounds.center + away * direction,
            bounds.center,
            up=np.eye(3)[np.abs(direction).argmin()],
            width=SIDE,
            height=SIDE,
            fov=FOV,
            near=away * NEAR_SHARE,
        )
        for direction in directions
    ]


def base_of(bounds: Bounds, up: np.ndarray) -> Base:
    """That of an object with ``up`` (3,)."""
    touching = bounds.weights > OPAQUE
    points, weights = bounds.points[touching], bounds.weights[touching]
    height = points @ up
    low, high = np.quantile(height, [STRAYS, 1 - STRAYS])
    level = points @ np.stack(level_axes(up)).T
    least, most = np.quantile(level, [STRAYS, 1 - STRAYS], axis=0)
    inside = ((level >= least) & (level <= most)).all(axis=1)
    width = float((most - least).max())
    tall = float(high - low)
    if width <= 0 or tall <= 0:
        return Base(-1.0, 0.0, 0.0)
    level = (level - least) / width
    middle = np.average(level, axis=0, weights=weights)
    on = inside & (height >= low - BASE[0] * tall) & (height <= low + BASE[1] * tall)
    if not on.any():
        return Base(-1.0, 0.0, tall / width)
    turns = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    around = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    edge = level[on] @ around.T
    margin = float((edge.max(axis=0) - middle @ around.T).min())
    whole = _area(level[inside], (level[inside] @ around.T).argmax(axis=0))
    return Base(margin, _area(level[on], edge.argmax(axis=0)) / max(whole, 1e-12), tall / width)


def _area(points: np.ndarray, corners: np.ndarray) -> float:
    """Area of the polygon of some of the ``points`` (n, 2), in the order of ``corners``."""
    x, y = points[corners].T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def slope(directions: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(3,) gradient of ``values`` (n,) over the sphere of ``directions`` (n, 3), evenly spread."""
    return 3 * (directions * (values - values.mean())[:, None]).mean(axis=0)


def coarse_beneath(directions: np.ndarray, coarse: np.ndarray, up: np.ndarray, *, alone: bool) -> bool:
    """Whether splats are coarse from below.

    Args:
        directions: (n, 3) towards the cameras, evenly spread.
        coarse: (n,) logarithms of the size of the splats that each sees.
        up: (3,) direction.
        alone: from there alone: the sides have to look like the top."""
    toward = slope(directions, coarse)
    length = float(np.linalg.norm(toward))
    if length < COARSER or length**2 / 3 < EVENLY * coarse.var() or -toward @ up < TOWARDS * length:
        return False
    height = directions @ up
    sides = coarse[abs(height) < 1 / 3].mean()
    below, above = coarse[height < -2 / 3].mean() - sides, sides - coarse[height > 2 / 3].mean()
    return not alone or above < ALONE * below
