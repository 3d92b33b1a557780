"""Splats as a float .ply: the layout of the 3D Gaussian Splatting code and its relatives.

Each row of element ``vertex`` is a splat: ``x y z``, ``f_dc_0..2`` and ``f_rest_*`` (spherical harmonics,
channel by channel), ``opacity`` (logit), ``scale_*`` (logarithms) and ``rot_0..3`` (quaternion w x y z of any
length). 2DGS files have two scales; the third axis is flat. Mip-Splatting files have ``filter_3D``, the width
of a smoothing filter that applies to scales and opacities. Properties are found by name. A comment may name
the kernel: ``SplatRenderMode: mip`` (Brush), ``antialiased 1`` (Postshot).
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshsplats._files.atomic import atomic_path
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats import _activation
from meshsplats.formats.ply.header import Element, PlyHeader
from meshsplats.formats.ply.table import CHUNK_BYTES, FloatTable
from meshsplats.formats.splats._cloud_builder import Fill, SplatReader, SplatRows
from meshsplats.gaussians import SH_C0, GaussianCloud, Kernel

_POSITION = ("x", "y", "z")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
_FILTER = "filter_3D"
_REST_COUNTS = {0: 1, 9: 4, 24: 9, 45: 16}
"""Coefficients per channel by the count of f_rest properties."""


class _Columns:
    """The properties of splats and their meaning. Raises FileFormatError if some are missing."""

    def __init__(self, element: Element, header: PlyHeader, where: object) -> None:
        names = set(element.names)
        self.scale = tuple(f"scale_{i}" for i in range(3) if f"scale_{i}" in names)
        missing = [n for n in (*_POSITION, "opacity", "scale_0", "scale_1", *_ROTATION) if n not in names]
        if not {"opacity", "scale_0", "rot_0"} & names:
            faces = header.element("face")
            mesh = f"a mesh with {faces.count:,} faces" if faces and faces.count else "a plain point cloud"
            raise FileFormatError(
                f"{where}: not splats but {mesh}: element 'vertex' has no opacity, scale_0.., rot_0.."
                f" properties (it has {_listed(element.names)}); load_mesh reads meshes"
            )
        self.color = _DC if names.issuperset(_DC) else _RGB
        if not names.issuperset(self.color):
            missing += [n for n in _DC if n not in names]
        if missing:
            raise FileFormatError(
                f"{where}: element 'vertex' lacks {', '.join(missing)}, which splats need (it has"
                f" {_listed(element.names)})"
            )
        rest = sorted(
            int(n[7:]) for n in names if n.startswith("f_rest_") and n[7:].isdecimal() and n.isascii()
        )
        if len(rest) not in _REST_COUNTS or rest != list(range(len(rest))):
            raise FileFormatError(
                f"{where}: found {len(rest)} f_rest properties{f' up to f_rest_{rest[-1]}' if rest else ''};"
                " spherical harmonics of degree 0, 1, 2, 3 have f_rest_0 to f_rest_(n-1) with n = 0, 9, 24,"
                " 45"
            )
        self.coefficients = _REST_COUNTS[len(rest)]
        self.filter = (_FILTER,) if _FILTER in names else ()
        # Ordered by coefficient, as sh in memory; files are ordered by channel.
        b = self.coefficients - 1
        self.sh = (*self.color, *(f"f_rest_{c * b + j}" for j in range(b) for c in range(3)))
        self.color_span: np.ndarray | None = None
        if self.color is _RGB:
            kinds = [p.dtype for name in _RGB for p in element.properties if p.name == name]
            self.color_span = np.array([np.iinfo(d).max if d.kind in "iu" else 1 for d in kinds], np.float32)

    @property
    def needed(self) -> tuple[str, ...]:
        """All properties that are read."""
        return (*_POSITION, *_ROTATION, *self.scale, "opacity", *self.sh, *self.filter)


def is_float_splat(header: PlyHeader) -> bool:
    """Whether the vertex element looks like float splats rather than points of a mesh."""
    element, face = header.element("vertex"), header.element("face")
    if element is None:
        return False
    marks = {"scale_0", "rot_0"} if face is not None and face.count else {"opacity", "scale_0", "rot_0"}
    return bool(marks & set(element.names))


def read_float_ply(file: BinaryIO, header: PlyHeader, where: object) -> SplatReader:
    """The splats of an opened .ply whose header has been read; errors and warnings as ``load_gaussians``."""
    element = header.element("vertex")
    if element is None:
        raise FileFormatError(
            f"{where}: no element 'vertex', which holds the splats (found"
            f" {_listed([e.name for e in header.elements])})"
        )
    columns = _Columns(element, header, where)
    table = FloatTable(file, header, element, columns.needed, where)
    kernel: Kernel = "antialiased" if columns.filter else kernel_of_comments(header.comments)
    if len(columns.scale) == 2:
        kernel = "2dgs"
    return SplatReader(element.count, columns.coefficients, kernel, where, _chunks(table, columns))


def _chunks(table: FloatTable, columns: _Columns) -> Iterator[tuple[int, Fill]]:
    index = {name: i for i, name in enumerate(table.names)}
    for chunk in table.chunks():
        yield len(chunk), partial(_fill, chunk, columns, index)


def _fill(chunk: np.ndarray, columns: _Columns, index: dict[str, int], rows: SplatRows) -> None:
    def take(names: Sequence[str], out: np.ndarray) -> None:
        np.take(chunk, [index[n] for n in names], axis=1, out=out, mode="clip")

    take(_POSITION, rows.means)
    take(_ROTATION, rows.quaternions)
    take(columns.sh, rows.sh.reshape(len(chunk), -1))
    _activate(
        rows,
        log_scales=chunk[:, [index[n] for n in columns.scale]],
        logits=chunk[:, index["opacity"]],
        filter_3d=chunk[:, index[_FILTER]] if columns.filter else None,
    )
    if columns.color_span is not None:
        rows.sh[:, 0] = (rows.sh[:, 0] / columns.color_span - np.float32(0.5)) / np.float32(SH_C0)


def kernel_of_comments(comments: tuple[str, ...]) -> Kernel:
    """The kernel that a .ply names in its comments; the last one counts, '3dgs' if there is none."""
    spelt: dict[str, Kernel] = {
        "splatrendermode mip": "antialiased",
        "splatrendermode 2dgs": "2dgs",
        "splatrendermode default": "3dgs",
        "antialiased 1": "antialiased",
        "antialiased 0": "3dgs",
    }
    found = [
        spelt[words] for c in comments if (words := " ".join(c.lower().replace(":", " ").split())) in spelt
    ]
    return found[-1] if found else "3dgs"


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


def write_float_ply(cloud: GaussianCloud, path: str | os.PathLike[str]) -> None:
    """Writes ``cloud`` in the layout of the 3D Gaussian Splatting code; see ``save_gaussians``."""
    flat = cloud.kernel == "2dgs" and not cloud.scales[:, 2].any()
    if cloud.kernel == "2dgs" and not flat:
        warnings.warn(
            f"{path}: this '2dgs' cloud has third scales that are not 0; written with three scales,"
            " it will be read back as '3dgs'",
            DataWarning,
            stacklevel=3,
        )
    write_float_blocks([cloud], path, len(cloud), cloud.sh.shape[1], cloud.kernel, flat=flat)


def write_float_blocks(
    blocks: Iterable[GaussianCloud],
    path: str | os.PathLike[str],
    count: int,
    coefficients: int,
    kernel: Kernel,
    *,
    flat: bool,
) -> None:
    """Writes ``count`` splats that come in ``blocks``.

    Args:
        blocks: clouds; spherical harmonics that they lack are 0.
        path: the file.
        count: of all splats together.
        coefficients: of the file, 1, 4, 9 or 16 per channel: those of the blocks at most.
        kernel: of the file.
        flat: leave out the third scale.

    Raises ValueError if the blocks hold another number of splats.
    """
    k = coefficients
    scale_names = [f"scale_{i}" for i in range(2 if flat else 3)]
    rest_names = [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names = [*_POSITION, "nx", "ny", "nz", *_DC, *rest_names, "opacity", *scale_names, *_ROTATION]
    at = {name: i for i, name in enumerate(names)}
    lines = ["ply", "format binary_little_endian 1.0"]
    if kernel == "antialiased":
        lines.append("comment SplatRenderMode: mip")
    lines.append(f"element vertex {count}")
    lines += [f"property float {name}" for name in names] + ["end_header", ""]
    per_chunk = max(1, CHUNK_BYTES // (4 * len(names)))
    written = 0
    with atomic_path(path, needs=4 * len(names) * count) as temporary, Path(temporary).open("wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        for cloud in blocks:
            for start in range(0, len(cloud), per_chunk):
                part = slice(start, start + per_chunk)
                sh = cloud.sh[part]
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
