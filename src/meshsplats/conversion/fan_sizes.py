"""How large and opaque the fans of splats are: axes, low-pass filter, shapes."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from meshsplats.conversion.fans import Shape, build, pattern
from meshsplats.conversion.footprint import FILTER_PX2, widen
from meshsplats.conversion.options import ConversionOptions
from meshsplats.conversion.profiles import fit_profile
from meshsplats.conversion.selection import disc_areas, mean_shadow
from meshsplats.scene.gaussians import GaussianCloud

LARGEST_SIGMA = np.float32(1e18)
"""Larger splats have this standard deviation: float32 holds no product of two that are larger."""
CROSSED_REACH = 1.06
"""Rim of crossed ellipses as a multiple of the radius that fits a Gaussian best. Seen from between their
axes, two ellipses are narrower than the splat; at equal integrated opacity, this gains 0.1 to 0.8 dB."""


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
            drawn = drawn * missing(self.areas, self.shadow, self.shapes, self.choice) ** np.float32(
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


def _filter_px2(cloud: GaussianCloud, options: ConversionOptions) -> float:
    """Variance of the low-pass filter, square pixels."""
    if options.footprint_px2 is not None:
        return options.footprint_px2
    return FILTER_PX2[options.look or "area"][cloud.kernel]


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
        return [ellipse(sides, rings, options, options.mode)], choice  # type: ignore[arg-type]
    choice[sigma[:, 2] <= options.flat_below * sigma[:, 1]] = 1
    return [ellipse(sides, rings, options, "crossed"), ellipse(2 * sides, rings, options)], choice


def ellipse(sides: int, rings: int, options: ConversionOptions, mode: str = "flat") -> Shape:
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


def missing(areas: np.ndarray, shadow: np.ndarray, shapes: list[Shape], choice: np.ndarray) -> np.ndarray:
    """(n,) mean area of a splat's projection over all directions, divided by that of its ellipses, whose mean
    |cos| is 1/2; 1 where the shape's profile is that of the projection."""
    of_ellipses = ~np.array([shape.fits_projection for shape in shapes])[choice]
    ellipses = np.array([1 if shape.fits_projection else shape.pattern.ellipses for shape in shapes])[choice]
    drawn = 0.5 * np.take_along_axis(np.cumsum(areas, axis=1), ellipses[:, None] - 1, axis=1)[:, 0]
    return np.divide(shadow, drawn, out=np.ones_like(shadow), where=of_ellipses & (drawn > 0))
