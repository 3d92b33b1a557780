"""Camera: a pinhole with OpenCV axes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from meshsplats._common.arrays import checked_array, subsample
from meshsplats._common.choices import MAX_SIDE
from meshsplats._common.kinds import need, need_choice, need_numbers

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Axes = Literal["opencv", "opengl"]
"""Of a camera: OpenCV's are +x right, +y down, +z forward, OpenGL's +x right, +y up, +z backward."""
NEAR_SHARE = 0.002
"""Depth of the near plane of a camera that names none, as a share of the distance from which on the scene
lies around it: 1 cm where that is 5 m."""
NEAREST_SHARE = 0.01
"""Share of the scene's points that may lie nearer than that distance: floaters, and splats at the lens."""
_POINTS = 20_000
"""Number of points to measure at most."""
MAX_SKEW = 1e-2
"""How far a rotation may be from orthonormal; less than that is taken for rounding."""
OPENGL = np.array([1.0, -1.0, -1.0])
"""Turns OpenGL's y and z axes, up and backwards, to those of OpenCV, and back."""
OUT_OF_SIGHT = "are they of one scene, and do the matrices of the cameras lead from world to camera?"
"""What to ask of cameras that do not see a scene."""
_MAX_NAME = 1000
"""Length of a name that camera files may have."""


def checked_side(name: str, value: Any) -> int:
    """A side of an image in pixels. TypeError for what is no number, ValueError for one out of range."""
    need_numbers(**{name: value})
    if not (value % 1 == 0 and 1 <= value <= MAX_SIDE):
        raise ValueError(f"{name} must be a whole number from 1 to {MAX_SIDE}, got {value}")
    return int(value)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: +x right, +y down, +z forward.

    Concretely, a world point p is at ``X = world_to_camera[:3, :3] @ p + world_to_camera[:3, 3]`` in the
    camera's frame and in the image at ``(fx * X[0] / X[2] + cx, fy * X[1] / X[2] + cy)`` pixels from the
    top left corner; the centre of pixel (row, col) is at (col + 0.5, row + 0.5).

    The matrix is copied: what is written into the caller's array later does not move the camera.
    """

    world_to_camera: np.ndarray
    """(4, 4) float64 rigid transform, from the coordinates of the scene, which are relative to its
    ``origin``."""
    fx: float
    """Focal length in pixels, horizontal."""
    fy: float
    """Focal length in pixels, vertical."""
    cx: float
    """Principal point in pixels from the left edge."""
    cy: float
    """Principal point in pixels from the top edge."""
    width: int
    height: int
    near: float | None = None
    """Depth z of the near plane, scene units: nothing nearer is drawn. None: a small share of the distance to
    the scene, ``with_near_plane``."""
    name: str = ""
    """Up to 1,000 characters."""

    def __post_init__(self) -> None:
        matrix = checked_array("world_to_camera", self.world_to_camera, np.float64, (4, 4))
        rotation = matrix[:3, :3]
        if (
            np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6
            or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4
        ):
            raise ValueError(
                "world_to_camera must be a rigid transform: orthonormal rotation, last row 0 0 0 1"
            )
        if np.linalg.det(rotation) < 0:
            raise ValueError("world_to_camera must not mirror: its rotation has determinant -1")
        object.__setattr__(self, "world_to_camera", matrix.copy())
        for name in ("fx", "fy", "near"):
            if name == "near" and self.near is None:
                continue
            need_numbers(**{name: getattr(self, name)})
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value}")
            object.__setattr__(self, name, value)
        for name in ("cx", "cy"):
            need_numbers(**{name: getattr(self, name)})
            value = float(getattr(self, name))
            if not np.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value}")
            object.__setattr__(self, name, value)
        for name in ("width", "height"):
            object.__setattr__(self, name, checked_side(name, getattr(self, name)))
        need(str, name=self.name)
        if len(self.name) > _MAX_NAME:
            raise ValueError(f"name must have up to {_MAX_NAME:,} characters, got {len(self.name):,}")

    @classmethod
    def from_camera_to_world(
        cls,
        matrix: ArrayLike,
        intrinsics: ArrayLike,
        width: int,
        height: int,
        *,
        axes: Axes = "opencv",
        near: float | None = None,
        name: str = "",
    ) -> Camera:
        """The camera whose ``matrix`` leads from its own frame to the world, the inverse of
        ``world_to_camera``, as NeRF data sets, nerfstudio and Blender have it.

        Args:
            matrix: (4, 4), or (3, 4) without the last row: a rotation and the position of the camera.
            intrinsics: (4,) fx, fy, cx, cy in pixels, or (3, 3) [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]. cx and
                cy count from the corner of the image: OpenCV's, which count from the centre of the first
                pixel, need 0.5 more.
            width, height: of the image, pixels.
            axes: of the camera's frame: 'opencv', or 'opengl' (+x right, +y up, +z backward), as in the
                ``transform_matrix`` of a transforms.json and Blender's ``matrix_world``.
            near, name: as in ``Camera``.

        Raises ValueError for a matrix that scales, shears or mirrors, and for a value out of range.
        """
        need_choice(Axes, axes=axes)
        rows = 3 if np.shape(matrix)[:1] == (3,) else 4
        pose = checked_array("matrix", matrix, np.float64, (rows, 4))
        flip = np.ones(3) if axes == "opengl" else OPENGL
        world_to_camera = from_opengl(pose * [*flip, 1])
        if world_to_camera is None or (pose[3:] != [0, 0, 0, 1]).any():
            raise ValueError(
                "matrix must lead from camera to world by a rotation and a translation, its last row being"
                " 0 0 0 1: it scales, shears or mirrors"
            )
        shape = (3, 3) if np.ndim(intrinsics) == 2 else (4,)
        lens = checked_array("intrinsics", intrinsics, np.float64, shape)
        if lens.ndim == 2:
            if lens[0, 1] or lens[1, 0] or (lens[2] != [0, 0, 1]).any():
                raise ValueError(
                    f"intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {lens.tolist()}"
                )
            lens = lens[[0, 1, 0, 1], [0, 1, 2, 2]]
        fx, fy, cx, cy = lens.tolist()
        return cls(world_to_camera, fx, fy, cx, cy, width, height, near, name)

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 position in the world frame."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def up(self) -> np.ndarray:
        """(3,) float64 unit direction towards the image's upper edge in the world frame."""
        return -self.world_to_camera[1, :3]

    def scaled(self, factor: float) -> Camera:
        """The same view with an image ``factor`` times as large, its sides rounded to whole pixels, at least
        1. ValueError where a side would have more than 32,768."""
        if not (np.isfinite(factor) and factor > 0):
            raise ValueError(f"factor must be positive, got {factor}")
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        if max(width, height) > MAX_SIDE:
            raise ValueError(
                f"an image of {self.width} x {self.height} pixels cannot be drawn {factor:g} times as large,"
                f" as is needed here: sides have at most {int(MAX_SIDE / factor)}. Take a smaller image, or"
                " parts of it, one by one (Camera.window)"
            )
        x, y = width / self.width, height / self.height  # not quite the factor where a side was rounded
        return replace(
            self, width=width, height=height, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y
        )

    def relative_to(self, origin: ArrayLike) -> Camera:
        """The same camera for coordinates relative to ``origin`` (3,), a point in those of this camera, such
        as the ``origin`` of the scene that is to be rendered."""
        point = checked_array("origin", origin, np.float64, (3,))
        if not point.any():
            return self
        matrix = self.world_to_camera.copy()
        matrix[:3, 3] += matrix[:3, :3] @ point
        return replace(self, world_to_camera=matrix)

    def window(self, x: int, y: int, width: int, height: int) -> Camera:
        """The camera of ``width`` x ``height`` pixels of the image, from column ``x`` and row ``y`` on. They
        may lie outside of it."""
        return replace(self, cx=self.cx - x, cy=self.cy - y, width=width, height=height)

    def within(self, side: int) -> Camera:
        """The same view with no side of the image longer than ``side`` pixels; never a larger image."""
        need_numbers(side=side)
        if not side > 0:
            raise ValueError(f"side must be a number of pixels above 0, got {side}")
        return self.scaled(min(1.0, side / max(self.width, self.height)))

    def near_plane(self, points: np.ndarray, pose: np.ndarray | None = None) -> float:
        """Depth of the near plane for a scene of ``points`` (n, 3), its vertices or centres: ``near``, or
        ``NEAR_SHARE`` of the distance within which ``NEAREST_SHARE`` of the points lie. ``pose``, (4, 4)
        world to camera, takes the place of the camera's.

        It depends on the position of the camera alone, so that parts of an image have that of the whole, and
        follows the units of the scene.
        """
        if self.near is not None:
            return self.near
        center = self.center if pose is None else -np.linalg.solve(pose[:3, :3], pose[:3, 3])
        distance = np.linalg.norm(subsample(points, _POINTS).astype(np.float64) - center, axis=1)
        distance = distance[distance > 0]
        if not len(distance):
            return NEAR_SHARE  # there is nothing to see
        nearest = int(NEAREST_SHARE * len(distance))
        return max(NEAR_SHARE * float(np.partition(distance, nearest)[nearest]), sys.float_info.min)

    def with_near_plane(self, points: np.ndarray, pose: np.ndarray | None = None) -> Camera:
        """The camera with the near plane that it has in front of a scene of ``points`` (n, 3), at the
        ``pose`` as in ``near_plane``."""
        return self if self.near is not None else replace(self, near=self.near_plane(points, pose))

    def sees(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: points (n, 3) beyond the near plane that project into the image."""
        return self.in_image(self.project(points)[0])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image positions and depths of world ``points`` (n, 3).

        Returns:
            (n, 2) x and y in pixels from the image's top left corner, NaN for points that are not beyond the
            near plane, or not in front of a camera without one; and (n,) depth z in the camera's frame. Both
            are float32 for float32 points, else float64.

        Raises ValueError for points of another shape; ``point[None]`` are those of a single one.
        """
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points must have shape (n, 3), got {points.shape}")
        if points.dtype != np.float32:
            points = points.astype(np.float64, copy=False)
        # Relative to the camera first: far from the origin, products of float32 would lose half a pixel.
        turn, center = self.world_to_camera[:3, :3], self.center.astype(points.dtype)
        rest = turn @ center.astype(np.float64) + self.world_to_camera[:3, 3]
        x, y, z = turn.astype(points.dtype) @ (points - center).T + rest.astype(points.dtype)[:, None]
        beyond = np.where(z > (self.near or 0), z, points.dtype.type(np.nan))
        with np.errstate(over="ignore"):  # points right at the camera, beside the image
            return np.stack([self.fx * x / beyond + self.cx, self.fy * y / beyond + self.cy]).T, z

    def pixels_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of the world ``points`` (n, 3) that project into the image, as in ``project``: their indices (k,),
        columns (k,) and rows (k,) of the pixels, and depths (k,)."""
        positions, depth = self.project(points)
        shown = np.flatnonzero(self.in_image(positions))
        column, row = positions[shown].T.astype(np.intp)
        return shown, column, row, depth[shown]

    def in_image(self, positions: np.ndarray) -> np.ndarray:
        """(n,) bool: which of ``positions`` (n, 2), as from ``project``, lie in the image."""
        x, y = positions.T
        with np.errstate(invalid="ignore"):  # NaN lies nowhere
            return (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)


def from_opengl(matrix: np.ndarray) -> np.ndarray | None:
    """(4, 4) world to camera in OpenCV's axes of a ``matrix`` (3 or 4, 4), camera to world in those of
    OpenGL; None where that is no rotation and translation, but scales, shears or mirrors."""
    axes = matrix[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > MAX_SKEW or np.linalg.det(axes) < 0:
        return None
    left, _, right = np.linalg.svd(axes)
    rotation = (left @ right * OPENGL).T
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = -rotation @ matrix[:3, 3]
    return result


def to_opengl(matrix: np.ndarray) -> np.ndarray:
    """(4, 4) camera to world in OpenGL's axes of a ``matrix`` (4, 4), world to camera in OpenCV's."""
    pose = np.eye(4)
    pose[:3, :3] = matrix[:3, :3].T * OPENGL
    pose[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return pose


def hiding_near_plane(cameras: Sequence[Camera], points: np.ndarray) -> str:
    """What to say if ``cameras`` see none of ``points`` (n, 3) because the near planes that they name are
    farther; empty otherwise."""
    some = subsample(points, _POINTS)
    nearest = np.inf
    for camera in cameras:
        if camera.sees(some).any():
            return ""
        bare = replace(camera, near=None)
        positions, depth = bare.project(some)
        depth = depth[bare.in_image(positions)]
        if len(depth) and camera.near is not None:
            nearest = min(nearest, camera.near)
    if nearest == np.inf:
        return ""
    return (
        f"what they look at is nearer than the near plane {nearest:g} that they name; without 'near' in the"
        " camera file, it follows the scene"
    )
