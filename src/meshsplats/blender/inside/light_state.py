"""What lights splats, as a checksum: baked light is older than the scene if it has changed since."""

from __future__ import annotations

import time
import zlib
from typing import Any

from meshsplats.blender.inside import meshes, versions

_SHAPES = ("MESH", "POINTCLOUD", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME")
_VALUES = ("BOOLEAN", "INT", "FLOAT", "ENUM", "STRING")
_LOOKS = {
    *("name", "label", "select", "width", "height", "location", "location_absolute", "hide", "mute_ui"),
    *("show_expanded", "show_options", "show_preview", "show_texture", "is_active", "use_pin_to_last"),
    *("show_viewport", "show_in_editmode", "show_on_cage", "use_custom_color", "color_tag", "preview_ui"),
    *("active_texture_index", "active_material_index", "use_fake_user", "tag", "warning_propagation"),
    *("parent_index", "execution_time", "persistent_uid", "show_gizmo", "use_extra_user", "bl_icon"),
    "use_nodes",  # always, from Blender 5 on, where asking for it warns
}
"""RNA properties that do not change images."""
_WHOLE = 300_000
"""Vertices of a mesh up to which all of them count; of larger ones, some."""
_SOME = 500
_LIT = "meshsplats_lit"
_LONG = 0.02
"""Processor seconds: what takes as long delays the window."""
_REST = 30
"""After which multiple of its time a state that takes long is looked for again."""
_STAND_IN = "meshsplats_stand_in"
"""``stand_ins.STAND_IN``."""
_known: dict[tuple[str, str], tuple[float, float, str]] = {}
"""When they began, how long they took, and what was found."""


def state(scene: Any, obj: Any) -> str:
    """A checksum of what lights the splats ``obj``: lamps, sky, and what is rendered, with its modifiers and
    materials. Of other splats, only their places and sizes: their light does not come from their nodes."""
    parts: list[Any] = [_numbers(obj.matrix_world)]
    used: dict[str, Any] = {}
    for other in sorted(scene.objects, key=lambda other: other.name):
        if is_rendered(other) and other != obj and not (other.parent == obj and other.get(_STAND_IN)):
            parts += _object(other, used)
    parts += [part for material in used.values() for part in _block(material)]
    if scene.world is not None:
        parts += _block(scene.world)
    return f"{zlib.crc32(repr(parts).encode()):08x}"


def latest(scene: Any, obj: Any) -> str:
    """``state``, for the panel, which asks whenever it is drawn: of a large scene, now and then."""
    key, now, begun = (scene.name, obj.name), time.monotonic(), time.thread_time()
    when, took, found = _known.get(key, (0.0, 0.0, ""))
    if took > _LONG and now - when < _REST * took:
        return found
    found = state(scene, obj)
    took = time.thread_time() - begun
    _known[key] = (now, took, found)
    return found


def renewed(scene: Any, obj: Any) -> str:
    """``state``, which ``latest`` then knows."""
    _known.pop((scene.name, obj.name), None)
    return latest(scene, obj)


def is_rendered(obj: Any) -> bool:
    """Whether ``obj`` is in images: neither it nor all of its collections are hidden there."""
    return not obj.hide_render and not all(home.hide_render for home in obj.users_collection)


def _object(obj: Any, used: dict[str, Any]) -> list[Any]:
    """What it is and where; its materials join those that are ``used``."""
    if obj.type == "LIGHT":
        return [_numbers(obj.matrix_world), *_block(obj.data)]
    if obj.instance_type == "COLLECTION" and obj.instance_collection is not None:
        parts: list[Any] = [obj.name, _numbers(obj.matrix_world)]
        for inner in obj.instance_collection.all_objects:
            parts += _object(inner, used) if is_rendered(inner) else []
        return parts
    if obj.type not in _SHAPES:
        return []
    parts = [obj.name, _numbers(obj.matrix_world)]
    if _LIT in obj.data:
        return [*parts, meshes.size(obj.data)]
    used |= {slot.material.name: slot.material for slot in obj.material_slots if slot.material is not None}
    for modifier in obj.modifiers:
        parts += _values(modifier) if modifier.show_render else []
    return parts + _shape(obj.data)


def _shape(data: Any) -> list[Any]:
    if hasattr(data, "polygons"):
        count = len(data.vertices)
        if count <= _WHOLE:
            return [meshes.size(data), zlib.crc32(versions.positions(data).tobytes())]
        some = (data.vertices[i].co for i in range(0, count, max(count // _SOME, 1)))
        return [meshes.size(data), _numbers(some)]
    if not hasattr(data, "splines"):
        return [meshes.size(data)] if hasattr(data, "points") else _values(data)
    parts = _values(data)
    for spline in data.splines:
        parts += _values(spline)
        for point in (*spline.points, *spline.bezier_points):
            parts.append(_numbers([point.co]))
    return parts


def _block(block: Any) -> list[Any]:
    """Values and nodes of a lamp, a material or a world."""
    return [block.name, *_values(block), *_nodes(block.node_tree, frozenset())]


def _nodes(tree: Any, outer: frozenset[str]) -> list[Any]:
    if tree is None or tree.name in outer:
        return []
    parts: list[Any] = []
    for node in tree.nodes:
        parts += [node.name, node.bl_idname, *_values(node)]
        for socket in (*node.inputs, *node.outputs):
            if hasattr(socket, "default_value") and not socket.is_linked:
                parts.append(_plain(socket.default_value))
        image = getattr(node, "image", None)
        if image is not None:
            parts += [image.name, image.filepath, tuple(image.size), image.colorspace_settings.name]
        ramp = getattr(node, "color_ramp", None)
        if ramp is not None:
            parts += [ramp.interpolation, *([e.position, *e.color] for e in ramp.elements)]
        parts += _nodes(getattr(node, "node_tree", None), outer | {tree.name})
    ends = (
        (link.from_node.name, link.from_socket.identifier, link.to_node.name, link.to_socket.identifier)
        for link in tree.links
    )
    return parts + sorted(ends)


def _values(owner: Any) -> list[Any]:
    """Names and values of the RNA properties of ``owner`` that a user may set."""
    found = []
    for prop in owner.bl_rna.properties:
        name = prop.identifier
        if (
            prop.type in _VALUES
            and not prop.is_readonly
            and name not in _LOOKS
            and not name.startswith("bl_")
        ):
            found.append((name, _plain(getattr(owner, name, None))))
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.4g}") + 0.0
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    if hasattr(value, "bl_rna"):  # another block: its name
        return getattr(value, "name", "")
    return [_plain(part) for part in value] if hasattr(value, "__len__") else str(type(value))


def _numbers(rows: Any) -> list[float]:
    return [float(f"{value:.4g}") + 0.0 for row in rows for value in row]
