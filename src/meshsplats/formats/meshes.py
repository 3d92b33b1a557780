"""Mesh files: the reader is chosen by content, the writer by suffix."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from meshsplats._files.atomic import atomic_path
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.gltf.compressed import Compression, write_compressed_glb
from meshsplats.formats.gltf.reader import read_gltf
from meshsplats.formats.gltf.writer import Alpha, ColorType, write_glb
from meshsplats.formats.npz import read_npz, write_npz
from meshsplats.formats.obj.mesh import read_obj, write_obj
from meshsplats.formats.ply.mesh import read_mesh_ply, write_mesh_ply
from meshsplats.formats.sniff import Content
from meshsplats.formats.usd.reader import read_usd
from meshsplats.formats.usd.writer import write_usd
from meshsplats.mesh import SplatMesh

_USD = (".usdc", ".usda", ".usd")
_WRITERS: dict[str, Callable[..., None]] = {
    ".npz": write_npz,
    ".ply": write_mesh_ply,
    ".glb": write_glb,
    **dict.fromkeys(_USD, write_usd),
    ".obj": write_obj,
}
_GLB = (".glb",)
BOUND_SUFFIXES = (".npz", ".glb")
"""Formats that keep the binding of a mesh prior."""
_UNFILTERED = (*_GLB, *_USD, ".obj")
"""Formats for programs that draw triangles as they are."""
_OPTION_SUFFIXES = {"lit": (*_GLB, *_USD), "color_type": _GLB, "alpha": _GLB, "compression": _GLB}

MESH_SUFFIXES = tuple(_WRITERS)
"""Suffixes that ``save_mesh`` knows."""


def load_mesh(path: str | os.PathLike[str]) -> SplatMesh:
    """The mesh in a file: `.npz`, `.ply`, `.glb`, `.gltf`, `.usdc`, `.usda`, `.usd` or `.obj`, recognised by
    what it holds.

    A file that ``save_mesh`` wrote comes back with its positions, faces and extra arrays exactly (`.obj` has
    no extra arrays); colours are exact from `.npz` and `.ply`, within 1e-6 from USD and within 1/2000 from
    `.glb`. Meshes of other programs are read as far
    as triangles and vertex colours go: polygons are cut into triangles, textures left out with a
    DataWarning.

    Raises FileNotFoundError or IsADirectoryError, and FileFormatError for a file that is broken, of
    another kind or holds no mesh; the message says what is wrong and where. MissingDependencyError for USD
    without the extra ``usd``.
    """
    source = Path(path)
    content = Content(source)
    content.refuse_empty()
    if content.container == "zip":
        if source.suffix.lower() == ".usdz":
            raise FileFormatError(
                f"{source}: .usdz packages are not read; unpack it: usdcat in.usdz -o out.usdc"
            )
        return read_npz(source)
    if content.container == "ply":
        return read_mesh_ply(source)
    if content.container in ("glb", "json"):
        return read_gltf(source)
    if content.container == "usd":
        return read_usd(source)
    if content.is_obj:
        return read_obj(source)
    raise FileFormatError(
        f"{source}: not a mesh file of a known format, it begins with {content.head[:8]!r};"
        " expected .npz, .ply, .glb, .gltf, .usdc, .usda or .obj"
    )


def save_mesh(
    mesh: SplatMesh,
    path: str | os.PathLike[str],
    *,
    lit: bool | None = None,
    color_type: ColorType | None = None,
    alpha: Alpha | None = None,
    compression: Compression | None = None,
) -> None:
    """Writes ``mesh`` in the format that the suffix of ``path`` names, whole or not at all.

    - `.npz`, `.ply` keep everything exactly, `.ply` without the binding to a base mesh.
    - `.glb` keeps colours as linear values of 16 bits (within 1/2000 as display values), the rest exactly.
    - `.usdc`, `.usda`, `.usd` keep linear float colours and opacity; splat numbers and attributes become
      primvars. Needs the extra ``usd``.
    - `.obj` keeps positions and display colours; opacity is lost, with a DataWarning.

    All but `.npz` and `.glb` leave out the binding of a mesh prior, with a DataWarning. All but `.obj` keep
    ``filter_px2``; as the programs that `.glb`, USD and `.obj` are for draw without a filter, a mesh that
    wants one is written to these with a DataWarning: ``bake_filter`` makes it part of the triangles.

    Options, each for the formats named; given for another one they are a ValueError:

    - ``lit`` (`.glb`, USD; default False): a material that scene lights shade instead of one that shows the
      colours as they are.
    - ``color_type`` (`.glb`; default 'uint16'): 'float32' stores colours exactly, but larger.
    - ``alpha`` (`.glb`; default 'blend'): 'mask' or 'hash-friendly' for viewers that do not sort; they are
      drawn solid where opacity reaches a cutoff, one for all or one for each splat.
    - ``compression`` (`.glb`): 'meshopt' makes files about a fifth as large, with the external program
      gltfpack. Each coordinate is moved by at most 1/131070 of the longest side of the mesh's box; triangles
      change their order a little; splat numbers and attributes are left out. Such files are for viewers;
      ``load_mesh`` does not read them.

    Raises ValueError for an unknown suffix, an option that the format does not have, or a mesh that the
    format cannot hold, MissingDependencyError where a package or program is missing, and OSError for a place
    that cannot be written, all before an older file at ``path`` is touched; if all goes well, it is replaced.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    writer = _WRITERS.get(suffix)
    if writer is None:
        known = ", ".join(_WRITERS)
        raise ValueError(f"{target.name!r} does not name a mesh format; choose a name that ends in {known}")
    given = {"lit": lit, "color_type": color_type, "alpha": alpha, "compression": compression}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    for name in options:
        if suffix not in _OPTION_SUFFIXES[name]:
            suffixes = ", ".join(_OPTION_SUFFIXES[name])
            raise ValueError(f"the option {name} applies to {suffixes} only, not to {suffix}")
    if mesh.binding is not None and (suffix not in BOUND_SUFFIXES or "compression" in options):
        warnings.warn(
            f"{target.name}: the binding to a base mesh is left out; only .npz or .glb keep what later poses"
            " need",
            DataWarning,
            stacklevel=2,
        )
    if mesh.filter_px2 and suffix in _UNFILTERED:
        warnings.warn(
            f"{target.name}: the mesh is to be drawn with a filter of {mesh.filter_px2:g} px^2, which other"
            " programs do not have: from afar it will look thin there. Make it part of the triangles for the"
            " views that count: bake_filter(mesh, cameras), or meshsplats bake",
            DataWarning,
            stacklevel=2,
        )
    if "compression" in options:
        writer = write_compressed_glb
    with atomic_path(
        target, needs=expected_bytes(mesh, suffix, compressed="compression" in options)
    ) as temporary:
        writer(mesh, temporary, **options)


def expected_bytes(mesh: SplatMesh, suffix: str, *, compressed: bool = False) -> int:
    """About how large the file of ``mesh`` with this ``suffix`` will be: exact to a few kilobytes for `.npz`
    and `.ply`, within 15 % for `.glb` with colours of 16 bits, a rough figure for the others."""
    v, f = len(mesh.vertices), len(mesh.faces)
    bound = suffix in BOUND_SUFFIXES
    arrays = {n: a for n, a in mesh.arrays().items() if a.ndim and (bound or not n.startswith("binding."))}
    held = sum(array.nbytes for array in arrays.values()) - 28 * v - 12 * f - 12  # beside the usual
    if suffix == ".obj":
        return 75 * v + (26 if mesh.normals is None else 50) * f
    if suffix == ".usda":
        return 85 * v + 24 * f + 3 * held
    if suffix == ".ply":
        return 28 * v + 13 * f + held
    if suffix == ".glb":
        whole = 20 * v + (12 if v > 0xFFFF else 6) * f + held
        return whole // 5 if compressed else whole
    if suffix in _USD:
        return 28 * v + 6 * f + held
    return 28 * v + 12 * f + held
