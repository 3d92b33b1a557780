"""Splats that move in time, in a .ply: what they are at one instant.

Two layouts have a published formula, with dt = t - the splat's own time:

- Spacetime Gaussian Feature Splatting (Li et al., CVPR 2024; the lite model of the authors' code): opacity
  times exp(-(dt / exp(trbf_scale))^2), centre + motion_0..2 dt + motion_3..5 dt^2 + motion_6..8 dt^3,
  quaternion + omega dt. Without f_rest, f_dc are the colours themselves. The full model mixes colours with a
  network that lies in another file.
- 4D Gaussian Splatting (Yang et al., ICLR 2024, and the authors' code): a Gaussian in space and
  time with four scales and two quaternions, rot_0..3 on the left and rot_r_0..3 on the right. Its slice at t
  is a Gaussian in space; opacity times exp(-dt^2 / (2 variance of time)), and nothing where that is at most
  0.05. Without rot_r it does not move, and exp(scale_t) is the variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats._common.geometry import quaternions_of
from meshsplats.errors import FileFormatError
from meshsplats.formats.splats._cloud_builder import SplatRows

_CUT = 0.05
"""4D Gaussian Splatting does not draw a splat whose opacity time has lowered to this share."""
_UNKNOWN = {
    *("motion_0", "omega_0", "mu_t", "t_scale", "rot_l_0", "t_center", "time_center", "t_sigma"),
    *("time_scale", "scale_time", "duration", "durations", "scale_t", "scale_t_0"),
}
"""Properties of moving splats whose formula is not known here."""


@dataclass(frozen=True)
class Motion:
    """A layout of moving splats, and its columns in a file."""

    name: str
    time: str
    """Property with the time at which a splat is most visible."""
    span: str
    """Property with the logarithm of how long it is visible."""
    path: tuple[str, ...]
    """Coefficients of the motion, axis by axis within each power of dt."""
    turn: tuple[str, ...]
    """Derivative of the quaternion, or the right quaternion."""
    plain_colors: bool = False
    """Whether f_dc are colours, not harmonics."""

    @property
    def needed(self) -> tuple[str, ...]:
        """The properties that are read besides those of splats at rest."""
        return (self.time, self.span, *self.path, *self.turn)

    def apply(self, rows: SplatRows, columns: dict[str, np.ndarray], time: float) -> None:
        """Moves ``rows`` to ``time``."""
        dt = time - columns[self.time].astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore", under="ignore", divide="ignore"):
            if self.name == _SPACETIME:
                self._spacetime(rows, columns, dt)
            else:
                self._sliced(rows, columns, dt)

    def _spacetime(self, rows: SplatRows, columns: dict[str, np.ndarray], dt: np.ndarray) -> None:
        rows.opacities[:] *= np.exp(-np.square(dt / np.exp(columns[self.span].astype(np.float64))))
        means = rows.means.astype(np.float64)
        for power in range(len(self.path) // 3):
            velocity = np.stack([columns[name] for name in self.path[3 * power : 3 * power + 3]], axis=1)
            means += velocity * (dt ** (power + 1))[:, None]
        rows.means[:] = means
        if self.turn:
            rows.quaternions[:] += np.stack([columns[name] for name in self.turn], axis=1) * dt[:, None]

    def _sliced(self, rows: SplatRows, columns: dict[str, np.ndarray], dt: np.ndarray) -> None:
        span = np.exp(columns[self.span].astype(np.float64))
        variance = span
        if self.turn:
            right = np.stack([columns[name] for name in self.turn], axis=1).astype(np.float64)
            axes = _rotations_4d(rows.quaternions.astype(np.float64), right)
            axes *= np.concatenate([rows.scales, span[:, None]], axis=1)[:, None, :]
            covariance = axes @ axes.transpose(0, 2, 1)
            variance = covariance[:, 3, 3]
            drift = covariance[:, :3, 3] / variance[:, None]
            rows.means[:] += drift * dt[:, None]
            slices = covariance[:, :3, :3] - drift[:, :, None] * covariance[:, None, 3, :3]
            good = np.isfinite(slices).all(axis=(1, 2))
            values, vectors = np.linalg.eigh(np.where(good[:, None, None], slices, np.eye(3)))
            vectors[:, :, 2] *= np.sign(np.linalg.det(vectors))[:, None]
            rows.scales[:] = np.where(good[:, None], np.sqrt(np.maximum(values, 0)), np.nan)
            rows.quaternions[:] = quaternions_of(vectors)
        share = np.exp(-0.5 * np.square(dt) / variance)
        rows.opacities[:] *= np.where(share > _CUT, share, 0)


_SPACETIME = "Spacetime Gaussians"


def motion_of(properties: Sequence[str], where: object) -> Motion | None:
    """The motion that splats with these properties have, None if they are at rest.

    Raises FileFormatError for splats that move by a formula that is not known.
    """
    names = set(properties)

    def numbered(prefix: str, counts: Sequence[int]) -> tuple[str, ...]:
        found = [name for name in names if name.startswith(prefix) and name[len(prefix) :].isdecimal()]
        wanted = tuple(f"{prefix}{i}" for i in range(len(found)))
        if set(found) != set(wanted) or len(found) not in counts:
            raise FileFormatError(
                f"{where}: splats that move in time ({', '.join(sorted(found))}), of which {prefix}0 to"
                f" {prefix}{max(counts) - 1} are expected"
            )
        return wanted

    if names & {"trbf_center", "trbf_scale"}:
        if lacking := {"trbf_center", "trbf_scale"} - names:
            raise FileFormatError(
                f"{where}: splats that move in time (Spacetime Gaussians) without {lacking.pop()}: they"
                " cannot be shown at one instant, and all instants at once are no scene"
            )
        if "f_t_0" in names or "f_dc_3" in names:
            raise FileFormatError(
                f"{where}: splats that move in time, of the full model of Spacetime Gaussians, whose colours"
                " come from a network that lies in another file; only its lite model is read"
            )
        return Motion(
            _SPACETIME,
            "trbf_center",
            "trbf_scale",
            numbered("motion_", (0, 3, 6, 9)),
            numbered("omega_", (0, 4)),
            plain_colors="f_dc_0" in names and "f_rest_0" not in names,
        )
    span = next((name for name in ("scale_t_0", "scale_t") if name in names), None)
    if "t" in names and span and ("rot_r_0" in names or span == "scale_t_0"):
        return Motion("4D Gaussian Splatting", "t", span, (), numbered("rot_r_", (0, 4)))
    if names & _UNKNOWN:
        raise FileFormatError(
            f"{where}: splats that move in time ({', '.join(sorted(names & _UNKNOWN)[:4])}), in a layout"
            " whose formula is not known here; export them at one instant, as a .ply of splats at rest"
        )
    return None


def _rotations_4d(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(n, 4, 4) rotations of x, y, z, t by pairs of quaternions w x y z of any length: v -> left v right',
    with t as the real part and x y z in the order of the authors' code, reversed."""
    a, b, c, d = (left / np.linalg.norm(left, axis=1, keepdims=True)).T
    p, q, r, s = (right / np.linalg.norm(right, axis=1, keepdims=True)).T
    first = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
    second = np.array([[p, q, r, s], [-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]])
    return np.einsum("ijn,jkn->nik", first, second)[:, ::-1, ::-1].copy()
