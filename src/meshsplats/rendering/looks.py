"""Two looks of an image of splats, the ground truth of a mesh: means over pixels, or a splat viewer's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np

from meshsplats._common.choices import Device, Look
from meshsplats._common.kinds import need
from meshsplats.rendering.api import Rendering, render, render_splats
from meshsplats.rendering.backward import TapedRendering, TapeOptions
from meshsplats.rendering.samples import needed_samples
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.gaussians import DILATION, GaussianCloud
from meshsplats.scene.mesh import SplatMesh

GROUND_TRUTHS: dict[Look, str] = {
    "area": "splats as means over each pixel's area",
    "splats": "splats as a 3DGS viewer renders them at this size",
}
"""The looks in words."""

AREA = 4
"""The mean over a pixel's area is taken from an image this many times as large."""


def check_look(look: str) -> None:
    """ValueError for a look that does not exist."""
    if look not in get_args(Look):
        raise ValueError(f"look must be {' or '.join(get_args(Look))}, got {look!r}")


def comparison_in_words(look: Look, samples: int) -> str:
    """What a score of a mesh compares."""
    return f"look {look}: {GROUND_TRUTHS[look]}; the mesh with {samples} x {samples} samples per pixel"


def mesh_samples(look: Look, mesh: SplatMesh, cameras: Sequence[Camera]) -> int:
    """Side of the grid of samples in each pixel for comparing ``mesh`` with images of that ``look`` from
    ``cameras``: 1 for 'splats', ``needed_samples`` for 'area'."""
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
    """The image of the splats that a mesh should match, in that ``look``.

    'splats' is ``render_splats`` with its defaults. 'area' is the mean over ``AREA`` x ``AREA`` blocks of the
    image that is ``AREA`` times as large. It is computed from that many samples in each pixel, with the
    filter of the larger image, 0.3 / 16 px^2: the same sums.

    Args:
        background: RGB, (3,) or (h, w, 3).
        samples: side of the grid of samples in each pixel; None: ``AREA`` for 'area', 1 for 'splats'. For
            'area', 2 takes half the time and comes within 48 to 56 dB of the mean; 1 gives the values at the
            pixels' centres.
        sh_degree, threads: as in ``render_splats``.

    Raises ValueError for an option out of its range.
    """
    need(GaussianCloud, cloud=cloud, instead={"SplatMesh": "render draws meshes"})
    need(Camera, camera=camera)
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
    device: Device = "cpu",
    listing: DrawOrder | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) display RGB over a display ``background``, and (h, w) alpha.

    The mesh is blended in its own space: one with linear colours in linear light, encoded for display
    afterwards. With ``listing``, a mesh for display blending is drawn as viewers draw a file with that order:
    in its plain colours, all layers, by the processor. The other arguments are those of ``render``.
    """
    if listing is not None:
        options = TapeOptions(background, samples, listing=listing)
        shown = TapedRendering(mesh.plain.triangles, camera, options, threads=threads, tape_bytes=None)
        return shown.color, shown.alpha
    linear = mesh.blending == "linear"
    backdrop = srgb_to_linear(np.asarray(background)) if linear else background
    drawn = render(
        mesh,
        camera,
        background=backdrop,
        samples=samples,
        max_layers=max_layers,
        threads=threads,
        device=device,
    )
    return (linear_to_srgb(drawn.color) if linear else drawn.color), drawn.alpha
