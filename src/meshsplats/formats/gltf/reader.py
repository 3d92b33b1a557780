"""Reads meshes from glTF 2.0: our own files exactly, those of others as triangles and vertex colours."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.arrays import joined_rows
from meshsplats.errors import NoColorsWarning, NoTextureWarning
from meshsplats.formats._validation import checked, straight_colors, warn_of_lost_detail
from meshsplats.formats.gltf import copies
from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty
from meshsplats.formats.gltf.looks import Look, look_of
from meshsplats.formats.gltf.own import (
    fits,
    grid_of,
    in_order_of_splats,
    is_own_placement,
    listed_vertices,
    origin_of,
    our_note,
    own_triangles,
    restored,
    warn,
)
from meshsplats.formats.gltf.scene import Placed, Skinning, placed_meshes
from meshsplats.formats.gltf.scene_parts import is_splats, shown_meshes
from meshsplats.formats.gltf.view_colors import Stored, put_back, stored_colors
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import choose_origin, zero_origin
from meshsplats.scene.spherical_harmonics import moved_harmonics

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
    Morph targets count by the weights of their node or mesh.
    Buffers must be embedded or lie beside the file. Positions are relative to ``origin``; by default to that
    of our files, or to one that suits those of others, whose nodes are applied in float64.

    Raises:
        FileFormatError: the file is broken, or has Draco compression, meshopt compression with filters.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # SplatMesh refuses values that are not finite
        return _read(GltfDocument(path), origin)


def listed_nodes(path: Path) -> int:
    """The number of nodes of a file that lists triangles in an order of blending, each with both windings,
    for viewers that cull; 0 for any other.

    Raises FileFormatError for a broken file.
    """
    meshes = [place.mesh for place in placed_meshes(GltfDocument(path))]
    return copies.counts(our_note(meshes[0]).get("copies")) if meshes else 0


def listed_order(path: Path, mesh: SplatMesh) -> DrawOrder | None:
    """The order in which a file lists the triangles of ``mesh``, which was read from it; None without one.

    Raises FileFormatError for a broken file.
    """
    document = GltfDocument(path)
    placed = shown_meshes(document)
    entry = dict_or_empty(our_note(placed[0].mesh).get("copies")) if placed else {}
    if not copies.counts(entry) or copies.counts(entry) != len(placed):
        return None
    listed, first = [], 0
    for place in placed:
        primitive = document.objects(place.mesh.get("primitives"), "primitives of a mesh")[0]
        places = document.accessor(dict_or_empty(primitive.get("attributes")).get("POSITION"), "POSITION")
        count = len(places)
        listed.append(placed_faces(document, place, primitive, count) + first)
        first += count
    vertex = listed_vertices(document, entry, first)
    faces, starts = np.concatenate(listed), np.cumsum([0, *map(len, listed)])
    return copies.order_of(mesh.faces, faces if vertex is None else vertex[faces], starts)


def _read(document: GltfDocument, origin: np.ndarray | None) -> SplatMesh:
    path = document.path
    placed = shown_meshes(document)
    pieces, skipped, textured, colored = [], 0, 0, False
    note = our_note(placed[0].mesh) if placed else {}
    if len(placed) != max(1, copies.counts(note.get("copies"))):
        note = {}
    own = placed[0].mesh if note else {}
    stored, grid = stored_colors(note, document.error), grid_of(document, note)
    named: np.ndarray | None = None
    kept = bool(note) and all(is_own_placement(place.matrix, note, grid) for place in placed)
    if kept:
        placed = [place._replace(matrix=np.eye(4)) for place in placed]
        named = origin_of(note)
    elif note:  # another program has moved the mesh in the scene
        note["up"] = [0.0, 1.0, 0.0]
    motion = placed[0].matrix[:3, :3] if placed else np.eye(3)
    for place in placed:
        for primitive in document.objects(place.mesh.get("primitives"), "primitives of a mesh"):
            mode = primitive.get("mode", _TRIANGLES)
            if mode in POINTS_TO_LINES:
                skipped += 1
                _refuse_splats(document, primitive)
                continue
            look = look_of(document, primitive)
            textured += bool(look.texture)
            colored |= look.factor is not None
            colored |= "COLOR_0" in dict_or_empty(primitive.get("attributes"))
            pieces.append(_piece(document, primitive, look, place, stored))
    if skipped:
        warn(f"{path}: {skipped:,} primitives of points or lines were left out")
    if textured:
        message = f"{path}: {textured:,} primitives have a texture, which was left out; colours may differ"
        warnings.warn(message, NoTextureWarning, stacklevel=3)
    if not pieces:
        raise document.error("the scene holds no triangles")
    if note and not (textured or colored):
        message = f"{path}: no vertex colours; the mesh is shown in white"
        warnings.warn(message, NoColorsWarning, stacklevel=3)
    shift = zero_origin()  # what is ours is relative to its origin already
    if named is not None:
        origin = named
    else:
        shift = origin = _chosen_origin(document, pieces) if origin is None else origin
    for piece in pieces:
        if kept and grid is not None:
            piece.vertices = (piece.vertices * grid.scale + np.array(grid.offset)).astype(np.float32)
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
    look: Look,
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
    faces = placed_faces(document, place, primitive, v)
    document.budget.spend(64 * v + 12 * len(faces), "a mesh")
    linear = linear_colors(document, attributes, v)
    if look.emits:
        linear[:, :3] = 1
    if look.factor is not None:
        linear *= look.factor.astype(np.float32)
    if look.alpha_mode == "OPAQUE":
        linear[:, 3] = 1
    normals = None
    if "NORMAL" in attributes:
        normals = document.floats(attributes["NORMAL"], "NORMAL", fractions=True)
    for name, values in (("POSITION", vertices), ("NORMAL", normals)):
        if values is not None and values.shape != (v, 3):
            raise document.error(f"{name} must be {v:,} vectors of 3, got shape {values.shape}")
    vertices = place.morphed(document, primitive, "POSITION", vertices)
    if normals is not None:
        normals = place.morphed(document, primitive, "NORMAL", normals)
    tables = {}
    for name in stored.names if stored else ():
        if name in attributes:
            tables[name] = document.floats(attributes[name], name)
            wanted = (v, stored.columns if stored else 0)
            if tables[name].shape != wanted:
                raise document.error(f"{name} must have shape {wanted}, got {tables[name].shape}")
    return _Piece(place, place.skinning(document, attributes, v), vertices, faces, linear, normals, tables)


def linear_colors(document: GltfDocument, attributes: dict[str, Any], v: int) -> np.ndarray:
    """(v, 4) float32 linear RGBA of the ``v`` vertices of a primitive (COLOR_0); white without any."""
    linear = np.ones((v, 4), np.float32)
    if "COLOR_0" in attributes:
        shape = document.accessor(attributes["COLOR_0"], "COLOR_0").shape
        if shape[0] != v or shape[1] < 3:
            raise document.error(f"COLOR_0 must be {v:,} RGB or RGBA colours, got shape {shape}")
        colors = document.floats(attributes["COLOR_0"], "COLOR_0", fractions=True)
        linear[:, : colors.shape[1]] = colors
    return linear


def placed_faces(document: GltfDocument, place: Placed, primitive: dict[str, Any], v: int) -> np.ndarray:
    """(m, 3) int32 triangles of a primitive of ``v`` vertices at its ``place``: the other way around where
    that makes a mirror image of it, so that they still face outwards."""
    faces = _faces(document, primitive, v)
    return faces[:, [0, 2, 1]] if place.mirrors(primitive) else faces


def _faces(document: GltfDocument, primitive: dict[str, Any], v: int) -> np.ndarray:
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
        faces, place = own_triangles(document, note["copies"], arrays["faces"], len(colors))
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
        arrays |= restored(document, own, note, len(arrays["faces"]), len(colors))
    if "splats" in note:
        arrays |= in_order_of_splats(document, note["splats"], arrays["faces"])
    if stored is not None and not put_back(stored, tables, arrays):
        warn(f"{document.path}: another program has changed the file, so this is ignored: harmonics")
    if arrays.get("binding") is not None and not fits(arrays["binding"], arrays["vertices"]):
        warn(f"{document.path}: another program has moved vertices, left out: the binding to a base mesh")
        arrays["binding"] = None
    return checked(document.path, SplatMesh, **arrays)


# -- helpers


def _refuse_splats(document: GltfDocument, primitive: dict[str, Any]) -> None:
    if is_splats(primitive):
        raise document.error("holds Gaussian splats, not a mesh; read it with load_gaussians")
