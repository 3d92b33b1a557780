"""View-dependent colours, in glTF. COLOR_0 has those for programs that draw no harmonics.

Every vertex has those of its splat: a shader needs no table, and compression removes what is repeated. As
attributes of the application: ``_BASE``, display RGB and opacity, divided by ``base`` in our note, and four
coefficients each in ``_SH_RED_0``, ``_SH_RED_1``, ... and the same of green and blue, divided by ``scale``;
the last ones are padded with zeros. In a view, red is ``max(0, base * _BASE.r + scale * (dot(b_0, _SH_RED_0)
+ dot(b_1, _SH_RED_1) + ...))``, where b_0 are the first four of ``sh_basis(d, degree)[1:]``, d the direction
from the camera in the mesh's own frame, and b_1 the next four.

Engines import texture coordinates only, and two of each: there, a number holds the bytes of a red, a green
and a blue as ``red + 256 green + 65536 blue``. The first is the base colour, 255 of ``base``; the others are
the coefficients, 127 of ``scale`` from 128 on. Shaders of vertices can read them; between vertices such
numbers mean nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.mesh import MAX_COLOR, SplatMesh
from meshsplats.scene.spherical_harmonics import TERMS, in_fours

Harmonics = Literal["attributes", "texcoords"]

IN_VIEW_COLORS = ("harmonics", "plain_colors")
"""Arrays of ``SplatMesh`` that these attributes hold."""

_CHANNELS = ("RED", "GREEN", "BLUE")
_FOUR = 4
_LARGEST = 1e4
"""Of the numbers that scales may be."""


class Scales(NamedTuple):
    """What a mesh's numbers are divided by. Parts of one mesh share them."""

    base: float
    """Of base colours."""
    harmonics: float


def scales_of(mesh: SplatMesh) -> Scales:
    """The least that make every number of ``mesh`` at most 1, as far as they are needed."""
    brightest = float(mesh.colors[:, :3].max(initial=1))
    harmonics = mesh.harmonics
    largest = 0.0 if harmonics is None else float(np.abs(harmonics).max(initial=0))
    return Scales(brightest, largest or 1.0)


def has_view_colors(mesh: SplatMesh) -> bool:
    """Whether COLOR_0 alone does not give back the colours of ``mesh``."""
    own = mesh.harmonics is not None or mesh.plain_colors is not None
    return own or bool(mesh.colors.max(initial=0) > 1)


def note_of(mesh: SplatMesh, scales: Scales, packing: Harmonics, *, exact: bool) -> dict[str, Any]:
    """What our note says about the attributes of ``vertex_tables``."""
    if not has_view_colors(mesh):
        return {}
    base, harmonics = (1.0, 1.0) if exact and packing == "attributes" else scales
    note: dict[str, Any] = {"packing": packing, "base": base, "plain": mesh.plain_colors is not None}
    if mesh.harmonics is not None:
        note |= {"degree": mesh.sh_degree, "scale": harmonics}
    return {"viewColors": note}


def stored_bytes(mesh: SplatMesh) -> int:
    """What ``vertex_tables`` of attributes take, less the arrays that they stand for."""
    if not has_view_colors(mesh):
        return 0
    held = sum(values.nbytes for field, values in mesh.extras().items() if field.name in IN_VIEW_COLORS)
    terms = 0 if mesh.harmonics is None else mesh.harmonics.shape[1]
    return len(mesh.vertices) * (8 + 3 * -(-terms // _FOUR) * _FOUR) - held


def vertex_tables(
    mesh: SplatMesh, scales: Scales, packing: Harmonics, *, exact: bool
) -> dict[str, np.ndarray]:
    """The attributes of all vertices by their names in glTF: float32, or integers that are fractions of their
    largest value. ``exact``: floats that nothing was divided by."""
    if not has_view_colors(mesh):
        return {}
    splats, harmonics = mesh.splats, mesh.harmonics
    if packing == "texcoords":
        return _texcoords(mesh, scales)
    if exact:
        tables = {"_BASE": mesh.colors}
    else:
        base = mesh.colors / np.array([*[scales.base] * 3, 1], np.float32)
        # Rounded as COLOR_0 is: the opacity is the same number in both.
        tables = {"_BASE": (base * np.float32(65535) + np.float32(0.5)).astype(np.uint16)}
    if harmonics is None:
        return tables
    none = np.zeros((1, *harmonics.shape[1:]), np.float32)  # of vertices that no splat uses
    rows = in_fours(np.concatenate([harmonics, none]))
    if not exact:
        rows = np.rint(rows * np.float32(127 / scales.harmonics)).astype(np.int8)
    for channel, fours in zip(_CHANNELS, rows, strict=True):
        tables |= {f"_SH_{channel}_{i}": four[splats.of_vertex] for i, four in enumerate(fours)}
    return tables


def _texcoords(mesh: SplatMesh, scales: Scales) -> dict[str, np.ndarray]:
    base = np.rint(mesh.colors[:, :3] * np.float32(255 / scales.base)).astype(np.uint8)
    numbers = [_packed(base)]
    if mesh.harmonics is not None:
        scaled = np.rint(mesh.harmonics * np.float32(127 / scales.harmonics)).astype(np.int16) + 128
        none = np.full((1, *scaled.shape[1:]), 128, np.int16)  # of vertices that no splat uses
        rows = _packed(np.concatenate([scaled, none]))[mesh.splats.of_vertex]
        numbers += list(rows.T)
    numbers += [np.zeros_like(numbers[0])] * (len(numbers) % 2)
    return {f"TEXCOORD_{i}": np.stack(numbers[2 * i : 2 * i + 2], axis=1) for i in range(len(numbers) // 2)}


def _packed(rgb: np.ndarray) -> np.ndarray:
    """(...) float32 numbers that hold bytes (..., 3)."""
    return (rgb.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)).astype(np.float32)


# -- reading


class Stored(NamedTuple):
    """What our note says, checked."""

    packing: Harmonics
    scales: Scales
    plain: bool
    degree: int

    @property
    def names(self) -> tuple[str, ...]:
        """Attributes of the vertices that hold the colours."""
        terms = 0 if not self.degree else TERMS[self.degree - 1]
        if self.packing == "texcoords":
            return tuple(f"TEXCOORD_{i}" for i in range((terms + 2) // 2))
        more = tuple(f"_SH_{c}_{i}" for c in _CHANNELS for i in range(-(-terms // _FOUR)))
        return ("_BASE", *more)

    @property
    def columns(self) -> int:
        """Numbers that each of them holds."""
        return 2 if self.packing == "texcoords" else 4


def stored_colors(note: Mapping[str, Any], error: Callable[[str], Exception]) -> Stored | None:
    """What the ``note`` of a mesh says; None without such colours. Raises ``error`` where it is wrong."""
    entry = note.get("viewColors")
    if entry is None:
        return None
    if not isinstance(entry, dict):
        raise error("viewColors must be an object")
    degree = entry.get("degree", 0)
    if degree not in (0, 1, 2, 3) or isinstance(degree, bool):
        raise error(f"harmonics must have degree 1, 2 or 3, got {str(degree)[:20]}")
    if entry.get("packing") not in ("attributes", "texcoords"):
        raise error(f"unknown packing of harmonics {str(entry.get('packing'))[:20]!r}")
    scales = [entry.get("base", 1), entry.get("scale", 1)]
    for scale in scales:
        number = isinstance(scale, (int, float)) and not isinstance(scale, bool)
        if not number or not 0 < scale <= _LARGEST:
            raise error(
                f"scales of colours must be numbers above 0, at most {_LARGEST:g}, got {str(scale)[:20]}"
            )
    return Stored(entry["packing"], Scales(*map(float, scales)), entry.get("plain") is True, int(degree))


def put_back(stored: Stored, tables: Mapping[str, np.ndarray], arrays: dict[str, Any]) -> bool:
    """Puts RGB, ``harmonics`` and ``plain_colors`` from attributes, as floats, among the arguments ``arrays``
    of ``SplatMesh``, as far as they are whole. False if another program has dropped or mixed some."""
    if not tables:
        return False
    terms = TERMS[stored.degree - 1] if stored.degree else 0
    rgb, table = (_of_texcoords if stored.packing == "texcoords" else _of_fours)(stored, tables, terms)
    shown = arrays["colors"][:, :3].copy()
    if stored.plain:
        arrays["plain_colors"] = shown
    elif stored.packing == "texcoords":  # as far as COLOR_0 has them, it is more precise
        rgb = np.where(shown < 1, shown, rgb)
    arrays["colors"][:, :3] = np.clip(rgb, 0, MAX_COLOR)
    number = arrays.get("face_splat")
    if not terms:
        return True
    if number is None or not len(number) or number[0] < 0 or (np.diff(number) < 0).any():
        return False
    splats = FaceSplats(arrays["faces"], number, len(rgb))
    harmonics = table[splats.faces[splats.starts, 0]]
    used = splats.of_vertex >= 0
    if (table[used] != harmonics[splats.of_vertex[used]]).any():
        return False
    arrays["harmonics"] = np.ascontiguousarray(harmonics, np.float32)
    return True


def _of_fours(stored: Stored, tables: Mapping[str, np.ndarray], terms: int) -> tuple[np.ndarray, np.ndarray]:
    """(v, 3) RGB, and (v, terms, 3) harmonics of the splats of vertices."""
    rgb = tables["_BASE"][:, :3] * np.float32(stored.scales.base)
    table = np.empty((len(rgb), terms, 3), np.float32)
    for c, channel in enumerate(_CHANNELS if terms else ()):
        fours = [tables[name] for name in stored.names if name.startswith(f"_SH_{channel}_")]
        table[:, :, c] = np.concatenate(fours, axis=1)[:, :terms]
    return rgb, table * np.float32(stored.scales.harmonics)


def _of_texcoords(
    stored: Stored, tables: Mapping[str, np.ndarray], terms: int
) -> tuple[np.ndarray, np.ndarray]:
    """As ``_of_fours``."""
    numbers = np.concatenate([tables[name] for name in stored.names], axis=1)[:, : 1 + terms]
    whole = np.where(np.isfinite(numbers), numbers, 0).clip(0, (1 << 24) - 1).astype(np.int64)
    values = np.stack([whole >> 8 * c & 255 for c in range(3)], axis=2).astype(np.float32)
    rgb = values[:, 0] * np.float32(stored.scales.base / 255)
    return rgb, (values[:, 1:] - 128) * np.float32(stored.scales.harmonics / 127)
