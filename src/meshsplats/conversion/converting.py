"""convert: a splat cloud as a mesh of translucent triangle fans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from meshsplats._common.choices import Look
from meshsplats._common.kinds import need, need_all
from meshsplats._core.library import check_threads
from meshsplats.cameras.framing import guess_up, unit_up
from meshsplats.conversion.budget import within_limits
from meshsplats.conversion.detail import FIRST_STAR, LEVELS, OnImage, choose_levels, visibility
from meshsplats.conversion.driver import Driver, drawn_part, filter_of, worth_drawing
from meshsplats.conversion.fan_sizes import ellipse
from meshsplats.conversion.footprint import SceneSample, SceneViews
from meshsplats.conversion.merging import simplify_large
from meshsplats.conversion.options import ConversionOptions, Preset, make_options
from meshsplats.conversion.selection import most_important, refuse_empty_box, within
from meshsplats.conversion.stars import STARS
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.conversion.options import ConversionChanges


def convert(
    cloud: GaussianCloud,
    options: ConversionOptions | None = None,
    *,
    preset: Preset = "default",
    cameras: Sequence[Camera] | None = None,
    up: Sequence[float] | np.ndarray | None = None,
    threads: int | None = None,
    on_image: OnImage | None = None,
    **changes: Unpack[ConversionChanges],
) -> SplatMesh:
    """Turns every splat into one or more fans of translucent triangles around its centre.

    ``preset='paper'`` is the conversion of MeshSplats (arXiv 2502.07754): the two largest axes of a splat
    span an ellipse of 8 triangles with a radius of 2.7 standard deviations, whose opacity falls linearly from
    the splat's at the centre to a fifth of it at the rim; with ``mode='3d'``, there are three such ellipses.
    ``preset='default'`` has the same number of triangles and comes closer to the image of the splats: two
    crossed ellipses of 4 triangles, rim opacity 0, a falloff fitted to the Gaussian and its integrated
    opacity. With ``look='splats'`` they are also widened by the low-pass filter of splat viewers.

    Args:
        cloud: the splats.
        options: what to do otherwise than ``preset`` does; fields that are None are the preset's.
        preset: 'default' or 'paper'.
        cameras: where the mesh will be seen from. They give the size of a pixel at each splat
            (``footprint``), the mean colour if asked for (``colors``) and what is up. Without them, images
            of the whole subject are assumed.
        up: direction that points up, world frame; by default that of the cameras, of the file (``cloud.up``),
            of a survey (z, where the coordinates of the cloud are those of one), or (0, -1, 0). Meshes with
            other ups are not joined.
        threads: at most this many, for splats that are merged and for the images of ``detail='cameras'``;
            all processors by default.
        on_image: called after each of these images, with how many are rendered and how many there will be;
            if it returns False, those so far have to do, but at least 6.
        changes: fields of ``ConversionOptions``, which says what they mean, in place of those of
            ``options``: ``convert(cloud, max_triangles=500_000)``.

    Returns:
        A mesh whose vertices are ordered by splat; within a splat the centre comes first, then the rings from
        the inside out, each in order around the ellipse. ``face_splat`` holds rows of ``cloud``; where a
        limit made splats merge (``budget``), rows of the merged splats, which are in the order of the first
        splat in each. Triangles at the centre list it first, and all triangles of an ellipse have the same
        winding.

    Raises:
        TypeError: an option that does not exist.
        ValueError: an option out of range, options that contradict each other, or no splat left to convert.
    """
    need(GaussianCloud, cloud=cloud)
    need(ConversionOptions, options=options, optional=True)
    need_all(Camera, cameras=cameras, optional=True)
    check_threads(threads)
    given = make_options(options, **changes)
    chosen = given.resolved(preset, has_cameras=bool(cameras))
    filter_px2 = filter_of(cloud.kernel, chosen)
    direction = guess_up(cloud, cameras) if up is None else unit_up(up)
    rows = worth_drawing(cloud, chosen).astype(np.int32)
    if not len(rows):
        _refuse_nothing(cloud, chosen)
    part = drawn_part(cloud, rows, chosen)
    chosen, count = within_limits(given, chosen, len(part))
    whole = part
    if chosen.budget == "merge" and count < len(part):
        cloud = part = simplify_large(part, count, cameras, threads)
        rows = np.arange(count, dtype=np.int32)
    views = SceneViews(SceneSample.of(part), chosen, cameras, direction, whole=True)
    driver = Driver(chosen, views, direction, cloud.origin, filter_px2)

    pixel = views.pixel_sizes(part.means)
    piece = driver.sized(part, rows, pixel)
    keep = driver.has_area(piece)
    if not keep.any():
        raise ValueError(f"none of the {len(part)} splats has a visible area")
    fans = piece.fans
    if count < len(part):
        importance = fans.opacity * fans.shadow
        if chosen.footprint == "cameras" and pixel is not None:
            importance = importance / np.square(pixel)
        # Splats without area come last.
        importance[~keep] = -1
        keep &= most_important(importance, count)
    mesh = driver.mesh(piece, keep)
    if chosen.detail == "cameras":
        wanted: Look = "splats" if chosen.footprint == "filter" else chosen.look or "area"
        shown = visibility(
            mesh, cloud.means, whole, cameras or (), wanted, threads=threads, on_image=on_image
        )
        visible = keep & ~shown.hidden[rows]
        keep = visible if visible.any() else keep
        budget = len(mesh.faces) if chosen.max_triangles is None else chosen.max_triangles
        choice = fans.choice.copy()
        choice[keep] = choose_levels(shown.need[rows[keep]], budget)
        thick = fans.sigma[:, 2] > chosen.flat_below * fans.sigma[:, :2].min(axis=1)
        choice[thick & (choice >= FIRST_STAR)] += len(STARS)
        levels = [ellipse(sides, rings, chosen) for sides, rings in LEVELS]
        detailed = fans._replace(shapes=[*levels, *STARS], choice=choice)
        mesh = driver.mesh(replace(piece, fans=detailed), keep)
    return mesh


def _refuse_nothing(cloud: GaussianCloud, options: ConversionOptions) -> NoReturn:
    """Raises ValueError where no splat of ``cloud`` is worth drawing."""
    if len(cloud) == 0:
        raise ValueError("the cloud has no splats: there is nothing to convert")
    if options.crop is not None:
        refuse_empty_box(cloud, options.crop)
    most = float(cloud.opacities[within(cloud, options.crop, None)].max())
    raise ValueError(
        f"no splat is left: the greatest opacity is {most:.4g},"
        f" below min_opacity {options.min_opacity or 0:.4g}"
    )
