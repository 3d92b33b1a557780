"""What our own `.glb` files hold beyond glTF: the note ``extras.meshsplats`` and the arrays it names."""

from __future__ import annotations

import math
import warnings
import zlib
from typing import Any, get_args

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._orientation import up_quaternion
from meshsplats.formats._validation import checked
from meshsplats.formats.gltf import copies
from meshsplats.formats.gltf.compressed import Grid
from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty
from meshsplats.formats.gltf.scene import rotation_matrix
from meshsplats.formats.gltf.view_colors import IN_VIEW_COLORS
from meshsplats.formats.gltf.writer import camel_case
from meshsplats.scene.binding import Binding
from meshsplats.scene.mesh import Blending, SplatMesh


def our_note(mesh: dict[str, Any]) -> dict[str, Any]:
    """The entry ``extras.meshsplats`` of a mesh if it is valid, else an empty one."""
    note = dict_or_empty(dict_or_empty(mesh.get("extras")).get("meshsplats"))
    up = note.get("up")
    good = (
        isinstance(up, list) and len(up) == 3 and all(isinstance(u, (int, float)) and abs(u) <= 2 for u in up)
    )
    origin = note.get("origin", [0, 0, 0])
    good &= isinstance(origin, list) and len(origin) == 3
    good = good and all(isinstance(x, (int, float)) and abs(x) < 1e300 for x in origin)
    if not good or note.get("blending") not in get_args(Blending) or not any(up):  # type: ignore[arg-type]
        return {}
    return note


def origin_of(note: dict[str, Any]) -> np.ndarray:
    return np.array(note.get("origin", [0, 0, 0]), np.float64)


def grid_of(document: GltfDocument, note: dict[str, Any]) -> Grid | None:
    """What positions are rounded to; None where they are not."""
    if "grid" not in note:
        return None
    entry = dict_or_empty(note["grid"])
    scale = float(document.numbers([entry.get("scale")], 1, "the scale of a grid")[0])
    x, y, z = document.numbers(entry.get("offset"), 3, "the offset of a grid").tolist()
    if scale <= 0:
        raise document.error(f"the scale of a grid must be above 0, got {scale}")
    return Grid(scale, (x, y, z))


def is_own_placement(matrix: np.ndarray, note: dict[str, Any], grid: Grid | None) -> bool:
    """Whether the nodes are still ours: they turn the mesh's up direction to +y and put the mesh at its
    origin, after making positions of the places in a ``grid``; nothing more."""
    if grid is not None:
        matrix = matrix.copy()
        matrix[:3, :3] /= grid.scale
        matrix[:3, 3] -= matrix[:3, :3] @ grid.offset
    wanted = rotation_matrix(up_quaternion(np.array(note["up"], np.float64)))
    wanted[:3, 3] = wanted[:3, :3] @ origin_of(note)
    rounding = 1e-12 * np.abs(wanted[:3, 3]).max()
    turn, shift = np.abs(matrix - wanted)[:3, :3], np.abs(matrix - wanted)[:3, 3]
    return bool(turn.max() < 1e-5 and shift.max() < max(1e-5, rounding))


def restored(
    document: GltfDocument, mesh: dict[str, Any], note: dict[str, Any], f: int, v: int
) -> dict[str, Any]:
    """Constructor arguments from our note. Arrays that another program has dropped or altered are left out,
    with a DataWarning: better no splat indices than wrong ones."""
    result: dict[str, Any] = {}
    lost: list[str] = []
    counts = {"vertex": v, "face": f}
    for field in SplatMesh.EXTRAS:
        if field.name in note and field.name not in IN_VIEW_COLORS:
            if field.per == "splat":
                counts["splat"] = len(np.unique(result.get("face_splat", ())))
            shape = field.shape(counts)
            values = _raw(document, dict_or_empty(note[field.name]), field.dtype, shape)
            if values is None:
                lost.append(field.name)
            else:
                result[field.name] = values
    if "filter_px2" in note:
        variance = float(document.numbers([note["filter_px2"]], 1, "filter_px2")[0])
        if "face_splat" in result:
            result["filter_px2"] = variance
        else:
            lost.append("the filter of its splats")
    if "order" in note:
        if "face_splat" in result:
            result["order"] = note["order"]
        else:
            lost.append("the order of its splats")
    if "binding" in note:
        result["binding"] = _binding(document, dict_or_empty(note["binding"]), v)
        if result["binding"] is None:
            lost.append("the binding to a base mesh")
    attributes: dict[str, np.ndarray] = {}
    stored = dict_or_empty(mesh["primitives"][0]["attributes"])
    entries = note.get("attributes", [])
    for entry in entries if isinstance(entries, list) else []:
        key, columns = dict_or_empty(entry).get("name"), dict_or_empty(entry).get("columns")
        if isinstance(key, str) and (columns is None or (isinstance(columns, int) and 0 <= columns <= 4096)):
            values = _attribute(document, stored, entry, v, 1 if columns is None else columns)
            if values is None:
                lost.append(key[:40])
            else:
                attributes[key] = values[:, 0] if columns is None else values
    if lost:
        warn(f"{document.path}: another program has changed the file, so this is ignored: {', '.join(lost)}")
    return result | {"attributes": attributes}


def _binding(document: GltfDocument, entry: dict[str, Any], v: int) -> Binding | None:
    """The binding of a mesh prior's v vertices; None if one of its arrays is missing or altered."""
    counts = {
        "vertex": v,
        "base vertex": document.whole(entry, "baseVertexCount", "a binding"),
        "base face": document.whole(entry, "baseFaceCount", "a binding"),
    }
    parts = {"lift": document.numbers([entry.get("lift")], 1, "lift of a binding")[0]}
    for field in Binding.FIELDS:
        if field.optional and camel_case(field.name) not in entry:
            continue
        stored = dict_or_empty(entry.get(camel_case(field.name)))
        values = _raw(document, stored, field.dtype, field.shape(counts))
        if values is None:
            return None
        parts[field.name] = values
    return checked(document.path, Binding.from_arrays, parts)


def fits(binding: Binding, vertices: np.ndarray) -> bool:
    """Whether the vertices are where the binding puts them, up to rounding."""
    size = float(np.abs(binding.base_vertices).max(initial=0))
    return bool((np.abs(binding.positions() - vertices) <= 1e-4 * size).all())


def own_triangles(
    document: GltfDocument, entry: Any, faces: np.ndarray, v: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """The triangles of the mesh among ``faces``, which hold both windings of each, and the places of its
    vertices among the v ones; None for the places of all. FileFormatError if they do not."""
    entry = dict_or_empty(entry)
    half = len(faces) // 2
    turned = _raw(document, dict_or_empty(entry.get("turned")), np.uint8, ((half + 7) // 8,))
    stored = dict_or_empty(entry.get("offset"))
    offset = _raw(document, stored, np.int8 if stored.get("bytes") == 1 else np.int32, (half,))
    vertices = None
    good = True
    if copies.counts(entry) > 1:
        vertex = listed_vertices(document, entry, v)
        vertices = None if vertex is None else copies.joined_vertices(vertex)
        good &= vertices is not None
        if vertex is not None:
            faces = vertex[faces]
    found = None
    if good and turned is not None and offset is not None:
        found = copies.without_copies(faces, copies.Own(turned, offset))
    if found is None:
        raise document.error(
            "its note says that each triangle is there twice, once with each winding, but another program has"
            " altered them; take the file that meshsplats wrote"
        )
    return found, vertices


def listed_vertices(document: GltfDocument, entry: dict[str, Any], v: int) -> np.ndarray | None:
    """(v,) those of the mesh that the nodes of a file with copies list one after another; None for a file of
    one node, which has them in the order of the mesh, and where another program has altered it."""
    return _raw(document, dict_or_empty(entry.get("vertex")), np.int32, (v,))


def in_order_of_splats(document: GltfDocument, entry: Any, faces: np.ndarray) -> dict[str, np.ndarray]:
    """``faces`` (f, 3) with those of each splat side by side, and their splats; nothing where another
    program has altered the file. ``entry``: the splats of the triangles in the order of the file."""
    splats = _raw(document, dict_or_empty(entry), np.int32, (len(faces),))
    if splats is None:
        return {}
    order = np.argsort(splats, kind="stable")
    return {"faces": faces[order], "face_splat": splats[order]}


def _attribute(
    document: GltfDocument, stored: dict[str, Any], entry: dict[str, Any], v: int, columns: int
) -> np.ndarray | None:
    """(v, columns) values of an attribute; None if they are missing."""
    if columns == 0:
        return np.empty((v, 0), np.float32)
    semantic = entry.get("semantic")
    if semantic is None:
        return _raw(document, entry, np.float32, (v, columns))
    if not isinstance(semantic, str) or semantic not in stored:
        return None
    values = document.floats(stored[semantic], semantic[:60])
    return values if values.shape == (v, columns) else None


def _raw(
    document: GltfDocument, entry: dict[str, Any], dtype: type[np.generic], shape: tuple[int, ...]
) -> np.ndarray | None:
    """Array of a buffer view that only our note refers to; None if the view is not the one we wrote."""
    stored = np.dtype(dtype).newbyteorder("<")
    try:
        data, _ = document.view_bytes(entry.get("bufferView"), "meshsplats")
    except FileFormatError:
        return None
    if len(data) != math.prod(shape) * stored.itemsize or zlib.crc32(data) != entry.get("crc32"):
        return None
    document.budget.spend(len(data), "meshsplats")
    return np.frombuffer(data, stored).astype(dtype).reshape(shape)


def warn(message: str) -> None:
    warnings.warn(message, DataWarning, stacklevel=5)
