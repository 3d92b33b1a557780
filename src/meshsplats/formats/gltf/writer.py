"""Writes meshes as binary glTF 2.0 (`.glb`), which viewers, engines and Blender open directly.

Specification: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. One mesh of one double-sided
primitive, or of two where solid triangles are kept apart, coloured by COLOR_0 (linear RGBA; what depends on
the view: ``view_colors``). glTF is y-up:
the node turns the mesh's own frame to one whose +y is the mesh's ``up``, and puts the mesh at its ``origin``;
vertices are stored unchanged. All else is in the mesh's ``extras.meshsplats``.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshsplats._common.geometry import vertex_normals
from meshsplats._common.kinds import need_choice
from meshsplats.formats._validation import check_attribute_names
from meshsplats.formats.cutting import CUTOFF
from meshsplats.formats.gltf import compressed, copies
from meshsplats.formats.gltf.binary_chunk import BinaryChunk, placed_node, write_binary
from meshsplats.formats.gltf.compressed import Compression, Grid
from meshsplats.formats.gltf.view_colors import (
    IN_VIEW_COLORS,
    Harmonics,
    note_of,
    scales_of,
    vertex_tables,
)
from meshsplats.scene.binding import Binding
from meshsplats.scene.colors import srgb_to_linear
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh, solid_faces

ColorType = Literal["uint16", "float32"]
Alpha = Literal["blend", "mask", "opaque", "hybrid"]

_ROWS = 1 << 15


def write_glb(
    mesh: SplatMesh,
    path: Path,
    *,
    lit: bool = False,
    color_type: ColorType = "uint16",
    alpha: Alpha = "blend",
    cutoff: float = CUTOFF,
    extras: bool = True,
    order: DrawOrder | None = None,
    harmonics: Harmonics = "attributes",
    compression: Compression | None = None,
) -> None:
    """Writes ``mesh`` to ``path``.

    Colours of a mesh for display blending are converted to linear; those of a mesh for linear blending are
    stored unchanged.

    Args:
        mesh: the mesh.
        path: the file.
        lit: the material is a rough dielectric that scene lights shade, with the mesh's normals or else
            area-weighted vertex normals; False: it is unlit (KHR_materials_unlit).
        color_type: 'uint16' keeps display colours within 1/10000, 'float32' within 1e-6.
        alpha: how viewers treat opacity. 'blend' is exact in viewers that sort, and good enough in many that
            do not. 'mask' needs no order: opacities of at least ``cutoff`` are rendered solid, with the depth
            buffer. 'opaque' is for a mesh of ``cut_mesh``, which is solid: viewers ignore opacity. 'hybrid'
            writes triangles with three opaque corners as an 'opaque' primitive, and all others as a 'blend'
            primitive, the lowest first, as most views look down; without the arrays that only this project
            reads, but for harmonics and their splats. docs/viewers.md compares them.
        cutoff: least opacity that 'mask' renders.
        extras: False leaves out the arrays that only this project reads.
        order: with 'blend', unlit: every triangle is written twice, with both windings and a single-sided
            material, in this order.
        harmonics: where colours are kept that COLOR_0 cannot hold: see ``view_colors``.
        compression: see ``compressed``. With colours of 16 bits, without an order.

    Raises:
        ValueError: the mesh has no triangles (glTF has no empty arrays), its normals are not of unit
            length, ``order`` is that of another mesh or goes with another mode, or the file needs more than
            the 4 GiB that the format can hold.
    """
    need_choice(Alpha, alpha=alpha)
    need_choice(ColorType, color_type=color_type)
    need_choice(Harmonics, harmonics=harmonics)
    if not len(mesh.faces):
        raise ValueError("glTF cannot hold a mesh without triangles; save it as .npz or .ply")
    check_attribute_names(mesh)
    grid = None
    if compression is not None:
        compressed.check_compression(compression, color_type, is_ordered=order is not None)
        grid = Grid.of(mesh.vertices)
    if order is None:
        colors = _Colors(mesh, color_type, harmonics)
        document, chunk = _document(mesh, lit, colors, alpha, cutoff, extras, grid)
        if grid is not None:
            chunk = compressed.with_compression(document, chunk)
    elif lit or alpha != "blend":
        raise ValueError("an order of triangles is for alpha='blend' and an unlit material")
    else:
        document, chunk = _ordered_document(mesh, order, _Colors(mesh, color_type, harmonics))
    advice = "; save it as .npz or .ply, or split it"
    write_binary(path, document, chunk, what="the mesh", advice=advice)


def mesh_part(mesh: SplatMesh, *, lit: bool) -> tuple[dict[str, Any], BinaryChunk]:
    """The document of ``mesh`` and its chunk, blended or, where it is all opaque, solid; errors as
    ``write_glb``."""
    check_attribute_names(mesh)
    alpha: Alpha = "opaque" if bool((mesh.colors[:, 3] == 1).all()) else "blend"
    return _document(mesh, lit, _Colors(mesh, "uint16", "attributes"), alpha, CUTOFF, True, None)


class _Colors:
    """How the colours of ``mesh``, and of parts of it, are stored."""

    def __init__(self, mesh: SplatMesh, color_type: ColorType, packing: Harmonics) -> None:
        self.type, self._packing = color_type, packing
        self._scales, self._exact = scales_of(mesh), color_type == "float32"
        self.note = note_of(mesh, self._scales, packing, exact=self._exact)

    def tables(self, part: SplatMesh) -> dict[str, np.ndarray]:
        """Attributes beside COLOR_0, for a part that has its splats."""
        return vertex_tables(part, self._scales, self._packing, exact=self._exact) if self.note else {}


def _document(
    mesh: SplatMesh,
    lit: bool,
    colors: _Colors,
    alpha: Alpha,
    cutoff: float,
    with_extras: bool,
    grid: Grid | None,
) -> tuple[dict[str, Any], BinaryChunk]:
    """The JSON part, and the binary one."""
    buffer, extras = BinaryChunk(), _note(mesh) | colors.note
    if grid is not None:
        extras["grid"] = grid._asdict()
    if alpha == "hybrid":
        with_extras = False
    if mesh.filter_px2 and with_extras:
        extras["filter_px2"] = mesh.filter_px2
    if mesh.order != "fragment" and with_extras:
        extras["order"] = mesh.order
    if mesh.normals is not None:
        _check_unit(mesh.normals)
    elif lit:
        mesh = replace(mesh, normals=computed_normals(mesh))
        extras["normals"] = "computed"
    parts: list[tuple[SplatMesh, Alpha]] = [(mesh, alpha)]
    if alpha == "hybrid":
        solid = solid_faces(mesh)
        halves: tuple[tuple[SplatMesh, Alpha], ...] = (
            (mesh.take(solid), "opaque"),
            (mesh.take(~solid), "blend"),
        )
        parts = [(half, mode) for half, mode in halves if len(half.faces)]
    primitives, splats = [], []
    for k, (part, mode) in enumerate(parts):
        tables, shown, own = colors.tables(part), part.plain, part.face_splat
        if alpha == "hybrid" and mode == "blend":
            order = _lowest_first(part)
            shown = replace(shown, face_splat=None, depth_group=None, order="fragment").take(order)
            own = None if own is None else own[order]
        primitives.append(_primitive(buffer, shown, colors.type, k, tables, grid))
        splats += [] if own is None else [own]
    if alpha == "hybrid" and mesh.harmonics is not None:
        extras["splats"] = _raw(buffer, np.concatenate(splats))
    if with_extras:
        _add_own_arrays(buffer, mesh, primitives[0]["attributes"], extras)
    meshes = [{"name": "splats", "primitives": primitives, "extras": {"meshsplats": extras}}]
    materials = [_material(mode, lit, cutoff) for _, mode in parts]
    return _scene(buffer, mesh, meshes, materials, grid), buffer


def _ordered_document(
    mesh: SplatMesh, order: DrawOrder, colors: _Colors
) -> tuple[dict[str, Any], BinaryChunk]:
    """As ``_document``, with both windings of all triangles in ``order``."""
    buffer, extras = BinaryChunk(), _note(mesh) | colors.note
    shown, tables = mesh.plain, colors.tables(mesh)
    if mesh.filter_px2:
        extras["filter_px2"] = mesh.filter_px2
    if mesh.normals is not None:
        _check_unit(mesh.normals)
    meshes: list[dict[str, Any]] = []
    listed = []
    for part in copies.parts(mesh, order):
        piece = SplatMesh(
            mesh.vertices[part.vertices],
            part.faces,
            shown.colors[part.vertices],
            normals=None if mesh.normals is None else mesh.normals[part.vertices],
            blending=mesh.blending,
        )
        listed.append(part.vertices)
        own_tables = {name: table[part.vertices] for name, table in tables.items()}
        primitive = _primitive(buffer, piece, colors.type, 0, own_tables)
        meshes.append({"name": "splats", "primitives": [primitive]})
        if colors.note:  # for shaders, which see one mesh at a time
            meshes[-1]["extras"] = {"meshsplats": colors.note}
    own = copies.own_triangles(mesh.faces)
    extras["copies"] = note = {"nodes": len(meshes), "turned": _raw(buffer, own.turned)}
    note["offset"] = _raw(buffer, own.offset) | {"bytes": own.offset.itemsize}
    if len(meshes) > 1:
        note["vertex"] = _raw(buffer, np.concatenate(listed))
    attributes = primitive["attributes"] if len(meshes) == 1 else None
    _add_own_arrays(buffer, mesh, attributes, extras)
    meshes[0]["extras"] = {"meshsplats": extras}
    material = _material("blend", False, CUTOFF) | {"doubleSided": False}
    return _scene(buffer, mesh, meshes, [material]), buffer


def _note(mesh: SplatMesh) -> dict[str, Any]:
    """What our note about ``mesh`` begins with."""
    note = {"version": 1, "blending": mesh.blending, "up": [float(u) for u in mesh.up]}
    return note | ({"origin": mesh.origin.tolist()} if mesh.origin.any() else {})


def _scene(
    buffer: BinaryChunk,
    mesh: SplatMesh,
    meshes: list[dict[str, Any]],
    materials: list[dict[str, Any]],
    grid: Grid | None = None,
) -> dict[str, Any]:
    """The JSON part of a file of ``meshes``, which hold ``mesh``; several are below one node that places
    them."""
    node = placed_node("splats", mesh)
    nodes = [node]
    if grid is not None:
        nodes.append({"name": "grid", "mesh": 0} | grid.node)
        node["children"] = [1]
    elif len(meshes) == 1:
        node["mesh"] = 0
    else:
        nodes += [{"name": f"splats {k + 1}", "mesh": k} for k in range(len(meshes))]
        node["children"] = list(range(1, len(nodes)))
    document = buffer.document(nodes, meshes, materials)
    if any("extensions" in material for material in materials):
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    return document


def _lowest_first(mesh: SplatMesh) -> np.ndarray:
    """(f,) the triangles of ``mesh`` in the order of their heights."""
    heights = (mesh.vertices @ mesh.up)[mesh.faces].sum(axis=1)
    return np.argsort(heights, kind="stable")


def _primitive(
    buffer: BinaryChunk,
    mesh: SplatMesh,
    color_type: ColorType,
    material: int,
    tables: dict[str, np.ndarray],
    grid: Grid | None = None,
) -> dict[str, Any]:
    """A primitive with the triangles of ``mesh``, and further attributes of its vertices."""
    places = mesh.vertices if grid is None else grid.places(mesh.vertices)
    attributes = {"POSITION": buffer.positions(places)}
    if mesh.normals is not None:
        normals = mesh.normals if grid is None else compressed.small_normals(mesh.normals)
        attributes["NORMAL"] = buffer.attribute(normals)
    attributes["COLOR_0"] = buffer.attribute(linear_colors(mesh, color_type))
    attributes |= {name: buffer.attribute(table) for name, table in tables.items()}
    indices = buffer.indices(mesh.faces, len(mesh.vertices))
    return {"attributes": attributes, "indices": indices, "material": material}


def _material(alpha: Alpha, lit: bool, cutoff: float) -> dict[str, Any]:
    material: dict[str, Any] = {
        "name": "splats",
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
        "alphaMode": alpha.upper(),
        "doubleSided": True,
    }
    if alpha == "mask":
        material["alphaCutoff"] = cutoff
    if not lit:
        material["extensions"] = {"KHR_materials_unlit": {}}
    return material


def change_alpha(path: Path, alpha: Alpha, cutoff: float = CUTOFF) -> None:
    """Makes the `.glb` at ``path``, which ``write_glb`` wrote with ``alpha='mask'``, one with 'blend', or
    with another cutoff of 'mask', in place: nothing else in the file changes.

    Raises ValueError for a text that does not fit, such as a cutoff of more digits.
    """
    with open(path, "r+b") as file:
        length = struct.unpack("<12xI4x", file.read(20))[0]
        document = json.loads(file.read(length))
        for material in document["materials"]:
            material["alphaMode"] = alpha.upper()
            material.pop("alphaCutoff", None)
            if alpha == "mask":
                material["alphaCutoff"] = cutoff
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        if len(text) > length:
            raise ValueError(f"{path}: no room for alpha {alpha} with cutoff {cutoff}")
        file.seek(20)
        file.write(text.ljust(length))


def _add_own_arrays(
    buffer: BinaryChunk, mesh: SplatMesh, attributes: dict[str, int] | None, extras: dict[str, Any]
) -> None:
    """Stores the arrays that only this project reads, and notes in ``extras`` where they are: those of
    vertices among the ``attributes`` of a primitive that has all vertices, if there is one."""
    extras |= {
        field.name: _raw(buffer, values)
        for field, values in mesh.extras().items()
        if field.name not in IN_VIEW_COLORS
    }
    for name, values in mesh.attributes.items():
        columns = None if values.ndim == 1 else values.shape[1]
        entry: dict[str, Any] = {"name": name, "columns": columns}
        if attributes is not None and (columns is None or 1 <= columns <= 4):
            semantic = _semantic(name, attributes)
            attributes[semantic] = buffer.attribute(values)
            entry["semantic"] = semantic
        elif columns != 0:
            entry |= _raw(buffer, values)
        extras.setdefault("attributes", []).append(entry)
    if mesh.binding is not None:
        extras["binding"] = _binding(buffer, mesh.binding)


def _raw(buffer: BinaryChunk, values: np.ndarray) -> dict[str, Any]:
    """Values that no glTF attribute can hold, as a plain buffer view. The checksum shows a reader whether
    another program has renumbered or dropped the views."""
    view = buffer.view(values)
    return {"bufferView": view, "crc32": zlib.crc32(buffer.parts[view].data)}


def _binding(buffer: BinaryChunk, binding: Binding) -> dict[str, Any]:
    """The entry of a binding in our note."""
    entry: dict[str, Any] = {
        "lift": binding.lift,
        "baseVertexCount": len(binding.base_vertices),
        "baseFaceCount": len(binding.base_faces),
    }
    arrays = binding.given_fields().items()
    return entry | {camel_case(name): _raw(buffer, values) for name, values in arrays}


def camel_case(name: str) -> str:
    """``name`` as glTF writes its keys."""
    return re.sub("_(.)", lambda match: match[1].upper(), name)


def _semantic(name: str, taken: dict[str, int]) -> str:
    """An unused name of an application's own attribute: glTF requires a leading underscore."""
    plain = "_" + re.sub(r"[^A-Z0-9_]", "_", name.upper())[:60]
    candidate, number = plain, 2
    while candidate in taken:
        candidate, number = f"{plain}_{number}", number + 1
    return candidate


def linear_colors(mesh: SplatMesh, color_type: ColorType) -> np.ndarray:
    """(v, 4) linear RGBA of the mesh's vertices, as float32 or as 16-bit fractions of 65535."""
    result = np.empty(mesh.colors.shape, np.dtype(color_type))
    for start in range(0, len(result), _ROWS):
        rows = mesh.colors[start : start + _ROWS]
        linear = rows if mesh.blending == "linear" else rows.copy()
        if mesh.blending == "display":
            linear[:, :3] = srgb_to_linear(rows[:, :3])
        if color_type == "uint16":
            linear = linear * np.float32(65535) + np.float32(0.5)
        result[start : start + _ROWS] = linear
    return result


def computed_normals(mesh: SplatMesh) -> np.ndarray:
    """(v, 3) float32 unit normals, area-weighted means of the triangles' normals around each vertex; where
    these have no area, the mesh's up direction."""
    return vertex_normals(mesh.vertices, mesh.faces, fallback=mesh.up).astype(np.float32)


def _check_unit(normals: np.ndarray) -> None:
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    bad = np.abs(length - 1) > 5e-4
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"glTF wants normals of unit length, that of vertex {row} has {length[row]:.4g}"
            f" ({int(bad.sum())} such); normalise them, or leave them out (normals=None)"
        )
