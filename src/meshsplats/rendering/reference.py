"""The executable specification of :mod:`meshsplats.rendering`: slow, in float64, written to be read.

``render`` and ``render_splats`` here define a correct image; the compiled core is tested against them.
Nothing is culled, binned or bounded: every triangle and every splat is tried at every sample, so the cost is
their product (about a second for 2,000 triangles on 64 x 64 samples).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats.camera import Camera
from meshsplats.colors import linear_to_srgb
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh, checked_cutoff, checked_filter
from meshsplats.rendering.api import Rendering

SPLAT_MIN_ALPHA = 1 / 255
"""Splats fainter than this at a sample are left out there, as in 3DGS."""
SPLAT_MAX_ALPHA = 0.99
"""No splat is more opaque than this at a sample, as in 3DGS."""
SPLAT_MIN_TRANSMITTANCE = 1e-4
"""A sample terminates before the splat that would leave less transmittance than this, as in 3DGS."""

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
    normals: bool = False,
    attributes: Sequence[str] = (),
    filter_px2: float | None = None,
    cutoff: float | None = None,
) -> Rendering:
    """The image of a mesh. The arrays of the result are float64; see :class:`Rendering` for shapes.

    At each of the ``samples`` x ``samples`` regularly spaced samples of a pixel, the triangles that cover it
    are sorted by depth there, equal depths by face index, and blended front to back: C = sum T_k a_k c_k + T
    background, with T_k the product of the (1 - a) in front. Fragments with a = 0 do not count.
    ``max_layers`` blends only that many of the nearest fragments of each sample; a sample terminates once its
    T is below ``min_transmittance`` (0: never). ``background`` is RGB, (3,) or (h, w, 3).

    ``filter_px2``, by default the mesh's, widens the fan of each splat first (see :func:`filtered`).

    With a ``cutoff``, in [0, 1], a becomes 1 where it is at least the cutoff, else 0.

    ``depth``, ``normals`` and the named ``attributes`` are sums with the weights T_k a_k, without background.

    Raises ValueError for options out of range, a background of another shape, or a missing attribute.
    """
    backdrop = _checked_background(background, camera)
    if max_layers is not None and not (max_layers == int(max_layers) and max_layers >= 1):
        raise ValueError(f"max_layers must be a whole number from 1 on, or None for all, got {max_layers}")
    if unknown := [name for name in attributes if name not in mesh.attributes]:
        present = ", ".join(mesh.attributes) or "none"
        raise ValueError(f"the mesh has no attribute {unknown[0]!r}; it has {present}")
    x, y = _sample_positions(camera, samples)
    px2 = mesh.filter_px2 if filter_px2 is None else checked_filter(filter_px2, mesh.face_splat)
    sheet = _fragments(mesh, camera, x, y, px2)
    corners = mesh.faces[sheet.face]

    def interpolated(values: np.ndarray) -> np.ndarray:
        at_corners = values.astype(np.float64)[corners]
        mixed = np.einsum("nk,nkc->nc", sheet.weights, at_corners)
        # Weights add up to 1 but for rounding, which must not lead outside the range of the corners.
        return np.clip(mixed, at_corners.min(axis=1), at_corners.max(axis=1))

    rgba = interpolated(mesh.colors)
    if cutoff is not None:
        # The core compares float32 values: so does this with the cutoff.
        rgba[:, 3] = rgba[:, 3] >= np.float32(checked_cutoff(cutoff))
    share, transmittance = _front_to_back(sheet, rgba[:, 3], len(x), max_layers, min_transmittance)

    def blended(values: np.ndarray) -> np.ndarray:
        sums = np.empty((len(x), values.shape[1]))
        for channel, value in enumerate(values.T):
            sums[:, channel] = np.bincount(sheet.sample, share * value, minlength=len(x))
        return _pixel_means(sums, camera, samples)

    through = _pixel_means(transmittance[:, None], camera, samples)
    extra = {}
    for name in attributes:
        values = mesh.attributes[name]
        mean = blended(interpolated(values[:, None] if values.ndim == 1 else values))
        extra[name] = mean[..., 0] if values.ndim == 1 else mean
    return Rendering(
        color=blended(rgba[:, :3]) + through * backdrop,
        alpha=1 - through[..., 0],
        depth=blended(sheet.depth[:, None])[..., 0] if depth else None,
        normals=blended(_facing_normals(mesh, camera, sheet, x, y)) if normals else None,
        attributes=extra,
        fragments=int(np.count_nonzero(share)),
    )


def render_splats(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    samples: int = 1,
    sh_degree: int | None = None,
    dilation: float = 0.3,
) -> Rendering:
    """The image of splats as 3D Gaussian Splatting draws it (Kerbl et al. 2023). Arrays are float64.

    Splats are blended front to back in the order of the depth z of their centres, equal depths by index;
    those with a centre nearer than the near plane are left out. ``dilation`` (square pixels for any
    ``samples``) widens every projected splat; for the kernel '2dgs', 5/3 of it is the least variance.
    ``sh_degree`` limits the degree of the view-dependent colour; None uses all that is stored.

    Unlike the published rasterisers this has no tiles and no cut at three standard deviations: a splat is
    drawn wherever its alpha reaches 1/255.

    Raises ValueError for options out of range or a background of another shape.
    """
    backdrop = _checked_background(background, camera)
    if sh_degree is not None and not (sh_degree == int(sh_degree) and sh_degree >= 0):
        raise ValueError(f"sh_degree must be a whole number from 0 on, or None for all, got {sh_degree}")
    if not (np.isfinite(dilation) and dilation >= 0):
        raise ValueError(f"dilation must be >= 0, got {dilation}")
    camera = camera.with_near_plane(cloud.means)
    x, y = _sample_positions(camera, samples)
    rgb = splat_colors(cloud, camera, cloud.sh_degree if sh_degree is None else int(sh_degree))
    opacities = cloud.opacities.astype(np.float64)
    centers = _to_camera(cloud.means, camera)
    in_front = np.flatnonzero(centers[:, 2] >= (camera.near or 0))
    nearest_first = in_front[np.argsort(centers[in_front, 2], kind="stable")]
    # Columns are the splat's own axes in the camera's frame.
    axes = camera.world_to_camera[:3, :3] @ _rotations(cloud)
    scales = cloud.scales.astype(np.float64)

    color, transmittance = np.zeros((len(x), 3)), np.ones(len(x))
    unfinished = np.ones(len(x), bool)
    fragments = 0
    for i in nearest_first:
        if cloud.kernel == "2dgs":
            falloff = _flat_falloff(centers[i], axes[i], scales[i], camera, x, y, dilation)
        else:
            falloff = _projected_falloff(centers[i], axes[i], scales[i], camera, x, y, dilation, cloud.kernel)
        alpha = np.minimum(SPLAT_MAX_ALPHA, opacities[i] * falloff)
        drawn = unfinished & (alpha >= SPLAT_MIN_ALPHA)
        after = transmittance * (1 - alpha)
        unfinished &= ~(drawn & (after < SPLAT_MIN_TRANSMITTANCE))
        drawn &= unfinished
        color[drawn] += (transmittance * alpha)[drawn, None] * rgb[i]
        transmittance[drawn] = after[drawn]
        fragments += int(drawn.sum())
    through = _pixel_means(transmittance[:, None], camera, samples)
    mean = _pixel_means(color, camera, samples)
    return Rendering(color=mean + through * backdrop, alpha=1 - through[..., 0], fragments=fragments)


# Samples and pixels


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
    middle_x, middle_y = _sample_positions(camera, 1)
    near = camera.near_plane(mesh.vertices)
    corners = _to_camera(mesh.vertices, camera)
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


def _checked_background(background: Sequence[float] | np.ndarray, camera: Camera) -> np.ndarray:
    array = np.asarray(background, np.float64)
    if array.shape not in ((3,), (camera.height, camera.width, 3)):
        raise ValueError(
            f"background must have shape (3,) or ({camera.height}, {camera.width}, 3), got {array.shape}"
        )
    return array


def _sample_positions(camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (n,) in pixels of all samples, row by row: pixel centres where ``samples`` is 1."""
    if not (samples == int(samples) and samples >= 1):
        raise ValueError(f"samples must be a whole number from 1 on, got {samples}")
    across = (np.arange(camera.width * samples) + 0.5) / samples
    down = (np.arange(camera.height * samples) + 0.5) / samples
    y, x = np.meshgrid(down, across, indexing="ij")
    return x.ravel(), y.ravel()


def _pixel_means(values: np.ndarray, camera: Camera, samples: int) -> np.ndarray:
    """(h, w, c) means over the samples of each pixel of ``values`` (n, c)."""
    grid = values.reshape(camera.height, samples, camera.width, samples, values.shape[1])
    return grid.mean(axis=(1, 3))


def _to_camera(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(n, 3) world points in the camera's frame."""
    columns = camera.world_to_camera[:3].T
    x, y, z = points.astype(np.float64).T[:, :, None]
    # Summed term by term so that a point's rounding does not depend on its row.
    return x * columns[0] + y * columns[1] + z * columns[2] + columns[3]


# Triangles


@dataclass
class _Fragments:
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


def _fragments(
    mesh: SplatMesh, camera: Camera, x: np.ndarray, y: np.ndarray, filter_px2: float = 0.0
) -> _Fragments:
    points = _to_camera(mesh.vertices, camera)
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
        return _Fragments(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, 3)))
    sample, depth, weights = (np.concatenate(parts) for parts in zip(*covers, strict=True))
    face = np.repeat(np.arange(len(covers)), [len(cover[0]) for cover in covers])
    nearness = 1 / depth
    if mesh.depth_group is not None:
        _share_depths(mesh, homogeneous, near, sample, face, nearness, x, y)
    order = np.lexsort((face, -nearness, sample))
    return _Fragments(sample[order], face[order], depth[order], weights[order])


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


def _front_to_back(
    sheet: _Fragments, alpha: np.ndarray, count: int, max_layers: int | None, min_transmittance: float
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


def _facing_normals(
    mesh: SplatMesh, camera: Camera, sheet: _Fragments, x: np.ndarray, y: np.ndarray
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


# Splats


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """(n, (degree + 1)^2) real spherical harmonics, degree 0 to 3, of unit ``directions`` (n, 3).

    Orthonormal on the sphere, ordered by degree l and then order m = -l .. l, with the Condon-Shortley sign
    (-1)^m: the convention of splat files.

    Raises ValueError for another degree.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"degree must be 0, 1, 2 or 3, got {degree}")
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z

    def norm(numerator: int, denominator: int) -> float:
        return float(np.sqrt(numerator / (denominator * np.pi)))

    basis = [
        np.full(len(x), norm(1, 4)),
        -norm(3, 4) * y,
        norm(3, 4) * z,
        -norm(3, 4) * x,
        norm(15, 4) * x * y,
        -norm(15, 4) * y * z,
        norm(5, 16) * (2 * zz - xx - yy),
        -norm(15, 4) * x * z,
        norm(15, 16) * (xx - yy),
        -norm(35, 32) * y * (3 * xx - yy),
        norm(105, 4) * x * y * z,
        -norm(21, 32) * y * (4 * zz - xx - yy),
        norm(7, 16) * z * (2 * zz - 3 * xx - 3 * yy),
        -norm(21, 32) * x * (4 * zz - xx - yy),
        norm(105, 16) * z * (xx - yy),
        -norm(35, 32) * x * (xx - 3 * yy),
    ]
    return np.stack(basis[: (degree + 1) ** 2], axis=1)


def splat_colors(cloud: GaussianCloud, camera: Camera, degree: int) -> np.ndarray:
    """(n, 3) RGB of every splat seen from the camera: max(0, 0.5 + SH), direction camera centre to splat.

    ``degree`` is limited to the stored one. As in 3DGS, there is no upper limit to colours, but for those of
    degree 0 alone: they are ``cloud.colors``, at most 1, as a vertex can hold them.
    """
    degree = min(degree, cloud.sh_degree)
    directions = cloud.means.astype(np.float64) - camera.center
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.divide(directions, length, out=np.zeros_like(directions), where=length > 0)
    basis = sh_basis(directions, degree)
    sh = cloud.sh[:, : basis.shape[1]].astype(np.float64)
    return np.clip(0.5 + np.einsum("nk,nkc->nc", basis, sh), 0, 1 if degree == 0 else None)


def _rotations(cloud: GaussianCloud) -> np.ndarray:
    """(n, 3, 3) rotation matrices; columns are the splat's own axes in the world frame."""
    w, x, y, z = cloud.quaternions.astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _projected_falloff(
    center: np.ndarray,
    axes: np.ndarray,
    scales: np.ndarray,
    camera: Camera,
    x: np.ndarray,
    y: np.ndarray,
    dilation: float,
    kernel: str,
) -> np.ndarray:
    """exp(-d^T cov^-1 d / 2) of one splat at all samples, with its covariance in the image.

    The projection is linearised at the centre (EWA, Zwicker et al. 2001). Where that is far outside the
    image the Jacobian is taken at 1.3 times the half field of view, as in 3DGS; a principal point off the
    middle moves these limits with it: 0.3 times the half field of view beyond each side of the image. For the
    kernel 'antialiased' the values are scaled to keep the integral that they had before the dilation.
    """
    tan_x, tan_y = center[0] / center[2], center[1] / center[2]
    beyond_x, beyond_y = 0.3 * camera.width / (2 * camera.fx), 0.3 * camera.height / (2 * camera.fy)
    u = np.clip(tan_x, -camera.cx / camera.fx - beyond_x, (camera.width - camera.cx) / camera.fx + beyond_x)
    v = np.clip(tan_y, -camera.cy / camera.fy - beyond_y, (camera.height - camera.cy) / camera.fy + beyond_y)
    jacobian = np.array([[camera.fx, 0, -camera.fx * u], [0, camera.fy, -camera.fy * v]]) / center[2]
    projected_axes = jacobian @ (axes * scales)
    sharp = projected_axes @ projected_axes.T
    cov = sharp + dilation * np.eye(2)
    determinant = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
    if determinant <= 0:  # edge on and not widened
        return np.zeros_like(x)
    dx, dy = x - (camera.fx * tan_x + camera.cx), y - (camera.fy * tan_y + camera.cy)
    power = (cov[1, 1] * dx * dx - 2 * cov[0, 1] * dx * dy + cov[0, 0] * dy * dy) / determinant
    falloff = np.exp(-0.5 * np.maximum(0, power))  # below 0 by rounding only
    if kernel == "antialiased":
        falloff *= np.sqrt(max(0.0, sharp[0, 0] * sharp[1, 1] - sharp[0, 1] ** 2) / determinant)
    return falloff


def _flat_falloff(
    center: np.ndarray,
    axes: np.ndarray,
    scales: np.ndarray,
    camera: Camera,
    x: np.ndarray,
    y: np.ndarray,
    dilation: float,
) -> np.ndarray:
    """exp(-rho / 2) of one flat splat at all samples, rho = min(rho3d, rho2d) (2DGS, Huang et al. 2024).

    rho3d is the squared distance, in standard deviations, from the centre to where the ray meets the plane of
    the splat's first two axes; it is infinite where that is nearer than the near plane, behind the camera or
    nowhere, and beside the line that a splat with a scale of 0 is. rho2d = 0.6 / dilation |p - c|^2 (2 in the
    2DGS code), with p the sample and c the projected centre in pixels, keeps splats that are tiny or seen
    edge on from falling between the samples.
    """
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=1)
    normal = np.cross(axes[:, 0], axes[:, 1])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z = (normal @ center) / (rays @ normal)
        local = (z[:, None] * rays - center) @ axes[:, :2] / scales[:2]
        rho3d = (local**2).sum(axis=1)
    rho3d = np.where((z >= (camera.near or 0)) & np.isfinite(rho3d), rho3d, np.inf)
    dx = x - (camera.fx * center[0] / center[2] + camera.cx)
    dy = y - (camera.fy * center[1] / center[2] + camera.cy)
    return np.exp(-0.5 * np.minimum(rho3d, 0.6 / max(dilation, 1e-6) * (dx * dx + dy * dy)))
