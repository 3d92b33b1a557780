"""The executable specification of :mod:`meshsplats.rendering`: slow, in float64, written to be read.

``render`` here and ``reference_splats.render_splats`` define a correct image; the compiled core is tested
against them.
Nothing is culled, binned or bounded: every triangle and every splat is tried at every sample, so the cost is
their product (about a second for 2,000 triangles on 64 x 64 samples).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats.rendering.api import Rendering, resolved_order
from meshsplats.rendering.reference_samples import (
    checked_background,
    pixel_means,
    sample_positions,
    to_camera,
)
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.mesh import SplatMesh, checked_cutoff, checked_filter
from meshsplats.scene.order import Order
from meshsplats.scene.spherical_harmonics import sh_basis

FILTER_MIN_VARIANCE = 1e-4
"""The filter takes no fan to have a smaller variance than this share of its own."""
FILTER_DEPTH_SHARE = 0.1
"""Weight of a fan's extent in depth in the areas of its triangles."""
FILTER_OPACITY_BIAS = 1e-6
"""Added to opacities for the filter, so that a fan without any has a shape, too."""
CUBATURE: list[tuple[np.ndarray, float]] = [
    (np.full(3, 1 / 3), -27 / 48),
    *((np.roll((0.6, 0.2, 0.2), k), 25 / 48) for k in range(3)),
]
"""Barycentric positions and weights whose sum is the mean over a triangle of a polynomial of degree 3."""


def render(
    mesh: SplatMesh,
    camera: Camera,
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    samples: int = 1,
    max_layers: int | None = None,
    min_transmittance: float = 0.0,
    depth: bool = False,
    median_depth: bool = False,
    normals: bool = False,
    attributes: Sequence[str] = (),
    filter_px2: float | None = None,
    cutoff: float | None = None,
    order: Order | None = None,
) -> Rendering:
    """The image of a mesh. The arrays of the result are float64; see :class:`Rendering` for shapes.

    At each of the ``samples`` x ``samples`` regularly spaced samples of a pixel, the triangles that cover it
    are sorted by depth there, equal depths by face index, and blended front to back: C = sum T_k a_k c_k + T
    background, with T_k the product of the (1 - a) in front. Fragments with a = 0 do not count.
    ``max_layers`` blends only that many of the nearest fragments of each sample; a sample terminates once its
    T is below ``min_transmittance`` (0: never). ``background`` is RGB, (3,) or (h, w, 3).

    ``filter_px2``, by default the mesh's, widens the fan of each splat first (see :func:`filtered`).

    ``order`` is by default the mesh's. With 'splat', not the depth at the sample counts, but that of the
    splat's centre (see :func:`splat_depths`). Of splats at one depth the later is in front, and so are the
    later triangles of a splat; depth groups have no effect.

    With a ``cutoff``, in [0, 1], a becomes 1 where it is at least the cutoff, else 0. The order is then
    'fragment', that of a depth buffer.

    ``depth``, ``normals`` and the named ``attributes`` are sums with the weights T_k a_k, without background.
    ``median_depth`` is the depth of the first fragment up to which these weights add up to half or more, the
    mean over the samples that have one, infinite if fewer than half have.

    Raises ValueError for options out of range, a background of another shape, or a missing attribute.
    """
    backdrop = checked_background(background, camera)
    if max_layers is not None and not (max_layers == int(max_layers) and max_layers >= 1):
        raise ValueError(f"max_layers must be a whole number from 1 on, or None for all, got {max_layers}")
    if unknown := [name for name in attributes if name not in mesh.attributes]:
        present = ", ".join(mesh.attributes) or "none"
        raise ValueError(f"the mesh has no attribute {unknown[0]!r}; it has {present}")
    x, y = sample_positions(camera, samples)
    px2 = mesh.filter_px2 if filter_px2 is None else checked_filter(filter_px2, mesh.face_splat)
    sheet = fragments_of(mesh, camera, x, y, px2, resolved_order(mesh, order, cutoff))
    corners = mesh.faces[sheet.face]

    def interpolated(values: np.ndarray) -> np.ndarray:
        at_corners = values.astype(np.float64)[corners]
        mixed = np.einsum("nk,nkc->nc", sheet.weights, at_corners)
        # Weights add up to 1 but for rounding, which must not lead outside the range of the corners.
        return np.clip(mixed, at_corners.min(axis=1), at_corners.max(axis=1))

    rgba = interpolated(shaded_colors(mesh, camera))
    if cutoff is not None:
        # The core compares float32 values: so does this with the cutoff.
        rgba[:, 3] = rgba[:, 3] >= np.float32(checked_cutoff(cutoff))
    share, transmittance = _front_to_back(sheet, rgba[:, 3], len(x), max_layers, min_transmittance)

    def blended(values: np.ndarray) -> np.ndarray:
        sums = np.empty((len(x), values.shape[1]))
        for channel, value in enumerate(values.T):
            sums[:, channel] = np.bincount(sheet.sample, share * value, minlength=len(x))
        return pixel_means(sums, camera, samples)

    through = pixel_means(transmittance[:, None], camera, samples)
    extra = {}
    for name in attributes:
        values = mesh.attributes[name]
        mean = blended(interpolated(values[:, None] if values.ndim == 1 else values))
        extra[name] = mean[..., 0] if values.ndim == 1 else mean
    return Rendering(
        color=blended(rgba[:, :3]) + through * backdrop,
        alpha=1 - through[..., 0],
        depth=blended(sheet.depth[:, None])[..., 0] if depth else None,
        median_depth=_median_depths(sheet, share, camera, samples) if median_depth else None,
        normals=blended(_facing_normals(mesh, camera, sheet, x, y)) if normals else None,
        attributes=extra,
        fragments=int(np.count_nonzero(share)),
    )


VIEWER_SAMPLES = ((0.375, 0.875), (0.875, 0.625), (0.125, 0.375), (0.625, 0.125))
"""Right and down from a pixel's corner: the samples of MSAA in Direct3D and Vulkan, upside down."""


def viewer_images(
    mesh: SplatMesh,
    camera: Camera,
    cutoffs: Sequence[float | None] = (None,),
    *,
    multisample: bool = True,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
) -> np.ndarray:
    """(k, h, w, 3) float64: a mesh as three.js draws it, see ``viewers.viewer_images``.

    The triangles that show their backs (their corners turn clockwise in the image), then the others, each in
    their order, go to every sample that they cover: with a = 1 where the opacity is at least the cutoff and
    no nearer fragment is there, or blended with a without one. The sample is then rounded to 8 bits. Colour
    and opacity, cut to [0, 1], are those of the plane of the triangle at the centre of the pixel.
    """
    positions = VIEWER_SAMPLES if multisample else ((0.5, 0.5),)
    middle_x, middle_y = sample_positions(camera, 1)
    near = camera.near_plane(mesh.vertices)
    corners = to_camera(mesh.vertices, camera)
    corners[:, 0] = camera.fx * corners[:, 0] + camera.cx * corners[:, 2]
    corners[:, 1] = camera.fy * corners[:, 1] + camera.cy * corners[:, 2]
    corners = corners[mesh.faces]
    edges, determinants = _edge_functions(corners)
    shape = len(cutoffs), len(positions), len(middle_x)
    color = np.broadcast_to(255 * np.asarray(background, np.float64), (*shape, 3)).copy()
    nearest = np.full(shape, np.inf)
    rgba = mesh.colors.astype(np.float64)
    if mesh.blending == "linear":
        rgba[:, :3] = linear_to_srgb(rgba[:, :3])
    for face in np.argsort(determinants <= 0, kind="stable"):
        for sample, (right, down) in enumerate(positions):
            x, y = middle_x - 0.5 + right, middle_y - 0.5 + down
            at, depth, _ = _cover(corners[face], edges[face], determinants[face], x, y, near)
            if not len(at):
                continue
            weights = np.column_stack([middle_x, middle_y, np.ones(len(middle_x))])[at] @ edges[face].T
            weights /= weights.sum(axis=1, keepdims=True)
            value = (weights @ rgba[mesh.faces[face]]).clip(0, 1)
            for image, cutoff in enumerate(cutoffs):
                drawn, alpha = np.ones(len(at), bool), value[:, 3]
                if cutoff is not None:
                    drawn = (alpha >= np.float32(cutoff)) & (depth <= nearest[image, sample, at])
                    alpha = np.ones(len(at))
                    nearest[image, sample, at[drawn]] = depth[drawn]
                own, share = at[drawn], alpha[drawn, None]
                before = color[image, sample, own]
                mixed = before + share * (255 * value[drawn, :3] - before)
                color[image, sample, own] = np.floor(mixed + 0.5)
    return color.mean(axis=1).reshape(len(cutoffs), camera.height, camera.width, 3) / 255


@dataclass
class Fragments:
    """n fragments, triangles at samples; sorted by sample, then nearest first, then face."""

    sample: np.ndarray
    """(n,) int"""
    face: np.ndarray
    """(n,) int"""
    depth: np.ndarray
    """(n,) z of the triangle at the sample"""
    weights: np.ndarray
    """(n, 3) perspective-correct barycentric weights of the corners"""


def filtered(points: np.ndarray, mesh: SplatMesh, camera: Camera, px2: float) -> np.ndarray:
    """(v, 3) the mesh's vertices in the camera's frame, ``points``, with the filter of variance ``px2``.

    In the image, the opacity of a splat's triangles (linear inside each) is a density. With its mean c
    and covariance M, px^2, the projected vertices p move to c + A (p - c), A = (M + px2 I)^(1/2) M^(-1/2), at
    their depth, so that the density has the covariance M + px2 I. M is widened by ``FILTER_MIN_VARIANCE`` px2
    before. Areas are those of triangles in (x, y, k / z), with k = ``FILTER_DEPTH_SHARE`` f z_1 and z_1 the
    depth of the splat's first corner: triangles seen edge on keep some area. A splat that reaches
    nearer than the near plane, or has no area at all, stays as it is.
    """
    assert mesh.face_splat is not None
    near = camera.near_plane(mesh.vertices)
    result = points.copy()
    with np.errstate(all="ignore"):
        projected = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy)
        nearness = 1 / points[:, 2]
    for splat in np.unique(mesh.face_splat):
        faces = mesh.faces[mesh.face_splat == splat]
        if not (points[faces, 2] >= near).all():
            continue
        k = FILTER_DEPTH_SHARE * np.sqrt(camera.fx * camera.fy) * points[faces[0, 0], 2]
        lifted = np.column_stack([projected, k * nearness])[faces]
        area = np.linalg.norm(np.cross(lifted[:, 1] - lifted[:, 0], lifted[:, 2] - lifted[:, 0]), axis=1)
        if not area.sum() > 0:
            continue
        corners = projected[faces]
        opacity = mesh.colors[faces, 3].astype(np.float64) + FILTER_OPACITY_BIAS
        position = np.concatenate([np.einsum("k,tkc->tc", at, corners) for at, _ in CUBATURE])
        share = np.concatenate([weight * area * (opacity @ at) for at, weight in CUBATURE])
        share /= share.sum()
        mean = share @ position
        covariance = np.einsum("n,ni,nj->ij", share, position - mean, position - mean)
        variances, axes = np.linalg.eigh(covariance + FILTER_MIN_VARIANCE * px2 * np.eye(2))
        spread = axes @ np.diag(np.sqrt((variances + px2) / variances)) @ axes.T
        own = np.unique(faces)
        moved = mean + (projected[own] - mean) @ spread
        result[own, :2] = moved / (camera.fx, camera.fy) * points[own, 2:]
    return result


def fragments_of(
    mesh: SplatMesh,
    camera: Camera,
    x: np.ndarray,
    y: np.ndarray,
    filter_px2: float = 0.0,
    order: Order = "fragment",
) -> Fragments:
    points = to_camera(mesh.vertices, camera)
    if filter_px2:
        points = filtered(points, mesh, camera, filter_px2)
    # Pixel space before the division by z: a point (X, Y, Z) is seen at (X / Z, Y / Z) pixels.
    homogeneous = points.copy()
    homogeneous[:, 0] = camera.fx * points[:, 0] + camera.cx * points[:, 2]
    homogeneous[:, 1] = camera.fy * points[:, 1] + camera.cy * points[:, 2]

    corners = homogeneous[mesh.faces]
    edges, determinants = _edge_functions(corners)
    near = camera.near_plane(mesh.vertices)
    covers = [_cover(*triangle, x, y, near) for triangle in zip(corners, edges, determinants, strict=True)]
    if not covers:
        return Fragments(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, 3)))
    sample, depth, weights = (np.concatenate(parts) for parts in zip(*covers, strict=True))
    face = np.repeat(np.arange(len(covers)), [len(cover[0]) for cover in covers])
    if order == "splat":
        ranks = np.lexsort((-face, splat_depths(mesh, camera)[face], sample))
    else:
        nearness = 1 / depth
        if mesh.depth_group is not None:
            _share_depths(mesh, homogeneous, near, sample, face, nearness, x, y)
        ranks = np.lexsort((face, -nearness, sample))
    return Fragments(sample[ranks], face[ranks], depth[ranks], weights[ranks])


def splat_depths(mesh: SplatMesh, camera: Camera) -> np.ndarray:
    """(f,) float32: of every triangle, the depth z of its splat's centre, the mean of the corners of the
    splat's triangles. A corner of several triangles counts as often."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces].sum(axis=1)
    centers = mesh.splats.sums(corners) / (3 * mesh.splats.counts[:, None])
    return to_camera(centers, camera)[mesh.splats.of_face, 2].astype(np.float32)


def _edge_functions(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of ``corners`` V (f, 3, 3): rows V_j x V_k opposite to corners i, and D = V_0 . (V_1 x V_2) (f,)."""
    edges = np.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
    return edges, (corners[:, 0] * edges[:, 0]).sum(axis=1)


def _cover(
    corners: np.ndarray, edges: np.ndarray, determinant: float, x: np.ndarray, y: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples that a triangle covers at a depth z >= near, the depth there, and the weights of the corners.

    ``corners`` V are (3, 3) homogeneous pixel positions. With p = (x, y, 1), e_i = p . (V_j x V_k) and
    D = V_0 . (V_1 x V_2), the ray through p meets the triangle's plane at z p = sum b_i V_i, z = D / sum e,
    b_i = e_i / sum e (Olano and Greer 1997). This point is in the triangle and in front of the camera if and
    only if no e_i / D is negative, so corners behind the camera need no clipping.
    """
    if determinant == 0:
        return np.zeros(0, int), np.zeros(0), np.zeros((0, 3))
    inside = np.ones(len(x), bool)
    distances = np.empty((len(x), 3))
    for i, (a, b, c) in enumerate(edges if determinant > 0 else -edges):
        # Both triangles at an edge evaluate it alike but for the sign, so that no sample falls between them.
        distances[:, i] = a * x + b * y + c
        # A sample on the edge belongs to the triangle to the right of it, or below it where it is level.
        top_left = a > 0 or (a == 0 and b > 0)
        inside &= (distances[:, i] >= 0) if top_left else (distances[:, i] > 0)
    sample = np.flatnonzero(inside)
    distances = distances[sample]
    total = distances.sum(axis=1)
    # Rounding must not separate triangles that lie at one depth, nor lead outside a sliver.
    depth = np.clip(abs(determinant) / total, corners[:, 2].min(), corners[:, 2].max())
    seen = depth >= near
    return sample[seen], depth[seen], distances[seen] / total[seen, None]


def _share_depths(
    mesh: SplatMesh,
    homogeneous: np.ndarray,
    near: float,
    sample: np.ndarray,
    face: np.ndarray,
    nearness: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
) -> None:
    """Replaces 1/z, by which fragments are ordered, with that of the common plane in every depth group.

    The plane is that of the triangle with the largest area in the world, the first of them if equal. Its 1/z
    is clamped to the range over the group's vertices; vertices nearer than ``near`` count as lying there. A
    plane seen edge on has no depth in the image: the nearest vertex's is taken.
    """
    assert mesh.depth_group is not None
    corners = homogeneous[mesh.faces]
    edges, determinants = _edge_functions(corners)
    world = mesh.vertices.astype(np.float64)[mesh.faces]
    areas = np.linalg.norm(np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0]), axis=1)
    for group in np.unique(mesh.depth_group[mesh.depth_group >= 0]):
        members = np.flatnonzero(mesh.depth_group == group)
        largest = members[np.argmax(areas[members])]
        limits = 1 / np.maximum(near, corners[members, :, 2])
        chosen = np.flatnonzero(mesh.depth_group[face] == group)
        if determinants[largest] == 0:
            nearness[chosen] = limits.max()
            continue
        a, b, c = edges[largest].sum(axis=0) / determinants[largest]
        plane = a * x[sample[chosen]] + b * y[sample[chosen]] + c
        nearness[chosen] = np.clip(plane, limits.min(), limits.max())


def shaded_colors(mesh: SplatMesh, camera: Camera) -> np.ndarray:
    """(v, 4) float64 colours that ``camera`` sees: those of the vertices, and what the harmonics of their
    splats add along the directions from the camera; at least 0."""
    colors = mesh.colors.astype(np.float64)
    if mesh.harmonics is None:
        return colors
    owner = mesh.splats.of_vertex
    used = np.flatnonzero(owner >= 0)
    away = mesh.vertices[used].astype(np.float64) - camera.center
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-150)
    basis = sh_basis(directions, mesh.sh_degree)[:, 1:]
    added = np.einsum("vk,vkc->vc", basis, mesh.harmonics[owner[used]].astype(np.float64))
    colors[used, :3] = np.maximum(colors[used, :3] + added, 0)
    return colors


def _front_to_back(
    sheet: Fragments, alpha: np.ndarray, count: int, max_layers: int | None, min_transmittance: float
) -> tuple[np.ndarray, np.ndarray]:
    """T_k a_k of every fragment (0 where it is not blended), and the final T of each of ``count`` samples."""
    share, transmittance = np.zeros(len(alpha)), np.ones(count)
    visible = np.flatnonzero(alpha > 0)
    sample = sheet.sample[visible]
    first = np.searchsorted(sample, sample)  # of the same sample
    layer = np.arange(len(sample)) - first
    by_layer = visible[np.argsort(layer, kind="stable")]
    sizes = np.bincount(layer)
    for k, end in enumerate(np.cumsum(sizes)):
        if max_layers is not None and k >= max_layers:
            break
        fragments = by_layer[end - sizes[k] : end]  # at most one a sample
        fragments = fragments[transmittance[sheet.sample[fragments]] >= min_transmittance]
        here = sheet.sample[fragments]
        share[fragments] = transmittance[here] * alpha[fragments]
        transmittance[here] *= 1 - alpha[fragments]
    return share, transmittance


def _median_depths(sheet: Fragments, share: np.ndarray, camera: Camera, samples: int) -> np.ndarray:
    """(h, w): see ``render``. The fragments of each sample follow each other, and blended ones have a share
    above 0."""
    count = camera.width * camera.height * samples**2
    total = np.cumsum(share)
    before = np.concatenate([[0.0], total])[np.searchsorted(sheet.sample, np.arange(count))]
    half = np.flatnonzero((total - before[sheet.sample] >= 0.5) & (share > 0))
    found, first = np.unique(sheet.sample[half], return_index=True)
    depths, has = np.zeros((count, 1)), np.zeros((count, 1))
    depths[found, 0], has[found, 0] = sheet.depth[half[first]], 1
    sums, shares = (pixel_means(values, camera, samples)[..., 0] for values in (depths, has))
    return np.where(shares >= 0.5, sums / np.maximum(shares, 1e-9), np.inf)


def _facing_normals(
    mesh: SplatMesh, camera: Camera, sheet: Fragments, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """(n, 3) unit normals in the world frame that face the camera; 0 where the mesh has none."""
    corners = mesh.faces[sheet.face]
    if mesh.normals is not None:
        normals = np.einsum("nk,nkc->nc", sheet.weights, mesh.normals.astype(np.float64)[corners])
    else:
        a, b, c = mesh.vertices.astype(np.float64)[corners].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=1)
    away = np.einsum("nc,nc->n", normals, rays[sheet.sample] @ camera.world_to_camera[:3, :3]) > 0
    return np.where(away[:, None], -normals, normals)
