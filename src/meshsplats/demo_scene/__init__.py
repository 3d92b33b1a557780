"""A small still life made of splats, for demos and tests: no download, no training, the same everywhere.

A glazed vase with ferns and flowers, a striped ball and two oranges on a chequered table. Splats lie on the
surfaces as training would put them: flat, and stretched along the pattern. Light is baked in (a key light
with soft shadows, sky light with ambient occlusion); gloss is stored in spherical harmonics of degree 3, so
the image changes with the view. The y axis points down, as in files trained from COLMAP cameras; the
table top is the plane y = 0 and the vase is 1.07 units tall.

``python -m meshsplats.demo_scene scene.ply`` writes it as a splat file.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from meshsplats.demo_scene._light import KEY_LIGHT, Patch, column, diffuse, mix, spherical_harmonics, unit
from meshsplats.scene.gaussians import GaussianCloud

GOLDEN_ANGLE = np.pi * (3 - 5**0.5)
UP = np.array([0.0, -1.0, 0.0])
Skin = Callable[[np.ndarray, np.random.Generator], np.ndarray]

# Share of each part in the count of splats; the table takes the rest.
SHARES = {"vase": 0.22, "ball": 0.13, "orange": 0.045, "leaves": 0.17, "flowers": 0.08}

VASE_FOOT = np.array([-0.10, 0.0, 0.15])
VASE_PROFILE = [
    (0.17, 0.0), (0.19, 0.02), (0.29, 0.18), (0.345, 0.40), (0.30, 0.61), (0.18, 0.80), (0.115, 0.93),
    (0.13, 1.02), (0.165, 1.06), (0.150, 1.065), (0.110, 1.01), (0.095, 0.92), (0.11, 0.84),
]  # fmt: skip
"""Radius and height, from the foot over the lip and a little down inside."""
MOUTH = VASE_FOOT + UP
BALL = (np.array([0.58, -0.30, -0.30]), 0.30)
ORANGES = [(np.array([-0.52, -0.135, -0.50]), 0.135), (np.array([-0.26, -0.125, -0.68]), 0.125)]
TABLE_RADIUS = 1.45


def make_scene(count: int = 20_000, seed: int = 0) -> GaussianCloud:
    """The still life as ``count`` splats.

    Args:
        count: number of splats, at least 200. The more there are, the smaller they get: surfaces stay closed.
        seed: of the random leaves, flowers and small irregularities; the same seed gives the same scene.

    Returns:
        A cloud with spherical harmonics of degree 3 and kernel '3dgs'.

    Raises ValueError if ``count`` is below 200.
    """
    if count < 200:
        raise ValueError(f"count must be at least 200 for every object to be there, got {count}")
    rng = np.random.default_rng(seed)
    n = {name: int(share * count) for name, share in SHARES.items()}
    patches = [
        _vase(n["vase"], rng),
        _sphere(n["ball"], *BALL, _ball_stripes, rng, gloss=0.42),
        *(_sphere(n["orange"], *orange, _orange_skin, rng, gloss=0.26) for orange in ORANGES),
    ]
    leaves, tips = _leaves(n["leaves"], rng)
    patches += [leaves, _flowers(n["flowers"], tips, rng)]
    patches.append(_table(count - sum(len(p.points) for p in patches), rng))
    blockers = _blockers(leaves)
    sh = np.concatenate([spherical_harmonics(p, diffuse(p, blockers)) for p in patches])
    return splats_of(patches, np.concatenate([p.points for p in patches]), sh)


def splats_of(patches: Sequence[Patch], means: np.ndarray, sh: np.ndarray) -> GaussianCloud:
    """The splats of ``patches`` at ``means`` (n, 3) with the harmonics ``sh`` (n, k, 3)."""
    frames = np.concatenate(
        [np.stack([p.tangents, np.cross(p.normals, p.tangents), p.normals], axis=2) for p in patches]
    )
    return GaussianCloud(
        means=means,
        quaternions=quaternions_of_frames(frames),
        scales=np.concatenate([p.sigmas for p in patches]),
        opacities=np.concatenate([p.opacities for p in patches]),
        sh=sh,
    )


# ---- The objects


def _vase(n: int, rng: np.random.Generator) -> Patch:
    """A surface of revolution: equal areas along the profile, golden angle around the axis."""
    radius, height = _smooth_curve(np.array(VASE_PROFILE), 400).T
    step = np.hypot(np.diff(radius), np.diff(height))
    area = np.concatenate([[0], np.cumsum(step * (radius[1:] + radius[:-1]) * np.pi)])
    at = (np.arange(n) + 0.5) / n * area[-1]
    r, h = np.interp(at, area, radius), np.interp(at, area, height)
    dr, dh = np.gradient(radius), np.gradient(height)
    slope_r, slope_h = np.interp(at, area, dr), np.interp(at, area, dh)
    length = np.hypot(slope_r, slope_h)
    angle = np.arange(n) * GOLDEN_ANGLE
    c, s = np.cos(angle), np.sin(angle)
    normals = np.stack([slope_h * c, slope_r, slope_h * s], axis=1) / length[:, None]
    along = np.stack([-s, np.zeros(n), c], axis=1)  # around the axis: the bands of the glaze run this way
    spacing = np.sqrt(area[-1] / n)
    sigmas = np.tile(spacing * np.array([0.68, 0.54, 0.05]), (n, 1))
    sigmas[:, 0] = np.minimum(sigmas[:, 0], 0.4 * r)  # flat splats cannot bend around a narrow neck
    inside = at > np.interp(np.argmax(height), np.arange(len(area)), area)

    glaze = mix(np.array([0.004, 0.022, 0.13]), np.array([0.008, 0.085, 0.20]), np.clip(h, 0, 1))
    cream, gold = np.array([0.80, 0.72, 0.54]), np.array([0.62, 0.36, 0.07])
    wave = np.abs(h - 0.42 - 0.045 * np.sin(9 * angle)) < 0.026
    rings = (np.abs(h - 0.29) < 0.013) | (np.abs(h - 0.55) < 0.013)
    lip = (h > 1.03) | (np.abs(h - 0.86) < 0.012)
    albedo = np.where(wave[:, None], cream, np.where((rings | lip)[:, None], gold, glaze))
    albedo = albedo * (1 + 0.05 * rng.standard_normal((n, 1)))
    return Patch(
        points=VASE_FOOT + np.stack([r * c, -h, r * s], axis=1),
        normals=normals,
        tangents=along,
        sigmas=sigmas,
        albedo=albedo,
        opacities=np.full(n, 0.985),
        gloss=0.58,
        occlusion=np.where(inside, 0.25 + 0.75 * np.clip((h - 0.9) / 0.15, 0, 1), 1.0),
    )


def _sphere(
    n: int, center: np.ndarray, radius: float, skin: Skin, rng: np.random.Generator, gloss: float
) -> Patch:
    """A Fibonacci sphere; ``skin(directions, rng)`` gives its linear reflectance (n, 3)."""
    height = 1 - (2 * np.arange(n) + 1) / n
    angle = np.arange(n) * GOLDEN_ANGLE
    ring = np.sqrt(1 - height**2)
    normals = np.stack([ring * np.cos(angle), -height, ring * np.sin(angle)], axis=1)
    # Stretched along the meridians, as the stripes are.
    tangents = unit(UP - normals * column(normals @ UP))
    spacing = radius * np.sqrt(4 * np.pi / n)
    return Patch(
        points=center + radius * normals,
        normals=normals,
        tangents=tangents,
        sigmas=np.broadcast_to(spacing * np.array([0.68, 0.52, 0.05]), (n, 3)),
        albedo=skin(normals, rng),
        opacities=np.full(n, 0.985),
        gloss=gloss,
    )


def _ball_stripes(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Twelve gores about an axis that leans to the viewer: red, cream, ochre, cream."""
    axis = unit(np.array([0.35, -0.80, -0.50]))
    side = unit(np.cross(axis, [0.0, 0.0, 1.0]))
    angle = np.arctan2(directions @ np.cross(axis, side), directions @ side)
    colors = np.array([[0.62, 0.045, 0.04], [0.80, 0.74, 0.62], [0.70, 0.33, 0.05], [0.80, 0.74, 0.62]])
    albedo = colors[np.floor((angle / (2 * np.pi) + 1) * 12).astype(int) % 4]
    cap = np.abs(directions @ axis) > 0.965
    return np.where(cap[:, None], colors[0], albedo) * (1 + 0.03 * rng.standard_normal((len(directions), 1)))


def _orange_skin(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Orange with pores, greener towards the stalk."""
    green = np.clip((-directions[:, 1] - 0.80) * 4, 0, 1)
    base = mix(np.array([0.80, 0.24, 0.02]), np.array([0.30, 0.28, 0.03]), green)
    return base * (1 - 0.22 * rng.random((len(directions), 1)) ** 2)


def _leaves(n: int, rng: np.random.Generator) -> tuple[Patch, np.ndarray]:
    """Fern fronds out of the vase's mouth: arched stems with leaflets on both sides; and the (k, 3) tips."""
    stems = 17
    turn = np.arange(stems) * GOLDEN_ANGLE + 0.3 * rng.standard_normal(stems)
    lean = np.linspace(0.10, 1.0, stems) ** 0.7
    reach, rise = 0.10 + 0.62 * lean, 0.56 - 0.40 * lean**1.6 + 0.06 * rng.standard_normal(stems)
    outwards = np.stack([np.cos(turn), np.zeros(stems), np.sin(turn)], axis=1)
    start = MOUTH + 0.06 * outwards
    middle = start + outwards * (0.35 * reach)[:, None] + UP * (0.20 + 0.8 * rise)[:, None]
    end = start + outwards * reach[:, None] + UP * rise[:, None]

    # One splat in five makes the stem, the others are leaflets.
    stem = np.arange(n) % stems
    is_stalk = rng.random(n) < 0.2
    t = np.where(is_stalk, rng.random(n), 0.12 + 0.88 * rng.random(n) ** 0.85)
    a, b, c = (column(w) for w in ((1 - t) ** 2, 2 * t * (1 - t), t * t))
    on_stem = a * start[stem] + b * middle[stem] + c * end[stem]
    along = unit(column(1 - t) * (middle - start)[stem] + column(t) * (end - middle)[stem])
    side = unit(np.cross(along, outwards[stem] + 0.01 * UP))
    side = side * rng.choice([-1.0, 1.0], (n, 1))
    direction = unit(0.62 * along + side + 0.16 * rng.standard_normal((n, 3)) + column(0.35 * t) * -UP)
    length = 0.115 * np.sin(np.pi * (0.10 + 0.86 * t)) * (0.8 + 0.4 * rng.random(n))
    # Leaflets droop: the farther out, the lower.
    along_leaf = rng.random(n)
    points = on_stem + direction * column(length * (0.25 + 0.6 * along_leaf))
    direction = np.where(is_stalk[:, None], along, direction)
    points = np.where(is_stalk[:, None], on_stem, points)
    normals = np.cross(direction, along + 0.3 * rng.standard_normal((n, 3)))
    normals = unit(normals + 1e-6) * column(np.where(normals @ UP < 0, -1.0, 1.0))
    normals = unit(normals - direction * column((normals * direction).sum(1)))
    fineness = (4_000 / max(n, 1)) ** 0.35
    width = np.where(is_stalk, 0.0045, 0.0078 * (1 - 0.45 * along_leaf)) * fineness
    extent = np.where(is_stalk, 0.028, 0.36 * length + 0.004) * fineness**0.5
    sigmas = np.stack([extent, width, 0.12 * width], axis=1)
    sigmas[is_stalk, 2] = sigmas[is_stalk, 1]
    young = np.clip(0.55 * t + 0.45 * along_leaf + 0.12 * rng.standard_normal(n), 0, 1)
    albedo = mix(np.array([0.020, 0.085, 0.022]), np.array([0.22, 0.40, 0.06]), young)
    albedo[is_stalk] = [0.10, 0.13, 0.03]
    patch = Patch(
        points=points,
        normals=normals,
        tangents=direction,
        sigmas=sigmas,
        albedo=albedo,
        opacities=np.where(is_stalk, 0.95, 0.62 + 0.33 * rng.random(n)),
        translucency=0.45,
        occlusion=np.clip(0.35 + 1.3 * np.linalg.norm(points - MOUTH, axis=1), 0, 1),
    )
    return patch, end


def _flowers(n: int, tips: np.ndarray, rng: np.random.Generator) -> Patch:
    """Round flower heads near some stem tips: petals are thin splats that point away from the middle."""
    chosen = tips[[1, 3, 4, 6, 9]]
    centers = MOUTH + (chosen - MOUTH) * 0.93 + [0.0, -0.10, 0.0]
    head = np.arange(n) % len(centers)
    directions = unit(np.array([0.0, -0.35, -0.25]) + rng.standard_normal((n, 3)))
    shell = rng.random(n) ** 0.4
    radius = np.array([0.085, 0.072, 0.092, 0.078, 0.086])[head] * shell
    tangents = directions
    normals = unit(np.cross(directions, rng.standard_normal((n, 3))))
    normals *= column(np.where(normals @ KEY_LIGHT < 0, -1.0, 1.0))
    size = (1_600 / max(n, 1)) ** 0.5
    inner = np.array([[0.70, 0.30, 0.02], [0.40, 0.02, 0.10], [0.70, 0.10, 0.08]])[head % 3]
    outer = np.array([[0.92, 0.66, 0.12], [0.80, 0.16, 0.30], [0.92, 0.45, 0.36]])[head % 3]
    return Patch(
        points=centers[head] + directions * column(radius),
        normals=normals,
        tangents=tangents,
        sigmas=np.broadcast_to([0.016, 0.0085 * size**0.7, 0.0015], (n, 3)),
        albedo=mix(inner, outer, shell),
        opacities=0.75 + 0.22 * rng.random(n),
        translucency=0.5,
        occlusion=0.35 + 0.65 * shell,
    )


def _table(n: int, rng: np.random.Generator) -> Patch:
    """A circular chequered table top whose edge fades out."""
    # A sunflower spiral, a little denser in the middle, where the objects and their shadows are.
    share = (np.arange(n) + 0.5) / n
    radius = TABLE_RADIUS * share**0.55
    spacing = TABLE_RADIUS * np.sqrt(np.pi * 1.1 * share**0.1 / n)
    angle = np.arange(n) * GOLDEN_ANGLE
    x, z = radius * np.cos(angle), radius * np.sin(angle)
    u, v = (x + z) / 0.42, (x - z) / 0.42
    dark = (np.floor(u) + np.floor(v)) % 2 == 1
    albedo = np.where(dark[:, None], [0.17, 0.24, 0.23], [0.62, 0.57, 0.48])
    albedo = albedo * (1 + 0.04 * rng.standard_normal((n, 1)))
    # Along the edges of the squares, splats are stretched with it and thin across, as training leaves them.
    to_u, to_v = np.abs(u - np.round(u)) * 0.297, np.abs(v - np.round(v)) * 0.297
    nearest = np.minimum(to_u, to_v)
    edge = np.clip(1 - nearest / (0.9 * spacing), 0, 1)
    direction_u = np.array([1.0, 0.0, 1.0]) / 2**0.5
    direction_v = np.array([1.0, 0.0, -1.0]) / 2**0.5
    tangents = np.where((to_u < to_v)[:, None], direction_v, direction_u)
    fade = np.clip((TABLE_RADIUS - radius - 0.05 * rng.random(n)) / 0.30, 0, 1)
    return Patch(
        points=np.stack([x, 0.002 * rng.random(n), z], axis=1),
        normals=np.broadcast_to([0.0, -1.0, 0.0], (n, 3)),
        tangents=tangents,
        sigmas=column(spacing) * np.stack([0.60 + 0.10 * edge, 0.60 - 0.20 * edge, 0.05 + 0 * edge], axis=1),
        albedo=albedo,
        opacities=np.clip(0.97 * fade**1.5, 0.01, None),
        gloss=0.05,
    )


def _blockers(leaves: Patch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spheres that block light in place of the objects: centres (b, 3), radii (b,), densities (b,)."""
    radius, height = _smooth_curve(np.array(VASE_PROFILE[:9]), 9).T
    centers = [VASE_FOOT + np.stack([0 * height, -np.maximum(height, 0.6 * radius), 0 * height], axis=1)]
    radii, densities = [0.97 * radius], [np.full(len(radius), 3.0)]
    for center, r in [BALL, *ORANGES]:
        centers.append(center[None])
        radii.append(np.array([0.97 * r]))
        densities.append(np.array([6.0]))
    some = leaves.points[:: max(1, len(leaves.points) // 120)]
    centers.append(some)
    radii.append(np.full(len(some), 0.055))
    densities.append(np.full(len(some), 0.55))
    return np.concatenate(centers), np.concatenate(radii), np.concatenate(densities)


def _smooth_curve(knots: np.ndarray, n: int) -> np.ndarray:
    """(n, d) points of the Catmull-Rom spline through the (k, d) knots."""
    padded = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    at = np.linspace(0, len(knots) - 1, n)
    i = np.minimum(at.astype(int), len(knots) - 2)
    t = column(at - i)
    p0, p1, p2, p3 = (padded[i + k] for k in range(4))
    return p1 + 0.5 * t * (p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0)))


def quaternions_of_frames(rotations: np.ndarray) -> np.ndarray:
    """(n, 4) unit quaternions w, x, y, z of (n, 3, 3) rotation matrices.

    Four times the outer product q q^T is linear in the matrix; the row with the largest diagonal is not zero.
    """
    m = rotations
    outer = np.empty((len(m), 4, 4))
    d0, d1, d2 = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    for i, diagonal in enumerate((1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2)):
        outer[:, i, i] = diagonal
    for axis, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        outer[:, 0, axis + 1] = outer[:, axis + 1, 0] = m[:, k, j] - m[:, j, k]
        outer[:, j + 1, k + 1] = outer[:, k + 1, j + 1] = m[:, j, k] + m[:, k, j]
    largest = np.argmax(np.einsum("nii->ni", outer), axis=1)
    return unit(outer[np.arange(len(m)), largest])


def main(arguments: list[str] | None = None) -> None:
    """``python -m meshsplats.demo_scene FILE.ply [COUNT]`` writes the scene; replaces an existing file."""
    from meshsplats import save_gaussians

    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) not in (1, 2) or not all(a.isdecimal() for a in arguments[1:]):
        raise SystemExit("usage: python -m meshsplats.demo_scene FILE.ply [COUNT]")
    path = Path(arguments[0])
    path.parent.mkdir(parents=True, exist_ok=True)
    cloud = make_scene(*map(int, arguments[1:]))
    save_gaussians(cloud, path)
    print(f"{path}: {len(cloud):,} splats of our own still life")
