"""What surrounds a place, told from floaters: walls and skies of few, large splats look like these to rules
that count neighbours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from meshsplats._common.arrays import subsample
from meshsplats.cameras.trajectories import look_at
from meshsplats.conversion.cleaning import Findings, find
from meshsplats.conversion.cleaning_rules import FLOATERS
from meshsplats.conversion.recovery import splats_of
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import scatter_to_vertices
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints.showing import default_views

PLACES = 8
"""Places that are looked around from."""
SIDE = 96
"""Pixels along a face of these panoramas, each 90 degrees wide."""
WINDOW = 25
"""Side in pixels of the window around a pixel: wider than floaters are."""
FARTHER = 1.25
"""Factor of depth from which on something lies behind a pixel and not beside it."""
BEHIND = 0.5
"""Share of the window that lies behind: a floater has more, the surroundings less."""
LEAST_SHARE = 0.1
"""Of a pixel, that splats in question must have."""
LEAST_PIXELS = 1.0
"""That a splat must cover, in all panoramas together, to count as seen."""
MOST = 500_000
"""Splats in the panoramas. Of larger scenes, every k-th one stands for k."""
MOST_OPACITY = 0.5
"""Share of all opacity that a rule for floaters may take."""
_STATISTICAL = ("sparse", "min_part")
"""The rules that walls and skies break, too."""


def floaters(
    scene: GaussianCloud | SplatMesh, source: Path | None = None, *, threads: int | None = None
) -> Findings:
    """What ``FLOATERS`` finds, without the surroundings of a place.

    Where the scene is no object, it is seen from the cameras beside ``source``, its file or folder, else from
    those that ``find_cameras`` finds; for a mesh, in the splats that its fans were. The ``camera`` of the
    result shows a place from within.
    """
    found = find(scene, FLOATERS, MOST_OPACITY)
    if found.kept.all():
        return found
    cloud = splats_of(scene)
    views = cloud and default_views(cloud, source, PLACES, side=(480, 480), threads=threads)
    if not views:
        return found
    return without_surroundings(scene, replace(found, camera=views[0][0]), views[0], threads=threads)


def without_surroundings(
    scene: GaussianCloud | SplatMesh,
    found: Findings,
    cameras: Sequence[Camera],
    *,
    threads: int | None = None,
) -> Findings:
    """``found`` in ``scene``, less what surrounds the places of the ``cameras``.

    Panoramas from there tell by depth. A floater hangs before other things, or before nothing: most of what
    is around it in the image is farther away. Beside a piece of a wall there is more of the wall, and
    whatever stands before it. Only splats that have few neighbours or belong to small parts are asked for;
    what no panorama shows stays found.
    """
    asked = np.any([found.gone[name] for name in _STATISTICAL if name in found.gone], axis=0)
    others = [mask for name, mask in found.gone.items() if name not in _STATISTICAL]
    asked &= ~np.any(others, axis=0) if others else True
    if not asked.any() or (isinstance(scene, SplatMesh) and scene.face_splat is None):
        return found
    mesh, rows = _as_mesh(scene, asked, threads)
    owner = rows[mesh.splats.numbers[mesh.splats.of_vertex]] if isinstance(scene, GaussianCloud) else rows
    n = len(asked)
    values = np.zeros((len(owner), 2), np.float32)
    values[:, 0] = asked[owner]
    engine, options = CpuEngine(threads), TapeOptions((0, 0, 0), 1)
    seen, surrounding = np.zeros(n), np.zeros(n)
    for camera in (face for place in subsample(cameras, PLACES) for face in _panorama(place)):
        values[:, 1] = np.linalg.norm(mesh.vertices - camera.center.astype(np.float32), axis=1)
        image = engine.tape(mesh.triangles._replace(values=values), camera, options)
        share, depth = image.attributes[..., 0], image.attributes[..., 1]
        alpha = image.alpha.reshape(share.shape)
        depth = np.where(alpha > 0.3, depth / np.maximum(alpha, 1e-6), np.inf)
        beside = (share > LEAST_SHARE) & (_behind(depth) < BEHIND)
        sums = scatter_to_vertices(image, np.stack([np.ones_like(share), beside], axis=2))
        seen += np.bincount(owner, sums[:, 0], n)
        surrounding += np.bincount(owner, sums[:, 1], n)
    spared = asked & (surrounding > 0.5 * seen) & (surrounding > LEAST_PIXELS)
    return replace(
        found, gone={name: mask & ~spared for name, mask in found.gone.items()}, surroundings=spared
    )


def _as_mesh(
    scene: GaussianCloud | SplatMesh, asked: np.ndarray, threads: int | None
) -> tuple[SplatMesh, np.ndarray]:
    """Triangles to draw the scene with. Of splats: all that are ``asked`` (n,) for, of many others only some,
    wider; and the row of each. Of a mesh: itself, and the (v,) splat of each vertex."""
    from meshsplats.conversion import convert

    if isinstance(scene, SplatMesh):
        return scene, scene.splats.of_vertex
    step = -(-len(scene) // MOST)
    rest = np.flatnonzero(~asked)[::step]
    rows = np.sort(np.concatenate([np.flatnonzero(asked), rest]))
    thin = scene.take(rows)
    wider = np.where(asked[rows], 1, step**0.5).astype(np.float32)
    # Which filter the splats were trained with makes no difference to what is behind what.
    thin = replace(thin, sh=thin.sh[:, :1], scales=thin.scales * wider[:, None], kernel="3dgs")
    mesh = convert(thin, mode="flat", detail="even", sides=4, rings=1, footprint="filter", threads=threads)
    return mesh, rows


def _panorama(camera: Camera) -> Iterator[Camera]:
    """The six views of a cube around the place of ``camera``."""
    axes = camera.world_to_camera[:3, :3]
    for gaze, up in zip((*axes, *-axes), (*axes[[1, 2, 0]], *axes[[1, 2, 0]]), strict=True):
        there = camera.center + gaze
        yield look_at(camera.center, there, up=up, width=SIDE, height=SIDE, fov=90, near=camera.near)


def _behind(depth: np.ndarray) -> np.ndarray:
    """(h, w) share of the window around each pixel whose ``depth`` (h, w) is ``FARTHER`` times its own."""
    windows = sliding_window_view(np.pad(depth, WINDOW // 2, mode="edge"), (WINDOW, WINDOW))
    result = np.empty(depth.shape)
    for row, own in enumerate(depth):  # a row at a time, since windows are many
        result[row] = (windows[row] > FARTHER * own[:, None, None]).mean(axis=(1, 2))
    return result
