"""Conversion of splats that do not fit into memory: in blocks, after passes over all of them.

The size of a pixel at a splat depends on the whole scene. The passes gather what it needs: a sample of
splats, around which cameras are placed, and the median pixel for splats that none of them sees.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from meshsplats._common.kinds import each, need, need_all
from meshsplats.cameras.framing import SAMPLE, guess_up, unit_up, warn_of_strays
from meshsplats.conversion.driver import Driver, Piece, drawn_part, filter_of, worth_drawing
from meshsplats.conversion.footprint import SceneSample, SceneViews, origin_of, origin_step
from meshsplats.conversion.options import ConversionOptions, Preset, make_options
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud, Kernel
from meshsplats.scene.mesh import SplatMesh

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.conversion.options import ConversionChanges

BLOCK = 1 << 16
"""Splats of a block of the result: a multiple of the chunks of all steps of a conversion, so that these see
the same numbers as in a conversion of the whole."""


@dataclass(frozen=True, eq=False)
class Survey(SceneSample):
    """A sample of a scene, and its bounds."""

    low: np.ndarray
    """(3,) float64 least coordinates of the centres that are kept."""
    high: np.ndarray
    """(3,) float64 greatest ones."""
    sh_degree: int
    """Greatest degree of the splats. The sample has degree 0."""


def survey(source: Iterable[GaussianCloud], options: ConversionOptions) -> Survey:
    """Two passes over the blocks of ``source``, for the resolved ``options``.

    Raises ValueError if no splat is left to convert.
    """
    read = kept = degree = 0
    kernels: set[Kernel] = set()
    low, high, most, largest = np.full(3, np.inf), np.full(3, -np.inf), 0.0, 0.0
    for block in source:
        read += len(block)
        kernels.add(block.kernel)
        degree = max(degree, block.sh_degree)
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
        part = replace(block.of_degree(0).take(worth_drawing(block, options)), kernel=kernel)
        samples.append(part.take(np.arange(-passed % step, len(part), step)))
        near_origin.append(part.means[-passed % distance :: distance])
        passed += len(part)
    if passed != kept:
        raise ValueError(f"the splats changed while they were read: {kept:,} before, {passed:,} now")
    sample = GaussianCloud.joined(samples)
    warn_of_strays(sample, low, high, largest)
    origin = origin_of(np.concatenate(near_origin))
    return Survey(kept, kernel, sample, step, origin, low, high, degree)


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
    views = SceneViews(scene, chosen, cameras, direction)
    if views.has_unseen:
        views.unseen = _median_seen(source, chosen, views) or views.unseen
    driver = Driver(chosen, views, direction, scene.sample.origin, filter_of(scene.kernel, chosen))

    def pieces() -> Iterator[Piece]:
        for block, rows in _aligned(source, chosen, scene.kernel):
            piece = driver.piece(block, rows)
            if chosen.colors != "view":
                piece = replace(piece, cloud=piece.cloud.of_degree(0))
            yield piece.select(np.flatnonzero(driver.has_area(piece)))

    done = 0
    for piece in _cut(pieces()):
        done += len(piece.rows)
        yield driver.mesh(piece)
    if not done:
        raise ValueError(f"none of the {scene.kept:,} splats has a visible area")


def refuse_whole(options: ConversionOptions) -> None:
    """Raises ValueError for resolved ``options`` that need all splats in memory."""
    if options.max_splats is not None or options.max_triangles is not None:
        raise ValueError("limits on splats or triangles need all splats in memory: use convert")
    if options.detail == "cameras":
        raise ValueError("detail='cameras' needs all splats in memory: use convert")


def _cut(pieces: Iterable[Piece]) -> Iterator[Piece]:
    """The splats of ``pieces`` in pieces of ``BLOCK``; the last may be shorter."""
    held: list[Piece] = []
    count = 0
    for piece in pieces:
        held.append(piece)
        count += len(piece.rows)
        while count >= BLOCK:
            whole = Piece.together(held)
            yield whole.select(np.arange(BLOCK))
            held = [whole.select(np.arange(BLOCK, count))]
            count -= BLOCK
    if count:
        yield Piece.together(held)


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
            held.append(replace(drawn_part(block, rows, options), kernel=kernel))
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
    source: Iterable[GaussianCloud], options: ConversionOptions, views: SceneViews
) -> np.float32 | None:
    """The median size of a pixel at the splats that cameras see, exactly; None where they see all or none.

    Sizes are positive floats, whose bits are in the order of their values: a histogram of the upper half of
    the bits and one of the lower half for the two bins in the middle find them in two passes.
    """

    flat = replace(options, colors="base")

    def blocks() -> Iterator[np.ndarray]:
        for block, _ in _aligned(source, flat, "3dgs"):
            yield views.seen(block.means)

    upper = np.zeros(1 << 16, np.int64)
    unseen = 0
    for sizes in blocks():
        upper += np.bincount(sizes[sizes > 0].view(np.uint32) >> np.uint32(16), minlength=1 << 16)
        unseen += int((sizes == 0).sum())
    total = int(upper.sum())
    if not total or not unseen:
        return None
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
