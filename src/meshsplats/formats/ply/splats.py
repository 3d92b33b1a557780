"""Splats as a float .ply: the layout of the 3D Gaussian Splatting code and its relatives.

Each row of element ``vertex`` is a splat: ``x y z``, ``f_dc_0..2`` and ``f_rest_*`` (spherical harmonics,
channel by channel), ``opacity`` (logit), ``scale_*`` (logarithms) and ``rot_0..3`` (quaternion w x y z of any
length). 2DGS files have two scales; the third axis is flat. Mip-Splatting files have ``filter_3D``, the width
of a smoothing filter that applies to scales and opacities. Deformable Beta Splatting is in ``beta.py``.
Properties are found by name. What comments and
other elements say is in ``notes.py``, splats that move in ``motion.py``. The comment ``meshsplats origin X Y
Z`` is ours: positions are relative to that point of the world.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshsplats._files.atomic import atomic_path
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats import _activation
from meshsplats.formats.content import Content
from meshsplats.formats.ply.activated import SAMPLE, Activated, harmonics_of, span_of, suspects, warn_of
from meshsplats.formats.ply.beta import add_lobes, lobe_columns, warn_of_beta
from meshsplats.formats.ply.compressed_splats import is_compressed_splat
from meshsplats.formats.ply.header import Element, PlyHeader, origin_comments, origin_of_comments
from meshsplats.formats.ply.motion import Motion, motion_of
from meshsplats.formats.ply.notes import is_linear, kernel_of_comments, note_comments, up_in, up_of
from meshsplats.formats.ply.table import CHUNK_BYTES, POSITION, FloatTable
from meshsplats.formats.reading import FormatReader, Reading
from meshsplats.formats.splats._cloud_builder import Fill, SplatReader, SplatRows
from meshsplats.formats.writing import FormatWriter, Writing
from meshsplats.scene.gaussians import GaussianCloud, Kernel
from meshsplats.scene.origin import zero_origin

_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SH0 = ("sh0_0", "sh0_1", "sh0_2")
"""``_DC`` of Deformable Beta Splatting, whose f_rest are shN."""
_RGB = ("red", "green", "blue")
_FILTER = "filter_3D"
_REST_COUNTS = {0: 1, 9: 4, 24: 9, 45: 16}
"""Coefficients per channel by the count of f_rest properties."""


class _Columns:
    """The properties of splats and their meaning. Raises FileFormatError if some are missing."""

    def __init__(self, element: Element, header: PlyHeader, where: object) -> None:
        names = set(element.names)
        self.motion = motion_of(element.names, where)
        self.scale = tuple(f"scale_{i}" for i in range(3) if f"scale_{i}" in names)
        missing = [n for n in (*POSITION, "opacity", "scale_0", "scale_1", *_ROTATION) if n not in names]
        if not {"opacity", "scale_0", "rot_0"} & names:
            faces = header.element("face")
            mesh = f"a mesh with {faces.count:,} faces" if faces and faces.count else "a plain point cloud"
            raise FileFormatError(
                f"{where}: not splats but {mesh}: element 'vertex' has no opacity, scale_0.., rot_0.."
                f" properties (it has {_listed(element.names)}); load_mesh reads meshes"
            )
        self.color = next((known for known in (_DC, _SH0) if names.issuperset(known)), _RGB)
        start = "shN_" if self.color is _SH0 else "f_rest_"
        if not names.issuperset(self.color):
            missing += [n for n in _DC if n not in names]
        if missing:
            raise FileFormatError(
                f"{where}: element 'vertex' lacks {', '.join(missing)}, which splats need (it has"
                f" {_listed(element.names)})"
            )
        numbers = (n.removeprefix(start) for n in names if n.startswith(start) and n.isascii())
        rest = sorted(int(n) for n in numbers if n.isdecimal())
        if len(rest) not in _REST_COUNTS or rest != list(range(len(rest))):
            last = f" up to {start}{rest[-1]}" if rest else ""
            raise FileFormatError(
                f"{where}: found {len(rest)} {start[:-1]} properties{last}; spherical harmonics of degree 0,"
                f" 1, 2, 3 have {start}0 to {start}(n-1) with n = 0, 9, 24, 45"
            )
        self.stored = _REST_COUNTS[len(rest)]
        """Coefficients in the file."""
        self.lobes = lobe_columns(element.names, where)
        self.coefficients = _REST_COUNTS[45] if self.lobes else self.stored
        self.filter = (_FILTER,) if _FILTER in names else ()
        # Ordered by coefficient, as sh in memory; files are ordered by channel.
        b = self.stored - 1
        self.sh = (*self.color, *(f"{start}{c * b + j}" for j in range(b) for c in range(3)))
        self.color_span: np.ndarray | None = None
        if self.color is _RGB:
            kinds = [p.dtype for name in _RGB for p in element.properties if p.name == name]
            self.color_span = np.array([np.iinfo(d).max if d.kind in "iu" else 1 for d in kinds], np.float32)
        elif self.motion and self.motion.plain_colors:
            self.color_span = np.ones(3, np.float32)

    @property
    def needed(self) -> tuple[str, ...]:
        """All properties that are read."""
        moving = self.motion.needed if self.motion else ()
        named = (*POSITION, *_ROTATION, *self.scale, "opacity", *self.sh)
        return (*named, *self.lobes, *self.filter, *moving)


def is_float_splat(header: PlyHeader) -> bool:
    """Whether the vertex element looks like float splats rather than points of a mesh."""
    element, face = header.element("vertex"), header.element("face")
    if element is None:
        return False
    marks = {"scale_0", "rot_0"} if face is not None and face.count else {"opacity", "scale_0", "rot_0"}
    return bool(marks & set(element.names))


def _open(content: Content, file: BinaryIO, reading: Reading) -> SplatReader:
    """The splats of an opened .ply; errors and warnings as ``load_gaussians``."""
    header, where = content.ply_header, content.path
    time, activated = reading.time, reading.activated
    element = header.element("vertex")
    if element is None:
        raise FileFormatError(
            f"{where}: no element 'vertex', which holds the splats (found"
            f" {_listed([e.name for e in header.elements])})"
        )
    columns = _Columns(element, header, where)
    warn_of_beta(element.names, where)
    table = FloatTable(file, header, element, columns.needed, where)
    kernel: Kernel = "antialiased" if columns.filter else kernel_of_comments(header.comments)
    if len(columns.scale) == 2:
        kernel = "2dgs"
    instant = None
    if columns.motion:
        instant = _instant(table, columns.motion, time, where)
    index = {name: i for i, name in enumerate(table.names)}
    spans = _spans(table, columns, activated)
    values = _Layout(columns, index, _Sample(element.count), activated, spans, instant)
    return SplatReader(
        element.count,
        columns.coefficients,
        kernel,
        where,
        partial(_chunks, table, values, where),
        table.sample,
        table.positions_are_float32,
        origin_of_comments(header.comments, where),
        up=up_of(file, header, where),
        linear=is_linear(file, header, where),
        instant=instant,
    )


def _motion(content: Content) -> tuple[str, float, float] | None:
    """Name of the layout, first and last time of the splats that move in a .ply; None for splats at rest."""
    header, where = content.ply_header, content.path
    element = header.element("vertex")
    motion = motion_of(element.names, where) if element is not None and is_float_splat(header) else None
    if element is None or motion is None:
        return None
    with content.open() as file:
        times = _times(FloatTable(file, header, element, (motion.time,), where), motion, where)
    return motion.name, float(times[0]), float(times[-1])


def _times(table: FloatTable, motion: Motion, where: object) -> np.ndarray:
    """The times of all splats that are finite, ascending."""
    column = table.names.index(motion.time)
    parts = [chunk[:, column].copy() for chunk in table.chunks()]
    times = np.concatenate(parts) if parts else np.empty(0, np.float32)
    times = np.sort(times[np.isfinite(times)])
    if not len(times):
        raise FileFormatError(f"{where}: none of the times ({motion.time}) of its splats is finite")
    return times


def _instant(table: FloatTable, motion: Motion, time: float | None, where: object) -> float:
    """``time``, or one in the middle at which there is a splat, with a DataWarning that names it."""
    if time is not None:
        return time
    times = _times(table, motion, where)
    middle = float(times[(len(times) - 1) // 2])
    warnings.warn(
        f"{where}: splats that move in time ({motion.name}, times {times[0]:.4g} to {times[-1]:.4g}), shown"
        f" at {middle:.4g}; ``time`` chooses another instant",
        DataWarning,
        stacklevel=5,
    )
    return middle


def _spans(table: FloatTable, columns: _Columns, activated: Sequence[Activated]) -> dict[Activated, int]:
    """The greatest value that each of ``activated`` can have: opacities and colours are of 1 or of 255."""
    names: dict[Activated, tuple[str, ...]] = {"opacities": ("opacity",), "colors": columns.color}
    index = {name: [table.names.index(n) for n in names[name]] for name in activated if name in names}
    spans: dict[Activated, int] = dict.fromkeys(index, 1)
    for chunk in table.chunks() if index else ():
        for name, at in index.items():
            spans[name] = max(spans[name], span_of(chunk[:, at]))
    return spans


@dataclass
class _Sample:
    """Stored values of every so many-th splat."""

    count: int
    """Of all splats."""
    seen: int = 0
    parts: list[list[np.ndarray]] = field(default_factory=list)

    def add(self, values: Sequence[np.ndarray]) -> None:
        """``values`` of the next splats."""
        step = -(-self.count // SAMPLE)
        self.parts.append([array[-self.seen % step :: step].copy() for array in values])
        self.seen += len(values[0])

    def values(self) -> list[np.ndarray]:
        arrays = [np.concatenate(column) for column in zip(*self.parts, strict=True)]
        finite = np.logical_and.reduce([np.isfinite(a.reshape(len(a), -1)).all(axis=1) for a in arrays])
        return [array[finite] for array in arrays]


@dataclass(frozen=True)
class _Layout:
    """How the columns of a file are read."""

    columns: _Columns
    index: dict[str, int]
    sample: _Sample
    activated: tuple[Activated, ...]
    spans: dict[Activated, int]
    """Greatest value that activated opacities and colours can have."""
    time: float | None
    """The instant of splats that move."""


def _chunks(
    table: FloatTable, reading: _Layout, where: object, origin: np.ndarray
) -> Iterator[tuple[int, Fill]]:
    table.origin = origin
    for chunk in table.chunks():
        yield len(chunk), partial(_fill, chunk, reading)
    found = suspects(reading.sample.count, *reading.sample.values()) if reading.sample.parts else {}
    if reading.columns.color_span is not None:
        found.pop("colors", None)
    warn_of({name: span for name, span in found.items() if name not in reading.activated}, where)


def _fill(chunk: np.ndarray, reading: _Layout, rows: SplatRows) -> None:
    columns, index = reading.columns, reading.index

    def take(names: Sequence[str], out: np.ndarray) -> None:
        np.take(chunk, [index[n] for n in names], axis=1, out=out, mode="clip")

    take(POSITION, rows.means)
    take(_ROTATION, rows.quaternions)
    if columns.lobes:
        rows.sh[:, columns.stored :] = 0
        rows.sh[:, : columns.stored] = chunk[:, [index[n] for n in columns.sh]].reshape(
            len(chunk), columns.stored, 3
        )
        add_lobes(rows.sh, chunk[:, [index[n] for n in columns.lobes]])
    else:
        take(columns.sh, rows.sh.reshape(len(chunk), -1))
    scales, opacities = chunk[:, [index[n] for n in columns.scale]], chunk[:, index["opacity"]]
    reading.sample.add([rows.means, scales, opacities, rows.sh[:, 0]])
    if "scales" in reading.activated:
        with np.errstate(divide="ignore"):
            scales = np.where(scales >= 0, np.log(np.maximum(scales, 0)), np.nan)  # no deviation is negative
    if "opacities" in reading.activated:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip(opacities / np.float32(reading.spans["opacities"]), 0, 1).astype(np.float64)
            opacities = (np.log(share) - np.log1p(-share)).astype(np.float32)
    _activate(
        rows,
        log_scales=scales,
        logits=opacities,
        filter_3d=chunk[:, index[_FILTER]] if columns.filter else None,
    )
    if columns.color_span is not None:
        rows.sh[:, 0] = harmonics_of(rows.sh[:, 0], columns.color_span)
    elif "colors" in reading.activated:
        rows.sh[:, 0] = harmonics_of(rows.sh[:, 0], reading.spans["colors"])
    if columns.motion is not None and reading.time is not None:
        moving = {name: chunk[:, index[name]] for name in columns.motion.needed}
        columns.motion.apply(rows, moving, reading.time)


def _activate(
    rows: SplatRows, *, log_scales: np.ndarray, logits: np.ndarray, filter_3d: np.ndarray | None
) -> None:
    """Scales and opacities from logarithms and logits; a scale or opacity of 0 may be stored as infinite.

    Mip-Splatting's filter (Yu et al., CVPR 2024, section 4.1) convolves the splat with an isotropic Gaussian
    of standard deviation f and keeps its integral: s' = sqrt(s^2 + f^2), o' = o sqrt(prod s^2 / prod s'^2).
    """
    axes = log_scales.shape[1]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        scales = _activation.activated_scales(log_scales)
        _activation.activated_opacities(logits, out=rows.opacities)
        if filter_3d is not None:
            wide = np.hypot(scales, filter_3d[:, None])
            rows.opacities[:] *= np.prod(np.where(wide > 0, scales / wide, 1), axis=1)
            scales = wide
    rows.scales[:, :axes] = scales
    rows.scales[:, axes:] = 0


def _listed(names: tuple[str, ...] | list[str]) -> str:
    shown = ", ".join(n[:40] for n in names[:8])
    return (shown + ", ..." if len(names) > 8 else shown) or "nothing"


def write_float_ply(cloud: GaussianCloud, path: Path, writing: Writing) -> None:
    """Writes ``cloud`` in the layout of the 3D Gaussian Splatting code; see ``save_gaussians``."""
    flat = cloud.kernel == "2dgs" and not cloud.scales[:, 2].any()
    if cloud.kernel == "2dgs" and not flat:
        warnings.warn(
            f"{writing.where}: this '2dgs' cloud has third scales that are not 0; written with three scales,"
            " it will be read back as '3dgs'",
            DataWarning,
            stacklevel=4,
        )
    write_float_blocks([cloud], path, len(cloud), cloud.sh.shape[1], cloud.kernel, flat=flat, up=cloud.up)


def write_float_blocks(
    blocks: Iterable[GaussianCloud],
    path: str | os.PathLike[str],
    count: int,
    coefficients: int,
    kernel: Kernel,
    *,
    flat: bool,
    up: np.ndarray | None = None,
) -> None:
    """Writes ``count`` splats that come in ``blocks``.

    Positions are written relative to the origin of the first block, which a comment names.

    Args:
        blocks: clouds; spherical harmonics that they lack are 0.
        path: the file.
        count: of all splats together.
        coefficients: of the file, 1, 4, 9 or 16 per channel: those of the blocks at most.
        kernel: of the file.
        flat: leave out the third scale.
        up: (3,) direction that points up, None if it is not known.

    Raises ValueError if the blocks hold another number of splats, or more harmonics.
    """
    k = coefficients
    scale_names = [f"scale_{i}" for i in range(2 if flat else 3)]
    rest_names = [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names = [*POSITION, "nx", "ny", "nz", *_DC, *rest_names, "opacity", *scale_names, *_ROTATION]
    at = {name: i for i, name in enumerate(names)}
    rest_of_blocks = iter(blocks)
    first = next(rest_of_blocks, None)
    origin = zero_origin() if first is None else first.origin
    lines = ["ply", "format binary_little_endian 1.0", *origin_comments(origin)]
    lines += note_comments(kernel, up)
    lines.append(f"element vertex {count}")
    lines += [f"property float {name}" for name in names] + ["end_header", ""]
    per_chunk = max(1, CHUNK_BYTES // (4 * len(names)))
    written = 0
    with atomic_path(path, needs=4 * len(names) * count) as temporary, Path(temporary).open("wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        for block in () if first is None else chain([first], rest_of_blocks):
            cloud = block.relative_to(origin)
            for start in range(0, len(cloud), per_chunk):
                part = slice(start, start + per_chunk)
                sh = cloud.sh[part]
                if sh.shape[1] > k:
                    raise ValueError(
                        f"{path}: splats of degree {cloud.sh_degree} for a file of degree"
                        f" {round(k**0.5) - 1}: give degree={cloud.sh_degree}, or block.of_degree(...)"
                    )
                rows = np.zeros((len(sh), len(names)), "<f4")
                rows[:, :3] = cloud.means[part]
                rows[:, 6:9] = sh[:, 0]
                rest = rows[:, 9 : at["opacity"]].reshape(len(sh), 3, k - 1)  # a view of the rows
                rest[:, :, : sh.shape[1] - 1] = sh[:, 1:].transpose(0, 2, 1)
                rows[:, at["opacity"]] = _activation.logits(cloud.opacities[part])
                scales = cloud.scales[part, : len(scale_names)]
                rows[:, at["scale_0"] : at["rot_0"]] = _activation.log_scales(scales)
                rows[:, at["rot_0"] : at["rot_0"] + 4] = cloud.quaternions[part]
                file.write(rows.data)
            written += len(cloud)
        if written != count:
            raise ValueError(f"{path}: {written:,} splats came for a file of {count:,}")


def _matches(content: Content) -> bool:
    """Whether it is a .ply without packed splats. Of a mesh, the reader says what is missing."""
    return content.is_ply and not is_compressed_splat(content.ply_header)


READER = FormatReader(_matches, _open, lambda content: is_float_splat(content.ply_header), up_in, _motion)
WRITER = FormatWriter(write_float_ply, lambda coefficients: 56 + 12 * coefficients)
