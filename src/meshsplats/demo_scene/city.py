"""A city of splats of any size, for tests and benchmarks: made block by block, the same everywhere.

Lots of 20 x 20 units lie in a square grid, each with a street, a pavement, lawns, trees and a house of its
own height and colours. The density of the splats is the same in every city: one with ten times as many
splats covers ten times the ground. The y axis points down and the ground is the plane y = 0.

``python -m meshsplats.demo_scene.city FILE.ply COUNT [DEGREE]`` writes one as a splat file.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from meshsplats.demo_scene import GOLDEN_ANGLE, UP, splats_of
from meshsplats.demo_scene._light import Patch, column, diffuse, spherical_harmonics, unit
from meshsplats.scene.gaussians import SH_C0, GaussianCloud

LOT = 20.0
"""Side of a lot, scene units."""
LOT_SPLATS = 20_000
"""Splats of a lot; the last one has the rest."""
SHARES = {"walls": 0.42, "roof": 0.10, "trees": 0.18}
"""Share of each part in the splats of a lot; the ground takes the rest."""
_ROUGHNESS = 0.01
"""Depth of surfaces: where splats shared a plane, rounding would decide which of them is in front."""
_NO_BLOCKERS = (np.empty((0, 3)), np.empty(0), np.empty(0))


def city_blocks(count: int, *, degree: int = 3, seed: int = 0) -> Iterator[GaussianCloud]:
    """The lots of a city of ``count`` splats, one after the other, each at most ``LOT_SPLATS``.

    Args:
        count: number of splats, at least 200.
        degree: of the spherical harmonics, 0 to 3.
        seed: of everything that is random; the same seed gives the same city.

    Raises ValueError for a count or degree out of range.
    """
    if count < 200:
        raise ValueError(f"count must be at least 200, got {count}")
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree must be 0, 1, 2 or 3, got {degree!r}")
    lots = -(-count // LOT_SPLATS)
    side = int(np.ceil(np.sqrt(lots)))
    for i in range(lots):
        n = min(LOT_SPLATS, count - i * LOT_SPLATS)
        rng = np.random.default_rng([seed, i])
        corner = LOT * (np.array([i % side, 0, i // side]) - [side / 2, 0, side / 2])
        yield _lot(n, corner, degree, rng)


def _lot(n: int, corner: np.ndarray, degree: int, rng: np.random.Generator) -> GaussianCloud:
    counts = {name: int(share * n) for name, share in SHARES.items()}
    size = rng.uniform([8.0, 5.0, 8.0], [12.0, 22.0, 12.0])
    middle = np.array([11.5, 0, 11.5])
    tone = rng.uniform(0.35, 0.75) * (1 + 0.3 * rng.standard_normal(3) * [1, 0.5, 1])
    patches = [
        _walls(counts["walls"], middle, size, tone, rng),
        _roof(counts["roof"], middle, size, rng),
        _trees(counts["trees"], rng),
        _ground(n - sum(counts.values()), rng),
    ]
    patches = [patch for patch in patches if len(patch.points)]
    colors = [diffuse(patch, _NO_BLOCKERS) for patch in patches]
    if degree:
        sh = np.concatenate([spherical_harmonics(p, c) for p, c in zip(patches, colors, strict=True)])
    else:
        sh = ((np.concatenate(colors) - 0.5) / SH_C0)[:, None]
    means = corner + np.concatenate([p.points for p in patches])
    return splats_of(patches, means, sh[:, : (degree + 1) ** 2])


def _walls(n: int, middle: np.ndarray, size: np.ndarray, tone: np.ndarray, rng: np.random.Generator) -> Patch:
    """Four walls with rows of windows, which shine."""
    width, height, depth = size
    lengths = np.array([width, depth, width, depth])
    wall = rng.choice(4, n, p=lengths / lengths.sum())
    along, up = rng.uniform(-0.5, 0.5, n) * lengths[wall], rng.uniform(0, height, n)
    directions = np.array([[1.0, 0, 0], [0, 0, 1.0], [-1.0, 0, 0], [0, 0, -1.0]])
    normals = np.array([[0, 0, -1.0], [1.0, 0, 0], [0, 0, 1.0], [-1.0, 0, 0]])[wall]
    away = np.array([depth, width, depth, width])[wall] / 2 - _ROUGHNESS * rng.random(n)
    points = middle + directions[wall] * column(along) + normals * column(away) + UP * column(up)
    window = (np.abs(along % 2.0 - 1) < 0.6) & (np.abs(up % 3.0 - 1.7) < 0.8) & (up < height - 0.6)
    albedo = np.where(window[:, None], [0.03, 0.06, 0.10], np.clip(tone, 0.05, 0.9))
    spacing = np.sqrt(lengths.sum() * height / max(n, 1))
    return Patch(
        points=points,
        normals=normals,
        tangents=directions[wall],
        sigmas=np.broadcast_to(spacing * np.array([0.75, 0.75, 0.06]), (n, 3)),
        albedo=albedo * (1 + 0.08 * rng.standard_normal((n, 1))),
        opacities=np.full(n, 0.97),
        gloss=0.3,
        occlusion=np.clip(0.5 + up / 6, 0, 1),
    )


def _roof(n: int, middle: np.ndarray, size: np.ndarray, rng: np.random.Generator) -> Patch:
    width, height, depth = size
    x, z = rng.uniform(-0.5, 0.5, (2, n)) * [[width], [depth]]
    spacing = np.sqrt(width * depth / max(n, 1))
    color = np.array([[0.32, 0.10, 0.06], [0.18, 0.18, 0.20], [0.30, 0.26, 0.20]])[rng.integers(3)]
    return Patch(
        points=middle + UP * height + np.stack([x, _ROUGHNESS * rng.random(n), z], axis=1),
        normals=np.broadcast_to(UP, (n, 3)),
        tangents=np.broadcast_to([1.0, 0, 0], (n, 3)),
        sigmas=np.broadcast_to(spacing * np.array([0.75, 0.75, 0.06]), (n, 3)),
        albedo=color * (1 + 0.15 * rng.standard_normal((n, 1))),
        opacities=np.full(n, 0.97),
    )


def _trees(n: int, rng: np.random.Generator) -> Patch:
    """Three crowns of leaves on the lawn along the street."""
    tree = rng.integers(3, size=n)
    heights, radii = rng.uniform(3.0, 6.0, 3), rng.uniform(1.0, 1.7, 3)
    foot = np.stack([5.0 + 5.0 * np.arange(3) + rng.uniform(-1, 1, 3), np.zeros(3), np.full(3, 4.6)], axis=1)
    directions = unit(rng.standard_normal((n, 3)))
    shell = rng.random(n) ** 0.4
    points = foot[tree] + UP * column(heights[tree]) + directions * column(radii[tree] * shell)
    normals = unit(directions + 0.5 * rng.standard_normal((n, 3)))
    tangents = unit(np.cross(normals, rng.standard_normal((n, 3))))
    width = 0.16 * (3_600 / max(n, 1)) ** 0.4
    return Patch(
        points=points,
        normals=normals,
        tangents=tangents,
        sigmas=np.broadcast_to(width * np.array([1.0, 0.55, 0.12]), (n, 3)),
        albedo=np.array([0.05, 0.16, 0.03]) * (0.6 + 0.8 * rng.random((n, 1))),
        opacities=rng.uniform(0.6, 0.95, n),
        translucency=0.4,
        occlusion=0.3 + 0.7 * shell,
    )


def _ground(n: int, rng: np.random.Generator) -> Patch:
    """Streets along two sides of the lot, a pavement, and a lawn."""
    share = (np.arange(n) + 0.5) / n
    x, z = LOT * share, LOT * ((np.arange(n) * GOLDEN_ANGLE / (2 * np.pi)) % 1)
    nearest = np.minimum(x, z)
    line = (np.abs(nearest - 1.5) < 0.08) & (np.maximum(x, z) % 3 < 1.6)
    kinds = np.select([line, nearest < 3.0, nearest < 3.8], [3, 0, 1], default=2)
    colors = np.array([[0.05, 0.05, 0.055], [0.36, 0.34, 0.31], [0.07, 0.15, 0.035], [0.75, 0.75, 0.70]])
    spacing = LOT / np.sqrt(max(n, 1))
    return Patch(
        points=np.stack([x, _ROUGHNESS * rng.random(n), z], axis=1),
        normals=np.broadcast_to(UP, (n, 3)),
        tangents=np.broadcast_to([1.0, 0, 0], (n, 3)),
        sigmas=np.broadcast_to(spacing * np.array([0.7, 0.7, 0.06]), (n, 3)),
        albedo=colors[kinds] * (1 + 0.10 * rng.standard_normal((n, 1))),
        opacities=np.full(n, 0.97),
        gloss=0.05,
    )


def main(arguments: list[str] | None = None) -> None:
    """``python -m meshsplats.demo_scene.city FILE.ply COUNT [DEGREE]``; replaces an existing file."""
    from meshsplats import save_gaussian_blocks

    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) not in (2, 3) or not all(a.isdecimal() for a in arguments[1:]):
        raise SystemExit("usage: python -m meshsplats.demo_scene.city FILE.ply COUNT [DEGREE]")
    path, count = Path(arguments[0]), int(arguments[1])
    degree = int(arguments[2]) if len(arguments) == 3 else 3
    save_gaussian_blocks(city_blocks(count, degree=degree), path, count, degree=degree)
    print(f"{path}: {count:,} splats of a city of our own")


if __name__ == "__main__":
    main()
