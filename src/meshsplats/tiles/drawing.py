"""Images of a tileset: the tiles that a camera needs, in bounded memory."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.kinds import need, need_all
from meshsplats.rendering import Rendering, render
from meshsplats.rendering.samples import CAMERAS, needed_samples
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.tiles.tileset import Tile, Tileset

MAX_ERROR = 1.0
"""Screen-space error in pixels up to which a tile is drawn."""
MAX_TRIANGLES = 4_000_000
"""Triangles that are in memory together, in about 60 bytes each."""
SMALLEST = 16
"""Side in pixels below which an image is not divided."""


def choose_tiles(
    tileset: Tileset, cameras: Sequence[Camera], *, max_error: float = MAX_ERROR, most: int | None = None
) -> tuple[list[Tile], float]:
    """The tiles that ``cameras`` need together, in octree order, and their largest error in pixels.

    The screen-space error of a tile is its geometric error at the nearest point of its box, in the image
    where it is largest. A tile of more than ``max_error`` is replaced by its children, those of the largest
    error first, as long as there are at most ``most`` triangles. Tiles outside all images are left out.
    """
    if not max_error >= 0:
        raise ValueError(f"max_error must be a number of pixels, at least 0, got {max_error}")
    cameras = [tileset.seen_by(camera) for camera in cameras]
    order = count()
    queue: list[tuple[float, int, tuple[int, ...], Tile]] = []
    chosen: list[tuple[tuple[int, ...], Tile]] = []
    triangles, worst = 0, 0.0

    def add(tile: Tile, place: tuple[int, ...]) -> None:
        nonlocal triangles, worst
        seeing = [camera for camera in cameras if reaches(camera, tile)]
        if not seeing:
            return
        triangles += tile.triangles
        pixels = max(screen_error(camera, tile) for camera in seeing)
        if pixels > max_error and tile.children:
            heapq.heappush(queue, (-pixels, next(order), place, tile))
        else:
            chosen.append((place, tile))
            worst = max(worst, pixels)

    add(tileset.root, ())
    while queue:
        pixels, _, place, tile = heapq.heappop(queue)
        children = tileset.children(tile)
        if most is not None and triangles + sum(child.triangles for child in children) > most:
            chosen.append((place, tile))
            worst = max(worst, -pixels)
            continue
        triangles -= tile.triangles
        for i, child in enumerate(children):
            add(child, (*place, i))
    chosen.sort(key=lambda entry: entry[0])
    return [tile for _, tile in chosen], worst


def screen_error(camera: Camera, tile: Tile) -> float:
    """Geometric error of a tile in pixels, at the point of its box that is nearest to the camera."""
    offset = camera.center - tile.center
    lengths = np.maximum(np.linalg.norm(tile.axes, axis=1), 1e-30)
    along = (tile.axes / lengths[:, None]) @ offset
    outside = np.maximum(np.abs(along) - lengths, 0)
    assert camera.near is not None
    distance = max(float(np.linalg.norm(outside)), camera.near)
    return tile.error * max(camera.fx, camera.fy) / distance


def reaches(camera: Camera, tile: Tile) -> bool:
    """Whether the box of a tile may reach into the image: it is outside none of the planes of the frustum."""
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    center, axes = rotation @ tile.center + shift, tile.axes @ rotation.T
    planes = np.array(
        [
            [0, 0, 1],
            [camera.fx, 0, camera.cx],
            [-camera.fx, 0, camera.width - camera.cx],
            [0, camera.fy, camera.cy],
            [0, -camera.fy, camera.height - camera.cy],
        ],
        np.float64,
    )
    limits = np.array([camera.near, 0, 0, 0, 0])
    return bool((planes @ center + np.abs(planes @ axes.T).sum(axis=1) >= limits).all())


def render_tiles(
    tileset: Tileset,
    camera: Camera,
    *,
    max_error: float = MAX_ERROR,
    max_triangles: int = MAX_TRIANGLES,
    **options: Any,
) -> Rendering:
    """The image of a tileset: that of the mesh of the tiles that the camera needs.

    An image that needs more triangles than fit into memory is rendered in parts, which need fewer of them
    each.

    Args:
        tileset: the tileset.
        camera: viewpoint, lens and size of the image.
        max_error: screen-space error in pixels up to which a tile is drawn; 0 draws the leaves.
        max_triangles: triangles that are in memory together. A part of the image of ``SMALLEST`` pixels that
            needs more is drawn with the error that they allow.
        options: those of ``render``, other than ``attributes``.

    Raises:
        ValueError: an option out of its range.
        FileFormatError: a tile is broken.
    """
    need(Tileset, tileset=tileset)
    need(Camera, camera=camera)
    camera = tileset.seen_by(camera)
    tiles, _ = choose_tiles(tileset, [camera], max_error=max_error)
    if sum(tile.triangles for tile in tiles) <= max_triangles:
        return render(join_tiles(tileset, tiles), camera, **options)
    if max(camera.width, camera.height) <= SMALLEST:
        tiles, _ = choose_tiles(tileset, [camera], max_error=max_error, most=max_triangles)
        return render(join_tiles(tileset, tiles), camera, **options)
    axis = int(camera.width >= camera.height)
    middle = (camera.height, camera.width)[axis] // 2
    parts = []
    background = np.asarray(options.pop("background", (1, 1, 1)), np.float32)
    for start, part in zip((0, middle), _halves(camera, axis, middle), strict=True):
        own = background
        if background.ndim == 3:
            own = (
                background[start : start + part.height]
                if axis == 0
                else background[:, start : start + part.width]
            )
        parts.append(
            render_tiles(
                tileset, part, max_error=max_error, max_triangles=max_triangles, background=own, **options
            )
        )
    return _side_by_side(parts, axis)


def tiles_mesh(
    tileset: Tileset,
    cameras: Sequence[Camera],
    *,
    max_error: float = MAX_ERROR,
    max_triangles: int = MAX_TRIANGLES,
) -> tuple[SplatMesh, float]:
    """One mesh of the tiles that ``cameras`` need together, and its largest error in pixels.

    The error is larger than ``max_error`` where the tiles that the cameras need have more than
    ``max_triangles`` triangles.

    Args:
        tileset: the tileset.
        cameras: viewpoints, lenses and sizes of the images.
        max_error: screen-space error in pixels up to which a tile is fine enough; 0 takes the leaves.
        max_triangles: maximum number of triangles.

    Raises:
        ValueError: an option out of its range; no tile is in any of the images.
        FileFormatError: a tile is broken.
    """
    need(Tileset, tileset=tileset)
    need_all(Camera, cameras=cameras)
    tiles, worst = choose_tiles(tileset, cameras, max_error=max_error, most=max_triangles)
    if not tiles:
        raise ValueError(f"{tileset.path}: none of the cameras sees any of it")
    return join_tiles(tileset, tiles), worst


def samples_for(tileset: Tileset, cameras: Sequence[Camera], max_error: float = MAX_ERROR) -> int:
    """Side of the grid of samples in each pixel that the tiles need; see ``needed_samples``."""
    found = 1
    for camera in map(tileset.seen_by, subsample(cameras, CAMERAS)):
        tiles, _ = choose_tiles(tileset, [camera], max_error=max_error, most=MAX_TRIANGLES // 8)
        found = max(found, needed_samples(join_tiles(tileset, tiles), [camera]))
    return found


def join_tiles(tileset: Tileset, tiles: Sequence[Tile]) -> SplatMesh:
    """The triangles of ``tiles`` as one mesh. ``face_splat`` numbers its splats anew."""
    triangles = sum(tile.triangles for tile in tiles)
    if triangles > np.iinfo(np.int32).max:
        raise ValueError(f"{triangles:,} triangles are more than a mesh can number")
    nothing = SplatMesh(np.empty((0, 3)), np.empty((0, 3), int), np.empty((0, 4)), up=tileset.up)
    parts = [_in_tileset(tile, tileset) for tile in tiles] or [replace(nothing, origin=tileset.origin)]
    return SplatMesh.joined(parts)


def _in_tileset(tile: Tile, tileset: Tileset) -> SplatMesh:
    mesh = tile.load()
    if mesh.face_splat is None:
        raise ValueError(f"{tile.content}: another program has altered the tile: it has no splat indices")
    return replace(mesh, up=tileset.up, origin=tileset.origin)


def _halves(camera: Camera, axis: int, middle: int) -> tuple[Camera, Camera]:
    """Cameras of the upper and the lower (``axis`` 0) or the left and the right part of the image."""
    width, height = camera.width, camera.height
    if axis == 0:
        return camera.window(0, 0, width, middle), camera.window(0, middle, width, height - middle)
    return camera.window(0, 0, middle, height), camera.window(middle, 0, width - middle, height)


def _side_by_side(parts: Sequence[Rendering], axis: int) -> Rendering:
    def joined(name: str) -> Any:
        arrays = [getattr(part, name) for part in parts]
        return None if arrays[0] is None else np.concatenate(arrays, axis=axis)

    return Rendering(
        joined("color"),
        joined("alpha"),
        joined("depth"),
        joined("normals"),
        fragments=sum(part.fragments for part in parts),
        median_depth=joined("median_depth"),
    )
