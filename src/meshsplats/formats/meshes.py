"""Mesh files: the reader is chosen by content, the writer by suffix."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.arrays import check_faces, checked_array
from meshsplats._common.foreign import foreign, foreign_archive
from meshsplats._common.kinds import each, need, need_path
from meshsplats._files.atomic import atomic_path
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.content import Content
from meshsplats.formats.cutting import CUTOFF, cut_mesh
from meshsplats.formats.gltf.compressed import Compression
from meshsplats.formats.gltf.view_colors import Harmonics
from meshsplats.formats.gltf.writer import Alpha, ColorType
from meshsplats.formats.mesh_formats import (
    FileSize,
    mesh_format,
    mesh_format_to_write,
    mesh_suffixes,
    written_mesh_suffixes,
)
from meshsplats.formats.ply.mesh import write_mesh_blocks
from meshsplats.formats.sniff import content_of
from meshsplats.formats.splat_formats import listed
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh, checked_cutoff


def load_mesh(
    path: str | os.PathLike[str], *, origin: Sequence[float] | np.ndarray | None = None
) -> SplatMesh:
    """The mesh in a file: `.npz`, `.ply`, `.glb`, `.gltf`, `.usdc`, `.usda`, `.usd`, `.usdz` or `.obj`.

    The content decides the format. A file that ``save_mesh`` wrote gives back its positions, faces and extra
    arrays exactly (`.obj` has no extra arrays); colours are exact from `.npz` and `.ply`, within 1e-6 from
    USD and within 1/2000 from `.glb`. From the files of other programs, triangles and vertex colours are
    read: polygons are cut into triangles, textures are left out with a DataWarning.

    Where float32 is too coarse for the coordinates of the file, a point near the mesh is subtracted from them
    in float64: ``SplatMesh.origin``; transforms of nodes are applied before. A DataWarning names files that
    store such coordinates as float32.

    Args:
        path: the file.
        origin: (3,) point of the world that ``vertices`` shall be relative to, such as that of splats or
            photographs of the same scene; by default that of our files, and one that suits those of others:
            zero wherever float32 is fine enough.

    Raises:
        FileNotFoundError, IsADirectoryError: ``path`` is not a file.
        FileFormatError: the file is broken, of another kind, or holds no mesh; the message says what is wrong
            and where.
        MissingDependencyError: USD without the extra ``usd``.
    """
    need_path(path=path)
    source = Path(path)
    point = None if origin is None else checked_array("origin", origin, np.float64, (3,))
    mesh = _read(source, point)
    # Files of our own name an origin, which takes the place of the one that is asked for.
    return mesh if point is None else mesh.relative_to(point)


def _read(source: Path, point: np.ndarray | None) -> SplatMesh:
    with content_of(source) as content:
        return _mesh_in(content, source, point)


def _mesh_in(content: Content, source: Path, point: np.ndarray | None) -> SplatMesh:
    content.refuse_empty()
    if content.member is not None:
        raise FileFormatError(f"{source}: splats in a zip archive ({content.member[:200]}), no mesh")
    if content.is_archive and not content.is_usd and source.suffix.lower() != ".npz":
        names = content.archive.names
        if source.suffix.lower() == ".usdz":
            raise FileFormatError(
                f"{source}: a .usdz package begins with a .usdc, .usda or .usd file, this one with"
                f" {names[0][:60] if names else 'nothing'!r}"
            )
        if what := foreign_archive(source, names):
            raise FileFormatError(f"{source}: {what}")
    if (kind := mesh_format(content)) is not None:
        return kind.codec.read(source, point)
    if what := foreign(source, content.head):
        raise FileFormatError(f"{source}: {what}")
    raise FileFormatError(
        f"{source}: not a mesh file of a known format, it begins with {content.head[:8]!r};"
        f" expected {listed(mesh_suffixes())}"
    )


def save_mesh(
    mesh: SplatMesh,
    path: str | os.PathLike[str],
    *,
    lit: bool | None = None,
    color_type: ColorType | None = None,
    alpha: Alpha | None = None,
    cutoff: float | None = None,
    compression: Compression | None = None,
    order: DrawOrder | None = None,
    harmonics: Harmonics | None = None,
) -> None:
    """Writes ``mesh`` in the format that the suffix of ``path`` names, whole or not at all.

    - `.npz`, `.ply` keep everything exactly, `.ply` without the binding to a base mesh.
    - `.glb` keeps colours as linear values of 16 bits (within 1/2000 as display values), harmonics as 8 bits
      of the largest one, the rest exactly.
    - `.usdc`, `.usda`, `.usd` keep linear float colours and opacity; splat indices, harmonics and attributes
      become primvars. They need the extra ``usd``.
    - `.obj` keeps positions and display colours; opacity is lost, with a DataWarning, and harmonics.

    Programs that draw no harmonics see ``mesh.plain``: its ``plain_colors``, or ``colors`` up to 1.

    Every format puts a mesh with an ``origin`` at its place in the world: as the translation of a node
    (`.glb`, USD), as double or decimal coordinates (`.ply`, `.obj`), as an array of its own (`.npz`). Read
    again, the origin and the coordinates relative to it come back exactly, but for the last digits in `.obj`.

    All but `.npz` and `.glb` leave out the binding of a mesh prior, with a DataWarning. All but `.obj`, and
    `.glb` with 'hybrid', keep ``filter_px2``, but other programs render without a low-pass filter: writing a
    mesh with one as `.glb`, USD or `.obj` gives a DataWarning; ``bake_filter`` makes the filter part of the
    triangles.

    An older file at ``path`` is replaced at the end; an error leaves it as it was.

    Args:
        mesh: the mesh.
        path: the file; its suffix decides the format.
        lit: (`.glb`, USD; default False) a material that scene lights shade, instead of an unlit one.
        color_type: (`.glb`; default 'uint16') 'float32' stores colours exactly, but larger.
        alpha: (default 'blend'; 'opaque' for a mesh whose opacities are all 1) 'opaque' cuts the triangles
            where their opacity crosses ``cutoff`` and writes the rest as solid geometry, for programs with a
            depth buffer, in any format: see ``cut_mesh``. 'mask' (`.glb`) keeps the triangles and lets the
            viewer draw them solid where the opacity reaches the cutoff; their edges stay jagged where those
            of 'opaque' are smooth. 'hybrid' (`.glb`) is for a mesh with solid and translucent triangles:
            those with three opaque corners form an opaque primitive, and all others, the lowest first, a
            blended one. Splat indices, attributes and binding are left out.
        cutoff: (with 'opaque' and 'mask'; default 0.2) least opacity that is drawn, 0 to 1.
        compression: (`.glb`) 'meshopt' makes files a quarter to a third as large. Each coordinate moves by at
            most 1/131070 of the longest side of the bounding box, and the corners of a triangle may be listed
            from another one on; all else is kept. Viewers need a decoder of EXT_meshopt_compression.
        order: (`.glb`) that of ``drawing_order``, for web viewers and engines, which blend triangles as they
            are listed: each is written twice, with both windings and a single-sided material, in this order.
            Not for ray tracers, Blender and CesiumJS, which do not cull translucent triangles and draw both.
            ``load_mesh`` returns the mesh as it was. Without lit, compression, and alpha but 'blend'.
        harmonics: (`.glb`; default 'attributes') 'texcoords' keeps them, and base colours of 8 bits, as
            texture coordinates, which engines import: docs/viewers.md has the shaders.

    Raises:
        ValueError: the suffix is unknown, the format does not have an option, or cannot hold the mesh, or its
            faces were changed in place and number vertices that there are not.
        MissingDependencyError: a package is missing.
        OSError: the file cannot be written.
    """
    need(
        SplatMesh, mesh=mesh, instead={"GaussianCloud": "save_gaussians writes splats, convert makes a mesh"}
    )
    need_path(path=path)
    check_faces(mesh.faces, len(mesh.vertices))
    target = Path(path)
    suffix = target.suffix.lower()
    kind = mesh_format_to_write(target)
    if kind is None:
        known = ", ".join(written_mesh_suffixes())
        raise ValueError(f"{target.name!r} does not name a mesh format; choose a name that ends in {known}")
    chosen = {
        "lit": lit,
        "color_type": color_type,
        "alpha": alpha,
        "compression": compression,
        "order": order,
        "harmonics": harmonics,
    }
    options: dict[str, Any] = {name: value for name, value in chosen.items() if value is not None}
    if cutoff is not None:
        if alpha not in ("opaque", "mask"):
            raise ValueError("the option cutoff needs alpha='opaque' or alpha='mask'")
        cutoff = checked_cutoff(cutoff)
    for name in options:
        if name not in kind.takes and options[name] != "opaque":
            suffixes = ", ".join(written_mesh_suffixes(name))
            raise ValueError(f"the option {name} applies to {suffixes} only, not to {suffix}")
    bound = "binding" in kind.keeps and alpha not in ("opaque", "hybrid")
    if mesh.binding is not None and not bound:
        warnings.warn(
            f"{target.name}: the binding to a base mesh is left out; later poses need .npz or .glb",
            DataWarning,
            stacklevel=2,
        )
    if alpha == "opaque":
        mesh = cut_mesh(mesh, CUTOFF if cutoff is None else cutoff)
        if "alpha" not in kind.takes:
            del options["alpha"]
    elif (
        alpha is None
        and order is None
        and "alpha" in kind.takes
        and len(mesh.colors)
        and (mesh.colors[:, 3] == 1).all()
    ):
        options["alpha"] = "opaque"
    elif cutoff is not None:
        options["cutoff"] = cutoff
    if mesh.filter_px2 and not kind.own:
        warnings.warn(
            f"{target.name}: the mesh is to be rendered with a filter of {mesh.filter_px2:g} px^2, which"
            " other programs do not have: from afar it will look thin there. Make it part of the triangles"
            " for the views that count: bake_filter(mesh, cameras), or meshsplats bake",
            DataWarning,
            stacklevel=2,
        )
    if mesh.harmonics is not None and "harmonics" not in kind.keeps:
        warnings.warn(
            f"{target.name}: harmonics are left out, {suffix} has no place for them: colours will be the same"
            " from everywhere. For the mean of what views show, save the mesh as .npz and run"
            f" 'meshsplats bake MESH.npz --colors -o NEW{suffix}', or use plain_colors_of(mesh, cameras)",
            DataWarning,
            stacklevel=2,
        )
    size = expected_bytes(mesh, suffix, compressed="compression" in options, copies=order is not None)
    with atomic_path(target, needs=size) as temporary:
        kind.codec.write(mesh, temporary, **options)


def save_mesh_blocks(
    parts: Iterable[SplatMesh], path: str | os.PathLike[str], *, splats: int | None = None
) -> tuple[int, int, int]:
    """Writes one mesh that comes in ``parts``, as from ``convert_blocks``, to a `.ply` file, whole or not at
    all; the file is that of ``save_mesh`` for the whole mesh.

    Memory holds one part at a time; the disk holds the data twice while they are put together.

    Args:
        parts: meshes, each with vertex indices of its own, alike as ``SplatMesh.joined`` wants them, without
            depth groups.
        path: the file, whose name ends in .ply.
        splats: about how many all parts have, from which the size is estimated for the message about a full
            disk; without, that of the parts so far is named.

    Returns:
        Counts of vertices, triangles and splats.

    Raises:
        ValueError: another suffix, no parts, parts that differ, or more than a mesh can number.
        OSError: the file cannot be written.
    """
    need_path(path=path)
    parts = each(SplatMesh, "parts", parts)
    target = Path(path)
    if target.suffix.lower() != ".ply":
        raise ValueError(f"parts of meshes are written as .ply, got {target.name!r}: for others, build tiles")
    taken = _Taken(splats)
    with atomic_path(target, needs=taken.needs) as temporary:
        return write_mesh_blocks(taken.counted(parts), temporary, target)


class _Taken:
    """Bytes and splats of the parts of a mesh so far, and of all its ``splats`` what the disk must hold."""

    def __init__(self, splats: int | None) -> None:
        self._all, self._splats, self._bytes = splats, 0, 0

    def counted(self, parts: Iterable[SplatMesh]) -> Iterator[SplatMesh]:
        for part in parts:
            self._bytes += expected_bytes(part, ".ply")
            self._splats += part.splat_count or 0
            yield part

    def needs(self) -> int | None:
        """Twice the file, as its parts lie beside it while it is put together; None before the first part."""
        if not self._splats:
            return 2 * self._bytes or None
        return round(2 * self._bytes * max(1, (self._all or 0) / self._splats))


def expected_bytes(mesh: SplatMesh, suffix: str, *, compressed: bool = False, copies: bool = False) -> int:
    """Estimated size of the file of ``mesh`` with this ``suffix``, with ``copies`` of all triangles: within a
    few kilobytes for `.npz` and `.ply`, within 15 % for `.glb` with colours of 16 bits, rough for the
    others."""
    kind = mesh_format_to_write(f"mesh{suffix}")
    if kind is None:
        raise ValueError(f"no mesh is written as {suffix!r}")
    bound = "binding" in kind.keeps
    arrays = {n: a for n, a in mesh.arrays().items() if a.ndim and (bound or not n.startswith("binding."))}
    # Beyond the required ones.
    held = sum(a.nbytes for a in arrays.values()) - 28 * len(mesh.vertices) - 12 * len(mesh.faces) - 12
    return kind.codec.expected_bytes(FileSize(mesh, suffix, held, compressed, copies))
