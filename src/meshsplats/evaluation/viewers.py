"""Which alpha mode suits a mesh in viewers that do not sort triangles: measured on images of both."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.cameras.trajectories import orbit
from meshsplats.errors import DataWarning
from meshsplats.formats.cutting import CUTOFF
from meshsplats.formats.gltf.writer import Alpha
from meshsplats.formats.mesh_formats import takes
from meshsplats.rendering.api import render
from meshsplats.rendering.layers import affordable, layers
from meshsplats.rendering.viewers import viewer_images
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh, solid_faces

CUTOFFS = (0.1, CUTOFF, 0.3)
"""Cutoffs of 'mask' that are tried. Each is the best on some scene; 0.5 was on none of ten."""
CUTOFF_GAIN = 0.75
"""A cutoff other than the usual one must gain this much, dB, pixel by pixel: a smaller gain may be a loss
against the splats, or in larger images."""
MASK_GAIN = 0.5
"""'mask' must gain this much, dB: its edges are hard, and it never wins where a viewer sorts."""
AREA = 4
"""Side in pixels of the areas whose mean colours tell 'mask' from 'blend'. What is drawn late and shows
through the front is wrong in all of an area, the grain of hard edges is not: with 'blend', a truck and the
face of a robot are missing in images that pixel by pixel are up to 2 dB nearer to the sorted one."""
SIDE = 400
"""Side in pixels of the images."""
VIEWS = 4
"""Largest number of images of a mesh of at most ``TRIANGLES``; fewer of larger ones, but two at least."""
TRIANGLES = 3_000_000
CLEAR = 2.0
"""Two images suffice where they differ by this much, dB."""
FRAGMENTS = 1e9
"""Largest number of fragments of an image: of a scene that has more, it is smaller."""
SOLID = 0.5
"""Share of solid triangles above which a mesh is one of solid triangles with a few soft ones."""
_MOST = 200.0
_SAMPLES = 4
"""Side of the grid of samples of one image that costs as much as those of a view together."""


@dataclass(frozen=True)
class AlphaChoice:
    """The alpha mode of a `.glb` file for viewers that do not sort, and what it was chosen for."""

    alpha: Alpha
    """'blend' or 'mask'; 'opaque' for a solid mesh and 'hybrid' for one that is mostly solid, without
    measurement; 'blend', too, where images would have too many layers."""
    cutoff: float | None = None
    """The cutoff of 'mask' that was compared: the best one."""
    blend: float | None = None
    """PSNR in dB of such viewers' images with 'blend' against the sorted image of the same mesh, both
    averaged over areas of 4 x 4 pixels, from the mean square error over all views."""
    mask: float | None = None
    """That with 'mask' and ``cutoff``."""

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of ``save_mesh``."""
        if self.alpha == "opaque":
            return {}  # its default for a solid mesh, which needs no cut
        return {"alpha": self.alpha} | ({"cutoff": self.cutoff} if self.alpha == "mask" else {})

    def in_words(self) -> str | None:
        """A line about the measurement; None where nothing was measured."""
        if self.blend is None:
            return None
        modes = {"blend": "blend", "mask": f"mask with cutoff {self.cutoff:g}"}
        other = "mask" if self.alpha == "blend" else "blend"
        best, rest = getattr(self, self.alpha), getattr(self, other)
        near = "equal to" if best >= _MOST else f"{best:.1f} dB from"
        sorting = (
            "" if self.alpha == "blend" else " (``alpha`` blend for ray tracers and Blender's own importer)"
        )
        return (
            f"alpha: {modes[self.alpha]}, {near} the sorted image in viewers that do not sort, seen from"
            f" afar; {modes[other]}: {'equal' if rest >= _MOST else f'{rest:.1f} dB'}{sorting}"
        )


def choose_alpha(
    mesh: SplatMesh,
    cameras: Sequence[Camera] | None = None,
    *,
    threads: int | None = None,
) -> AlphaChoice:
    """The alpha mode with which viewers that do not sort triangles come nearest to the sorted image of
    ``mesh``: three.js and what is built on it, Babylon.js, most engines.

    Draws the mesh as such viewers do, with MSAA (``viewer_images``), blended and with an alpha test, and
    takes the better. A mesh of many layers is better with the test: what is drawn late shows through the
    front.

    Args:
        mesh: the mesh, its triangles in the order of the file.
        cameras: where it will be seen from; a few of them are used, in images of at most ``SIDE`` pixels. By
            default an orbit.
        threads: at most this many; all processors by default. The result does not depend on it.

    Raises ValueError for a mesh without triangles.
    """
    if not len(mesh.faces):
        raise ValueError("a mesh without triangles has no alpha mode to choose")
    solid = solid_faces(mesh).mean()
    if solid == 1:
        return AlphaChoice("opaque")
    if solid > SOLID and mesh.binding is None:  # which 'hybrid' does not keep
        return AlphaChoice("hybrid")
    count = int(np.clip(VIEWS * TRIANGLES // len(mesh.faces), 2, VIEWS))
    views = [camera.within(SIDE) for camera in subsample(cameras or (), count)]
    if not views:
        around = orbit(mesh, count, elevation=20, width=SIDE, height=SIDE)
        views = [*around[::2], *around[1::2]]  # the second from the other side
    cheap = [small for view in views if (small := affordable(mesh, view, _SAMPLES, FRAGMENTS))]
    if not cheap:
        warnings.warn(
            f"the alpha mode is 'blend', without measurement: about {layers(mesh, views[0]):,.0f} layers"
            " overlap at each pixel of the images, which would take too long to render",
            DataWarning,
            stacklevel=2,
        )
        return AlphaChoice("blend")
    views = cheap
    return choose_by_views(((mesh, view) for view in views), threads=threads)


def alpha_for_viewers(
    mesh: SplatMesh, path: str | os.PathLike[str], threads: int | None = None
) -> dict[str, Any]:
    """Arguments of ``save_mesh`` for the alpha mode of ``choose_alpha``, where ``path`` is a .glb; none for
    other files and empty meshes."""
    measured = takes(os.fspath(path), "alpha") and len(mesh.faces)
    return choose_alpha(mesh, threads=threads).options if measured else {}


def area_means(image: np.ndarray) -> np.ndarray:
    """(h / AREA, w / AREA, c) float64, rounded up: means over areas of (h, w, c) ``image``, of which those at
    its right and lower edge may be smaller."""
    sums, sizes = image.astype(np.float64), np.ones(image.shape[:2])
    for axis in (0, 1):
        starts = np.arange(0, image.shape[axis], AREA)
        sums, sizes = np.add.reduceat(sums, starts, axis), np.add.reduceat(sizes, starts, axis)
    return sums / sizes[..., None]


def choose_by_views(views: Iterable[tuple[SplatMesh, Camera]], *, threads: int | None = None) -> AlphaChoice:
    """``choose_alpha`` by these views, each with what a viewer draws of the scene there. A DataWarning says
    that nothing is seen from any of them; 'blend' is then no result of measurement."""
    near, far = np.zeros((2, 1 + len(CUTOFFS)))
    number = 0
    for mesh, view in views:
        drawn = render(mesh, view, samples=2, threads=threads)
        if not drawn.alpha.any():
            continue
        number += 1
        truth = drawn.color.clip(0, 1)
        differences = [
            image - truth for image in viewer_images(mesh, view, (None, *CUTOFFS), threads=threads)
        ]
        near += [np.square(difference, dtype=np.float64).mean() for difference in differences]
        far += [np.square(area_means(difference)).mean() for difference in differences]
        blend, *masks = _decibels(far / number)
        if number > 1 and abs(max(masks) - blend) > CLEAR:
            break
    if not number:
        text = "the alpha mode is 'blend', without measurement: the images show nothing of the scene"
        warnings.warn(text, DataWarning, stacklevel=2)
        return AlphaChoice("blend")
    sharp = _decibels(near[1:])
    best = int(np.argmax(sharp))
    if sharp[best] <= sharp[CUTOFFS.index(CUTOFF)] + CUTOFF_GAIN:
        best = CUTOFFS.index(CUTOFF)
    chosen: Alpha = "mask" if masks[best] > blend + MASK_GAIN else "blend"
    return AlphaChoice(chosen, CUTOFFS[best], round(float(blend), 2), round(float(masks[best]), 2))


def _decibels(errors: np.ndarray) -> np.ndarray:
    return np.minimum(-10 * np.log10(np.maximum(errors, 1e-30)), _MOST)
