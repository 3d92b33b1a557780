"""Reads meshes from glTF 2.0: our own files exactly, those of others as triangles and vertex colours."""

from __future__ import annotations

import math
import warnings
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from meshsplats._arrays import joined_rows
from meshsplats._origin import choose_origin, zero_origin
from meshsplats.binding import Binding
from meshsplats.colors import linear_to_srgb
from meshsplats.errors import DataWarning, FileFormatError, NoTextureWarning
from meshsplats.formats._validation import checked, straight_colors, warn_of_lost_detail
from meshsplats.formats.gltf import copies
from meshsplats.formats.gltf.document import GltfDocument
from meshsplats.formats.gltf.scene import Placed, Skinning, placed_meshes, rotation_matrix
from meshsplats.formats.gltf.scene_parts import is_splats, shown_meshes
from meshsplats.formats.gltf.view_colors import IN_VIEW_COLORS, Stored, put_back, stored_colors
from meshsplats.formats.gltf.writer import camel_case, up_quaternion
from meshsplats.mesh import Blending, SplatMesh
from meshsplats.spherical_harmonics import moved_harmonics

POINTS_TO_LINES = (0, 1, 2, 3)
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


@dataclass
class _Piece:
    """A primitive, which a node places."""

    place: Placed
    skinning: Skinning | None
    vertices: np.ndarray
    """In the frame of the mesh; in that of the scene after ``put``."""
    faces: np.ndarray
    linear: np.ndarray
    normals: np.ndarray | None
    tables: dict[str, np.ndarray]
    """Those attributes that hold the rest of our colours."""

    def put(self, origin: np.ndarray) -> None:
        """Puts the piece into the scene, relative to ``origin``."""
        self.vertices, self.normals = self.place.applied(self.skinning, self.vertices, self.normals, origin)
        self.skinning = None

    def arrays(self) -> dict[str, np.ndarray]:
        found = {"vertices": self.vertices, "faces": self.faces, "linear": self.linear} | self.tables
        return found if self.normals is None else found | {"normals": self.normals}


def read_gltf(path: Path, origin: np.ndarray | None = None) -> SplatMesh:
    """The mesh in a `.glb` or `.gltf` file.

    Our own files give back positions and extra arrays exactly, and colours within their stored precision.
    From other programs' files, all triangles of the scene are joined in its y-up frame; colours are COLOR_0
    times the material's base colour, converted to display values; textures are left out with a DataWarning.
    Buffers must be embedded or lie beside the file. Positions are relative to ``origin``; by default to that
    of our files, or to one that suits those of others, whose nodes are applied in float64.

    Raises:
        FileFormatError: the file is broken, or has Draco or meshopt compression or sparse accessors.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # SplatMesh refuses values that are not finite
        return _read(GltfDocument(path), origin)


def listed_nodes(path: Path) -> int:
    """The number of nodes of a file that lists triangles in an order of blending, each with both windings,
    for viewers that cull; 0 for any other.

    Raises FileFormatError for a broken file.
    """
    meshes = [place.mesh for place in placed_meshes(GltfDocument(path))]
    return copies.counts(_our_note(meshes[0]).get("copies")) if meshes else 0


def _read(document: GltfDocument, origin: np.ndarray | None) -> SplatMesh:
    path = document.path
    placed = shown_meshes(document)
    pieces, skipped, textured = [], 0, 0
    note = _our_note(placed[0].mesh) if placed else {}
    if len(placed) != max(1, copies.counts(note.get("copies"))):
        note = {}
    own = placed[0].mesh if note else {}
    stored = stored_colors(note, document.error)
    named: np.ndarray | None = None
    kept = bool(note) and all(_is_own_placement(place.matrix, note) for place in placed)
    if kept:
        placed = [place._replace(matrix=np.eye(4)) for place in placed]
        named = _origin_of(note)
    elif note:  # another program has moved the mesh in the scene
        note["up"] = [0.0, 1.0, 0.0]
    motion = placed[0].matrix[:3, :3] if placed else np.eye(3)
    for place in placed:
        for primitive in objects_in(document, place.mesh.get("primitives"), "primitives of a mesh"):
            mode = primitive.get("mode", _TRIANGLES)
            if mode in POINTS_TO_LINES:
                skipped += 1
                _refuse_splats(document, primitive)
                continue
            material = material_of(document, primitive)
            textured += "baseColorTexture" in pbr_of(material)
            pieces.append(_piece(document, primitive, material, place, stored))
    if skipped:
        _warn(f"{path}: {skipped:,} primitives of points or lines were left out")
    if textured:
        message = f"{path}: {textured:,} primitives have a texture, which was left out; colours may differ"
        warnings.warn(message, NoTextureWarning, stacklevel=3)
    if not pieces:
        raise document.error("the scene holds no triangles")
    shift = zero_origin()  # what is ours is relative to its origin already
    if named is not None:
        origin = named
    else:
        shift = origin = _chosen_origin(document, pieces) if origin is None else origin
    for piece in pieces:
        piece.put(shift)
    mesh = _join(document, pieces, own, note | {"viewColors": stored}, origin)
    if mesh.harmonics is not None and (motion != np.eye(3)).any():
        return replace(mesh, harmonics=moved_harmonics(mesh.harmonics, motion))
    return mesh


def _chosen_origin(document: GltfDocument, pieces: list[_Piece]) -> np.ndarray:
    sample = np.concatenate([piece.place.sample(piece.skinning, piece.vertices) for piece in pieces])
    if all((piece.place.matrix == np.eye(4)).all() for piece in pieces):
        warn_of_lost_detail(sample, document.path)
    return choose_origin(sample)


def _piece(
    document: GltfDocument,
    primitive: dict[str, Any],
    material: dict[str, Any],
    place: Placed,
    stored: Stored | None,
) -> _Piece:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        raise document.error("a primitive has no POSITION")
    if "KHR_draco_mesh_compression" in dict_or_empty(primitive.get("extensions")):
        raise document.compressed()
    vertices = document.floats(attributes["POSITION"], "POSITION")
    v = len(vertices)
    faces = primitive_faces(document, primitive, v)
    document.budget.spend(64 * v + 12 * len(faces), "a mesh")
    factor = document.numbers(pbr_of(material).get("baseColorFactor", [1, 1, 1, 1]), 4, "baseColorFactor")
    linear = np.ones((v, 4), np.float32)
    if "COLOR_0" in attributes:
        shape = document.accessor(attributes["COLOR_0"], "COLOR_0").shape
        if shape[0] != v or shape[1] < 3:
            raise document.error(f"COLOR_0 must be {v:,} RGB or RGBA colours, got shape {shape}")
        colors = document.floats(attributes["COLOR_0"], "COLOR_0", fractions=True)
        linear[:, : colors.shape[1]] = colors
    if (factor != 1).any():
        linear *= factor.astype(np.float32)
    if material.get("alphaMode", "OPAQUE") == "OPAQUE":
        linear[:, 3] = 1
    normals = None
    if "NORMAL" in attributes:
        normals = document.floats(attributes["NORMAL"], "NORMAL", fractions=True)
    for name, values in (("POSITION", vertices), ("NORMAL", normals)):
        if values is not None and values.shape != (v, 3):
            raise document.error(f"{name} must be {v:,} vectors of 3, got shape {values.shape}")
    tables = {}
    for name in stored.names if stored else ():
        if name in attributes:
            tables[name] = document.floats(attributes[name], name)
            wanted = (v, stored.columns if stored else 0)
            if tables[name].shape != wanted:
                raise document.error(f"{name} must have shape {wanted}, got {tables[name].shape}")
    return _Piece(place, place.skinning(document, attributes, v), vertices, faces, linear, normals, tables)


def primitive_faces(document: GltfDocument, primitive: dict[str, Any], v: int) -> np.ndarray:
    if "indices" in primitive:
        stored = document.accessor(primitive["indices"], "indices")
        if stored.dtype.kind != "u" or stored.shape[1] != 1:
            raise document.error(f"indices must be unsigned integers, got {stored.dtype}")
        if len(stored) and stored.max() >= v:
            raise document.error(f"indices run up to {stored.max()}, there are {v:,} vertices")
        document.budget.spend(4 * len(stored), "indices")
        corners = stored[:, 0].astype(np.int32)
    else:
        corners = np.arange(v, dtype=np.int32)
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise document.error(f"{len(corners):,} indices are no whole number of triangles")
        return corners.reshape(-1, 3)
    n = max(len(corners) - 2, 0)
    document.budget.spend(36 * n, "indices")
    i = np.arange(n)
    if mode == _STRIP:
        return corners[np.stack([i, i + 1 + i % 2, i + 2 - i % 2], axis=1)]
    if mode == _FAN:
        return corners[np.stack([i + 1, i + 2, 0 * i], axis=1)]
    raise document.error(f"unknown primitive mode {str(mode)[:20]}")


def _join(
    document: GltfDocument,
    pieces: list[_Piece],
    own: dict[str, Any],
    note: dict[str, Any],
    origin: np.ndarray,
) -> SplatMesh:
    stored: Stored | None = note.pop("viewColors")
    whole = stored is not None and all(len(piece.tables) == len(stored.names) for piece in pieces)
    if not whole:
        for piece in pieces:
            piece.tables = {}
    try:
        arrays: dict[str, Any] = joined_rows([piece.arrays() for piece in pieces])
    except ValueError as error:
        raise document.error(str(error)) from None
    colors = straight_colors(arrays.pop("linear"), document.path)
    if note.get("blending") != "linear":
        colors[:, :3] = linear_to_srgb(colors[:, :3])
    if note.get("normals") == "computed":
        arrays.pop("normals", None)
    arrays |= {"colors": colors, "up": (0, 1, 0), "origin": origin}
    if "copies" in note:
        faces, place = _own_triangles(document, note["copies"], arrays["faces"], len(colors))
        arrays["faces"] = faces
        if place is not None:
            kept = ("vertices", "colors", "normals", *(stored.names if stored and whole else ()))
            rows = [name for name in kept if arrays.get(name) is not None]
            arrays |= {name: arrays[name][place] for name in rows}
            colors = arrays["colors"]
    if note:
        arrays |= {"up": note["up"], "blending": note["blending"]}
    tables = {name: arrays.pop(name) for name in (stored.names if stored and whole else ())}
    if note and len(own["primitives"]) == 1:
        arrays |= _restore(document, own, note, len(arrays["faces"]), len(colors))
        if stored is not None and not put_back(stored, tables, arrays):
            _warn(f"{document.path}: another program has altered the file, left out: harmonics")
        if arrays.get("binding") is not None and not _matches(arrays["binding"], arrays["vertices"]):
            _warn(
                f"{document.path}: another program has moved vertices, left out: the binding to a base mesh"
            )
            arrays["binding"] = None
    return checked(document.path, SplatMesh, **arrays)


# -- contents of our own files beyond glTF


def _our_note(mesh: dict[str, Any]) -> dict[str, Any]:
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


def _origin_of(note: dict[str, Any]) -> np.ndarray:
    return np.array(note.get("origin", [0, 0, 0]), np.float64)


def _is_own_placement(matrix: np.ndarray, note: dict[str, Any]) -> bool:
    """Whether the node is still ours: it turns the mesh's up direction to +y and puts the mesh at its origin,
    nothing more."""
    wanted = rotation_matrix(up_quaternion(np.array(note["up"], np.float64)))
    wanted[:3, 3] = wanted[:3, :3] @ _origin_of(note)
    rounding = 1e-12 * np.abs(wanted[:3, 3]).max()
    turn, shift = np.abs(matrix - wanted)[:3, :3], np.abs(matrix - wanted)[:3, 3]
    return bool(turn.max() < 1e-5 and shift.max() < max(1e-5, rounding))


def _restore(
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
        _warn(f"{document.path}: another program has altered the file, left out: {', '.join(lost)}")
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
        stored = dict_or_empty(entry.get(camel_case(field.name)))
        values = _raw(document, stored, field.dtype, field.shape(counts))
        if values is None:
            return None
        parts[field.name] = values
    return checked(document.path, Binding.from_arrays, parts)


def _matches(binding: Binding, vertices: np.ndarray) -> bool:
    """Whether the vertices are where the binding puts them, up to rounding."""
    size = float(np.abs(binding.base_vertices).max(initial=0))
    return bool((np.abs(binding.positions() - vertices) <= 1e-4 * size).all())


def _own_triangles(
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
        vertex = _raw(document, dict_or_empty(entry.get("vertex")), np.int32, (v,))
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


# -- helpers


def material_of(document: GltfDocument, primitive: dict[str, Any]) -> dict[str, Any]:
    if "material" not in primitive:
        return {}
    return document.item("materials", primitive["material"], "a primitive")


def pbr_of(material: dict[str, Any]) -> dict[str, Any]:
    return dict_or_empty(material.get("pbrMetallicRoughness"))


def _refuse_splats(document: GltfDocument, primitive: dict[str, Any]) -> None:
    if is_splats(primitive):
        raise document.error("holds Gaussian splats, not a mesh; read it with load_gaussians")


def dict_or_empty(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def objects_in(document: GltfDocument, value: object, what: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(x, dict) for x in value):
        raise document.error(f"{what} must be an array of objects")
    return value


def _warn(message: str) -> None:
    warnings.warn(message, DataWarning, stacklevel=4)
