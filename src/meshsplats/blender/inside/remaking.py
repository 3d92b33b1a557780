"""Other colours and another shading for a mesh that there is, or a part of it: what an artist has added to it
stays, such as vertex groups, shape keys, UV maps, attributes and materials."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from meshsplats.blender.inside import (
    baking,
    light_state,
    materials,
    meshes,
    notes,
    priors,
    sorted_copies,
    versions,
)
from meshsplats.blender.inside.host import bpy

_OWN = {
    *(meshes.COLOR, meshes.DISPLAY, meshes.MADE, meshes.NORMAL, meshes.SPLAT, sorted_copies.CENTER),
    *(materials.LIGHT, baking.POINT, *priors.ATTRIBUTES.values()),
}
"""Attributes that MeshSplats makes, besides the harmonics."""
_BLENDERS = {"position", "material_index", "sharp_face", "sharp_edge", versions.CUSTOM_NORMAL}
"""Attributes that Blender makes by itself."""
_KEYS = {"BYTE_COLOR": "color_srgb", "FLOAT_COLOR": "color", "FLOAT_VECTOR": "vector", "FLOAT2": "vector"}
"""Properties that hold the values of an attribute of each type; of all others, it is ``value``."""
_WIDTHS = {
    **{"BYTE_COLOR": 4, "FLOAT_COLOR": 4, "FLOAT_VECTOR": 3, "FLOAT2": 2},
    **{"QUATERNION": 4, "INT16_2D": 2, "INT32_2D": 2, "FLOAT4X4": 16},
}
"""Numbers of each value; 1 for all other types."""
_TYPES = {"BOOLEAN": bool, "INT": np.int32, "INT8": np.int8, "INT16_2D": np.int16, "INT32_2D": np.int32}
_NAMES = "Splats"
"""How the names of our materials begin; what an artist has renamed is the artist's."""
LOOK = "meshsplats_look"
"""Property of our materials: what their ``_look`` was when they were made, the same for all of a kind."""
DISTANCE = "meshsplats_self_shadow"
"""Property of lit ones: the self-shadow distance that they were made with."""


def fits(data: Any, vertices: np.ndarray, faces: np.ndarray, away: float | None) -> bool:
    """Whether the mesh ``data`` has the triangles ``faces`` (f, 3), in whatever winding, and the ``vertices``
    (v, 3), ``away`` from their places at most; None: anywhere."""
    if len(data.vertices) != len(vertices) or len(data.loops) != 3 * len(data.polygons):
        return False
    corners = versions.corners(data).reshape(-1, 3)
    if corners.shape != faces.shape or not (np.sort(corners, axis=1) == np.sort(faces, axis=1)).all():
        return False
    return away is None or bool((np.abs(versions.positions(data) - vertices) <= away).all())


def fill(
    data: Any,
    faces: np.ndarray,
    colors: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    face_splat: np.ndarray | None = None,
    display: np.ndarray | None = None,
) -> None:
    """Gives the mesh ``data``, which ``fits``, what ``meshes.make_mesh`` makes of the same arguments, and
    takes away what it has of MeshSplats else."""
    _wind(data, faces)
    if normals is None and meshes.NORMAL in data.attributes and versions.CUSTOM_NORMAL in data.attributes:
        data.attributes.remove(data.attributes[versions.CUSTOM_NORMAL])
    arrays = {
        meshes.COLOR: ("FLOAT_COLOR", "POINT", colors),
        meshes.DISPLAY: ("FLOAT_COLOR", "POINT", display),
        meshes.MADE: ("FLOAT_COLOR", "POINT", None if display is None else colors),
        meshes.NORMAL: ("FLOAT_VECTOR", "POINT", normals),
        meshes.SPLAT: ("INT", "FACE", face_splat),
    }
    kept = {name: (kind, domain) for name, (kind, domain, values) in arrays.items() if values is not None}
    for name in [attribute.name for attribute in data.attributes if _is_own(attribute.name)]:
        attribute = data.attributes[name]
        if name != sorted_copies.CENTER and kept.get(name) != (attribute.data_type, attribute.domain):
            data.attributes.remove(attribute)
    for name, (kind, domain, values) in arrays.items():
        if values is not None:
            attribute = data.attributes.get(name) or data.attributes.new(name, kind, domain)
            flat = np.ascontiguousarray(values, _TYPES.get(kind, np.float32)).ravel()
            attribute.data.foreach_set(_KEYS.get(kind, "value"), flat)
    data.color_attributes.active_color = data.color_attributes[meshes.COLOR]
    data.color_attributes.render_color_index = data.color_attributes.find(meshes.COLOR)
    data.update()
    if normals is not None:
        versions.set_normals(data, normals)


def set_material(data: Any, material: Any) -> None:
    """Puts ``material``, a new one, in the place of all materials of MeshSplats that ``data`` has, or else in
    the first one, whose material moves to the end. Faces keep the numbers of their materials. One of them
    that an artist has changed stays instead, or at least in the file (``_chosen``)."""
    material[LOOK] = _look(material)
    distance = _distance(material)
    if distance is not None:
        material[DISTANCE] = distance
    slots = data.materials
    ours = _ours(slots)
    material = _chosen([slots[i] for i in ours], material)
    if not ours:
        if len(slots) and slots[0] is not None:
            slots.append(slots[0])
        ours = [0]
    if not len(slots):
        slots.append(material)
        return
    slots[ours[0]] = material
    if len(ours) == 1:
        return
    # Joined with others.
    index = np.zeros(len(data.polygons), np.int32)
    data.polygons.foreach_get("material_index", index)
    index[np.isin(index, ours)] = ours[0]
    data.polygons.foreach_set("material_index", index)
    for i in reversed(ours[1:]):
        slots.pop(index=i)


def _ours(slots: Any) -> list[int]:
    """Indices of the materials of MeshSplats among ``slots``: by their names, or the first material if it was
    made here and renamed since."""
    found = [i for i, other in enumerate(slots) if other is not None and other.name.startswith(_NAMES)]
    renamed = len(slots) > 0 and slots[0] is not None and LOOK in slots[0]
    return found or [0] * renamed


def _chosen(old: Iterable[Any], material: Any, *, shared: bool = False) -> Any:
    """``material``, which is new, or in its place the first of the ``old`` ones if that is of its kind and an
    artist has changed or renamed it. Others that were changed, such as those of some faces alone, stay in the
    file, and a note names them. ``shared``: others use the old ones, too."""
    chosen = material
    for i, other in enumerate(old):
        if not _is_changed(other):
            continue
        if i == 0 and other[LOOK] == material[LOOK]:
            chosen = _like(other, material, shared=shared or other.users - other.use_fake_user > 1)
        else:
            other.use_fake_user = True
            notes.add(f"your material {other.name} stays in the file, and gave its place to {chosen.name}")
    if chosen != material:
        bpy.data.materials.remove(material)
    return chosen


def _like(changed: Any, material: Any, *, shared: bool) -> Any:
    """``changed``, or a copy of it if it is ``shared``, showing the light that ``material`` shows, with its
    self-shadow distance, unless the artist has set that."""
    if shared:
        changed = changed.copy()
    if materials.shows_even(material):
        materials.set_even(changed)
    else:
        materials.set_baked(changed, materials.shows_baked(material))
    if DISTANCE in material and _distance(changed) == changed[DISTANCE]:
        changed.node_tree.nodes[materials.SELF_SHADOW].outputs[0].default_value = material[DISTANCE]
        changed[DISTANCE] = material[DISTANCE]
    return changed


def _is_changed(material: Any) -> bool:
    """Whether an artist has changed or renamed ``material`` since it was made here."""
    if LOOK not in material:
        return False
    renamed = not material.name.startswith(_NAMES)
    return renamed or _distance(material) != material.get(DISTANCE) or _look(material) != material[LOOK]


def _look(material: Any) -> str:
    """A checksum of the nodes of ``material`` and of what else images show of it, whatever light it shows and
    whatever its self-shadow distance."""
    nodes = light_state.nodes(material.node_tree, free=(materials.BAKED, materials.SELF_SHADOW))
    parts = [nodes, material.pass_index, material.use_backface_culling, material.surface_render_method]
    return f"{zlib.crc32(repr(parts).encode()):08x}"


def _distance(material: Any) -> float | None:
    node = material.node_tree.nodes.get(materials.SELF_SHADOW) if material.node_tree else None
    return None if node is None else float(node.outputs[0].default_value)


def part(data: Any, faces: np.ndarray) -> None:
    """Leaves of the mesh ``data`` of triangles those in ``faces`` (f,) bool, in their order, with the
    vertices that they use."""
    import bmesh

    used = np.zeros(len(data.vertices), bool)
    used[versions.corners(data).reshape(-1, 3)[faces].ravel()] = True
    edited = bmesh.new()
    try:
        edited.from_mesh(data)
        gone = [face for face, keep in zip(edited.faces, faces.tolist(), strict=True) if not keep]
        alone = [vertex for vertex, keep in zip(edited.verts, used.tolist(), strict=True) if not keep]
        bmesh.ops.delete(edited, geom=gone, context="FACES")
        bmesh.ops.delete(edited, geom=[vertex for vertex in alone if vertex.is_valid], context="VERTS")
        edited.to_mesh(data)
    finally:
        edited.free()


def added(obj: Any) -> list[str]:
    """What an artist has added to the mesh of ``obj`` that belongs to its vertices, corners or faces."""
    data, found = obj.data, []
    if len(obj.vertex_groups) and any(vertex.groups for vertex in data.vertices):
        found.append("vertex groups")
    if data.shape_keys is not None:
        found.append("shape keys")
    layers = {layer.name for layer in data.uv_layers}
    if layers:
        found.append("UV maps")
    left_out = layers | _BLENDERS
    names = [
        attribute.name
        for attribute in data.attributes
        if attribute.name not in left_out
        and not attribute.name.startswith(".")
        and not _is_own(attribute.name)
    ]
    if names:
        found.append(f"attributes ({', '.join(names)})")
    index = np.zeros(len(data.polygons), np.int32)
    data.polygons.foreach_get("material_index", index)
    if index.any():
        found.append("materials of faces")
    return found


def take_properties(data: Any, old: Any) -> None:
    """Gives ``data`` the custom properties and further materials of the mesh ``old``, which it replaces, and
    its first one where an artist has changed that (``_chosen``)."""
    for name in old.keys():  # noqa: SIM118 - no dictionary
        if name not in data and not name.startswith("meshsplats"):
            data[name] = old[name]
    ours = _ours(old.materials)
    before = [old.materials[i] for i in ours]
    data.materials[0] = _chosen(before, data.materials[0], shared=old.users > 0)
    for i, material in enumerate(old.materials):
        if material is not None and i not in ours:
            data.materials.append(material)


def _is_own(name: str) -> bool:
    return name in _OWN or name.startswith(meshes.HARMONICS)


def _wind(data: Any, faces: np.ndarray) -> None:
    """Winds the triangles of ``data``, which ``fits``, as ``faces`` (f, 3) are: what belongs to corners goes
    with their vertices."""
    old = versions.corners(data).reshape(-1, 3)
    rows = np.flatnonzero((old != faces).any(axis=1))
    if not len(rows):
        return
    place = (old[rows][:, None, :] == faces[rows][:, :, None]).argmax(axis=2)
    source = np.arange(old.size).reshape(-1, 3)
    source[rows] = 3 * rows[:, None] + place
    # A corner's edge leads to the next corner: it is the one that the third corner does not touch.
    edges = np.arange(old.size).reshape(-1, 3)
    edges[rows] = 3 * rows[:, None] + (np.roll(place, 1, axis=1) + 1) % 3
    before = np.empty(old.size, np.int32)
    data.loops.foreach_get("edge_index", before)
    data.loops.foreach_set("edge_index", before[edges.ravel()])
    for attribute in data.attributes:
        kind = attribute.data_type
        if attribute.domain == "CORNER" and not attribute.name.startswith(".corner_") and kind != "STRING":
            values = np.empty((old.size, _WIDTHS.get(kind, 1)), _TYPES.get(kind, np.float32)).ravel()
            key = _KEYS.get(kind, "value")
            attribute.data.foreach_get(key, values)
            attribute.data.foreach_set(key, values.reshape(old.size, -1)[source.ravel()].ravel())
    versions.set_corners(data, faces)


def copied(data: Any) -> Any:
    """``data`` where it has one user, which then owns what is changed; else a copy."""
    return data if data.users == 1 else data.copy()
