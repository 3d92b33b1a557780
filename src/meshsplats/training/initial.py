"""Where a training starts: flat splats on what is known of the scene, with colours from the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._arrays import subsample
from meshsplats._geometry import quaternions_of
from meshsplats.camera import Camera
from meshsplats.conversion import convert
from meshsplats.datasets.points import ScenePoints
from meshsplats.datasets.views import View
from meshsplats.gaussians import SH_C0, GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import scatter_to_vertices
from meshsplats.training.hull import carve, has_silhouettes, in_silhouettes
from meshsplats.training.patches import Patches, SurfacePoints, merged, sums_around
from meshsplats.training.stereo import SIDE, WITNESSES, dense_points

COLOR_VIEWS = 40
"""Maximum number of training views, evenly spread, that give the first colours."""
NEAREST_POINTS = 2000
"""Points, at most, among which the nearest is looked for."""
OPACITY = 0.8
"""Opacity of fans at the start."""
FILL_OPACITY = 0.2
"""That of fans between matched depths, which may hang in front of a sky: the views decide."""
SIGMA = 0.6
"""Standard deviation of a fan on a surface, in sides of its patch."""
ROUGH_CELLS = 5000
"""Cells of the hull that bounds the depths in which photographs are matched."""
MIN_TRACK = 3
"""Views that must show a known point."""
FEWEST_POINTS = 30
"""Points that bound the depths in a view, at least."""
NEARER, FARTHER = 0.6, 3.0
"""Depths are tried from this multiple of the least depth of the points to that of the greatest."""
SHELL_SHARE = 0.25
"""Share of the fans at the start that the shell around everything has."""
SHELL_DISTANCE = 1.3
"""Radius of the shell, as a multiple of the distance of the farthest points but one in fifty."""
SHELL_VIEWS, SHELL_SIDE = 48, 100
"""Maximum number of views, evenly spread, and of pixels along a side of their images, in which it is found
where the shell is needed."""
SHELL_MARGIN = 0.25
"""Share of these images by which they are widened to each side, for the views between them."""
BACKDROP_MARGIN = 1.0
"""The same for the coarse backdrop of the shell: views from new places see past what the photographs show."""
BACKDROP_SHARE = 0.2
"""Pieces of a whole sphere as coarse as the backdrop, as a share of those of the shell."""
BACKDROP_DISTANCE = 1.25
"""Radius of the backdrop, as a multiple of that of the shell."""
COVERED = 0.98
"""Alpha of the other fans from which the shell is not needed behind them."""
FILL_WEIGHT = 2
"""Weight of a point that was not matched itself against one that was: it stands for more pixels."""
FREE_VIEWS = 3
"""Views that must see past a cell of the hull to make it empty."""


def starting_patches(
    views: Sequence[View], count: int, points: ScenePoints | None = None
) -> tuple[Patches | None, Patches | None]:
    """About ``count`` pieces of the surfaces that ``views`` show, if any is found; and those of the shell
    around the scene, where nothing masks the background.

    ``points``: known points of the scene.
    """
    if has_silhouettes(views):
        return _masked_patches(views, count), None
    known = None if points is None else points.positions[points.views >= MIN_TRACK]
    if known is not None and len(known) < FEWEST_POINTS:
        known = None
    near, far, targets = ranges_of_points(views, known) if known is not None else ranges_of_cameras(views)
    depths = dense_points(views, near, far, targets)
    parts = [
        SurfacePoints.alike(depths.points, depths.colors, 1, OPACITY),
        SurfacePoints.alike(*depths.between(), FILL_WEIGHT, FILL_OPACITY),
    ]
    if known is not None and points is not None:
        tints = points.colors[points.views >= MIN_TRACK].astype(np.float32) / np.float32(255)
        parts.append(SurfacePoints.alike(known, tints, WITNESSES, OPACITY))
    surfaces = SurfacePoints.joined(*parts)
    places = surfaces.positions
    shell = int(SHELL_SHARE * count)
    dense = None
    if len(places):
        dense = merged(surfaces, pixel_sizes(views, places), count - shell)
    return dense, shell_patches(views, dense, shell_radius(views, places, far), shell)


def _masked_patches(views: Sequence[View], count: int) -> Patches:
    """The surface of the subject inside the silhouettes."""
    rough = carve(views, ROUGH_CELLS)
    if rough is None:
        raise ValueError(
            "the alpha of the photographs leaves nothing that is the same subject in all of them: cameras and"
            " masks do not fit each other"
        )
    near, far = depth_ranges(views, rough.points)
    target = np.tile(rough.points.mean(axis=0), (len(views), 1))
    depths = dense_points(views, near, far, target)
    inside = in_silhouettes(views, depths.points, 0.5 * depths.pixels)
    points, colors = depths.points[inside], depths.colors[inside]
    hull = carve(views, count // 2, lambda points: depths.free(points) < FREE_VIEWS)
    hull = rough if hull is None else hull
    rest = _uncolored(hull.points, hull.normals, hull.side)
    if not len(points):
        return rest
    surfaces = SurfacePoints.alike(points, colors, 1, OPACITY)
    dense = merged(surfaces, pixel_sizes(views, points), count)
    return Patches.joined(dense, rest.select(apart(hull.points, dense.points, 1.5 * hull.side)))


def ranges_of_points(views: Sequence[View], points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(views,) least and greatest depth for each view, (views, 3) a point it looks at: from the ``points``
    (n, 3) in its image, or from all views where it has few."""
    found = []
    for view in views:
        positions, depth = view.camera.project(points)
        depth = depth[view.camera.in_image(positions)]
        enough = len(depth) >= FEWEST_POINTS
        found.append(np.quantile(depth, (0.01, 0.5, 0.98)) if enough else np.full(3, np.nan))
    table = np.array(found)
    known = ~np.isnan(table[:, 0])
    if not known.any():
        return ranges_of_cameras(views)
    table[~known] = np.median(table[known], axis=0)
    near, far = NEARER * table[:, 0], FARTHER * table[:, 2]
    return near, far, np.array([_ahead(v.camera, d) for v, d in zip(views, table[:, 1], strict=True)])


def ranges_of_cameras(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same from where the cameras stand and look."""
    centers = np.array([view.camera.center for view in views])
    axes = np.array([view.camera.world_to_camera[2, :3] for view in views])
    spread = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))) or 1.0
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=1e-6)[0]
    depth = np.einsum("ni,ni->n", focus - centers, axes)
    if np.mean(depth > 0.2 * spread) < 0.8:  # the views do not share a subject
        depth = np.full(len(views), 2 * spread)
    depth = np.maximum(depth, 0.2 * spread)
    targets = np.array([_ahead(v.camera, d) for v, d in zip(views, depth, strict=True)])
    return 0.25 * depth, 20 * depth, targets


def _ahead(camera: Camera, depth: float) -> np.ndarray:
    return camera.center + depth * camera.world_to_camera[2, :3]


def pixel_sizes(views: Sequence[View], points: np.ndarray) -> np.ndarray:
    """(n,) least size of a pixel at ``points`` (n, 3) in the images of ``views`` for matching, scene
    units; the median where no view sees a point."""
    least = np.full(len(points), np.inf)
    for view in views:
        camera = view.camera.within(SIDE)
        positions, depth = camera.project(points)
        size = np.where(camera.in_image(positions), depth / camera.fx, np.inf)
        np.minimum(least, size, out=least)
    seen = np.isfinite(least)
    least[~seen] = np.median(least[seen]) if seen.any() else 1.0
    return least


def shell_radius(views: Sequence[View], points: np.ndarray, far: np.ndarray) -> float:
    """Radius of the shell around the cameras: behind nearly all ``points`` (n, 3), or at the greatest depths
    ``far`` (views,) where there are few."""
    centers = np.array([view.camera.center for view in views])
    middle = np.median(centers, axis=0)
    outermost = float(np.linalg.norm(centers - middle, axis=1).max())
    if len(points) < FEWEST_POINTS:
        return float(np.median(far)) + outermost
    distance = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.98))
    return max(SHELL_DISTANCE * distance, 1.5 * outermost)


def shell_patches(
    views: Sequence[View], patches: Patches | None, radius: float, count: int
) -> Patches | None:
    """About ``count`` pieces of a sphere of ``radius`` around the cameras, where views see it past
    ``patches``, and a coarse backdrop behind them, which is much wider."""
    middle = np.median(np.array([view.camera.center for view in views]), axis=0)
    mesh = None if patches is None else fans_of(flat_splats(patches), 4)
    looks = []
    for view in subsample(views, SHELL_VIEWS):
        camera = view.camera.within(SHELL_SIDE)
        covered = np.zeros((camera.height, camera.width), np.float32)
        if mesh is not None:
            covered = render(mesh, camera).alpha
        # Views between these see a little more than they do.
        wider = _widened(camera, SHELL_MARGIN)
        x, y = (wider.width - camera.width) // 2, (wider.height - camera.height) // 2
        looks.append((wider, np.pad(covered, ((y, y), (x, x)))))
    total = 4 * count
    for _ in range(4):
        directions = _sphere(total)
        places = middle + radius * directions
        needed = np.zeros(total, bool)
        for camera, covered in looks:
            positions, _depth = camera.project(places)
            rows = np.flatnonzero(camera.in_image(positions))
            u, v = positions[rows].astype(int).T
            needed[rows] |= covered[v, u] < COVERED
        found = int(needed.sum())
        if not found:
            return None
        if 0.8 * count < found <= 1.2 * count or (found < count and total >= 64 * count):
            break
        total = min(max(int(total * count / found), 1), 64 * count)
    backdrop = _sphere(max(round(BACKDROP_SHARE * count), 1))
    behind = middle + BACKDROP_DISTANCE * radius * backdrop
    seen = np.zeros(len(behind), bool)
    for view in views:
        seen |= _widened(view.camera, BACKDROP_MARGIN).sees(behind)
    return Patches.joined(
        _pieces(middle, radius, directions[needed], len(directions)),
        _pieces(middle, BACKDROP_DISTANCE * radius, backdrop[seen], len(backdrop)),
    )


def _widened(camera: Camera, margin: float) -> Camera:
    """``camera`` with an image that is wider by a ``margin``, as a share of it, on each side."""
    x, y = (round(margin * side) for side in (camera.width, camera.height))
    return camera.window(-x, -y, camera.width + 2 * x, camera.height + 2 * y)


def _pieces(middle: np.ndarray, radius: float, directions: np.ndarray, total: int) -> Patches:
    """Those in the given ``directions`` (n, 3) of ``total`` pieces of a sphere around ``middle``."""
    side = radius * np.sqrt(4 * np.pi / total)
    # Pieces overlap, as nothing is behind them.
    return _uncolored(middle + radius * directions, -directions, 1.6 * side)


def _uncolored(points: np.ndarray, normals: np.ndarray, side: float) -> Patches:
    """Grey patches of equal ``side`` at ``points`` (n, 3)."""
    n = len(points)
    return Patches(
        points, normals, np.full((n, 3), 0.5, np.float32), np.full(n, float(side)), np.full(n, OPACITY)
    )


def _sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors evenly over the sphere: a Fibonacci spiral."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (1 + np.sqrt(5)) * i
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def apart(points: np.ndarray, others: np.ndarray, distance: float) -> np.ndarray:
    """(n,) bool: ``points`` (n, 3) with none of ``others`` (m, 3) in their cell of side ``distance`` and the
    26 beside it."""
    low = np.concatenate([points, others]).min(axis=0)
    return sums_around(others, points, low, distance)[0] == 0


def depth_ranges(views: Sequence[View], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(views,) least and greatest depth of ``points`` (n, 3) in each view."""
    near, far = np.empty(len(views)), np.empty(len(views))
    some = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)) or 1.0
    for i, view in enumerate(views):
        depth = view.camera.project(points)[1]
        depth = depth[depth > (view.camera.near or 0)]
        near[i], far[i] = (0.98 * depth.min(), 1.02 * depth.max()) if len(depth) else (some, 2 * some)
    return near, far


def flat_splats(patches: Patches) -> GaussianCloud:
    """A flat splat on each of ``patches``."""
    normals = patches.normals
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first), normals], axis=2)
    return GaussianCloud(
        patches.points,
        quaternions_of(frames),
        SIGMA * patches.sides[:, None] * [1, 1, 0],
        patches.opacities,
        (patches.colors[:, None] - 0.5) / SH_C0,
        kernel="2dgs",
    )


def fans_of(cloud: GaussianCloud, sides: int) -> SplatMesh:
    """One fan of ``sides`` triangles for each splat, in order; none is left out."""
    return convert(
        cloud, mode="flat", sides=sides, footprint="none", min_opacity=0.0, shrink_faint=False, up=(0, -1, 0)
    )


def colored(
    mesh: SplatMesh, views: Sequence[View], threads: int | None, unseen_from: int | None = None
) -> SplatMesh:
    """``mesh`` with colours from the images of ``views``: for each vertex the mean over the pixels that it is
    blended into, with the weights of the blending.

    Vertices from index ``unseen_from`` on that no view shows take the colour of the nearest one among them
    that is seen.
    """
    sums = np.zeros((len(mesh.vertices), 4))
    for view in subsample(views, COLOR_VIEWS):
        image = view.load()
        values = np.zeros((len(mesh.vertices), 4), np.float32)
        rendering = CpuEngine(threads).tape(mesh.triangles._replace(values=values), view.camera)
        # Colour times alpha, and alpha: mixed pixels on the outline show other things, too.
        alpha = np.ones(image.color.shape[:2], np.float32) if view.alpha is None else view.alpha.copy()
        if image.mask is not None:
            alpha[~image.mask] = 0
        values = np.concatenate([image.over((0, 0, 0)), np.ones_like(alpha)[..., None]], axis=2)
        values[..., 3] = alpha
        values[alpha == 0] = 0
        sums += scatter_to_vertices(rendering, values)
    colors = mesh.colors.copy()
    seen = sums[:, 3] > 1e-6
    colors[seen, :3] = np.clip(sums[seen, :3] / sums[seen, 3:], 0, 1)
    if unseen_from is not None:
        rows = np.flatnonzero(~seen[unseen_from:]) + unseen_from
        known = np.flatnonzero(seen[unseen_from:]) + unseen_from
        if len(rows) and len(known):
            colors[rows, :3] = colors[_nearest(mesh.vertices[known], mesh.vertices[rows], known), :3]
    return replace(mesh, colors=colors)


def _nearest(points: np.ndarray, places: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """For each of ``places`` (m, 3) the entry of ``indices`` (n,) of the nearest of ``points`` (n, 3)."""
    some = points[:: max(1, len(points) // NEAREST_POINTS)]
    taken = indices[:: max(1, len(points) // NEAREST_POINTS)]
    found = np.empty(len(places), np.int64)
    squares = np.square(some).sum(axis=1)
    for start in range(0, len(places), 4096):
        part = places[start : start + 4096]
        found[start : start + 4096] = (squares - 2 * part @ some.T).argmin(axis=1)
    return taken[found]
