"""What splats count when similar ones are merged for cameras: the pixels that show them.

A splat that others hide, or that lies where no camera looks, may become coarse: what is merged for a budget
is then what nobody sees, not what is seen best.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.chunks import chunks
from meshsplats._core.neighbours import nearest
from meshsplats.conversion.driver import Driver
from meshsplats.conversion.footprint import CameraCoverage, SceneSample, SceneViews
from meshsplats.conversion.options import ConversionOptions
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import visible_pixels
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud

HIDDEN = 0.2
"""What a splat counts that others hide from a camera, relative to one that nothing hides."""

AROUND = 8
"""A splat counts as visible as the most visible one of so many neighbours: what is merged just below a
surface would come out of it, above all in fur."""

CLEAREST = 2.0
"""The most that it is taken to be visible, relative to a splat that nothing hides: images have noise."""

ELSEWHERE = 0.005
"""What a splat that no camera looks at counts, relative to one that all of them see from the nearest one."""

NEAREST = 0.01
"""Share of the splats that may be nearer to cameras than the distance from which on that counts."""

MOST = 1_000_000
"""Splats of which images are rendered to see what is hidden; in a larger cloud nothing counts as hidden."""

CHUNK = 1 << 13
"""Splats whose distances are computed together: so many stay in the cache."""

IMAGES = 8
SIDE = 400
"""Number and side of these images, at most."""


def pixels_of(
    cloud: GaussianCloud, masses: np.ndarray, coverage: CameraCoverage, threads: int | None = None
) -> np.ndarray:
    """(n,) float64 pixels of the mean image of the cameras of ``coverage``, which is that of ``cloud``, that
    splats with these ``masses`` (n,) count for: those that show them, and a little more for those that do
    not.

    Of more than ``MOST`` splats, the pixels that their masses cover are taken instead.
    """
    covered = coverage.densities() * masses
    square = _nearest_squares(cloud.means, coverage.cameras)
    least = max(float(np.quantile(square, NEAREST)), float(np.finfo(np.float32).tiny))
    focal = float(np.mean([camera.fx * camera.fy for camera in coverage.cameras]))
    elsewhere = ELSEWHERE * focal * masses / np.maximum(square, np.float32(least))
    if len(cloud) > MOST:
        return covered + elsewhere
    visible = _visible(cloud, masses > 0, coverage.cameras, threads)
    shown = np.divide(visible, masses, out=np.zeros(len(cloud)), where=masses > 0)
    clearest = np.minimum(_greatest_around(cloud.means, shown, threads) * masses, CLEAREST * covered)
    return clearest + HIDDEN * covered + elsewhere


def _nearest_squares(means: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(n,) float32 squares of the distances of ``means`` (n, 3) from the nearest of ``cameras``."""
    square = np.full(len(means), np.inf, np.float32)
    centers = [camera.center.astype(np.float32)[:, None] for camera in cameras]
    for part in chunks(len(means), CHUNK):
        points = np.ascontiguousarray(means[part].T)
        for center in centers:
            x, y, z = points - center
            np.minimum(square[part], x * x + y * y + z * z, out=square[part])
    return square


def _greatest_around(means: np.ndarray, values: np.ndarray, threads: int | None) -> np.ndarray:
    """(n,) greatest of the ``values`` (n,) of each splat and of its neighbours."""
    neighbours = min(AROUND, len(means) - 1)
    if neighbours < 1:
        return values
    order, near = nearest(means, neighbours, threads)
    own = values[order]
    result = np.empty(len(values))
    result[order] = np.maximum(own, own[near].max(axis=1))
    return result


def _visible(
    cloud: GaussianCloud, drawn: np.ndarray, cameras: Sequence[Camera], threads: int | None
) -> np.ndarray:
    """(n,) float64 pixels of the mean image of ``cameras`` that show each splat; 0 for those that are not
    ``drawn`` (n,)."""
    # Round splats that are seen edge-on have neighbours that are not.
    options = ConversionOptions(mode="flat", sides=4, footprint="none", colors="base")
    chosen = options.resolved("default", has_cameras=False)
    up = np.array([0.0, 0.0, 1.0])  # of the mesh: nothing here depends on it
    rows = np.flatnonzero(drawn).astype(np.int32)
    part = cloud.of_degree(0).take(rows)
    driver = Driver(chosen, SceneViews(SceneSample.of(part), chosen, None, up), up, cloud.origin)
    piece = driver.sized(part, rows, None)
    keep = driver.has_area(piece)
    result = np.zeros(len(cloud))
    if not keep.any():
        return result
    mesh = driver.mesh(piece, keep)
    splats, engine = mesh.splats, CpuEngine(threads)
    owner = splats.numbers[splats.of_vertex]
    some = subsample(cameras, IMAGES)
    for own in some:
        camera = own.within(SIDE).with_near_plane(mesh.vertices)
        shown = visible_pixels(engine, mesh.triangles, camera)
        scale = own.width * own.height / (camera.width * camera.height * len(some))
        result += scale * np.bincount(owner, shown, len(cloud))
    return result
