"""Conversion of splats that do not fit into memory: in blocks, after passes over all of them.

The size of a pixel at a splat depends on the whole scene. The passes gather what it needs: a sample of
splats, around which cameras are placed, and the median pixel for splats that none of them sees.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from meshsplats._kinds import each, need, need_all
from meshsplats.camera import Camera
from meshsplats.cameras.framing import SAMPLE, guess_up, unit_up, warn_of_strays
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import Fans, filter_of
from meshsplats.conversion.footprint import (
    FRAMING_PIXELS,
    FRAMING_VIEWS,
    CameraCoverage,
    largest_pixel,
    none_seen,
    origin_of,
    origin_step,
)
from meshsplats.conversion.options import ConversionOptions, Preset, make_options
from meshsplats.conversion.selection import within
from meshsplats.gaussians import GaussianCloud, Kernel
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.conversion.options import ConversionChanges

BLOCK = 1 << 16
"""Splats of a block of the result: a multiple of the chunks of all steps of a conversion, so that these see
the same numbers as in a conversion of the whole."""


@dataclass(frozen=True, eq=False)
class Survey:
    """What the conversion of a part needs to know of the whole scene."""

    kept: int
    """Count of the splats that are converted: inside the crop box and opaque enough."""
    kernel: Kernel
    low: np.ndarray
    """(3,) float64 least coordinates of the centres that are kept."""
    high: np.ndarray
    """(3,) float64 greatest ones."""
    sample: GaussianCloud
    """Every ``step``-th of the kept splats, of degree 0; its origin is that of all splats."""
    step: int
    origin: np.ndarray
    """(3,) float64 as ``CameraCoverage.origin`` of all of them, in their coordinates."""


def survey(source: Iterable[GaussianCloud], options: ConversionOptions) -> Survey:
    """Two passes over the blocks of ``source``, for the resolved ``options``.

    Raises ValueError if no splat is left to convert.
    """
    read = kept = 0
    kernels: set[Kernel] = set()
    low, high, most, largest = np.full(3, np.inf), np.full(3, -np.inf), 0.0, 0.0
    for block in source:
        read += len(block)
        kernels.add(block.kernel)
        most = max(most, float(block.opacities.max(initial=0)))
        rows = worth_drawing(block, options)
        if len(rows):
            kept += len(rows)
            means = block.means[rows]
            low, high = np.minimum(low, means.min(axis=0)), np.maximum(high, means.max(axis=0))
            largest = max(largest, float(block.scales[rows].max()))
    if not kept:
        raise ValueError(
            f"none of the {read:,} splats is left to convert: the crop box holds none, or the greatest"
            f" opacity, {most:.4g}, is below min_opacity {options.min_opacity or 0:.4g}"
        )
    kernel = kernels.pop() if len(kernels) == 1 else "3dgs"
    step, distance = -(-kept // SAMPLE), origin_step(kept)
    samples, near_origin = [], []
    passed = 0
    for block in source:
        part = replace(block.take(worth_drawing(block, options)), kernel=kernel)
        samples.append(flattened(part).take(np.arange(-passed % step, len(part), step)))
        near_origin.append(part.means[-passed % distance :: distance])
        passed += len(part)
    if passed != kept:
        raise ValueError(f"the splats changed while they were read: {kept:,} before, {passed:,} now")
    sample = GaussianCloud.joined(samples)
    warn_of_strays(sample, low, high, largest)
    return Survey(kept, kernel, low, high, sample, step, origin_of(np.concatenate(near_origin)))


def worth_drawing(block: GaussianCloud, options: ConversionOptions) -> np.ndarray:
    """(k,) rows of the splats that are inside the crop box and opaque enough, ascending."""
    return np.flatnonzero(within(block, options.crop, options.min_opacity))


def flattened(cloud: GaussianCloud) -> GaussianCloud:
    """``cloud`` with its harmonics of degree 0 alone."""
    return replace(cloud, sh=cloud.sh[:, :1]) if cloud.sh_degree else cloud


class ScenePixels:
    """Size of a pixel at any splat of a surveyed scene, as a conversion of the whole has it.

    Args:
        scene: the survey.
        options: resolved ones.
        cameras: where the mesh will be seen from, for ``footprint='cameras'``.
        up: (3,) unit vector.
    """

    def __init__(
        self,
        scene: Survey,
        options: ConversionOptions,
        cameras: Sequence[Camera] | None,
        up: np.ndarray,
    ) -> None:
        self._fixed: np.float32 | None = None
        self._cameras: Sequence[Camera] = cameras or ()
        self._origin, self._largest = scene.origin, np.float32(np.inf)
        self.unseen = np.float32(1)
        """At splats that no camera sees: the median pixel of the others, of the sample at first."""
        self.is_none = options.footprint in ("none", "filter")
        if self.is_none:
            return
        if options.footprint == "distance":
            self._fixed = np.float32(options.viewing_distance / options.focal)  # type: ignore[operator]
            return
        if options.footprint == "framing":
            side = FRAMING_PIXELS
            self._cameras = orbit(scene.sample, FRAMING_VIEWS, width=side, height=side, up=up)
            self._largest = largest_pixel(scene.sample.means, scene.step)
        sizes = self.seen(scene.sample.means)
        if not (sizes > 0).any():
            raise ValueError(none_seen(self._cameras, scene.sample.means, scene.kept))
        self.unseen = np.median(sizes[sizes > 0])

    @property
    def has_unseen(self) -> bool:
        """Whether splats may be outside all images."""
        return not self.is_none and self._fixed is None

    def coverage(self, means: np.ndarray) -> CameraCoverage:
        return CameraCoverage(means, self._cameras, self._origin)

    def seen(self, means: np.ndarray) -> np.ndarray:
        """(n,) float32 sizes in scene units, 0 where no camera sees the splat."""
        return self.coverage(means).pixel_sizes()

    def at(self, means: np.ndarray) -> np.ndarray | None:
        """(n,) float32 sizes at ``means`` (n, 3); None without a footprint."""
        if self.is_none:
            return None
        if self._fixed is not None:
            return np.full(len(means), self._fixed, np.float32)
        sizes = self.seen(means)
        sizes = np.where(sizes > 0, sizes, self.unseen)
        return np.minimum(sizes, self._largest, out=sizes)


def convert_blocks(
    source: Iterable[GaussianCloud],
    options: ConversionOptions | None = None,
    *,
    preset: Preset = "default",
    cameras: Sequence[Camera] | None = None,
    up: Sequence[float] | np.ndarray | None = None,
    **changes: Unpack[ConversionChanges],
) -> Iterator[SplatMesh]:
    """``convert`` for splats that do not fit into memory: the same mesh in parts.

    Together, the parts have the vertices, triangles and colours of ``convert``, in their order and to the
    last bit. Each part numbers its own vertices; ``face_splat`` holds rows of all splats. Before the first
    part there are two passes over the splats, three where splats may lie outside all images.

    Args:
        source: the splats, as ``stream_gaussians`` gives them: blocks that can be iterated over several
            times.
        options, preset, cameras, up, changes: as for ``convert``.

    Raises:
        ValueError: as ``convert``; and for what needs all splats at once: limits that splats are merged or
            dropped for, and ``detail='cameras'``.
    """
    source = each(GaussianCloud, "source", source, again=True)
    need(ConversionOptions, options=options, optional=True)
    need_all(Camera, cameras=cameras, optional=True)
    given = make_options(options, **changes)
    chosen = given.resolved(preset, has_cameras=bool(cameras))
    refuse_whole(chosen)
    scene = survey(source, chosen)
    direction = guess_up(scene.sample, cameras) if up is None else unit_up(up)
    cameras = [camera.with_near_plane(scene.sample.means) for camera in cameras or ()]
    filter_px2 = filter_of(scene.kernel, chosen)
    pixels = ScenePixels(scene, chosen, cameras, direction)
    if pixels.has_unseen:
        pixels.unseen = _median_seen(source, chosen, pixels)

    def pieces() -> Iterator[_Piece]:
        for block, rows in _aligned(source, chosen, scene.kernel):
            fans = Fans.of(block, chosen, pixels.at(block.means))
            colors = block.colors
            if cameras and chosen.colors == "cameras" and block.sh_degree:
                colors = CameraCoverage(block.means, cameras, scene.origin).mean_colors(block.sh)
            keep = fans.areas[:, 0] > 0 if chosen.min_opacity else np.ones(len(block), bool)
            yield _Piece(flattened(block), rows, colors, fans).select(np.flatnonzero(keep))

    done = 0
    for piece in _cut(pieces()):
        done += len(piece.rows)
        vertices, faces, rgba, owners = piece.fans.build(
            piece.cloud, piece.rows, piece.colors, chosen.compensation
        )
        yield SplatMesh(
            vertices,
            faces,
            rgba,
            face_splat=owners,
            up=direction,
            filter_px2=filter_px2,
            origin=scene.sample.origin,
        )
    if not done:
        raise ValueError(f"none of the {scene.kept:,} splats has a visible area")


def refuse_whole(options: ConversionOptions) -> None:
    """Raises ValueError for resolved ``options`` that need all splats in memory."""
    if options.max_splats is not None or options.max_triangles is not None:
        raise ValueError("limits on splats or triangles need all splats in memory: use convert")
    if options.detail == "cameras":
        raise ValueError("detail='cameras' needs all splats in memory: use convert")


@dataclass(frozen=True, eq=False)
class _Piece:
    """Splats, each with its row among all, and their fans."""

    cloud: GaussianCloud
    rows: np.ndarray
    colors: np.ndarray
    fans: Fans

    def select(self, index: np.ndarray) -> _Piece:
        if len(index) == len(self.rows):
            return self
        own: dict[str, Any] = {name: np.take(getattr(self.fans, name), index, axis=0) for name in _PER_SPLAT}
        return _Piece(self.cloud.take(index), self.rows[index], self.colors[index], self.fans._replace(**own))

    @staticmethod
    def together(pieces: Sequence[_Piece]) -> _Piece:
        if len(pieces) == 1:
            return pieces[0]
        own: dict[str, Any] = {
            name: np.concatenate([getattr(p.fans, name) for p in pieces]) for name in _PER_SPLAT
        }
        return _Piece(
            GaussianCloud.joined([p.cloud for p in pieces]),
            np.concatenate([p.rows for p in pieces]),
            np.concatenate([p.colors for p in pieces]),
            pieces[0].fans._replace(**own),
        )


_PER_SPLAT = tuple(name for name in Fans._fields if name != "shapes")


def _cut(pieces: Iterable[_Piece]) -> Iterator[_Piece]:
    """The splats of ``pieces`` in pieces of ``BLOCK``; the last may be shorter."""
    held: list[_Piece] = []
    count = 0
    for piece in pieces:
        held.append(piece)
        count += len(piece.rows)
        while count >= BLOCK:
            whole = _Piece.together(held)
            yield whole.select(np.arange(BLOCK))
            held = [whole.select(np.arange(BLOCK, count))]
            count -= BLOCK
    if count:
        yield _Piece.together(held)


def _aligned(
    source: Iterable[GaussianCloud], options: ConversionOptions, kernel: Kernel
) -> Iterator[tuple[GaussianCloud, np.ndarray]]:
    """The splats worth drawing in blocks of ``BLOCK`` (the last may be shorter), with their rows."""
    held: list[GaussianCloud] = []
    numbers: list[np.ndarray] = []
    count = passed = 0
    for block in source:
        rows = worth_drawing(block, options)
        if len(rows):
            part = replace(block.take(rows), kernel=kernel)
            held.append(part if options.colors == "cameras" else flattened(part))
            numbers.append((rows + passed).astype(np.int32))
            count += len(rows)
        passed += len(block)
        while count >= BLOCK:
            cloud, own = GaussianCloud.joined(held), np.concatenate(numbers)
            yield cloud.take(np.arange(BLOCK)), own[:BLOCK]
            held, numbers = [cloud.take(np.arange(BLOCK, count))], [own[BLOCK:]]
            count -= BLOCK
    if count:
        yield GaussianCloud.joined(held), np.concatenate(numbers)


def _median_seen(
    source: Iterable[GaussianCloud], options: ConversionOptions, pixels: ScenePixels
) -> np.float32:
    """The median size of a pixel at the splats that cameras see, exactly.

    Sizes are positive floats, whose bits are in the order of their values: a histogram of the upper half of
    the bits and one of the lower half for the two bins in the middle find them in two passes.
    """

    flat = replace(options, colors="degree0")

    def blocks() -> Iterator[np.ndarray]:
        for block, _ in _aligned(source, flat, "3dgs"):
            yield pixels.seen(block.means)

    upper = np.zeros(1 << 16, np.int64)
    unseen = 0
    for sizes in blocks():
        upper += np.bincount(sizes[sizes > 0].view(np.uint32) >> np.uint32(16), minlength=1 << 16)
        unseen += int((sizes == 0).sum())
    total = int(upper.sum())
    if not total or not unseen:
        return pixels.unseen
    places = sorted({(total - 1) // 2, total // 2})
    ends = np.cumsum(upper)
    bins = [int(np.searchsorted(ends, place, side="right")) for place in places]
    lower = {b: np.zeros(1 << 16, np.int64) for b in bins}
    for sizes in blocks():
        bits = sizes[sizes > 0].view(np.uint32)
        high = bits >> np.uint32(16)
        for b, counts in lower.items():
            counts += np.bincount(bits[high == b] & np.uint32(0xFFFF), minlength=1 << 16)
    found = []
    for place, b in zip(places, bins, strict=True):
        rest = place - (int(ends[b - 1]) if b else 0)
        low = int(np.searchsorted(np.cumsum(lower[b]), rest, side="right"))
        found.append(np.array([(b << 16) | low], np.uint32).view(np.float32)[0])
    return np.median(np.array(found, np.float32))
