"""Images that show at a glance what a file holds, made smaller where they would take long."""

from __future__ import annotations

import os
from typing import Any

from meshsplats.cameras.trajectories import orbit
from meshsplats.images.writing import save_image
from meshsplats.rendering.api import render_splats
from meshsplats.rendering.layers import affordable
from meshsplats.rendering.looks import image_of
from meshsplats.rendering.samples import FEWEST, needed_samples
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

TRIANGLES = 1_000_000
"""Triangles of a mesh above which its preview is half as wide, with the fewest samples. Of 2 to 17 million
triangles, it is 36 to 39 dB from one with all samples, in a sixth of the time."""
FRAGMENTS = 1e9
"""Fragments above which a preview is made smaller, or not at all: some 10 s of one processor. Of real scenes,
previews have 1e7 to 4e8."""
USUAL = 30.0
"""Degrees of azimuth: in front and a little to the side, which shows more of the shape."""
SIDE = 800
"""Longer side of previews in pixels, at least."""


def preview_camera(scene: SplatMesh | GaussianCloud, azimuth: float = USUAL) -> Camera:
    """A view of the whole of ``scene`` from ``azimuth``, degrees."""
    return orbit(scene, 1, azimuth=azimuth, width=SIDE, height=SIDE)[0]


def save_preview(
    scene: SplatMesh | GaussianCloud,
    path: str | os.PathLike[str],
    camera: Camera | None = None,
    listing: DrawOrder | None = None,
    *,
    threads: int | None = None,
) -> bool:
    """Saves an image of ``scene`` from ``camera``, by default ``preview_camera``; of a mesh as viewers draw a
    file with the order ``listing``, where there is one. ``threads``: at most this many. Returns False, and
    saves nothing, if it would have more than ``FRAGMENTS`` at an eighth of the size, too."""
    camera = preview_camera(scene) if camera is None else camera
    camera = camera.scaled(max(1.0, SIDE / max(camera.width, camera.height)))
    samples = 1
    if isinstance(scene, SplatMesh):
        if len(scene.faces) <= TRIANGLES:
            samples = needed_samples(scene, [camera])
        else:
            camera, samples = camera.scaled(0.5), 1 if scene.filter_px2 else FEWEST
    small = affordable(scene, camera, samples, FRAGMENTS)
    if small is None:
        return False
    if isinstance(scene, SplatMesh):
        how: dict[str, Any] = {"samples": samples, "threads": threads, "listing": listing}
        image = image_of(scene, small, (1, 1, 1), **how)[0]
    else:
        image = render_splats(scene, small, threads=threads).color
    save_image(path, image.clip(0, 1))  # some splats are far brighter than white
    return True
