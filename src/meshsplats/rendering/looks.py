"""What a picture of splats is the truth of: the splat viewer's, or what a pixel's area holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from meshsplats.camera import Camera
from meshsplats.colors import linear_to_srgb, srgb_to_linear
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.api import Rendering, render, render_splats
from meshsplats.rendering.samples import needed_samples

Look = Literal["area", "splats"]
"""area: each pixel is the mean over its area, which is what photographs are, and what Blender, engines with
MSAA and every ray tracer show. splats: as a 3DGS viewer draws them, with its filter of 0.3 px^2 at the size
of the image: fatter when small, thinner when near."""

AREA = 4
"""The mean over a pixel's area is that of an image so many times as large."""

DILATION = 0.3
"""Variance of the filter of 3DGS, square pixels."""


def check_look(look: str) -> None:
    """ValueError for a look that does not exist."""
    if look not in get_args(Look):
        raise ValueError(f"look must be {' or '.join(get_args(Look))}, got {look!r}")


def mesh_samples(look: Look, mesh: SplatMesh, cameras: Sequence[Camera]) -> int:
    """Side of the grid of samples in each pixel with which ``mesh`` is compared with that look from
    ``cameras``: 1 for 'splats', as many as it needs for 'area'."""
    return 1 if look == "splats" else needed_samples(mesh, cameras)


def draw_splats(
    cloud: GaussianCloud,
    camera: Camera,
    look: Look = "area",
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    samples: int | None = None,
    sh_degree: int | None = None,
    threads: int | None = None,
) -> Rendering:
    """The image of the splats that a mesh should match, as ``look`` has it.

    'splats' is ``render_splats`` with its defaults. 'area' is the mean over ``AREA`` x ``AREA`` blocks of the
    image that is ``AREA`` times as large. It is drawn as that many samples in each pixel, with the filter of
    the larger image, 0.3 / 16 px^2: the same sums.

    Args:
        background: RGB, (3,) or (h, w, 3).
        samples: side of the grid of samples in each pixel; None: ``AREA`` for 'area', 1 for 'splats'. For
            'area', 2 cost half of the time and are within 48 to 56 dB of the mean, and 1 gives the values at
            the pixels' centres, of which the mean is made.
        sh_degree, threads: as in ``render_splats``.

    Raises ValueError for an option out of its range.
    """
    check_look(look)
    area = look == "area"
    return render_splats(
        cloud,
        camera,
        background=background,
        samples=(AREA if area else 1) if samples is None else samples,
        sh_degree=sh_degree,
        dilation=DILATION / AREA**2 if area else DILATION,
        threads=threads,
    )


def image_of(
    mesh: SplatMesh,
    camera: Camera,
    background: Sequence[float],
    *,
    samples: int = 1,
    max_layers: int | None = None,
    threads: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) display RGB over a display ``background`` and (h, w) alpha, blended in the space that the
    mesh was made for: a mesh of linear colours is blended in linear light and encoded after."""
    linear = mesh.blending == "linear"
    behind = srgb_to_linear(np.asarray(background)) if linear else background
    drawn = render(mesh, camera, background=behind, samples=samples, max_layers=max_layers, threads=threads)
    return (linear_to_srgb(drawn.color) if linear else drawn.color), drawn.alpha
