"""Splats out of a converted mesh, wherever the triangles of a splat are all there, after an edit, say."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from meshsplats._common.geometry import quaternions_of
from meshsplats.conversion.fan_sizes import ellipse, missing
from meshsplats.conversion.fans import PLANES, Shape
from meshsplats.conversion.options import ConversionOptions
from meshsplats.conversion.selection import disc_areas, mean_shadow
from meshsplats.conversion.stars import CENTERS, OPACITIES, star
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.scene.mesh import SplatMesh

THICKNESS = 0.02
"""Standard deviation across a flat fan, as a share of the smaller one in it: viewers need one above 0."""
_CHUNK = 1 << 14
_SQUARE = 1e-3
"""Cosine between axes, and share of the largest one, up to which those of triangles are those of a splat."""
_FAINT = 1e-6
"""Weight of a corner of opacity 0 in a mean of colours."""


def splats_of(scene: GaussianCloud | SplatMesh) -> GaussianCloud | None:
    """The splats of ``scene``: of a mesh those that its fans were, or None if most of it is no fans."""
    if isinstance(scene, GaussianCloud):
        return scene
    try:
        cloud, whole = recover_splats(scene)
    except ValueError:  # which splats its triangles were is not known
        return None
    return cloud if whole.mean() >= 0.5 else None


def recover_splats(mesh: SplatMesh) -> tuple[GaussianCloud, np.ndarray]:
    """The splats whose fans, ellipses or stars ``mesh`` consists of, as ``convert`` makes them by default.

    A splat has the affine map that takes the pattern of its triangles to where its corners are, by least
    squares, so that meshes may have been moved, scaled or bent. Its opacity is that of the centre, its colour
    the mean of the corners', by opacity. The footprint, which widened it, stays. What a flat ellipse leaves
    out, the thickness of its splat, becomes ``THICKNESS``.

    Returns:
        The splats, in the order of the mesh; and (s,) bool for ``mesh.splats``: those that are whole, with
        triangles and corners of their own in a pattern of ``convert``. Only these become splats.

    Raises:
        ValueError: the mesh does not know its splats, blends linear light, or has no whole one.
    """
    if mesh.face_splat is None:
        raise ValueError("the mesh does not know which triangles were one splat: it cannot become splats")
    if mesh.blending == "linear":
        raise ValueError("the mesh blends linear light, and splats blend display values: export a mesh")
    splats = mesh.splats
    n, counts = len(splats), splats.counts
    whole = np.zeros(n, bool)
    place, axes = np.zeros((n, 3)), np.zeros((n, 3, 3))
    opacity, rgb = np.zeros(n), np.zeros((n, 3))
    shared = splats.shared
    for count in np.unique(counts):
        rows = np.flatnonzero(counts == count)
        for begin in range(0, len(rows), _CHUNK):
            own = rows[begin : begin + _CHUNK]
            corners = mesh.faces[splats.starts[own][:, None] + np.arange(count)].astype(np.int64)
            first = corners.min(axis=(1, 2))
            relative = np.sort(corners - first[:, None, None], axis=2)  # whichever way they wind
            for size in np.unique(relative.max(axis=(1, 2)) + 1):
                for shape, faces in _shapes(int(count), int(size)):
                    fits = np.flatnonzero((relative == faces).all(axis=(1, 2)) & ~whole[own])
                    index = first[fits][:, None] + np.arange(size)
                    alone = ~shared[index].any(axis=1)
                    fits, index = fits[alone], index[alone]
                    if not len(fits):
                        continue
                    found = own[fits]
                    whole[found] = True
                    place[found], axes[found], opacity[found] = _fitted(mesh, shape, index)
                    weight = mesh.colors[index, 3:].astype(np.float64) + _FAINT
                    rgb[found] = (weight * mesh.colors[index, :3]).sum(axis=1) / weight.sum(axis=1)
    if not whole.any():
        raise ValueError("none of the splats has all its triangles: it cannot become splats again")
    sigma, rotations = _principal(axes[whole])
    sh = (rgb[whole, None] - 0.5) / SH_C0
    if mesh.harmonics is not None:
        sh = np.concatenate([sh, mesh.harmonics[whole]], axis=1)
    cloud = GaussianCloud(
        place[whole],
        quaternions_of(rotations),
        sigma,
        np.clip(opacity[whole], 0, 1),
        sh,
        up=mesh.up,
        origin=mesh.origin,
    )
    return cloud, whole


def _fitted(mesh: SplatMesh, shape: Shape, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (k, 3), semi-axes (k, 3, 3), by rows and 0 where there is none, and opacities (k,) of splats
    whose pattern is that of ``shape`` and whose corners are the vertices ``index`` (k, m)."""
    pattern = shape.pattern
    radius = np.array(shape.profile.level_radii)[pattern.level]
    design = np.column_stack([np.ones(len(radius)), radius[:, None] * pattern.directions])
    solved = np.linalg.pinv(design) @ mesh.vertices[index].astype(np.float64)
    axes = np.zeros((len(index), 3, 3))
    axes[:, : solved.shape[1] - 1] = solved[:, 1:]
    peak = mesh.colors[index[:, 0], 3].astype(np.float64)
    if shape.fits_projection:
        return solved[:, 0], axes, np.interp(peak, CENTERS[pattern.ellipses], OPACITIES)
    drawn = peak / shape.profile.opacities[0]  # type: ignore[attr-defined]
    areas = disc_areas(np.sort(np.linalg.norm(axes, axis=2), axis=1)[:, ::-1])
    factor = missing(areas, mean_shadow(areas), [shape], np.zeros(len(index), np.int8))
    return solved[:, 0], axes, drawn / np.maximum(factor, 1e-6)


def _principal(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (k, 3), largest first, and rotations (k, 3, 3) to the world of Gaussians that are
    round ones mapped by ``axes`` (k, 3, 3). Where several will do, as for a round splat, those along its
    triangles, so that another conversion makes the same of it."""
    _, sizes, turns = np.linalg.svd(axes)
    lengths = np.linalg.norm(axes, axis=2)
    own = axes / np.maximum(lengths, 1e-300)[:, :, None]
    own[:, 2] = np.where(lengths[:, 2:] > 0, own[:, 2], np.cross(own[:, 0], own[:, 1]))
    apart = np.abs(np.einsum("kij,klj->kil", own, own) - np.eye(3)).max(axis=(1, 2))
    along = (apart < _SQUARE) & (np.diff(lengths, axis=1) <= _SQUARE * lengths[:, :1]).all(axis=1)
    for i in (1, 2):  # those that are alike stay in their order
        alike = np.abs(lengths[:, i] - lengths[:, i - 1]) <= _SQUARE * lengths[:, 0]
        lengths[alike, i] = lengths[alike, i - 1]
    turns[along], sizes[along] = own[along], lengths[along]
    rotations = turns.transpose(0, 2, 1)
    rotations[np.linalg.det(rotations) < 0, :, 2] *= -1
    sizes[:, 1] = np.maximum(sizes[:, 1], 1e-3 * sizes[:, 0])
    sizes[:, 2] = np.maximum(sizes[:, 2], THICKNESS * sizes[:, 1])
    return sizes, rotations


@lru_cache(maxsize=256)
def _shapes(triangles: int, corners: int) -> list[tuple[Shape, np.ndarray]]:
    """The shapes of ``convert`` with so many triangles and corners, and the (t, 3) triangles of each, their
    corners in ascending order."""
    options = ConversionOptions().resolved("default", has_cameras=False)
    found = []
    for rings in range(1, 5):
        for mode, planes in PLANES.items():
            sides, rest = divmod(triangles, (2 * rings - 1) * len(planes))
            whole = sides >= 3 and not rest and sides % {"flat": 1, "crossed": 2, "3d": 4}[mode] == 0
            if whole:
                found.append(ellipse(sides, rings, options, mode))
    found += [star(k, triangles // k) for k in CENTERS if triangles % k == 0 and triangles // k >= 3]
    return [
        (shape, np.sort(shape.pattern.faces, axis=1))
        for shape in found
        if len(shape.pattern.level) == corners and len(shape.pattern.faces) == triangles
    ]
