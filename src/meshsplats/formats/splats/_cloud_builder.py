"""Collects the splats of a file into a GaussianCloud and drops unusable ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._validation import Budget, warn_of_coarse_steps, warn_of_lost_detail
from meshsplats.formats.opened import Splats
from meshsplats.scene.gaussians import GaussianCloud, Kernel
from meshsplats.scene.origin import choose_origin, sampled, zero_origin


class SplatRows(NamedTuple):
    """Views of the rows to be filled next, as in GaussianCloud but with quaternions of any length."""

    means: np.ndarray
    quaternions: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


Fill = Callable[[SplatRows], None]
"""Writes the splats of a chunk of a file into rows that are as many."""
Chunks = Callable[[np.ndarray], Iterator[tuple[int, Fill]]]
"""For an origin (3,) float64, which is subtracted from positions before they are rounded: count of the splats
of each chunk, and what reads them."""


def _nothing() -> None:
    pass


@dataclass(frozen=True)
class SplatReader(Splats):
    """Splats that are read chunk by chunk."""

    count: int
    """Count of the splats that the file declares."""
    coefficients: int
    """Spherical harmonics per channel, 1, 4, 9 or 16."""
    kernel: Kernel
    where: object
    """The file, for messages."""
    chunks: Chunks
    positions: Callable[[], np.ndarray]
    """Gives a sample (k, 3) float64 of the positions, by which the origin is chosen."""
    float32: bool = True
    """Whether the file has no more digits of positions than float32."""
    origin: np.ndarray | None = None
    """The origin that the file names, which its positions are relative to."""
    up: np.ndarray | None = None
    linear: bool = False
    instant: float | None = None
    to_y_down: np.ndarray | None = None
    close_files: Callable[[], None] = _nothing
    """Closes the files that ``chunks`` reads, where the reader has opened them."""

    def close(self) -> None:
        self.close_files()

    def with_kernel(self, kernel: Kernel) -> SplatReader:
        return replace(self, kernel=kernel)

    def world_sample(self) -> np.ndarray:
        return self.positions() if self.origin is None else self.positions() + self.origin

    def chosen_origin(self) -> np.ndarray:
        """As in ``Splats``, with a DataWarning for a file that has lost detail."""
        if self.origin is not None:
            return self.origin
        if not self.count:
            return zero_origin()
        sample = self.positions()
        if self.float32:
            warn_of_lost_detail(sample, self.where)
        return choose_origin(sample)

    def read(self, *, strict: bool, origin: np.ndarray | None = None) -> GaussianCloud:
        origin = self.chosen_origin() if origin is None else origin
        builder = self._builder(origin)
        for m, fill in self.chunks(self._shift(origin)):
            rows = builder.next(m)
            fill(rows)
            builder.keep(rows)
        cloud = builder.finish(self.kernel, strict=strict)
        self._check_steps(cloud)
        return cloud

    def blocks(self, size: int, *, strict: bool, origin: np.ndarray) -> Iterator[GaussianCloud]:
        builder: CloudBuilder | None = None
        for m, fill in self.chunks(self._shift(origin)):
            if builder is None:
                builder = self._builder(origin, max(size, m))
            elif builder.held and builder.held + m > size:
                yield from self._taken(builder)
            rows = builder.next(m)
            fill(rows)
            builder.keep(rows)
            if strict:
                builder.report(strict=True)
        builder = builder or self._builder(origin)
        builder.report(strict=strict)
        if builder.held:
            yield from self._taken(builder)

    def _taken(self, builder: CloudBuilder) -> Iterator[GaussianCloud]:
        """The splats that ``builder`` holds, as a block; the first is looked at for lost detail."""
        first, block = builder.taken == 0, builder.take(self.kernel)
        if first:
            self._check_steps(block)
        yield block

    def _check_steps(self, cloud: GaussianCloud) -> None:
        sample = sampled(cloud.means)
        if self.float32 and self.origin is None:
            sample += cloud.origin
        warn_of_coarse_steps(sample, cloud.scales, self.where)

    def _builder(self, origin: np.ndarray, capacity: int | None = None) -> CloudBuilder:
        flat = self.kernel == "2dgs"
        return CloudBuilder(self.count, self.coefficients, self.where, capacity, origin, flat=flat)

    def _shift(self, origin: np.ndarray) -> np.ndarray:
        """What is subtracted from the stored positions, so that they are relative to ``origin``."""
        return origin if self.origin is None else origin - self.origin


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
        origin: np.ndarray | None = None,
        *,
        flat: bool = False,
    ) -> None:
        if count == 0:
            raise FileFormatError(f"{where}: no splats, the file declares 0 of them")
        self._where, self._count, self._flat = where, count, flat
        self._origin = zero_origin() if origin is None else origin
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
    def taken(self) -> int:
        """Count of the rows that were taken."""
        return self._taken

    @property
    def held(self) -> int:
        """Count of the rows that are kept and not yet taken."""
        return self._kept

    def take(self, kernel: Kernel) -> GaussianCloud:
        """The kept rows as a cloud of their own; they make room for others."""
        means, quaternions, scales, opacities, sh = (array[: self._kept].copy() for array in self._arrays)
        self._taken += self._kept
        self._kept = 0
        return GaussianCloud(means, quaternions, scales, opacities, sh, kernel, origin=self._origin)

    def next(self, m: int) -> SplatRows:
        """The next ``m`` rows, to be written."""
        return SplatRows(*(a[self._kept : self._kept + m] for a in self._arrays))

    def keep(self, rows: SplatRows) -> np.ndarray:
        """Keeps the rows from ``next``: normalises their quaternions and drops unusable ones. Returns (m,)
        bool which are kept."""
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
        return good

    def finish(self, kernel: Kernel, *, strict: bool) -> GaussianCloud:
        """The cloud. Dropped splats give a DataWarning; an error if ``strict`` or if none is left."""
        if self.report(strict=strict):
            for array in self._arrays:
                array.resize((self._kept, *array.shape[1:]), refcheck=False)  # shrinks in place
        means, quaternions, scales, opacities, sh = self._arrays
        return GaussianCloud(means, quaternions, scales, opacities, sh, kernel, origin=self._origin)

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
    return GaussianCloud.joined(clouds)


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
