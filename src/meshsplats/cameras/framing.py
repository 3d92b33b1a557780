"""Where the subject of a scene is and which way is up, robust against stray splats."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.cells import Cells
from meshsplats._common.geometry import away_from_ground
from meshsplats._common.kinds import need_array
from meshsplats.errors import DataWarning, StraysWarning
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import FAR, choose_origin, sampled

DEFAULT_UP = (0.0, -1.0, 0.0)
"""Splats trained from COLMAP cameras have the y axis pointing down."""
SURVEY_UP = (0.0, 0.0, 1.0)
"""Surveys have eastings, northings and heights."""
_EASTING = 1.5e6
"""Easting of surveys, at most, metres."""
SAMPLE = 20_000
"""Largest number of points to measure: more do not change the quantiles visibly."""
SURROUNDINGS = 4.0
"""Points farther from the centre than this many median distances are surroundings, not the subject. Splats of
a single object reach about 2 (surface of a ball: 1; filled ball: 1.26; longest object measured: 3.9)."""

APART = 0.15
"""Parts of the subject that are farther than this many radii from the rest are separate..."""
FLOATER = 0.01
"""... and are floaters if they have less than this share of its opacity..."""
FLOATERS = 0.1
"""... and all of them together have less than this share."""
COVERED = 0.995
"""Share of the subject's opacity that must be in the image."""
MARGIN = 1.08
"""Distance of the cameras as a multiple of the one at which the subject just fits."""

LEVEL_SPREAD = 0.006
"""Least mean square of the second principal component of the directions to the right of cameras, for these
to tell what is level: cameras that look the same way within some 10 degrees do not. In 35 series of 18 to 30
neighbouring photographs of a room, from above, it is 0.007 to 0.065, and what they tell 0.4 to 11 degrees
off; their mean up direction is 24 to 35 off in the 21 below 0.03."""
LEVEL_ROLL = 0.12
"""Greatest mean square of what stands out of that plane, as a share of the former: people roll cameras. In
these series, 0.002 to 0.107; where the camera was turned on its side, 0.88."""
LEVEL_AGREES = 0.3
"""Least cosine between that direction and the cameras' mean up direction."""

_REACH = 0.7
"""Two standard deviations of a splat, as a share of the way from the centre of its triangles to corners
without any opacity: 0.64 and 0.8 in the fans of ``convert``, with 4 and 8 sides."""

_LARGEST = 100
"""Triangles of a splat, on average, up to which it counts as one point: those of a mesh prior are the faces
of its base."""

STRAY = 10_000.0
"""Distance from the subject, and size, in its radii, from which on splats are strays. In captures that were
tried, floaters are at most 1,100 radii away."""

MANY = 1000
"""Number of splats from which on a scene is expected to be visible..."""
UNSEEN = 0.05
"""...by so large a share: shadows of splats times their opacity, over the area of the subject. In captures
that were tried, splats have 0.4 to 10, points that were written as splats 0.01 to 0.2."""

Framable = GaussianCloud | SplatMesh | np.ndarray
"""Whatever cameras can be placed around: splats, a mesh, or points (n, 3)."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Extent of a scene without its strays, in the frame and units of the scene."""

    center: np.ndarray
    """(3,) float64 weighted median of the points along each axis."""
    radius: float
    """Distance from ``center`` within which 90 % of the weight lies, > 0."""
    points: np.ndarray
    """(k, 3) float64 sample of the subject's points, without surroundings and floaters."""
    weights: np.ndarray
    """(k,) float64 weights of the points, >= 0: their opacity."""
    sizes: np.ndarray
    """(k,) float64 reach of each point: two standard deviations of the middle axis of a splat, or of the
    triangles that were one; else 0."""


def need_scene(scene: Framable) -> None:
    """TypeError unless ``scene`` is one."""
    if isinstance(scene, (GaussianCloud, SplatMesh)):
        return
    instead = {
        "path": "load_gaussians(path) or load_mesh(path) reads the scene first",
        "MeshPrior": "prior.mesh is its mesh",
        "BaseMesh": "base.vertices are points",
        "Dataset": "its cameras are there already, [view.camera for view in dataset.views]",
        "Tileset": "tiles_mesh makes a mesh of it",
    }
    need_array(scene=scene, instead=instead, wanted="splats, a mesh or points (n, 3)")


def weighted_quantile(values: np.ndarray, weights: np.ndarray, q: float) -> float:
    """Smallest of ``values`` (k,) at which the sorted ``weights`` add up to ``q`` (0 to 1) of their sum."""
    order = np.argsort(values)  # equal values may stand in any order
    total = np.cumsum(weights[order])
    return float(values[order[min(np.searchsorted(total, q * total[-1]), len(order) - 1)]])


def scene_bounds(scene: Framable) -> Bounds:
    """Robust bounds of a cloud, a mesh or points (n, 3); splats and vertices are weighted by opacity.

    Raises ValueError for a scene without points, or if points (n, 3) have another shape or are not finite.
    """
    extent = _Extent.of(scene)
    points, weights, distance, radius = extent.points, extent.weights, extent.distance, extent.radius
    limit = SURROUNDINGS * weighted_quantile(distance, weights, 0.5)
    subject = distance <= limit if limit > 0 else np.ones(len(points), bool)
    subject[subject] = _without_floaters(points[subject], weights[subject], APART * radius)
    return Bounds(extent.center, radius, points[subject], weights[subject], extent.sizes[subject])


class _Extent(NamedTuple):
    """A sample of a scene, with its surroundings and floaters; fields as in ``Bounds``."""

    center: np.ndarray
    radius: float
    points: np.ndarray
    weights: np.ndarray
    sizes: np.ndarray
    distance: np.ndarray
    """(k,) float64 of the points from ``center``."""

    @classmethod
    def of(cls, scene: Framable) -> _Extent:
        """Raises ValueError as ``scene_bounds``."""
        points, weights, sizes = _sample(scene)
        center = np.array([weighted_quantile(points[:, axis], weights, 0.5) for axis in range(3)])
        distance = np.linalg.norm(points - center, axis=1)
        radius = weighted_quantile(distance, weights, 0.9)
        if radius == 0:
            # Nearly all points are in one spot: use the largest distance, or else the size of the splats.
            radius = float(distance.max())
        if radius == 0:
            radius = float(sizes.max()) or 1.0
        return cls(center, radius, points, weights, sizes, distance)


def _sample(scene: Framable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(k, 3) points, (k,) weights and (k,) sizes of a sample of a scene, float64."""
    if isinstance(scene, SplatMesh) and _has_small_splats(scene):
        return _sample_of_splats(scene)
    if isinstance(scene, GaussianCloud):
        points, weights = scene.means, scene.opacities
    elif isinstance(scene, SplatMesh):
        points, weights = scene.vertices, scene.colors[:, 3]
    else:
        need_scene(scene)
        points = np.asarray(scene, np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"points must be finite and of shape (n, 3), got {points.shape}")
        weights = np.ones(len(points))
    if len(points) == 0:
        raise ValueError("the scene is empty: there is nothing to place cameras around")
    step = -(-len(points) // SAMPLE)
    points = np.asarray(points[::step], np.float64)
    weights = np.asarray(weights[::step], np.float64)
    sizes = np.zeros(len(points))
    if isinstance(scene, GaussianCloud):
        sizes = 2 * np.median(scene.scales[::step].astype(np.float64), axis=1)
    if weights.sum() == 0:
        weights = np.ones(len(points))
    return points, weights, sizes


def _has_small_splats(mesh: SplatMesh) -> bool:
    return mesh.face_splat is not None and 0 < len(mesh.faces) <= _LARGEST * len(mesh.splats)


def _sample_of_splats(mesh: SplatMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As ``_sample``: one point for each splat of ``mesh``, so that a mesh is framed as its splats are."""
    splats = mesh.splats
    rows = np.arange(0, len(splats), -(-len(splats) // SAMPLE))
    counts = splats.counts[rows]
    first = np.cumsum(counts) - counts
    faces = np.arange(counts.sum()) + np.repeat(splats.starts[rows] - first, counts)
    corners, each, start = mesh.faces[faces].ravel(), 3 * counts, 3 * first
    opacities = mesh.colors[corners, 3].astype(np.float64)
    peaks = np.maximum.reduceat(opacities, start)
    places = mesh.vertices[corners].T.astype(np.float64)  # columns are summed far faster than rows
    weights = opacities + 1e-6
    centers = np.add.reduceat(weights * places, start, axis=1) / np.add.reduceat(weights, start)
    away = places - np.repeat(centers, each, axis=1)
    moments = np.empty((len(rows), 3, 3))
    for i, j in ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)):
        moments[:, i, j] = np.add.reduceat(away[i] * away[j], start)
    _, axes = np.linalg.eigh(moments)  # reads the lower half
    share = opacities / np.repeat(np.maximum(peaks, 1e-12), each)
    away *= np.minimum(1, _REACH / np.maximum(1 - share, 1e-12))
    reach = np.empty((3, len(rows)))
    for k, axis in enumerate(np.ascontiguousarray(axes.transpose(2, 1, 0))):
        along = sum(away[i] * np.repeat(axis[i], each) for i in range(3))
        reach[k] = np.maximum.reduceat(np.abs(along), start)
    return np.ascontiguousarray(centers.T), peaks, np.sort(reach, axis=0)[1]


def warn_of_strays(scene: GaussianCloud | SplatMesh, low: np.ndarray, high: np.ndarray, size: float) -> None:
    """Issues a StraysWarning if splats lie ``STRAY`` radii from the subject of ``scene``, a sample of it, or
    are as large.

    Args:
        low, high: (3,) least and greatest coordinates of all centres.
        size: largest standard deviation of all splats.
    """
    extent = _Extent.of(scene)
    with np.errstate(over="ignore"):
        away = float(np.maximum(np.abs(low - extent.center), np.abs(high - extent.center)).max())
    if max(away, size) <= STRAY * extent.radius:
        return
    radii = f"about 10^{round(np.log10(max(away, size) / extent.radius))} radii"
    what = f"lie {radii} away from the rest" if away >= size else f"are {radii} of the scene large"
    warnings.warn(
        f"some splats {what}: 'meshsplats clean' removes such strays",
        StraysWarning,
        stacklevel=3,
    )


def warn_of_strays_in(scene: GaussianCloud | SplatMesh) -> None:
    """``warn_of_strays`` of a whole scene."""
    points = scene.means if isinstance(scene, GaussianCloud) else scene.vertices
    if len(points):
        size = float(scene.scales.max()) if isinstance(scene, GaussianCloud) else 0.0
        warn_of_strays(scene, points.min(axis=0), points.max(axis=0), size)


def warn_of_unseen(cloud: GaussianCloud) -> None:
    """Issues a DataWarning if pictures of many splats show hardly anything: they are too faint, or as small
    as the points of a scan."""
    if len(cloud) < MANY:
        return
    step, bounds = -(-len(cloud) // SAMPLE), scene_bounds(cloud)
    scales, opacities = cloud.scales[::step].astype(np.float64), cloud.opacities[::step].astype(np.float64)
    near = np.linalg.norm(cloud.means[::step] - bounds.center, axis=1) <= bounds.radius
    # The mean shadow of a splat, over the disc that the subject covers.
    shadows = 2 * np.pi / 3 * (scales * np.roll(scales, 1, axis=1)).sum(axis=1) * near
    shares = step * np.array([(opacities * shadows).sum(), shadows.sum()]) / (np.pi * bounds.radius**2)
    if shares[0] >= UNSEEN:
        return
    if shares[1] >= UNSEEN:
        most = float(np.quantile(opacities, 0.95))
        why = f"so faint (95% have an opacity below {max(most, 0.001):.2g})"
        cure = "the program that wrote the file may have spoilt its opacities"
    else:
        sizes = f"usually {np.median(scales):.2g} units, in a scene of {bounds.radius:.2g}"
        why = f"so small for their distances ({sizes})"
        cure = "it looks like a point cloud: write it with larger splats"
    warnings.warn(
        f"hardly anything can be seen: the splats are {why} that they cover about {100 * shares[0]:.1g}% of"
        f" the pictures; {cure}",
        DataWarning,
        stacklevel=2,
    )


def _without_floaters(points: np.ndarray, weights: np.ndarray, gap: float) -> np.ndarray:
    """(k,) bool: points that are not in floaters, separate parts of little weight.

    Where the other parts are not nearly all of the weight, the scene is a scatter of small parts, and all
    points stay.
    """
    part = Cells(points, gap).parts()
    held = np.bincount(part, weights)
    keep = (held >= FLOATER * held.sum())[part]
    return keep if weights[keep].sum() >= (1 - FLOATERS) * weights.sum() else np.ones(len(points), bool)


def guess_up(scene: Framable | None = None, cameras: Sequence[Camera] | None = None) -> np.ndarray:
    """(3,) float64 unit direction that points up in the world frame.

    That of ``cameras`` if there are any and they agree (people hold cameras upright); else the ``up`` of a
    mesh, or of splats whose file names it; of splats of a survey, z; else ``DEFAULT_UP``, as in scenes
    trained from COLMAP cameras. The ``up`` of a file or a survey that is within 45 degrees of that of the
    cameras is the better one: those lean. The points themselves do not count: they cannot distinguish an
    upright vase from a hanging lamp.
    """
    held = _up_of_cameras(cameras) if cameras else None
    told = None
    if isinstance(scene, GaussianCloud):
        told = up_of_survey(scene) if scene.up is None else scene.up.astype(np.float64)
    if told is not None and (held is None or told @ held > np.sqrt(0.5)):
        return told
    if held is not None:
        return held
    if isinstance(scene, SplatMesh):
        return scene.up.astype(np.float64)
    return np.array(DEFAULT_UP)


def up_of_survey(cloud: GaussianCloud) -> np.ndarray | None:
    """(3,) unit direction that points up in the coordinates of a survey, such as UTM or ECEF; None for other
    ones."""
    up = default_up(choose_origin(sampled(cloud.means) + cloud.origin))
    return None if np.array_equal(up, DEFAULT_UP) else up


def default_up(origin: np.ndarray) -> np.ndarray:
    """(3,) unit direction that points up in a scene of which no more is known than its ``origin`` (3,) in the
    world: (0, 0, 0), or a point in its midst if it is far from there. Surveys have z up, coordinates from the
    middle of the Earth (ECEF) the normal of its ellipsoid."""
    if np.hypot(*origin[:2]) >= FAR > abs(origin[2]):
        return np.array(SURVEY_UP)
    away = None if has_northing_along_z(origin) else away_from_ground(origin)
    return np.array(DEFAULT_UP) if away is None else away


def has_northing_along_z(origin: np.ndarray) -> bool:
    """Whether ``origin`` (3,), whose z is large, is one of a survey that was turned to y up; on the globe it
    would be near a pole."""
    return bool(abs(origin[1]) < FAR and abs(origin[0]) < _EASTING)


def _up_of_cameras(cameras: Sequence[Camera]) -> np.ndarray | None:
    """(3,) unit direction, None if the cameras do not agree."""
    if cameras:
        rotations = np.array([camera.world_to_camera[:3, :3] for camera in cameras])
        mean = -rotations[:, 1].mean(axis=0)
        length = float(np.linalg.norm(mean))
        if length > 0.2:  # up directions all around a sphere cancel out
            level = _across(rotations[:, 0])
            if level is None or abs(level @ mean) < LEVEL_AGREES * length:
                return mean / length
            return level if level @ mean > 0 else -level
    return None


def _across(rights: np.ndarray) -> np.ndarray | None:
    """(3,) unit direction across the horizontal axes of images, (k, 3); None if they do not tell it.

    Cameras that look up or down tilt their own up direction, but not the axis to their right: that of an
    upright camera is level. So this is exact for upright cameras, whose mean up direction is not.
    """
    values, axes = np.linalg.eigh(rights.T @ rights / len(rights))
    told = values[1] >= LEVEL_SPREAD and values[0] <= LEVEL_ROLL * values[1]
    return axes[:, 0] if told else None


def unit_up(up: Sequence[float] | np.ndarray) -> np.ndarray:
    """``up`` as a (3,) float64 unit vector. ValueError if it is not three finite numbers or has no length."""
    vector = np.asarray(up, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or np.linalg.norm(vector) == 0:
        raise ValueError(f"up must be three finite numbers that are not all 0, got {up!r}")
    vector = vector / np.abs(vector).max()
    return vector / np.linalg.norm(vector)


def front_axes(up: np.ndarray) -> np.ndarray:
    """(3, 3) float64 rows right, up, forward of someone who stands before the scene, for a unit ``up``.

    Right is the world's +x (+z if ``up`` is close to the x axis), made orthogonal to ``up``; forward = up x
    right. So COLMAP's y-down scenes are seen along +z, y-up scenes along -z and z-up scenes along +y.
    """
    right = np.array([1.0, 0, 0]) if abs(up[0]) < 0.9 else np.array([0, 0, 1.0])
    right = right - up * (right @ up)
    right /= np.linalg.norm(right)
    return np.stack([right, up, np.cross(up, right)])


def middle(bounds: Bounds, axes: np.ndarray) -> np.ndarray:
    """(3,) centre of the subject's bounding box along ``axes``: half-way along a guitar, not in its body."""
    along = bounds.points @ axes.T
    return np.array([_middle_of(along[:, k], bounds.weights) for k in range(3)]) @ axes


def fit_images(
    bounds: Bounds, target: np.ndarray, rotations: Sequence[np.ndarray], slopes: tuple[float, float]
) -> tuple[np.ndarray, float]:
    """The point to look at, and the least distance from it at which every view shows the whole subject.

    Args:
        bounds: of the subject.
        target: (3,) first guess of the point.
        rotations: (3, 3) from the world's to each view's axes (OpenCV).
        slopes: x / z and y / z at the right and the lower edge of the image.
    """
    # Near parts look larger, so the centre of the box is not in the centre of an image. Two steps of least
    # squares over a dozen of the views bring it there within a few pixels.
    some = subsample(rotations, 12)
    across = np.concatenate([rotation[:2] for rotation in some])
    for _ in range(2):
        away = max(_fitting_distance(bounds, target, rotation, slopes) for rotation in some)
        aside = np.concatenate([_seen_aside(bounds, target, rotation, away) for rotation in some])
        target = target + np.linalg.lstsq(across, aside, rcond=1e-6)[0]
    return target, max(_fitting_distance(bounds, target, rotation, slopes) for rotation in rotations)


def _fitting_distance(
    bounds: Bounds, target: np.ndarray, rotation: np.ndarray, slopes: tuple[float, float]
) -> float:
    """Distance d at which one view shows the covered share of the points.

    A point at (x, y, z) from the target, in the view's axes, is in the image if |x| <= slope (d + z): it
    needs d >= |x| / slope - z.
    """
    x, y, z = rotation @ (bounds.points - target).T
    needed = np.maximum((np.abs(x) + bounds.sizes) / slopes[0], (np.abs(y) + bounds.sizes) / slopes[1]) - z
    return max(weighted_quantile(needed, bounds.weights, COVERED) * MARGIN, 0.1 * bounds.radius)


def _seen_aside(bounds: Bounds, target: np.ndarray, rotation: np.ndarray, away: float) -> np.ndarray:
    """(2,) offset of the subject's middle from the image's centre, right and down, in lengths at the
    target."""
    x, y, z = rotation @ (bounds.points - target).T
    seen = z > -0.9 * away
    if not seen.any():
        return np.zeros(2)
    depth, weights = z[seen] + away, bounds.weights[seen]
    return np.array([_middle_of(x[seen] / depth, weights), _middle_of(y[seen] / depth, weights)]) * away


def _middle_of(values: np.ndarray, weights: np.ndarray) -> float:
    return (weighted_quantile(values, weights, 1 - COVERED) + weighted_quantile(values, weights, COVERED)) / 2
