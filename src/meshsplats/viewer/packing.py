"""Meshes and splats as the whole numbers of a container.

The triangles of a splat, its fan, nearly always have one of a few patterns: the same faces over the same
vertices. The vertices of a fan are predicted from some of them by weights that are fitted to all fans of the
pattern. The ellipses that ``convert`` makes follow from three or four of their vertices exactly, so that
nothing else is stored of them; fans that were fine-tuned store small corrections. Meshes without fans store
each vertex as a difference from the one before.

The page decodes the same numbers in the same order of operations (``page/scene.js``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.cameras.framing import scene_bounds
from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer.streams import Packer, rounded

FINER = 8
"""Steps of the vertices from which others are predicted are this much finer."""

MOST_STEPS = 1 << 30
"""Positions are at most this many of the fine steps from their origin; those of strays are floats."""

WORTHWHILE = 64
"""Fewest fans of a pattern for which weights are fitted and stored."""

MOST_PATTERNS = 256
"""Meshes with more patterns than this are stored as meshes without fans."""

SCALE_STEPS = 64
"""Steps of a standard deviation in each power of two."""

LARGEST_SPLAT = 64
"""Standard deviation in radii of the scene; larger ones are strays, which must not make small ones flat."""

ROTATION_STEPS = 511
"""Steps of a component of a quaternion in one."""

HARMONIC_STEPS = 127
"""Steps of spherical harmonics in the magnitude that HARMONIC_SHARE of them do not exceed: 8 bits with the
sign."""

HARMONIC_SHARE = 0.999

MOST_HARMONIC_STEPS = (1 << 15) - 1
"""Largest magnitude of a harmonic in steps."""

SAMPLE = 6000
"""Fans, or triangles of a mesh without fans, from which the size of the data is estimated."""


@dataclass(frozen=True)
class Precision:
    """Steps of quantisation."""

    position: int
    """log2 of the number of steps of a vertex in the radius of the scene."""
    color: int
    """Bits of a colour channel."""
    alpha: int
    """Bits of an opacity."""


def pack_mesh(mesh: SplatMesh, precision: Precision, radius: float) -> bytes:
    """``mesh`` as a container. ``radius``: size of the scene, to which the steps of positions relate."""
    return pack_in_order(mesh, vertex_order(mesh), precision, radius)


def pack_in_order(mesh: SplatMesh, order: np.ndarray, precision: Precision, radius: float) -> bytes:
    """``pack_mesh``; ``order`` as from ``vertex_order``."""
    vertices, colors = mesh.vertices[order].astype(np.float64), mesh.colors[order]
    renumber = np.zeros(len(mesh.vertices), np.int64)
    renumber[order] = np.arange(len(order))
    faces = renumber[mesh.faces]
    step = rounded([radius * 2.0**-precision.position])[0]
    origin = _origin(vertices, step / FINER)
    far = _far(vertices - origin, step / FINER)
    fans = _fans(faces, mesh.face_splat)
    if fans is not None and far.any():
        # All vertices of a fan, so that none is predicted from another that is not there.
        far = np.repeat(np.logical_or.reduceat(far, fans.first), np.diff(np.append(fans.first, len(far))))
    places = np.where(far[:, None], 0, vertices - origin)
    rgb = np.rint(colors[:, :3].astype(np.float64) * (2**precision.color - 1)).astype(np.int64)
    alpha = np.rint(colors[:, 3].astype(np.float64) * (2**precision.alpha - 1)).astype(np.int64)
    packer = Packer()
    header: dict[str, Any] = {
        "kind": "mesh",
        "vertices": len(vertices),
        "triangles": len(faces),
        "origin": origin,
        "step": step,
        "finer": FINER,
        "color": 2**precision.color - 1,
        "alpha": 2**precision.alpha - 1,
        "blending": mesh.blending,
        "filter": mesh.filter_px2,
        **({} if mesh.order == "fragment" else {"order": mesh.order}),
        "up": rounded(mesh.up),
    }
    if fans is None:
        header |= _pack_vertices(packer, places, rgb, alpha, step)
        header["faces"] = packer.add_rows(_compact_faces(faces))
        header["splat"] = -1 if mesh.face_splat is None else packer.add(mesh.face_splat)
    else:
        header |= _pack_fans(packer, fans, places, rgb, alpha, step)
    header |= _pack_far(packer, far, vertices)
    header["group"] = -1 if mesh.depth_group is None else packer.add(mesh.depth_group)
    if mesh.harmonics is not None:
        header["harmonics"] = _pack_harmonics(packer, mesh.harmonics)
    return packer.finish(header)


def vertex_order(mesh: SplatMesh) -> np.ndarray:
    """(k,) indices of the vertices that triangles use, in the order of first use."""
    corners = mesh.faces.ravel()
    first = np.full(len(mesh.vertices), len(corners), np.int64)
    np.minimum.at(first, corners, np.arange(len(corners)))
    order = np.argsort(first, kind="stable")
    return order[: np.count_nonzero(first < len(corners))]


def _pack_harmonics(packer: Packer, harmonics: np.ndarray) -> dict[str, Any]:
    """Spherical harmonics (s, k, 3) of the splats in the order of their triangles, with one step for all.
    Numbers above 8 bits are few, so that their second bytes compress to nearly nothing."""
    size = np.abs(harmonics)
    usual, largest = float(np.quantile(size, HARMONIC_SHARE)), float(size.max())
    step = rounded([max(usual / HARMONIC_STEPS, 1.001 * largest / MOST_HARMONIC_STEPS) or 1.0])[0]
    whole = np.rint(harmonics.astype(np.float64) / step).astype(np.int64)
    terms = harmonics.shape[1]
    return {"terms": terms, "step": step, "row": packer.add_rows(whole.reshape(-1, 3 * terms))}


# ---- Strays


def _origin(points: np.ndarray, step: float) -> list[float]:
    """(3,) what positions ``points`` (n, 3) are relative to: the middle of all, if all can be stored so."""
    low, high = points.min(axis=0), points.max(axis=0)
    whole = float((high - low).max()) <= 2 * MOST_STEPS * step
    return rounded((low + high) / 2 if whole else np.median(points, axis=0))


def _far(points: np.ndarray, step: float) -> np.ndarray:
    """(n,) bool: ``points`` (n, 3), relative to the origin, that are too far for whole steps."""
    return np.asarray(np.abs(points).max(axis=1) > 1.001 * MOST_STEPS * step)


def _pack_far(packer: Packer, far: np.ndarray, points: np.ndarray) -> dict[str, Any]:
    """Which points are ``far`` (n,) bool, and those of ``points`` (n, 3) as the two halves of their float32
    bits: strays are as exact as they were, and all others as exact as without them."""
    rows = np.flatnonzero(far)
    if not len(rows):
        return {"far": -1}
    bits = points[rows].astype("<f4").view("<u4").astype(np.int64)
    halves = np.concatenate([bits >> 16, bits & 0xFFFF], axis=1)
    return {"far": packer.add(rows), "far_places": packer.add_rows(halves)}


# ---- Meshes without fans


def _pack_vertices(
    packer: Packer, positions: np.ndarray, rgb: np.ndarray, alpha: np.ndarray, step: float
) -> dict[str, Any]:
    grid = np.rint(positions / step).astype(np.int64)
    values = np.concatenate([grid, rgb, alpha[:, None]], axis=1)
    # Differences are taken here, as rows choose for themselves by an estimate that colours mislead.
    return {"attributes": packer.add_rows(np.diff(values, axis=0, prepend=np.int64(0)))}


def _compact_faces(faces: np.ndarray) -> np.ndarray:
    """(f, 3) numbers that are small for vertices in the order of first use: how far each corner is below the
    next new vertex, which is 0 for a new one."""
    corners = faces.ravel()
    new = np.maximum.accumulate(np.concatenate([[-1], corners[:-1]])) + 1
    return (new - corners).reshape(-1, 3)


# ---- Fans


@dataclass(frozen=True, eq=False)
class _Fans:
    """Fans by their patterns."""

    first: np.ndarray
    """(s,) first vertex of each fan."""
    choice: np.ndarray
    """(s,) its pattern."""
    patterns: list[np.ndarray]
    """Faces (t, 3) of each pattern, in vertices of the fan."""
    splat: np.ndarray
    """(s,) splat of each fan."""


def _fans(faces: np.ndarray, face_splat: np.ndarray | None) -> _Fans | None:
    """The fans of ``faces``, whose vertices are in the order of first use. None if splats share vertices, or
    for too many patterns."""
    if face_splat is None:
        return None
    splats = FaceSplats(faces, face_splat, 0)
    starts, counts = splats.starts, splats.counts
    low = np.minimum.reduceat(faces.min(axis=1), starts)
    high = np.maximum.reduceat(faces.max(axis=1), starts)
    if (low[1:] != high[:-1] + 1).any():
        return None
    local = faces - np.repeat(low, counts)[:, None]
    choice = np.zeros(len(starts), np.int64)
    patterns: list[np.ndarray] = []
    for count in np.unique(counts):
        rows = np.flatnonzero(counts == count)
        own = local[starts[rows][:, None] + np.arange(count)].reshape(len(rows), -1)
        while len(rows):  # a few patterns: much faster than sorting the rows
            if len(patterns) == MOST_PATTERNS:
                return None
            same = (own == own[0]).all(axis=1)
            choice[rows[same]] = len(patterns)
            patterns.append(own[0].reshape(count, 3))
            rows, own = rows[~same], own[~same]
    return _Fans(low, choice, patterns, splats.numbers.astype(np.int64))


def _pack_fans(
    packer: Packer, fans: _Fans, positions: np.ndarray, rgb: np.ndarray, alpha: np.ndarray, step: float
) -> dict[str, Any]:
    header: dict[str, Any] = {"splat": packer.add(fans.splat), "choice": packer.add(fans.choice)}
    listed = []
    for index, pattern in enumerate(fans.patterns):
        own = fans.first[fans.choice == index]
        corners = own[:, None] + np.arange(int(pattern.max()) + 1)
        described: dict[str, Any] = {"fans": len(own), "size": corners.shape[1], "faces": pattern.tolist()}
        described |= _pack_positions(packer, positions[corners], step)
        described |= _pack_paint(packer, rgb[corners], alpha[corners])
        listed.append(described)
    return {**header, "patterns": listed}


def _pack_positions(packer: Packer, points: np.ndarray, step: float) -> dict[str, Any]:
    """Positions (s, m, 3) of the fans of a pattern: the first vertex, then some as offsets from it, then
    corrections of what weights of these offsets predict for the others."""
    fine = step / FINER
    count, m, _ = points.shape
    anchor = np.rint(points[:, 0] / fine).astype(np.int64)
    offsets = points - (anchor * fine)[:, None]
    basis: list[int] = []
    if count >= WORTHWHILE:
        basis = _basis(offsets.transpose(0, 2, 1).reshape(-1, m), [], 3, step / 4)
    values = [np.rint(offsets[:, j] / fine).astype(np.int64) for j in basis]
    known = [grid * fine for grid in values]
    weights = _weights(offsets.transpose(0, 2, 1).reshape(-1, m), basis, others_than(m, [0, *basis]))
    return {
        "basis": basis,
        "weights": weights,
        "anchor": packer.add_rows(anchor),
        "offsets": [packer.add_rows(grid) for grid in values],
        "rest": [
            packer.add_rows(np.rint((offsets[:, i] - predicted) / step).astype(np.int64))
            for i, predicted in predict(others_than(m, [0, *basis]), weights, known, (count, 3))
        ],
    }


def _pack_paint(packer: Packer, rgb: np.ndarray, alpha: np.ndarray) -> dict[str, Any]:
    """Colours (s, m, 3) and opacities (s, m) of the fans of a pattern: colours of the first vertex and
    differences from them; opacities of one or two vertices, and corrections of what these predict."""
    count, m = alpha.shape
    values = alpha.astype(np.float64)
    basis = _basis(values, [0], 2, 0.25) if count >= WORTHWHILE else [0]
    weights = _weights(values, basis, others_than(m, basis)) if count >= WORTHWHILE else [1.0] * (m - 1)
    return {
        "rgb": packer.add_rows(rgb[:, 0]),
        "shades": [packer.add_rows(rgb[:, i] - rgb[:, 0]) for i in range(1, m)],
        "alpha_basis": basis,
        "alpha_weights": weights,
        "alpha": [packer.add(alpha[:, j]) for j in basis],
        "alpha_rest": [
            packer.add(alpha[:, i] - np.floor(predicted + 0.5).astype(np.int64))
            for i, predicted in predict(others_than(m, basis), weights, list(values.T[basis]), (count,))
        ],
    }


def _basis(values: np.ndarray, chosen: list[int], most: int, enough: float) -> list[int]:
    """Columns of ``values`` (n, m), at most ``most``, ``chosen`` first, of which the others are nearly
    linear combinations: to ``enough`` in the root mean square, if so many suffice."""
    basis = list(chosen)
    rest = subsample(values, 4 * SAMPLE).copy()
    for j in basis:
        _project_out(rest, j)
    while len(basis) < most:
        energy = np.einsum("ij,ij->j", rest, rest) / len(rest)
        j = int(energy.argmax())
        if energy[j] <= enough**2:
            break
        basis.append(j)
        _project_out(rest, j)
    return basis


def _project_out(values: np.ndarray, column: int) -> None:
    """Subtracts from all columns of ``values`` their part along one of them."""
    direction = values[:, column].copy()
    square = direction @ direction
    if square > 0:
        values -= np.outer(direction, (direction @ values) / square)


def _weights(values: np.ndarray, basis: list[int], others: list[int]) -> list[float]:
    """Weights, one after the other, with which the columns ``basis`` of ``values`` (n, m) predict each of
    ``others``."""
    if not basis or not others:
        return []
    some = subsample(values, 4 * SAMPLE)
    return rounded(np.linalg.lstsq(some[:, basis], some[:, others], rcond=1e-9)[0].T)


def predict(
    others: list[int], weights: list[float], known: list[np.ndarray], shape: tuple[int, ...]
) -> Iterator[tuple[int, np.ndarray]]:
    """Each of ``others`` and what ``weights`` of ``known`` predict for it, summed in this order."""
    k = len(known)
    for row, i in enumerate(others):
        total = np.zeros(shape)
        for weight, value in zip(weights[row * k : row * k + k], known, strict=False):
            total = total + weight * value
        yield i, total


def others_than(m: int, basis: list[int]) -> list[int]:
    return [i for i in range(m) if i not in basis]


# ---- Splats


def pack_splats(cloud: GaussianCloud) -> bytes:
    """``cloud`` in about 18 bytes a splat, for comparison in the viewer: colours of degree 0.

    Centres in steps of the radius times 2^-15, standard deviations to 0.6 %, rotations to 0.2 degrees,
    colours and opacities in 255 levels.

    Raises ValueError for a cloud without splats.
    """
    radius = scene_bounds(cloud).radius
    means = cloud.means.astype(np.float64)
    step = rounded([radius * 2.0**-15])[0]
    origin = _origin(means, step)
    far = _far(means - origin, step)
    places = np.where(far[:, None], 0, means - origin)
    largest = min(float(cloud.scales.max()), LARGEST_SPLAT * radius) or 1.0
    # A standard deviation below a millionth of the largest one is flat.
    scales = np.log2(np.maximum(cloud.scales.astype(np.float64) / largest, 2.0**-20))
    q = cloud.quaternions.astype(np.float64)
    leader = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    q *= np.where(q[rows, leader] < 0, -1.0, 1.0)[:, None]
    rest = (leader[:, None] + [1, 2, 3]) % 4
    packer = Packer()
    header: dict[str, Any] = {
        "kind": "splats",
        "splats": len(cloud),
        "kernel": cloud.kernel,
        "origin": origin,
        "step": step,
        "largest": largest,
        "means": packer.add_rows(np.rint(places / step).astype(np.int64)),
        **_pack_far(packer, far, means),
        "scales": packer.add_rows(np.rint(scales * SCALE_STEPS).astype(np.int64)),
        "scale_steps": SCALE_STEPS,
        "leader": packer.add(leader),
        "rotations": packer.add_rows(np.rint(q[rows[:, None], rest] * ROTATION_STEPS).astype(np.int64)),
        "rotation_steps": ROTATION_STEPS,
        "colors": packer.add_rows(np.rint(cloud.colors * np.float32(255)).astype(np.int64)),
        "opacities": packer.add(np.rint(cloud.opacities * np.float32(255)).astype(np.int64)),
    }
    return packer.finish(header)
