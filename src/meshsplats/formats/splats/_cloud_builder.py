"""Collects the splats of a file into a GaussianCloud and drops unusable ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._validation import Budget
from meshsplats.gaussians import GaussianCloud, Kernel, joined


class SplatRows(NamedTuple):
    """Views of the rows to be filled next, as in GaussianCloud but with quaternions of any length."""

    means: np.ndarray
    quaternions: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


Fill = Callable[[SplatRows], None]
"""Writes the splats of a chunk of a file into rows that are as many."""


@dataclass(frozen=True)
class SplatReader:
    """The splats of an opened file, ready to be read once, as a whole or in blocks."""

    count: int
    """Count of the splats that the file declares."""
    coefficients: int
    """Spherical harmonics per channel, 1, 4, 9 or 16."""
    kernel: Kernel
    where: object
    """The file, for messages."""
    chunks: Iterator[tuple[int, Fill]]
    """Count of the splats of each chunk, and what reads them."""
    up: np.ndarray | None = None
    """(3,) direction that points up in the axes of the file, where it says so."""
    linear: bool = False
    """Whether its colours are linear, not display values."""
    instant: float | None = None
    """The time at which they are shown, of splats that move."""

    def read(self, *, strict: bool) -> GaussianCloud:
        """All splats; errors and warnings as ``load_gaussians``, which must be the caller."""
        builder = CloudBuilder(self.count, self.coefficients, self.where, flat=self.kernel == "2dgs")
        for m, fill in self.chunks:
            rows = builder.next(m)
            fill(rows)
            builder.keep(rows)
        return builder.finish(self.kernel, strict=strict)

    def blocks(self, size: int, *, strict: bool) -> Iterator[GaussianCloud]:
        """The same splats in blocks of about ``size``."""
        builder: CloudBuilder | None = None
        for m, fill in self.chunks:
            if builder is None:
                builder = CloudBuilder(
                    self.count,
                    self.coefficients,
                    self.where,
                    capacity=max(size, m),
                    flat=self.kernel == "2dgs",
                )
            elif builder.held and builder.held + m > size:
                yield builder.take(self.kernel)
            rows = builder.next(m)
            fill(rows)
            builder.keep(rows)
            if strict:
                builder.report(strict=True)
        builder = builder or CloudBuilder(self.count, self.coefficients, self.where)
        builder.report(strict=strict)
        if builder.held:
            yield builder.take(self.kernel)


class CloudBuilder:
    """The arrays of a cloud, filled in chunks: ``rows = builder.next(m)``, fill them, ``builder.keep(rows)``.

    A row is dropped and counted if a value is not finite after activation or if its quaternion is zero. Later
    rows take its place, so that no array is copied. With a ``capacity`` of fewer rows than ``count``, kept
    rows must be taken out before there are more. The third scales of ``flat`` splats become 0: where formats
    must have three, writers of 2DGS splats put anything there.
    """

    def __init__(
        self,
        count: int,
        coefficients: int,
        where: object,
        capacity: int | None = None,
        *,
        flat: bool = False,
    ) -> None:
        if count == 0:
            raise FileFormatError(f"{where}: no splats, the file declares 0 of them")
        self._where, self._count, self._flat = where, count, flat
        rows = count if capacity is None else min(capacity, count)
        self._arrays = SplatRows(
            np.empty((rows, 3), np.float32),
            np.empty((rows, 4), np.float32),
            np.empty((rows, 3), np.float32),
            np.empty(rows, np.float32),
            np.empty((rows, coefficients, 3), np.float32),
        )
        self._kept = self._taken = self._not_finite = self._zero_quaternions = 0
        self._first_bad: int | None = None

    @property
    def held(self) -> int:
        """Count of the rows that are kept and not yet taken."""
        return self._kept

    def take(self, kernel: Kernel) -> GaussianCloud:
        """The kept rows as a cloud of their own; they make room for others."""
        means, quaternions, scales, opacities, sh = (array[: self._kept].copy() for array in self._arrays)
        self._taken += self._kept
        self._kept = 0
        return GaussianCloud(means, quaternions, scales, opacities, sh, kernel)

    def next(self, m: int) -> SplatRows:
        """The next ``m`` rows, to be written."""
        return SplatRows(*(a[self._kept : self._kept + m] for a in self._arrays))

    def keep(self, rows: SplatRows) -> None:
        """Keeps the rows from ``next``: normalises their quaternions and drops unusable ones."""
        m = len(rows.means)
        if self._flat:
            rows.scales[:, 2] = 0
        finite = np.ones(m, bool)
        for array in rows:
            # A sum is not finite if any term is not: only then check each value.
            with np.errstate(invalid="ignore", over="ignore"):
                suspicious = not np.isfinite(array.sum())
            if suspicious:
                finite &= np.isfinite(array).reshape(m, -1).all(axis=1)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            q = rows.quaternions.astype(np.float64)  # squares of float32 neither overflow nor vanish
            norm = np.sqrt(np.einsum("ij,ij->i", q, q))
            rows.quaternions[:] = q / norm[:, None]
        has_rotation = norm > 0
        good = finite & has_rotation
        if not good.all():
            if self._first_bad is None:
                self._first_bad = self._taken + self._kept + int(good.argmin())
            self._not_finite += int((~finite).sum())
            self._zero_quaternions += int((finite & ~has_rotation).sum())
            m = int(good.sum())
            for array in rows:
                array[:m] = array[good]
        self._kept += m

    def finish(self, kernel: Kernel, *, strict: bool) -> GaussianCloud:
        """The cloud. Dropped splats give a DataWarning; an error if ``strict`` or if none is left."""
        if self.report(strict=strict):
            for array in self._arrays:
                array.resize((self._kept, *array.shape[1:]), refcheck=False)  # shrinks in place
        means, quaternions, scales, opacities, sh = self._arrays
        return GaussianCloud(means, quaternions, scales, opacities, sh, kernel)

    def report(self, *, strict: bool) -> int:
        """Count of dropped splats; they give a DataWarning, an error if ``strict`` or if none is left."""
        dropped = self._not_finite + self._zero_quaternions
        if dropped:
            reasons = []
            if self._not_finite:
                reasons.append(f"{self._not_finite:,} with values that are not finite")
            if self._zero_quaternions:
                reasons.append(f"{self._zero_quaternions:,} with a zero quaternion")
            what = f"{dropped:,} of {self._count:,} splats are unusable: {' and '.join(reasons)}"
            what += f"; the first is splat {self._first_bad:,} (from 0)"
            if not self._kept + self._taken:
                raise FileFormatError(f"{self._where}: no usable splats; {what}")
            if strict:
                raise FileFormatError(f"{self._where}: {what}; without strict they would be left out")
            warnings.warn(f"{self._where}: {what}; they are left out", DataWarning, stacklevel=5)
        return dropped


def joined_within(clouds: Sequence[GaussianCloud], budget: Budget) -> GaussianCloud:
    """``joined``, which takes memory from the ``budget`` of a file."""
    if len(clouds) > 1:
        count, width = sum(map(len, clouds)), max(cloud.sh.shape[1] for cloud in clouds)
        budget.spend(4 * (11 + 3 * width) * count, f"its {count:,} splats together")
    return joined(clouds)


def decode_smallest_three(out: np.ndarray, small: np.ndarray, largest: np.ndarray) -> None:
    """Writes quaternions ``out`` (m, 4) from three components (m, 3) and the index (m,) of the omitted one.

    Of a unit quaternion the component that is largest in magnitude is omitted and taken as positive; the
    others follow in order.
    """
    rest = np.sqrt(np.maximum(0, 1 - np.einsum("ij,ij->i", small, small)))
    for omitted in range(4):
        chosen = largest == omitted
        out[chosen, omitted] = rest[chosen]
        for i, column in enumerate([c for c in range(4) if c != omitted]):
            out[chosen, column] = small[chosen, i]
