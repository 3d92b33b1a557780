"""Lenses: the camera models of COLMAP, and undistortion of their images to those of a pinhole.

A ray that leaves the camera at (u, v, 1), OpenCV axes, meets the image at ``(fx * u' + cx, fy * v' + cy)``
pixels. The models differ in how (u', v') follows from (u, v); every one has a closed form in that direction,
as needed here: each pixel of the pinhole image is looked up where its ray meets the photograph.
Formulas: the camera models of COLMAP 4.2 (src/colmap/sensor/models.h) and the papers named there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from pathlib import Path

import numpy as np

from meshsplats._core.resampling import resample
from meshsplats.errors import FileFormatError
from meshsplats.images.reading import Header

ROWS_BYTES = 4 << 20
"""Images are undistorted in strips of rows, so that each array of a strip takes at most about this much."""
APART = 1.5
"""Pixels between look-ups whose mean is a pixel of a smaller image, at most: each mixes two along a side."""
WHOLE = 0.999
"""A pixel between others counts only if all of those it mixes count, but for rounding."""
MAX_STRETCH = 0.02
"""Largest difference between the scales of width and height at which an image still fits its camera."""

Point = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Lens:
    """How a camera maps rays to its image."""

    model: str
    """Name of a camera model as COLMAP has it, a key of ``MODELS``."""
    fx: float
    """Focal length in pixels, horizontal; 1 for EQUIRECTANGULAR, which has none."""
    fy: float
    cx: float
    """Principal point in pixels from the left edge."""
    cy: float
    width: int
    height: int
    coefficients: tuple[float, ...] = ()
    """Parameters of the model besides focal lengths and principal point, in COLMAP's order."""

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"unknown camera model {self.model!r}; known: {', '.join(MODELS)}")
        values = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        if not np.isfinite(values).all():
            raise ValueError(f"camera parameters must be finite, got {values}")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths must be positive, got {self.fx:g}, {self.fy:g}")
        if len(self.coefficients) != MODELS[self.model].coefficients:
            raise ValueError(
                f"{self.model} has {MODELS[self.model].coefficients} coefficients beside focal lengths and"
                f" principal point, got {len(self.coefficients)}"
            )

    @classmethod
    def from_colmap(cls, model: str, width: int, height: int, parameters: tuple[float, ...]) -> Lens:
        """A lens from COLMAP's list of parameters. ValueError for an unknown model or a wrong number of
        them."""
        if model not in MODELS:
            raise ValueError(f"unknown camera model {model!r}; known: {', '.join(MODELS)}")
        if len(parameters) != MODELS[model].parameters:
            raise ValueError(f"{model} has {MODELS[model].parameters} parameters, got {len(parameters)}")
        if model == "EQUIRECTANGULAR":  # its parameters repeat the size
            return cls(model, 1.0, 1.0, width / 2, height / 2, width, height)
        focals = MODELS[model].focals
        fx, fy, (cx, cy) = parameters[0], parameters[focals - 1], parameters[focals : focals + 2]
        return cls(model, fx, fy, cx, cy, width, height, tuple(parameters[focals + 2 :]))

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines are straight in the image, so that no undistortion is needed."""
        if self.model in ("SIMPLE_PINHOLE", "PINHOLE"):
            return True
        straight_at_zero = MODELS[self.model].straight_at_zero
        return straight_at_zero and not any(self.coefficients)

    def scaled(self, width: int, height: int) -> Lens:
        """The same lens for an image of another size; each axis is scaled separately."""
        x, y = width / self.width, height / self.height
        fx, fy = (self.fx, self.fy) if self.model == "EQUIRECTANGULAR" else (self.fx * x, self.fy * y)
        return Lens(self.model, fx, fy, self.cx * x, self.cy * y, width, height, self.coefficients)

    def distort(self, u: np.ndarray, v: np.ndarray) -> Point:
        """(u', v') of rays (u, v, 1), any shape, float64; NaN or infinite where no image point belongs to a
        ray."""
        with np.errstate(all="ignore"):
            return MODELS[self.model].distort(u, v, self.coefficients)

    def pixels(self, rays: np.ndarray) -> np.ndarray:
        """(..., 2) image points in pixels of rays (..., 3), which need no particular length.

        Rays with z <= 0 have none and give NaN, except with EQUIRECTANGULAR. So have rays beyond
        ``reach``, where the polynomials of a model have turned back.
        """
        rays = np.asarray(rays, np.float64)
        x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
        if self.model == "EQUIRECTANGULAR":
            across = np.arctan2(x, z) / (2 * np.pi)
            down = np.arctan2(y, np.hypot(x, z)) / np.pi
            return np.stack([(across + 0.5) * self.width, (down + 0.5) * self.height], axis=-1)
        with np.errstate(all="ignore"):
            u, v = x / z, y / z
            a, b = self.distort(u, v)
            inside = (z > 0) & (np.hypot(u, v) <= self.reach())
        points = np.stack([self.fx * a + self.cx, self.fy * b + self.cy], axis=-1)
        points[~inside] = np.nan
        return points

    def reach(self) -> float:
        """Largest sqrt(u^2 + v^2) up to which image points move outwards with it, in all directions.

        The polynomials fit within the photograph only; farther out many of them turn back, and rays from
        far outside would land on the photograph once more.
        """
        return _reach(self)


@lru_cache(maxsize=64)
def _reach(lens: Lens) -> float:
    slopes = np.tan(np.linspace(0, np.pi / 2 - 1e-4, 4001))
    angles = np.arange(32) * (np.pi / 16)
    u, v = (np.outer(f(angles), slopes) for f in (np.cos, np.sin))
    a, b = lens.distort(u, v)
    with np.errstate(all="ignore"):
        outward = a * np.cos(angles)[:, None] + b * np.sin(angles)[:, None]
        # Written so that NaN counts as turning back.
        back = ~(np.diff(outward, axis=1) >= 0).all(axis=0)
    return float(slopes[int(back.argmax())]) if back.any() else np.inf


# ---- The models: (u', v') of (u, v, 1)


def _pinhole(u: np.ndarray, v: np.ndarray, _: tuple[float, ...]) -> Point:
    return u, v


def _polynomial(square: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """k1 s + k2 s^2 + ... of s = ``square``."""
    result = np.zeros_like(square)
    for k in reversed(coefficients):
        result = (result + k) * square
    return result


def _radial(u: np.ndarray, v: np.ndarray, k: tuple[float, ...]) -> Point:
    factor = 1 + _polynomial(u * u + v * v, k)
    return u * factor, v * factor


def _tangential(u: np.ndarray, v: np.ndarray, p1: float, p2: float) -> Point:
    square = u * u + v * v
    return (
        2 * p1 * u * v + p2 * (square + 2 * u * u),
        2 * p2 * u * v + p1 * (square + 2 * v * v),
    )


def _opencv(u: np.ndarray, v: np.ndarray, c: tuple[float, ...]) -> Point:
    k1, k2, p1, p2 = c
    a, b = _radial(u, v, (k1, k2))
    du, dv = _tangential(u, v, p1, p2)
    return a + du, b + dv


def _full_opencv(u: np.ndarray, v: np.ndarray, c: tuple[float, ...]) -> Point:
    k1, k2, p1, p2, k3, k4, k5, k6 = c
    square = u * u + v * v
    factor = (1 + _polynomial(square, (k1, k2, k3))) / (1 + _polynomial(square, (k4, k5, k6)))
    du, dv = _tangential(u, v, p1, p2)
    return u * factor + du, v * factor + dv


def _fov(u: np.ndarray, v: np.ndarray, c: tuple[float, ...]) -> Point:
    """Devernay and Faugeras, "Straight lines have to be straight" (2001)."""
    (omega,) = c
    r = np.hypot(u, v)
    if abs(omega) < 1e-6:
        return u, v
    slope = 2 * np.tan(omega / 2)
    factor = np.where(r > 1e-9, np.arctan(r * slope) / np.where(r > 1e-9, r * omega, 1), slope / omega)
    return u * factor, v * factor


def _equidistant(u: np.ndarray, v: np.ndarray) -> Point:
    """The ray's angle with the axis, in radians, as the length."""
    r = np.hypot(u, v)
    factor = np.where(r > 1e-9, np.arctan(r) / np.where(r > 1e-9, r, 1), 1)
    return u * factor, v * factor


def _fisheye(u: np.ndarray, v: np.ndarray, k: tuple[float, ...]) -> Point:
    return _radial(*_equidistant(u, v), k)


def _thin_prism_fisheye(u: np.ndarray, v: np.ndarray, c: tuple[float, ...]) -> Point:
    """Weng, Cohen and Herniou, "Camera calibration with distortion models" (1992), behind a fisheye."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = c
    u, v = _equidistant(u, v)
    a, b = _radial(u, v, (k1, k2, k3, k4))
    du, dv = _tangential(u, v, p1, p2)
    square = u * u + v * v
    return a + du + sx1 * square, b + dv + sy1 * square


def _rad_tan_thin_prism_fisheye(u: np.ndarray, v: np.ndarray, c: tuple[float, ...]) -> Point:
    """The FisheyeRadTanThinPrism model of Project Aria: tangential and prism terms of what the radial ones
    gave."""
    (p0, p1), s = c[6:8], c[8:]
    a, b = _fisheye(u, v, c[:6])
    square = a * a + b * b
    du, dv = _tangential(a, b, p1, p0)
    return (
        a + du + _polynomial(square, s[:2]),
        b + dv + _polynomial(square, s[2:]),
    )


def _division(u: np.ndarray, v: np.ndarray, c: tuple[float, ...]) -> Point:
    """Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion" (2001):
    r = r' / (1 + k r'^2), solved for r'."""
    (k,) = c
    factor = 2 / (1 + np.sqrt(1 - 4 * k * (u * u + v * v)))
    return u * factor, v * factor


def _eucm(u: np.ndarray, v: np.ndarray, c: tuple[float, ...]) -> Point:
    """Khomutenko, Garcia and Martinet, "An enhanced unified camera model" (2016)."""
    alpha, beta = c
    depth = alpha * np.sqrt(beta * (u * u + v * v) + 1) + (1 - alpha)
    depth = np.where(depth > 0, depth, np.nan)
    return u / depth, v / depth


@dataclass(frozen=True)
class _Model:
    focals: int
    """1 if both axes share a focal length, else 2."""
    coefficients: int
    distort: Callable[[np.ndarray, np.ndarray, tuple[float, ...]], Point]
    straight_at_zero: bool = True
    """Whether coefficients of 0 make it a pinhole."""

    @property
    def parameters(self) -> int:
        """How many parameters COLMAP stores."""
        return self.focals + 2 + self.coefficients if self.focals else 2


MODELS: dict[str, _Model] = {
    "SIMPLE_PINHOLE": _Model(1, 0, _pinhole),
    "PINHOLE": _Model(2, 0, _pinhole),
    "SIMPLE_RADIAL": _Model(1, 1, _radial),
    "RADIAL": _Model(1, 2, _radial),
    "OPENCV": _Model(2, 4, _opencv),
    "OPENCV_FISHEYE": _Model(2, 4, _fisheye, False),
    "FULL_OPENCV": _Model(2, 8, _full_opencv),
    "FOV": _Model(2, 1, _fov),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, 1, _fisheye, False),
    "RADIAL_FISHEYE": _Model(1, 2, _fisheye, False),
    "THIN_PRISM_FISHEYE": _Model(2, 8, _thin_prism_fisheye, False),
    "RAD_TAN_THIN_PRISM_FISHEYE": _Model(2, 12, _rad_tan_thin_prism_fisheye, False),
    "SIMPLE_DIVISION": _Model(1, 1, _division),
    "DIVISION": _Model(2, 1, _division),
    "SIMPLE_FISHEYE": _Model(1, 0, _fisheye, False),
    "FISHEYE": _Model(2, 0, _fisheye, False),
    "EUCM": _Model(2, 2, _eucm),
    "EQUIRECTANGULAR": _Model(0, 0, _pinhole, False),
}
"""Camera models in the order of COLMAP's numbers, 0 to 17."""


# ---- Undistortion to pinhole images


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A pinhole image that the image of a lens is undistorted to."""

    rotation: np.ndarray
    """(3, 3) from the lens's frame to that of the pinhole, OpenCV axes."""
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    suffix: str = ""
    """Distinguishes several pinholes of one lens."""


@lru_cache(maxsize=64)
def pinholes(lens: Lens) -> tuple[Pinhole, ...]:
    """The pinhole images made of one image, the same objects for the same lens: one with the lens's own
    focal lengths, principal point and size; of an equirectangular panorama the six sides of a cube, a quarter
    of its width each."""
    if lens.model != "EQUIRECTANGULAR":
        return (Pinhole(np.eye(3), lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height),)
    side = max(1, round(lens.width / 4))
    sides = []
    for suffix, turn, tilt in (
        ("front", 0, 0), ("right", 90, 0), ("back", 180, 0), ("left", 270, 0), ("up", 0, 90), ("down", 0, -90)
    ):  # fmt: skip
        a, e = np.radians(turn), np.radians(tilt)
        around = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
        over = np.array([[1, 0, 0], [0, np.cos(e), np.sin(e)], [0, -np.sin(e), np.cos(e)]])
        sides.append(Pinhole(over @ around, side / 2, side / 2, side / 2, side / 2, side, side, f"/{suffix}"))
    return tuple(sides)


def undistort(image: np.ndarray, lens: Lens, pinhole: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """The image of the pinhole, from ``image`` (h, w, c), uint8 or floating-point, at the size of the lens or
    a larger one.

    Values between pixels are bilinear. Of a larger image, a pixel is the mean of look-ups all over it, no
    more than ``APART`` apart: what is made smaller before is blurred twice. Returns
    (pinhole.height, pinhole.width, c) of the same type, 0 where the lens saw nothing, and (h, w) bool that is
    True where all four pixels around lie in the image of the lens.
    """
    points = _points(lens, pinhole)
    values = image if image.dtype == np.uint8 else image.astype(np.float32, copy=False)
    wraps = lens.model == "EQUIRECTANGULAR"
    result = np.empty((*points.shape[:2], image.shape[2]), image.dtype)
    scale = np.array([image.shape[1] / lens.width, image.shape[0] / lens.height], np.float32)
    across, down = (max(1, ceil(float(times) / APART - 0.01)) for times in scale)
    step = max(1, ROWS_BYTES // (24 * pinhole.width))
    for start in range(0, pinhole.height, step):
        rows = slice(start, start + step)
        if across * down == 1:
            at = points[rows] if (scale == 1).all() else (points[rows] + 0.5) * scale - 0.5
            result[rows] = resample(values, at, wraps=wraps, threads=1)
            continue
        near = points[max(start - 1, 0) : start + step + 1]
        inner = slice(min(start, 1), min(start, 1) + len(points[rows]))
        along_x, along_y = (_slopes(near, axis, lens.width if wraps else None)[inner] for axis in (1, 0))
        total = np.zeros_like(result[rows], np.float32)
        for y in (np.arange(down, dtype=np.float32) + 0.5) / down - 0.5:
            for x in (np.arange(across, dtype=np.float32) + 0.5) / across - 0.5:
                at = (points[rows] + x * along_x + y * along_y + 0.5) * scale - 0.5
                if wraps:
                    at[..., 0] %= image.shape[1]
                total += resample(values, at, wraps=wraps, threads=1)
        total /= across * down
        result[rows] = np.rint(total) if image.dtype == np.uint8 else total
    return result, ~np.isnan(points[..., 0])


def _slopes(points: np.ndarray, axis: int, around: int | None) -> np.ndarray:
    """Differences (h, w, 2) of ``points`` (h, w, 2) from each pixel to the next along ``axis``, or from the
    one before where there is none; 0 where there is neither. ``around``: columns after which the first one
    follows."""
    steps = np.diff(points, axis=axis)
    if around is not None:
        steps[..., 0] -= around * np.rint(steps[..., 0] / around)
    missing = [(0, 0)] * 3
    missing[axis] = (0, 1)
    ahead = np.pad(steps, missing, constant_values=np.nan)
    missing[axis] = (1, 0)
    behind = np.pad(steps, missing, constant_values=np.nan)
    return np.nan_to_num(np.where(np.isnan(ahead), behind, ahead))


def fits(lens: Lens, header: Header) -> bool:
    """Whether the image is that of ``lens``, but for its scale and a pixel of rounding."""
    return abs(_stretch(lens, header) - 1) <= MAX_STRETCH + 1 / min(header.width, header.height)


def check_shape(lens: Lens, header: Header, path: Path) -> None:
    """FileFormatError unless the image at ``path`` ``fits``."""
    if fits(lens, header):
        return
    width, height = header.width, header.height
    turned = ""
    if abs(_stretch(lens, header) / (width / height) ** 2 - 1) < 0.05:
        turned = ". It is rotated: cameras belong to images as stored, before their EXIF orientation"
    raise FileFormatError(
        f"{path}: {width} x {height} pixels do not fit its camera, which took {lens.width} x"
        f" {lens.height}{turned}"
    )


def _stretch(lens: Lens, header: Header) -> float:
    return (header.width / lens.width) / (header.height / lens.height)


@lru_cache(maxsize=1)
def _points(lens: Lens, pinhole: Pinhole) -> np.ndarray:
    """(h, w, 2) float32 column and row, from the centre of the first pixel, in the image of ``lens`` of each
    pixel of ``pinhole``; NaN where not all four pixels around are in it.

    That of the last lens is kept: most often all photographs of a data set have the same one.
    """
    points = np.empty((pinhole.height, pinhole.width, 2), np.float32)
    slack = 1e-6
    for rows, found in _strips(lens, pinhole):
        x, y = found[..., 0] - 0.5, found[..., 1] - 0.5  # pixel centres are at halves
        if lens.model == "EQUIRECTANGULAR":  # left and right edge are one, and the poles are rows of a point
            x, y = np.mod(x, lens.width), np.clip(y, 0, lens.height - 1)
        else:
            with np.errstate(invalid="ignore"):
                valid = (x >= -slack) & (x <= lens.width - 1 + slack)
                valid &= (y >= -slack) & (y <= lens.height - 1 + slack)
            x, y = np.where(valid, x, np.nan), np.where(valid, y, np.nan)
        points[rows] = np.stack([x, y], axis=-1)
    points.flags.writeable = False
    return points


def _strips(lens: Lens, pinhole: Pinhole) -> Iterator[tuple[slice, np.ndarray]]:
    """Rows of the pinhole image, and the points (rows, w, 2) where their rays meet the lens's image."""
    across = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    down = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.fy
    step = max(1, ROWS_BYTES // (24 * pinhole.width))
    for start in range(0, pinhole.height, step):
        rows = slice(start, min(start + step, pinhole.height))
        u, v = np.meshgrid(across, down[rows])
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ pinhole.rotation  # = rotation.T @ ray
        yield rows, lens.pixels(rays)
