"""convert: a splat cloud as a mesh of translucent triangle fans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from meshsplats._kinds import need, need_all
from meshsplats.camera import Camera
from meshsplats.cameras.framing import guess_up, unit_up
from meshsplats.conversion.baking import bake_filter
from meshsplats.conversion.budget import within_limits
from meshsplats.conversion.detail import FIRST_STAR, LEVELS, OnImage, choose_levels, visibility
from meshsplats.conversion.fans import Shape, build, pattern
from meshsplats.conversion.footprint import DRAWN_PX2, FILTER_PX2, CameraCoverage, pixel_sizes, widen
from meshsplats.conversion.merging import simplify
from meshsplats.conversion.options import PRESETS, ConversionOptions, Preset, make_options
from meshsplats.conversion.profiles import Profile, fidelity, fit_profile
from meshsplats.conversion.selection import (
    disc_areas,
    mean_shadow,
    most_important,
    refuse_empty_box,
    within,
)
from meshsplats.conversion.stars import STARS
from meshsplats.gaussians import GaussianCloud, Kernel
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.looks import Look

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.conversion.options import ConversionChanges

__all__ = [
    "PRESETS",
    "ConversionOptions",
    "Profile",
    "bake_filter",
    "convert",
    "fidelity",
    "fit_profile",
    "simplify",
]

LARGEST_SIGMA = np.float32(1e18)
"""Larger splats have this standard deviation: float32 holds no product of two that are larger."""
CROSSED_REACH = 1.06
"""Rim of crossed ellipses as a multiple of the radius that fits a Gaussian best. Seen from between their
axes, two ellipses are narrower than the splat; at equal integrated opacity, this gains 0.1 to 0.8 dB."""


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
            or (0, -1, 0).
        threads: maximum number of threads for the images of ``detail='cameras'``; all processors by default.
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
    given = make_options(options, **changes)
    chosen = given.resolved(preset, has_cameras=bool(cameras))
    filter_px2 = filter_of(cloud.kernel, chosen)
    direction = guess_up(cloud, cameras) if up is None else unit_up(up)
    rows = _worth_drawing(cloud, chosen)
    part = cloud
    if chosen.colors == "degree0" and cloud.sh_degree:
        part = replace(part, sh=part.sh[:, :1])
    if len(rows) < len(cloud):
        part = part.take(rows)
    chosen, count = within_limits(given, chosen, len(part))
    whole = part
    if chosen.budget == "merge" and count < len(part):
        cloud = part = simplify(part, count, cameras=cameras)
        rows = np.arange(count, dtype=np.int32)
    viewed = _ViewedSplats(part, chosen, cameras, direction)

    fans = Fans.of(part, chosen, viewed.pixel)
    keep = fans.areas[:, 0] > 0 if chosen.min_opacity else np.ones(len(part), bool)
    if not keep.any():
        raise ValueError(f"none of the {len(part)} splats has a visible area")
    if count < len(part):
        importance = fans.opacity * fans.shadow
        if chosen.footprint == "cameras" and viewed.pixel is not None:
            importance = importance / np.square(viewed.pixel)
        # Splats without area come last.
        importance[~keep] = -1
        keep &= most_important(importance, count)

    colors = part.colors
    if chosen.colors == "cameras" and part.sh_degree > 0 and viewed.coverage is not None:
        colors = viewed.coverage.mean_colors(part.sh)

    def assembled(fans: Fans, keep: np.ndarray) -> SplatMesh:
        kept = None if keep.all() else np.flatnonzero(keep)
        vertices, faces, rgba, owners = fans.build(part, rows, colors, chosen.compensation, kept)
        return SplatMesh(
            vertices,
            faces,
            rgba,
            face_splat=owners,
            up=direction,
            filter_px2=filter_px2,
            origin=cloud.origin,
        )

    mesh = assembled(fans, keep)
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
        levels = [_ellipse(sides, rings, chosen) for sides, rings in LEVELS]
        mesh = assembled(fans._replace(shapes=[*levels, *STARS], choice=choice), keep)
    return mesh


class Fans(NamedTuple):
    """How n splats become triangles."""

    shapes: list[Shape]
    choice: np.ndarray
    """(n,) index of each splat's shape."""
    axes: np.ndarray
    """(n, 3) the splat's axes in the order in which the ellipses use them."""
    sigma: np.ndarray
    """(n, 3) standard deviations along them after the low-pass filter, scene units."""
    opacity: np.ndarray
    """(n,) opacities after the filter."""
    areas: np.ndarray
    """(n, 3) as from ``disc_areas``."""
    shadow: np.ndarray
    """(n,) as from ``mean_shadow``."""

    @classmethod
    def of(cls, cloud: GaussianCloud, options: ConversionOptions, pixel: np.ndarray | None) -> Fans:
        """The fans of ``cloud``. ``pixel``: (n,) size of a pixel at each splat, None without a footprint."""
        axes = _axis_order(cloud, options)
        sigma, opacity = _drawn_gaussians(cloud, options, pixel, axes)
        areas = disc_areas(sigma)
        shapes, choice = _shapes(sigma, options)
        return cls(shapes, choice, axes, sigma, opacity, areas, mean_shadow(areas))

    def build(
        self,
        cloud: GaussianCloud,
        rows: np.ndarray,
        colors: np.ndarray,
        compensation: float | None,
        kept: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (v, 3), faces (f, 3), colours (v, 4) and the splat of each face (f,), from ``rows`` (n,).

        ``kept``: indices of the splats that get triangles, all by default.
        """
        drawn = self.opacity
        if compensation:
            drawn = drawn * _missing(self.areas, self.shadow, self.shapes, self.choice) ** np.float32(
                compensation
            )

        def pick(array: np.ndarray) -> np.ndarray:
            return array if kept is None else np.take(array, kept, axis=0)

        counts = np.array([len(shape.pattern.faces) for shape in self.shapes])
        vertices, faces, rgba = build(
            self.shapes,
            pick(self.choice),
            pick(cloud.means),
            pick(cloud.quaternions),
            pick(self.axes),
            pick(self.sigma),
            pick(colors),
            pick(drawn),
        )
        return vertices, faces, rgba, np.repeat(pick(rows), counts[pick(self.choice)])


def filter_of(kernel: Kernel, options: ConversionOptions) -> float:
    """``filter_px2`` of the mesh of splats of that kernel: variance in square pixels, 0 for none."""
    if options.footprint != "filter":
        return 0.0
    if kernel != "3dgs":
        raise ValueError(
            f"footprint='filter' draws as 3DGS does, but these splats are of kernel {kernel!r}, which"
            " filters in another way: choose another footprint, or none"
        )
    return DRAWN_PX2 if options.footprint_px2 is None else float(options.footprint_px2)


class _ViewedSplats:
    """Splats, with the size of a pixel at each of them."""

    def __init__(
        self,
        cloud: GaussianCloud,
        options: ConversionOptions,
        cameras: Sequence[Camera] | None,
        up: np.ndarray,
    ) -> None:
        self.coverage = None
        if cameras and "cameras" in (options.footprint, options.colors):
            self.coverage = CameraCoverage(cloud.means, cameras)
        self.pixel = pixel_sizes(cloud, options, self.coverage, up)
        """(n,) scene units, or None: no low-pass filter."""


def _filter_px2(cloud: GaussianCloud, options: ConversionOptions) -> float:
    """Variance of the low-pass filter, square pixels."""
    if options.footprint_px2 is not None:
        return options.footprint_px2
    return FILTER_PX2[options.look or "area"][cloud.kernel]


def _worth_drawing(cloud: GaussianCloud, options: ConversionOptions) -> np.ndarray:
    """(k,) int32 rows of the splats that are inside the crop box and opaque enough, ascending."""
    if len(cloud) == 0:
        raise ValueError("the cloud has no splats: there is nothing to convert")
    keep = within(cloud, options.crop, options.min_opacity)
    if not keep.any():
        if options.crop is not None:
            refuse_empty_box(cloud, options.crop)
        most = float(cloud.opacities[within(cloud, options.crop, None)].max())
        raise ValueError(
            f"no splat is left: the greatest opacity is {most:.4g},"
            f" below min_opacity {options.min_opacity:.4g}"
        )
    return np.flatnonzero(keep).astype(np.int32)


def _drawn_gaussians(
    cloud: GaussianCloud, options: ConversionOptions, pixel: np.ndarray | None, axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) standard deviations along ``axes`` and (n,) opacities of splats after the low-pass filter."""
    widened = widen(cloud.scales, pixel, _filter_px2(cloud, options), cloud.kernel)
    sigma = np.minimum(np.take_along_axis(widened, axes, axis=1), LARGEST_SIGMA)
    opacity = cloud.opacities
    if cloud.kernel == "antialiased" and pixel is not None:
        # That kernel lowers the opacity by as much as its filter widens the splat.
        before = mean_shadow(disc_areas(np.take_along_axis(cloud.scales, axes, axis=1)))
        after = mean_shadow(disc_areas(sigma))
        opacity = opacity * np.divide(before, after, out=np.zeros_like(after), where=after > 0)
    if options.shrink_faint:
        # 3DGS stops drawing where the opacity has fallen to 1/255, at the radius sqrt(2 ln(255 o)). Within it
        # lies the share 1 - 1 / (255 o) of the integrated opacity.
        sigma = sigma * np.sqrt(1 - 1 / np.maximum(255 * cloud.opacities, 1))[:, None]
    return sigma, opacity


def _axis_order(cloud: GaussianCloud, options: ConversionOptions) -> np.ndarray:
    """(n, 3) indices of each splat's axes in the order in which the ellipses use them.

    flat: the smallest axis (the third of a '2dgs' cloud) last, the others in cyclic order, so that first x
    second points along it. crossed: by size, largest first. 3d: as stored.
    """
    n = len(cloud)
    if options.mode == "3d":
        return np.broadcast_to(np.arange(3, dtype=np.int8), (n, 3))
    if options.mode == "crossed":
        return _by_size(cloud.scales)
    dropped = np.full(n, 2) if cloud.kernel == "2dgs" else np.argmin(cloud.scales, axis=1)
    return np.array([[1, 2, 0], [2, 0, 1], [0, 1, 2]], np.int8)[dropped]


def _by_size(scales: np.ndarray) -> np.ndarray:
    """(n, 3) stable descending order of three columns, by comparisons: faster than sorting short rows."""
    a, b, c = scales.T
    return _ORDERS[(a >= b) * np.int8(4) + (a >= c) * np.int8(2) + (b >= c)]


_ORDERS = np.array(
    [[2, 1, 0], [1, 2, 0], [2, 1, 0], [1, 0, 2], [2, 0, 1], [2, 0, 1], [0, 2, 1], [0, 1, 2]], np.int8
)
"""Indexed by the bits a >= b, a >= c and b >= c; the third and sixth combination cannot occur."""


def _shapes(sigma: np.ndarray, options: ConversionOptions) -> tuple[list[Shape], np.ndarray]:
    """The shapes in use, and (n,) int8 index of the one that each splat has."""
    sides, rings = int(options.sides), int(options.rings)  # type: ignore[arg-type]
    choice = np.zeros(len(sigma), np.int8)
    if options.mode != "crossed":
        return [_ellipse(sides, rings, options, options.mode)], choice  # type: ignore[arg-type]
    choice[sigma[:, 2] <= options.flat_below * sigma[:, 1]] = 1
    return [_ellipse(sides, rings, options, "crossed"), _ellipse(2 * sides, rings, options)], choice


def _ellipse(sides: int, rings: int, options: ConversionOptions, mode: str = "flat") -> Shape:
    """An ellipse, or two crossed ones, with the profile that ``options`` ask for."""
    fit = partial(
        fit_profile,
        sides,
        rings,
        rim_opacity=options.rim_opacity,
        center_opacity=options.center_opacity,
        conserve=True,
    )
    profile = fit(rim_radius=options.rim_radius)
    if mode == "crossed" and options.rim_radius is None:
        profile = fit(rim_radius=CROSSED_REACH * profile.radii[-1])
    return Shape(pattern(sides, rings, mode), profile)


def _missing(areas: np.ndarray, shadow: np.ndarray, shapes: list[Shape], choice: np.ndarray) -> np.ndarray:
    """(n,) mean area of a splat's projection over all directions, divided by that of its ellipses, whose mean
    |cos| is 1/2; 1 where the shape's profile is that of the projection."""
    of_ellipses = ~np.array([shape.fits_projection for shape in shapes])[choice]
    ellipses = np.array([1 if shape.fits_projection else shape.pattern.ellipses for shape in shapes])[choice]
    drawn = 0.5 * np.take_along_axis(np.cumsum(areas, axis=1), ellipses[:, None] - 1, axis=1)[:, 0]
    return np.divide(shadow, drawn, out=np.ones_like(shadow), where=of_ellipses & (drawn > 0))
