"""Where a training starts: flat splats on what is known of the scene, with colours from the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._core.stereo import SurfaceArrays
from meshsplats.conversion import convert
from meshsplats.datasets.points import ScenePoints
from meshsplats.datasets.reduced import reduced_views
from meshsplats.datasets.silhouettes import has_silhouettes
from meshsplats.datasets.views import ImageCache, View
from meshsplats.rendering import render
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import scatter_to_vertices
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training.hull import carve, in_silhouettes
from meshsplats.training.patches import Patches, flat_splats, fused
from meshsplats.training.references import references
from meshsplats.training.stereo import REFERENCES, SIDE, find_depths

COLOR_VIEWS = 40
"""Maximum number of training views, evenly spread, that give the first colours..."""
COLOR_SIDES = (200, 400)
"""... and the longer sides of their images in pixels, at most, for these colours and for their errors."""
ERROR_PIXELS = 0.5
"""Added to the pixels that a vertex has errors in: those of few pixels may be those of its neighbours."""
NEAREST_POINTS = 2000
"""Points, at most, among which the nearest is looked for."""
OPACITY = 0.8
"""Opacity of fans at the start that no matched photographs show: on hulls and the shell."""
ROUGH_CELLS = 5000
"""Cells of the hull that bounds the depths in which photographs are matched."""
MIN_TRACK = 3
"""Views that must show a known point."""
FEWEST_POINTS = 30
"""Points that bound the depths in a view, at least."""
RANGE_POINTS = 20_000
"""Points, at most, that ranges of depth are taken from."""
LOST_POINTS = 5000
"""Points, at most, of which is asked whether any view shows them..."""
LOST_DISTANCE = 1000.0
"""...within this multiple of the farthest camera's distance from the middle of all."""
NEARER, FARTHER = 0.6, 60.0
"""Depths are tried from this multiple of the least depth of the points to that of the greatest: outdoors,
all known points may lie on what stands in front."""
SHELL_SHARE = 0.06
"""Share of the fans at the start that the shell around everything has."""
SHELL_DISTANCE = 1.2
"""Radius of the shell, as a multiple of the distance of the farthest points but one in two hundred."""
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
FREE_VIEWS = 3
"""Views that must see past a cell of the hull to make it empty."""


def starting_patches(
    views: Sequence[View], count: int, points: ScenePoints | None = None, threads: int | None = None
) -> tuple[Patches | None, Patches | None]:
    """At most ``count`` pieces of the surfaces that ``views`` show, if any is found; and those of the shell
    around the scene, where nothing masks the background.

    ``points``: known points of the scene.
    """
    if has_silhouettes(views):
        return _masked_patches(views, count, threads), None
    known = None if points is None else points.positions[points.views >= MIN_TRACK]
    if known is not None and len(known) < FEWEST_POINTS:
        known = None
    near, far, targets = ranges_of_points(views, known) if known is not None else ranges_of_cameras(views)
    depths = find_depths(views, near, far, targets if known is None else known, threads)
    origin = np.median([view.camera.center for view in views], axis=0)
    surface = depths.surface(origin)
    if known is not None and points is not None:
        tints = points.colors[points.views >= MIN_TRACK]
        surface = _with_points(surface, known - origin, tints, pixel_sizes(views, known))
    shell = int(SHELL_SHARE * count)
    dense = None
    if len(surface.points):
        dense = fused(surface, origin, depths, count - shell, threads)
    if dense is not None and not len(dense.points):
        dense = None
    radius = shell_radius(views, surface.points.astype(np.float64) + origin, far)
    return dense, shell_patches(views, dense, radius, shell, threads)


def lost_points(views: Sequence[View], points: ScenePoints) -> float:
    """Share of ``points`` that lie in the image of none of ``views``, or far from them all.

    Raises ValueError for points that are not finite.
    """
    positions = points.positions
    if not np.isfinite(positions).all():
        wrong = int((~np.isfinite(positions).all(axis=1)).sum())
        raise ValueError(f"points must be finite, {wrong:,} of {len(positions):,} are not: leave them out")
    positions = subsample(positions, LOST_POINTS)
    centers = np.array([view.camera.center for view in views])
    middle = np.median(centers, axis=0)
    around = np.linalg.norm(positions - middle, axis=1)
    near = around <= LOST_DISTANCE * (np.linalg.norm(centers - middle, axis=1).max() or np.inf)
    seen = np.zeros(len(positions), bool)
    for view in views:
        rest = np.flatnonzero(near & ~seen)
        if not len(rest):
            break
        image, _ = view.camera.project(positions[rest])
        seen[rest] = view.camera.in_image(image)
    return 1 - float(seen.mean()) if len(seen) else 0.0


def _with_points(
    surface: SurfaceArrays, places: np.ndarray, colors: np.ndarray, pixels: np.ndarray
) -> SurfaceArrays:
    """``surface`` and known points (n, 3)."""
    n = len(places)
    known = SurfaceArrays(
        places.astype(np.float32),
        np.zeros((n, 3), np.float32),
        pixels.astype(np.float32),
        colors.astype(np.uint8),
        np.ones(n, np.uint8),
    )
    return SurfaceArrays(*(np.concatenate(pair) for pair in zip(surface, known, strict=True)))


def _masked_patches(views: Sequence[View], count: int, threads: int | None) -> Patches:
    """The surface of the subject inside the silhouettes."""
    rough = carve(views, ROUGH_CELLS)
    if rough is None:
        raise ValueError(
            "no place is inside of the silhouettes of the photographs that show it: cameras and masks do not"
            " fit each other, or fewer than three photographs show each part of the subject"
        )
    near, far = depth_ranges(views, rough.points)
    depths = find_depths(views, near, far, rough.points, threads)
    origin = rough.points.mean(axis=0)
    surface = depths.surface(origin)
    places = surface.points.astype(np.float64) + origin
    inside = in_silhouettes(views, places, 0.5 * surface.pixels)
    surface, places = SurfaceArrays(*(column[inside] for column in surface)), places[inside]
    hull = carve(views, count // 2, lambda points: depths.counts(points, threads)[1] < FREE_VIEWS)
    hull = rough if hull is None else hull
    rest = Patches.squares(hull.points, hull.normals, hull.side, OPACITY)
    if not len(places):
        return rest
    rest = rest.select(apart(hull.points, places, 1.5 * hull.side))
    dense = fused(surface, origin, depths, max(count - len(rest.points), count // 2), threads)
    return Patches.joined(dense, rest)


def ranges_of_points(views: Sequence[View], points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(views,) least and greatest depth for each view, (views, 3) a point it looks at: from the ``points``
    (n, 3) in its image, or from all views where it has few."""
    found, points = [], subsample(points, RANGE_POINTS)
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
    cameras = [view.camera.within(SIDE) for view in views]
    for camera in (cameras[i] for i in references(cameras, points, REFERENCES)):
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
    distance = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.995))
    return max(SHELL_DISTANCE * distance, 1.5 * outermost)


def shell_patches(
    views: Sequence[View], patches: Patches | None, radius: float, count: int, threads: int | None = None
) -> Patches | None:
    """About ``count`` pieces of a sphere of ``radius`` around the cameras, where views see it past
    ``patches``, and a coarse backdrop behind them, which is much wider."""
    middle = np.median(np.array([view.camera.center for view in views]), axis=0)
    mesh = None if patches is None else fans_of(flat_splats(patches), 4, threads)
    looks = []
    for view in subsample(views, SHELL_VIEWS):
        camera = view.camera.within(SHELL_SIDE)
        covered = np.zeros((camera.height, camera.width), np.float32)
        if mesh is not None:
            covered = render(mesh, camera, threads=threads).alpha
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
            shown, u, v, _ = camera.pixels_of(places)
            needed[shown] |= covered[v, u] < COVERED
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
    return Patches.squares(middle + radius * directions, -directions, 1.6 * side, OPACITY)


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
    low = np.concatenate([points, others]).min(axis=0) - distance

    def cell_of(positions: np.ndarray) -> np.ndarray:
        cells = np.clip((positions - low) / distance, 0, 2**20 - 1).astype(np.int64)
        return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]

    held, wanted = np.unique(cell_of(others)), cell_of(points)
    near = np.zeros(len(points), bool)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            for k in (-1, 0, 1):
                beside = wanted + ((i << 42) + (j << 21) + k)
                near |= held[np.minimum(np.searchsorted(held, beside), len(held) - 1)] == beside
    return ~near


def depth_ranges(views: Sequence[View], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(views,) least and greatest depth of ``points`` (n, 3) in each view."""
    near, far = np.empty(len(views)), np.empty(len(views))
    some = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)) or 1.0
    for i, view in enumerate(views):
        depth = view.camera.project(points)[1]
        depth = depth[depth > (view.camera.near or 0)]
        near[i], far[i] = (0.98 * depth.min(), 1.02 * depth.max()) if len(depth) else (some, 2 * some)
    return near, far


def fans_of(cloud: GaussianCloud, sides: int, threads: int | None = None) -> SplatMesh:
    """One fan of ``sides`` triangles for each splat, in order; none is left out."""
    return convert(
        cloud,
        mode="flat",
        sides=sides,
        footprint="none",
        min_opacity=0.0,
        shrink_faint=False,
        up=(0, -1, 0),
        threads=threads,
    )


def colored(
    mesh: SplatMesh, views: Sequence[View], threads: int | None, unseen_from: int | None = None
) -> SplatMesh:
    """``mesh`` with colours from the images of ``views``: for each vertex the mean over the pixels that it is
    blended into, with the weights of the blending; then once more by what is left of their errors, in larger
    images.

    Vertices from index ``unseen_from`` on that no view shows take the colour of the nearest one among them
    that is seen.
    """
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    small, large = (
        reduced_views(subsample(views, COLOR_VIEWS), min(1.0, side / longest), ImageCache(0))
        for side in COLOR_SIDES
    )
    colors = mesh.colors.copy()
    sums = _color_sums(mesh, small, threads, errors=False)
    seen = sums[:, 3] > 1e-6
    colors[seen, :3] = np.clip(sums[seen, :3] / sums[seen, 3:], 0, 1)
    if unseen_from is not None:
        rows = np.flatnonzero(~seen[unseen_from:]) + unseen_from
        known = np.flatnonzero(seen[unseen_from:]) + unseen_from
        if len(rows) and len(known):
            colors[rows, :3] = colors[_nearest(mesh.vertices[known], mesh.vertices[rows], known), :3]
    mesh = replace(mesh, colors=colors)
    sums = _color_sums(mesh, large, threads, errors=True)
    colors = colors.copy()
    colors[:, :3] = np.clip(colors[:, :3] + sums[:, :3] / (sums[:, 3:] + ERROR_PIXELS), 0, 1)
    return replace(mesh, colors=colors)


def _color_sums(mesh: SplatMesh, views: Sequence[View], threads: int | None, errors: bool) -> np.ndarray:
    """(v, 4) sums over the pixels that each vertex of ``mesh`` is blended into, by its weight in them: RGB of
    ``views``, or what the mesh lacks of it (``errors``), and the weights."""
    sums = np.zeros((len(mesh.vertices), 4))
    triangles = mesh.triangles._replace(values=np.zeros((len(mesh.vertices), 4), np.float32))
    for view in views:
        image = view.load()
        rendering = CpuEngine(threads).tape(triangles, view.camera)
        # Colour times alpha, and alpha: mixed pixels on the outline show other things, too.
        alpha = np.ones(image.color.shape[:2], np.float32) if view.alpha is None else view.alpha.copy()
        if image.mask is not None:
            alpha[~image.mask] = 0
        values = np.concatenate([image.over((0, 0, 0)), alpha[..., None]], axis=2)
        if errors:
            values[..., :3] -= rendering.color
        values[alpha == 0] = 0
        sums += scatter_to_vertices(rendering, values)
    return sums


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
