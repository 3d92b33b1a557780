"""A furnished room of splats, seen from within, for the tutorial about places and for tests.

The still life stands on a table in a room of 6 x 8 x 3 units, with a sofa, shelves, a sideboard and three
windows through which the sun shines. Behind the walls is what training leaves where no photograph looked:
large, translucent splats of no shape. The y axis points down, and the floor is the plane y = 0.

``python -m meshsplats.demo_scene.room FILE.ply [COUNT]`` writes it as a splat file.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshsplats.demo_scene import GOLDEN_ANGLE, make_scene, splats_of
from meshsplats.demo_scene._light import KEY_LIGHT, Patch, column, diffuse, spherical_harmonics
from meshsplats.scene.gaussians import SH_C0, GaussianCloud

Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Reflectance (n, 3) of places (n,), (n,) along the two edges of a rectangle, in units."""

HALF = np.array([3.0, 1.5, 4.0])
"""Half the width, height and length of the room."""
MIDDLE = np.array([0.0, -1.5, 0.0])
TABLE = np.array([0.5, -0.74, 0.4])
"""Middle of the table top."""
STILL_LIFE = 0.55
"""Size of the still life."""
SHARES = {"still life": 0.2, "noise": 0.12}
"""Share of each in the splats; room and furniture take the rest, by their area."""
WINDOWS = ((-2.9, -1.5), (-0.7, 0.7), (1.5, 2.9))
"""From where to where along the left wall..."""
SILL, LINTEL = 0.8, 2.4
"""...and from which height to which."""
FEWEST = 2000
_NO_BLOCKERS = (np.empty((0, 3)), np.empty(0), np.empty(0))
_SKY = np.array([0.86, 0.93, 1.0])
_ROUGHNESS = 0.003
"""Depth of surfaces: where splats shared a plane, rounding would decide which of them is in front."""


@dataclass(frozen=True)
class _Sheet:
    """A rectangle with paint on its front."""

    corner: Sequence[float]
    across: Sequence[float]
    """One edge, from ``corner``, ..."""
    along: Sequence[float]
    """...and the other: ``across`` x ``along`` points to the front."""
    paint: Paint
    gloss: float = 0.0

    @property
    def area(self) -> float:
        return float(np.linalg.norm(np.cross(self.across, self.along)))

    def patch(self, n: int, rng: np.random.Generator) -> Patch:
        edges = np.array([self.across, self.along], np.float64)
        lengths = np.linalg.norm(edges, axis=1)
        share = np.stack([(np.arange(n) + 0.5) / n, (np.arange(n) * GOLDEN_ANGLE / (2 * np.pi)) % 1], axis=1)
        normal = np.cross(*(edges / lengths[:, None]))
        points = self.corner + share @ edges - normal * column(_ROUGHNESS * rng.random(n))
        spacing = np.sqrt(self.area / max(n, 1))
        # Light comes from the windows, from the floor to the ceiling, and less of it to the corners.
        corner = np.sort(np.abs((points - MIDDLE) / HALF), axis=1)[:, 1]
        sky = (1.7 + 0.9 * max(normal[1], 0)) * (1 - 0.2 * points[:, 0] / HALF[0] - 0.3 * corner**8)
        return Patch(
            points=points,
            normals=np.broadcast_to(normal, (n, 3)),
            tangents=np.broadcast_to(edges[0] / lengths[0], (n, 3)),
            sigmas=np.broadcast_to(spacing * np.array([0.62, 0.62, 0.06]), (n, 3)),
            albedo=self.paint(*(share * lengths).T) * (1 + 0.05 * rng.standard_normal((n, 1))),
            opacities=np.full(n, 0.97),
            gloss=self.gloss,
            occlusion=sky,
            sunlit=_sunlit(points),
        )


def make_room(count: int = 80_000, seed: int = 0) -> GaussianCloud:
    """The room as ``count`` splats with spherical harmonics of degree 3.

    Args:
        count: number of splats, at least ``FEWEST``. The more there are, the smaller they get.
        seed: of everything that is random; the same seed gives the same room.

    Raises ValueError if ``count`` is too small.
    """
    if count < FEWEST:
        raise ValueError(f"count must be at least {FEWEST} for everything to be there, got {count}")
    rng = np.random.default_rng(seed)
    still, noise = (int(SHARES[name] * count) for name in ("still life", "noise"))
    sheets = [*_walls(), *_furniture()]
    panes = [_pane(*window) for window in WINDOWS]
    areas = np.array([sheet.area for sheet in (*sheets, *panes)])
    ends = np.round(np.cumsum(areas) / areas.sum() * (count - still - noise)).astype(int)
    patches = [s.patch(int(n), rng) for s, n in zip((*sheets, *panes), np.diff(ends, prepend=0), strict=True)]
    colors = [diffuse(patch, _NO_BLOCKERS) for patch in patches]
    colors[len(sheets) :] = [_sky_of(patch) for patch in patches[len(sheets) :]]
    sh = np.concatenate([spherical_harmonics(p, c) for p, c in zip(patches, colors, strict=True)])
    placed = np.column_stack([STILL_LIFE * np.eye(3), TABLE])
    return GaussianCloud.joined(
        [
            splats_of(patches, np.concatenate([patch.points for patch in patches]), sh),
            make_scene(still, seed).transformed(placed),
            _noise(noise, rng),
        ]
    )


def _sunlit(points: np.ndarray) -> np.ndarray:
    """(n,) 1 where the way to the sun leads through a window, else 0."""
    steps = (points[:, 0] + HALF[0]) / -KEY_LIGHT[0]
    there = points + column(steps) * KEY_LIGHT
    through = np.zeros(len(points), bool)
    for start, end in WINDOWS:
        through |= (
            (there[:, 2] > start) & (there[:, 2] < end) & (-there[:, 1] > SILL) & (-there[:, 1] < LINTEL)
        )
    return through.astype(np.float64)


def _walls() -> list[_Sheet]:
    x, z, height = HALF[0], HALF[2], 2 * HALF[1]
    return [
        _Sheet([-x, 0, -z], [2 * x, 0, 0], [0, 0, 2 * z], _boards, gloss=0.15),
        _Sheet([-x, -height, -z], [0, 0, 2 * z], [2 * x, 0, 0], _plain(0.72, 0.71, 0.68)),
        _Sheet([-x, 0, z], [2 * x, 0, 0], [0, -height, 0], _wall_with_pictures),
        _Sheet([x, 0, -z], [-2 * x, 0, 0], [0, -height, 0], _wall_with_door),
        _Sheet([-x, 0, -z], [0, 0, 2 * z], [0, -height, 0], _wall),
        _Sheet([x, 0, z], [0, 0, -2 * z], [0, -height, 0], _wall),
    ]


def _pane(start: float, end: float) -> _Sheet:
    """A window, a little before its wall."""
    return _Sheet(
        [0.02 - HALF[0], -SILL, start], [0, 0, end - start], [0, SILL - LINTEL, 0], _plain(0.5, 0.5, 0.5)
    )


def _sky_of(pane: Patch) -> np.ndarray:
    """(n, 3) display RGB of a window: sky between white bars."""
    height = (-pane.points[:, 1] - SILL) / (LINTEL - SILL)
    side = pane.points[:, 2] - pane.points[:, 2].min()
    width = side.max()
    bars = (
        (np.abs(height - 0.62) < 0.02)
        | (np.abs(side - width / 2) < 0.035)
        | (height < 0.03)
        | (height > 0.97)
    )
    bars |= (side < 0.05) | (side > width - 0.05)
    green = column(np.clip((0.3 - height) * 8, 0, 1))
    view = (1 - green) * _SKY + green * [0.45, 0.60, 0.35]
    return np.where(bars[:, None], [0.97, 0.96, 0.93], view * (1 - 0.1 * column(height)))


def _furniture() -> list[_Sheet]:
    wood, cloth = _plain(0.36, 0.20, 0.09), _plain(0.10, 0.19, 0.24)
    x, top, z = TABLE[0] - 0.07, -TABLE[1], TABLE[2] - 0.07
    return [
        _Sheet([-1.5, -0.01, -1.6], [3.4, 0, 0], [0, 0, 3.4], _rug),
        *_box([x, 0, z], [0.14, top - 0.03, 0.14], wood),
        *_box([-0.9, 0, 3.45], [1.8, 0.85, 0.5], wood),
        *_box([2.6, 0, -0.9], [0.38, 2.2, 2.4], wood, front=_books),
        *_box([-0.9, 0, -3.3], [2.4, 0.42, 0.9], cloth),
        *_box([-0.9, 0.42, -3.3], [2.4, 0.42, 0.25], cloth),
        *_box([-1.1, 0, -3.3], [0.2, 0.62, 0.9], cloth),
        *_box([1.5, 0, -3.3], [0.2, 0.62, 0.9], cloth),
        *_box([2.2, 0, 3.1], [0.4, 0.45, 0.4], _plain(0.45, 0.16, 0.08)),
    ]


def _box(
    corner: Sequence[float], size: Sequence[float], paint: Paint, front: Paint | None = None
) -> list[_Sheet]:
    """A box on its lower corner (x, height, z), without its bottom; ``front``: paint of the side towards
    -x."""
    x, low, z = corner
    w, h, d = size
    y = -low
    return [
        _Sheet([x, y - h, z], [w, 0, 0], [0, 0, d], paint),
        _Sheet([x, y, z], [w, 0, 0], [0, -h, 0], paint),
        _Sheet([x + w, y, z + d], [-w, 0, 0], [0, -h, 0], paint),
        _Sheet([x, y, z + d], [0, 0, -d], [0, -h, 0], front or paint),
        _Sheet([x + w, y, z], [0, 0, d], [0, -h, 0], paint),
    ]


def _noise(n: int, rng: np.random.Generator) -> GaussianCloud:
    """Large splats around the room."""
    away = rng.standard_normal((n, 3))
    away /= np.abs(away).max(axis=1, keepdims=True)
    means = MIDDLE + away * (HALF + 0.8 + rng.gamma(1.5, 0.5, (n, 1)))
    turns = rng.standard_normal((n, 4))
    grey = rng.uniform(0.15, 0.8, (n, 1)) + 0.12 * rng.standard_normal((n, 3))
    sh = np.zeros((n, 16, 3), np.float32)
    sh[:, 0] = (np.clip(grey, 0, 1) - 0.5) / SH_C0
    return GaussianCloud(
        means,
        turns / np.linalg.norm(turns, axis=1, keepdims=True),
        rng.uniform(0.08, 0.3, (n, 3)) * rng.uniform(0.6, 1.6, (n, 1)),
        rng.uniform(0.1, 0.85, n),
        sh,
    )


# ---- Paint


def _plain(red: float, green: float, blue: float) -> Paint:
    return lambda x, y: np.tile([red, green, blue], (len(x), 1))


def _boards(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    row = np.floor(y / 0.22)
    board = np.floor((x + 0.73 * row) / 1.1)
    tone = 0.75 + 0.5 * ((np.sin(12.9 * row + 78.2 * board) * 43758.5) % 1)
    seam = (np.abs(y / 0.22 % 1 - 0.5) > 0.46) | (np.abs((x + 0.73 * row) / 1.1 % 1 - 0.5) > 0.49)
    return np.array([0.42, 0.24, 0.11]) * column(np.where(seam, 0.45, tone))


def _wall(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    panel = np.where((y < 0.9)[:, None], [0.30, 0.38, 0.33], [0.66, 0.60, 0.47])
    stripe = 1 - 0.16 * ((x % 0.3 < 0.15) & (y >= 0.9))
    return np.where(
        ((y < 0.12) | (np.abs(y - 0.9) < 0.03))[:, None], [0.75, 0.73, 0.68], panel * column(stripe)
    )


def _wall_with_pictures(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    color = _wall(x, y)
    for middle, half, hue in ((1.7, 0.42, 0.0), (3.0, 0.62, 2.1), (4.3, 0.42, 4.2)):
        u, v = (x - middle) / half, (y - 1.8) / (0.75 * half)
        inside, frame = (np.abs(u) < 1) & (np.abs(v) < 1), (np.abs(u) < 1.1) & (np.abs(v) < 1.13)
        color[frame] = [0.30, 0.19, 0.06]
        waves = np.sin(4 * u + 2 * np.sin(3 * v + hue)) + np.cos(5 * v + hue)
        shades = 0.35 + 0.18 * np.sin(column(waves) + hue + np.array([0, 2.1, 4.2]))
        color[inside] = shades[inside]
    return color


def _wall_with_door(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    color = _wall(x, y)
    u = np.abs(x - 4.6)
    color[(u < 0.55) & (y < 2.15)] = [0.75, 0.73, 0.68]
    color[(u < 0.45) & (y < 2.05)] = [0.20, 0.27, 0.24]
    color[(u < 0.32) & (np.abs(y % 1.0 - 0.55) < 0.32) & (y < 1.9)] = [0.26, 0.34, 0.30]
    return color


def _rug(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    edge = np.minimum(np.minimum(x, 3.4 - x), np.minimum(y, 3.4 - y))
    diamonds = (np.abs(x % 0.68 - 0.34) + np.abs(y % 0.68 - 0.34)) < 0.22
    inner = np.where(diamonds[:, None], [0.62, 0.45, 0.20], [0.32, 0.05, 0.06])
    return np.where(
        (edge < 0.25)[:, None],
        np.where((edge % 0.1 < 0.05)[:, None], [0.6, 0.5, 0.3], [0.1, 0.1, 0.2]),
        inner,
    )


def _books(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    shelf, height = np.floor(y / 0.42), y % 0.42
    book = np.floor(x / 0.055 + 0.3 * np.sin(9 * shelf))
    tone = (np.sin(12.9 * book + 78.2 * shelf) * 43758.5) % 1
    hue = 6.3 * tone + np.array([[0, 2.1, 4.2]]).T
    color = (0.20 + 0.11 * np.sin(hue)).T
    gap = height > 0.27 + 0.1 * tone
    return np.where(
        (height < 0.03)[:, None], [0.36, 0.20, 0.09], np.where(gap[:, None], [0.03, 0.02, 0.02], color)
    )


def main(arguments: list[str] | None = None) -> None:
    """``python -m meshsplats.demo_scene.room FILE.ply [COUNT]``; replaces an existing file."""
    from meshsplats import save_gaussians

    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) not in (1, 2) or not all(a.isdecimal() for a in arguments[1:]):
        raise SystemExit("usage: python -m meshsplats.demo_scene.room FILE.ply [COUNT]")
    room = make_room(int(arguments[1])) if len(arguments) == 2 else make_room()
    save_gaussians(room, Path(arguments[0]))
    print(f"{arguments[0]}: {len(room):,} splats of a room of our own")


if __name__ == "__main__":
    main()
