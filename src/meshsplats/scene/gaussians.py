"""GaussianCloud: splats after activation, in scene units, whatever file they came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from meshsplats._common.arrays import checked_array, chosen_rows, guarded
from meshsplats._common.geometry import affine_parts, quaternion_product, quaternions_of, rotation_rows
from meshsplats._common.kinds import need_all, need_choice
from meshsplats.errors import warn_of_data
from meshsplats.scene.origin import (
    in_words,
    loses_detail,
    lost_by_rounding,
    relative,
    shared_origin,
    zero_origin,
)
from meshsplats.scene.spherical_harmonics import ODD_AXES, harmonics_map

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Kernel = Literal["3dgs", "antialiased", "2dgs"]

DILATION = 0.3
"""Variance in square pixels that 3DGS adds to the projected covariance of splats, at any size of the
image."""
LOW_PASS_PX2: Mapping[Kernel, float] = {"3dgs": DILATION, "antialiased": DILATION, "2dgs": 0.5}
"""Variance of the low-pass filter that splats of each kernel are drawn with, likewise."""
LEAST_OPACITY = 1 / 255
"""Opacity below which 3DGS draws nothing."""

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""


def constant_harmonics(colors: np.ndarray) -> np.ndarray:
    """The coefficients of degree 0 of float32 display ``colors``, of any shape."""
    return (colors - np.float32(0.5)) / np.float32(SH_C0)


@guarded
@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """N Gaussians. Arrays are float32 and C-contiguous; the constructor checks and converts them. Those that
    need no conversion are kept, not copied: what is written into them later is in the splats, unchecked, and
    in all that share them. ``dataclasses.replace(cloud, means=...)`` is another cloud with other centres.
    float64 centres whose detail float32 would lose are told of by a DataWarning: give ``origin``.

    Concretely, splat i is ``opacities[i] * exp(-0.5 * |diag(1 / scales[i]) R_i^T (x - means[i])|^2)`` with
    ``R_i`` the rotation of ``quaternions[i]``.
    """

    means: np.ndarray
    """(n, 3) centres relative to ``origin``, along the axes of the world frame, scene units."""
    quaternions: np.ndarray
    """(n, 4) unit quaternions w, x, y, z: rotation from the splat's own axes to the world."""
    scales: np.ndarray
    """(n, 3) standard deviations along the splat's own axes, scene units, >= 0; 0 marks a flat axis."""
    opacities: np.ndarray
    """(n,) peak opacities in [0, 1]."""
    sh: np.ndarray
    """(n, k, 3) spherical harmonic coefficients of the display colour, k = 1, 4, 9 or 16 (degree 0 to 3)."""
    kernel: Kernel = "3dgs"
    """Kernel that the splats were trained with: '3dgs' (0.3 px^2 added to the projected covariance),
    'antialiased' (the same with the opacity lowered to keep its integral) or '2dgs' (flat splats intersected
    by the ray)."""
    up: np.ndarray | None = None
    """(3,) unit direction that points up in the world frame, where the file says so."""
    origin: np.ndarray = field(default_factory=zero_origin)
    """(3,) float64 point of the world that ``means`` are relative to: world = origin + means. Readers choose
    one where float32 is too coarse for coordinates of the world; else it is zero."""

    _PER_SPLAT: ClassVar[tuple[str, ...]] = ("means", "quaternions", "scales", "opacities", "sh")

    def __post_init__(self) -> None:
        means = checked_array("means", self.means, np.float32, (None, 3))
        warn_of_data(lost_by_rounding("means", self.means))
        n = len(means)
        quaternions = checked_array("quaternions", self.quaternions, np.float32, (n, 4))
        scales = checked_array("scales", self.scales, np.float32, (n, 3))
        opacities = checked_array("opacities", self.opacities, np.float32, (n,))
        sh = checked_array("sh", self.sh, np.float32, (n, None, 3))
        if sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(f"sh must hold 1, 4, 9 or 16 coefficients a channel, got {sh.shape[1]}")
        if n:
            norm = np.einsum("ij,ij->i", quaternions, quaternions)
            if np.abs(norm - 1).max() > 1e-3:
                row = int(np.abs(norm - 1).argmax())
                length = float(norm[row]) ** 0.5
                raise ValueError(f"quaternions must be normalised, row {row} has length {length:.4g}")
            if scales.min() < 0:
                raise ValueError(f"scales are standard deviations and must be >= 0, got {scales.min():.4g}")
            if opacities.min() < 0 or opacities.max() > 1:
                raise ValueError(
                    f"opacities must lie in [0, 1], got {opacities.min():.4g} to {opacities.max():.4g}"
                    " (apply the sigmoid to stored logits)"
                )
        need_choice(Kernel, kernel=self.kernel)
        if self.up is not None:
            up = checked_array("up", self.up, np.float32, (3,)).astype(np.float64)
            if not up.any():
                raise ValueError("up must be a direction, got a vector of length 0")
            object.__setattr__(self, "up", (up / np.linalg.norm(up)).astype(np.float32))
        for name, value in [
            ("means", means),
            ("quaternions", quaternions),
            ("scales", scales),
            ("opacities", opacities),
            ("sh", sh),
            ("origin", checked_array("origin", self.origin, np.float64, (3,))),
        ]:
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        at = f", origin {in_words(self.origin)}" if self.origin.any() else ""
        return f"GaussianCloud({len(self):,} splats of degree {self.sh_degree}, kernel {self.kernel!r}{at})"

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics, 0 to 3."""
        return int(self.sh.shape[1] ** 0.5) - 1

    def of_degree(self, degree: int) -> GaussianCloud:
        """The splats with their harmonics up to ``degree``, 0 to 3."""
        if not 0 <= degree <= 3:
            raise ValueError(f"degree must be 0, 1, 2 or 3, got {degree}")
        return replace(self, sh=self.sh[:, : (degree + 1) ** 2]) if degree < self.sh_degree else self

    @property
    def colors(self) -> np.ndarray:
        """(n, 3) display RGB of degree 0 in [0, 1]: ``clip(0.5 + C0 * sh[:, 0])``."""
        return np.clip(0.5 + np.float32(SH_C0) * self.sh[:, 0], 0, 1)

    @property
    def rotations(self) -> np.ndarray:
        """(n, 3, 3) float32 rotation matrices; columns are the splat's own axes in the world frame."""
        matrices = np.empty((len(self), 3, 3), np.float32)
        for i, row in enumerate(rotation_rows(*self.quaternions.T)):
            for j, entry in enumerate(row):
                matrices[:, i, j] = entry
        return matrices

    def take(self, splats: ArrayLike | slice) -> GaussianCloud:
        """The splats that a mask (n,) bool, indices or a slice chooses, in that order."""
        rows = chosen_rows(splats, len(self), "splats")
        # np.take is several times as fast as indexing on rows as short as these.
        arrays: dict[str, Any] = {}
        for name in self._PER_SPLAT:
            arrays[name] = np.take(getattr(self, name), rows, axis=0)
        return replace(self, **arrays)

    @staticmethod
    def joined(clouds: Sequence[GaussianCloud]) -> GaussianCloud:
        """One cloud of one or more, one behind the other.

        Missing harmonics are zero; the kernel is '3dgs' unless all share one, ``up`` is None unless all have
        the same, and the origin is that of the first cloud whose origin is not zero. A DataWarning says where
        the kernel of a cloud is lost, or the detail of one that is too far from that origin.
        """
        need_all(GaussianCloud, clouds=clouds)
        if not clouds:
            raise ValueError("there must be at least one cloud to join")
        if len(clouds) == 1:
            return clouds[0]
        sh = np.zeros((sum(map(len, clouds)), max(cloud.sh.shape[1] for cloud in clouds), 3), np.float32)
        start = 0
        for cloud in clouds:
            sh[start : start + len(cloud), : cloud.sh.shape[1]] = cloud.sh
            start += len(cloud)
        kernels = sorted({cloud.kernel for cloud in clouds})
        if len(kernels) > 1:
            warn_of_data(
                f"splats of the kernels {' and '.join(map(repr, kernels))} are joined: all are drawn as"
                " '3dgs', which makes fine splats of the others wider"
            )
        origin = shared_origin(cloud.origin for cloud in clouds)
        clouds = [cloud.relative_to(origin) for cloud in clouds]
        rest = [name for name in GaussianCloud._PER_SPLAT if name != "sh"]
        arrays = {name: np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in rest}
        return GaussianCloud(
            **arrays,
            sh=sh,
            kernel=kernels[0] if len(kernels) == 1 else "3dgs",
            up=shared_up([cloud.up for cloud in clouds]),
            origin=origin,
        )

    def transformed(self, matrix: ArrayLike, *, origin: ArrayLike | None = None) -> GaussianCloud:
        """The splats after the affine map ``matrix`` of the world: moved, turned, scaled, mirrored.

        Concretely, a splat of covariance C and mean m in the world gets covariance A C A^T and mean A m + t.
        Its colour seen from direction d becomes its earlier colour seen from U^T d, where U is the orthogonal
        factor of A, and ``up`` turns by U. Where A is a similarity, cameras that move along see the same
        image.

        Args:
            matrix: (4, 4) [[A, t], [0, 1]], (3, 4) [A, t], or (3, 3) A.
            origin: (3,) float64, of the result; None: A times that of the cloud, so that ``means`` become A
                times them plus t. Where t is so large that float32 would lose their detail, it goes to the
                origin instead.

        Raises ValueError for another shape or last row, and for a matrix that is singular or not finite.
        """
        a, shift = affine_parts(np.asarray(matrix))
        reverses_axes = (np.abs(a) == np.eye(3)).all()
        moved = self._mirrored(np.diag(a)) if reverses_axes else self._mapped(a)
        mapped = a @ self.origin + 0.0
        if origin is None and shift.any() and loses_detail(moved.means, shift):
            origin = mapped + shift
        if origin is not None:
            point = checked_array("origin", origin, np.float64, (3,))
            means = self.means.astype(np.float64) @ a.T + (mapped - point + shift)
            return replace(moved, means=means, origin=point)
        if shift.any():
            moved = replace(moved, means=moved.means + shift.astype(np.float32))
        return moved if (mapped == moved.origin).all() else replace(moved, origin=mapped)

    def _mirrored(self, signs: np.ndarray) -> GaussianCloud:
        """Reverses axes: only signs change, nothing is rounded."""
        if (signs > 0).all():
            return self
        sign = dict(zip("xyz", signs, strict=True))
        # M R M is a rotation again, with quaternion (w, yz x, xz y, xy z); the splat's own axes may change
        # sign freely.
        turn = [1, sign["y"] * sign["z"], sign["x"] * sign["z"], sign["x"] * sign["y"]]
        harmonics = np.ones((self.sh.shape[1], 1), np.float32)
        for i in range(len(harmonics)):
            harmonics[i] = np.prod([sign[axis] for axis in ODD_AXES[i]])
        return replace(
            self,
            means=self.means * signs.astype(np.float32),
            quaternions=self.quaternions * np.array(turn, np.float32),
            sh=self.sh * harmonics,
            up=None if self.up is None else self.up * signs.astype(np.float32),
        )

    def _mapped(self, a: np.ndarray) -> GaussianCloud:
        u, stretch, vt = np.linalg.svd(a)
        orthogonal = u @ vt
        # A Gaussian is symmetric, so a mirror turns its axes as the rotation does that is its negative.
        proper = orthogonal * np.sign(np.linalg.det(orthogonal))
        if stretch[0] <= stretch[2] * (1 + 1e-6):
            turn = quaternions_of(proper[None])[0]
            quaternions = quaternion_product(turn, self.quaternions.astype(np.float64))
            scales = self.scales * np.float32(stretch.mean())
        else:
            # A R S = U D V^T: the new axes are the columns of U, the new scales D, largest first.
            axes, scales, _ = np.linalg.svd(a @ (self.rotations.astype(np.float64) * self.scales[:, None]))
            axes[:, :, 2] *= np.linalg.det(axes)[:, None]
            quaternions = quaternions_of(axes)
        sh = self.sh
        if sh.shape[1] > 1:
            sh = np.concatenate([sh[:, :1], harmonics_map(orthogonal, self.sh_degree) @ sh[:, 1:]], axis=1)
        means = (self.means.astype(np.float64) @ a.T).astype(np.float32)
        up = None if self.up is None else orthogonal @ self.up
        return replace(self, means=means, quaternions=quaternions, scales=scales, sh=sh, up=up)

    def relative_to(self, origin: ArrayLike) -> GaussianCloud:
        """The same splats in the world, with coordinates relative to ``origin`` (3,). A DataWarning says
        where that is too far for their detail."""
        point = checked_array("origin", origin, np.float64, (3,))
        if (point == self.origin).all():
            return self
        return replace(self, means=relative(self.means, self.origin, point), origin=point)


def shared_up(ups: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """The direction that all of ``ups`` name, None if they differ or one is None."""
    first = ups[0] if ups else None
    if first is None or any(up is None or np.abs(up - first).max() > 1e-6 for up in ups):
        return None
    return first
