"""Meshes in Blender from arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.blender.inside import versions
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.splat_points import is_splats, values
from meshsplats.cameras.framing import SAMPLE
from meshsplats.scene.spherical_harmonics import TERMS, in_fours

COLOR = "Color"
"""Attribute with RGBA: display values where the image is unlit, linear light where it is lit."""
DISPLAY = "DisplayColor"
"""Attribute of a lit mesh: the RGBA that the unlit one has in ``COLOR``."""
MADE = "LitColor"
"""Attribute of a lit mesh: the RGBA that it was made with in ``COLOR``, so that painted colours show."""
HARMONICS = ("splat_sh_red", "splat_sh_green", "splat_sh_blue")
"""Names, up to a number from 0, of attributes with four coefficients each of the harmonics of a vertex'
splat, of degree 1 and more; the last ones are padded with zeros."""
NORMAL = "splat_normal"
"""Attribute with the shading normal, in the object's own frame."""
SPLAT = "splat"
"""Face attribute: index of the splat that each was made from."""
BASE_FACE = "splat_base_face"
"""Attribute of splats that follow a base: the face of it that each vertex lies on."""
STAND_IN = "meshsplats_stand_in"
"""Property of the objects that take light in place of splats: True."""
POINTS = "meshsplats_light_points"
"""Property of the splats' object: the object of the points that light on them is gathered at."""
_ALL = slice(None)
_VISIBLE = 0.1
"""Opacity from which a vertex counts as visible."""


def make_mesh(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    face_splat: np.ndarray | None = None,
    display: np.ndarray | None = None,
    edges: bool = True,
) -> Any:
    """A bpy mesh of (v, 3) float32 vertices, (f, 3) int32 faces and (v, 4) float32 colours, stored unchanged,
    as are the unlit ones, ``display`` (v, 4).

    ``edges`` False skips the edges and, without ``normals``, shades flat: renderers need no edges, an unlit
    material no normals, and both take as long as all the rest.
    """
    mesh = make_plain(name, vertices, faces)
    color = mesh.attributes.new(COLOR, "FLOAT_COLOR", "POINT")
    color.data.foreach_set("color", np.ascontiguousarray(colors, np.float32).ravel())
    if display is not None:
        attribute = mesh.attributes.new(DISPLAY, "FLOAT_COLOR", "POINT")
        attribute.data.foreach_set("color", np.ascontiguousarray(display, np.float32).ravel())
        attribute = mesh.attributes.new(MADE, "FLOAT_COLOR", "POINT")
        attribute.data.foreach_set("color", np.ascontiguousarray(colors, np.float32).ravel())
    if normals is not None:
        attribute = mesh.attributes.new(NORMAL, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", np.ascontiguousarray(normals, np.float32).ravel())
    if face_splat is not None:
        attribute = mesh.attributes.new(SPLAT, "INT", "FACE")
        attribute.data.foreach_set("value", np.ascontiguousarray(face_splat, np.int32))
    mesh.color_attributes.active_color = mesh.color_attributes[COLOR]
    mesh.color_attributes.render_color_index = mesh.color_attributes.find(COLOR)
    if edges:
        mesh.update(calc_edges=True)
    elif normals is None:
        versions.shade_flat(mesh)
    if normals is not None:
        # Cycles lights only the side that the mesh's own (smooth) normals face.
        versions.set_normals(mesh, normals)
    return mesh


def store_harmonics(mesh: Any, harmonics: np.ndarray, of_vertex: np.ndarray | slice = _ALL) -> None:
    """Gives the bpy ``mesh`` the harmonics (v, k, 3) of its vertices' splats, or those of its splats (s, k,
    3) and the splat ``of_vertex`` (v,)."""
    for name, fours in zip(HARMONICS, in_fours(harmonics), strict=True):
        for i, four in enumerate(fours):
            own = f"{name}_{i}"
            attribute = mesh.attributes.get(own) or mesh.attributes.new(own, "FLOAT_COLOR", "POINT")
            attribute.data.foreach_set("color", four[of_vertex].ravel())


def terms_of(harmonics: np.ndarray | None) -> int:
    """How many ``harmonics`` (v, k, 3) there are: k; 0 for None."""
    return 0 if harmonics is None else harmonics.shape[1]


def read_harmonics(mesh: Any, vertices: np.ndarray | slice = _ALL) -> np.ndarray | None:
    """(v, k, 3) float32 harmonics of the splats of ``vertices`` (v,), k = 3, 8 or 15; None without."""
    fours = 0
    while all(f"{name}_{fours}" in mesh.attributes for name in HARMONICS):
        fours += 1
    if not fours:
        return None
    found = [
        np.concatenate([read_colors(mesh, f"{name}_{i}")[vertices] for i in range(fours)], axis=1)
        for name in HARMONICS
    ]
    return np.stack(found, axis=2)[:, : max(terms for terms in TERMS if terms <= 4 * fours)]


def make_plain(name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A bpy mesh of (v, 3) float32 vertices and (f, 3) int32 faces, without edges: ``mesh.update`` adds
    them."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    versions.set_positions(mesh, vertices)
    mesh.loops.add(3 * len(faces))
    versions.set_corners(mesh, faces)
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    return mesh


def make_object(mesh: Any, name: str, rotation: np.ndarray, collection: Any) -> Any:
    """An object of ``mesh`` in ``collection``, rotated by ``rotation`` (3, 3)."""
    from mathutils import Matrix

    obj = bpy.data.objects.new(name, mesh)
    obj.matrix_world = Matrix(np.asarray(rotation, np.float64).tolist()).to_4x4()
    collection.objects.link(obj)
    return obj


def read_colors(mesh: Any, name: str) -> np.ndarray:
    """(v, 4) float32 values of the colour attribute ``name``."""
    colors = np.empty(4 * len(mesh.vertices), np.float32)
    mesh.attributes[name].data.foreach_get("color", colors)
    return colors.reshape(-1, 4)


def triangles(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """(f, 3) int32 triangles of ``mesh``, its faces cut where they have more corners; and (f,) int32 the face
    of each."""
    count = len(mesh.polygons)
    if len(mesh.loops) == 3 * count:
        return versions.corners(mesh).reshape(-1, 3), np.arange(count, dtype=np.int32)
    mesh.calc_loop_triangles()
    faces = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    polygon = np.empty(len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("polygon_index", polygon)
    return faces.reshape(-1, 3), polygon


def owners(mesh: Any) -> np.ndarray:
    """(f,) int32 values of ``SPLAT``."""
    values = np.empty(len(mesh.polygons), np.int32)
    mesh.attributes[SPLAT].data.foreach_get("value", values)
    return values


def face_middles(mesh: Any) -> np.ndarray:
    """(f, 3) float32 means of the corners of each face of ``mesh``."""
    corners, places = versions.corners(mesh), versions.positions(mesh)
    if len(corners) == 3 * len(mesh.polygons):
        a, b, c = (places[corners[k::3]] for k in range(3))
        return (a + b + c) / np.float32(3)
    starts = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", starts)
    counts = np.diff(starts, append=len(corners)).astype(np.float32)
    return np.add.reduceat(places[corners], starts) / counts[:, None]


def size(data: Any) -> int:
    """Count of the vertices of a mesh, or of the points of a point cloud."""
    return len(data.vertices if hasattr(data, "vertices") else data.points)


def world_points(obj: Any) -> np.ndarray:
    """(k, 3) float64 sample of the visible vertices, or splats, of ``obj``, in Blender's world."""
    world = np.array(obj.matrix_world)
    return local_points(obj) @ world[:3, :3].T + world[:3, 3]


def local_points(obj: Any) -> np.ndarray:
    """(k, 3) float64 sample of the visible vertices, or splats, of ``obj``, in its own frame."""
    data = obj.data
    own = is_splats(obj)  # of Blender
    points = (values(data, "position") if own else versions.positions(data)).astype(np.float64)
    if own:
        points = points[values(data, "radiance:base")[:, 3] > _VISIBLE]
    elif COLOR in data.attributes and len(points):
        points = points[read_colors(data, COLOR)[:, 3] > _VISIBLE]
    return points[:: -(-max(len(points), 1) // SAMPLE)]
