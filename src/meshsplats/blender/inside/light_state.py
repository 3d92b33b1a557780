"""What lights splats, as a checksum: baked light is older than the scene if it has changed since."""

from __future__ import annotations

import zlib
from collections.abc import Container, Iterator
from typing import Any

from meshsplats.blender.inside import deforming, meshes, pacing, versions
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.materials import LIT

_SHAPES = ("MESH", "POINTCLOUD", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME")
_VALUES = ("BOOLEAN", "INT", "FLOAT", "ENUM", "STRING")
_LOOKS = {
    *("name", "label", "select", "width", "height", "location", "location_absolute", "hide", "mute_ui"),
    *("is_active", "use_pin_to_last", "use_custom_color", "color_tag", "preview_ui"),
    *("active_texture_index", "active_material_index", "use_fake_user", "tag", "warning_propagation"),
    *("parent_index", "execution_time", "persistent_uid", "use_extra_user", "bake_directory"),
    "use_nodes",  # always, from Blender 5 on, where asking for it warns
}
"""RNA properties that do not change images; those of ``_SHOWN`` neither."""
_SHOWN = ("bl_", "open_", "show_")
_UNLIKE = {
    *("shadow_buffer_bias", "shadow_color", "use_contact_shadow", "contact_shadow_distance"),
    *("contact_shadow_bias", "contact_shadow_thickness", "shadow_method", "socket_idname", "bake_target"),
    *("use_backface_culling_lightprobe_volume", "subsurface_method", "falloff", "flip_axis"),
}
"""RNA properties that Blender 5.3 lacks, or reads from a file of 4.2 with another value: all of little
influence on light, or of none."""
_SKIPPED = _LOOKS | _UNLIKE
_NEWER = {
    **{"exposure": 0.0, "normalize": True, "temperature": 6500.0, "use_temperature": False},
    **{"edge_weight": "bevel_weight_edge", "vertex_weight": "bevel_weight_vert"},
    **{"use_adaptive_subdivision": False, "adaptive_space": "PIXEL", "adaptive_pixel_size": 1.0},
    **{"adaptive_object_edge_length": 0.01, "fill_rule": "EVEN_ODD", "fill_solver": "SWEEP_LINE"},
    **{"surface_collision_distance": 0.005, "base": "DISPLACED", "convention": "OPENGL"},
    "phase": "HENYEY_GREENSTEIN",
}
"""RNA properties that Blender 4.2 lacks, with the values that they have in its files, which do not count."""
_NEWER_INPUTS = {
    "ShaderNodeAttribute": {"LightIndex"},
    "ShaderNodeBsdfGlass": {"Anisotropy", "Rotation", "Tangent", "Thin Film Thickness", "Thin Film IOR"},
    "ShaderNodeBsdfPrincipled": {
        *("Thin Wall", "Diffuse Roughness"),
        *("Transmission Dispersion Scale", "Transmission Dispersion Abbe Number"),
    },
    "ShaderNodeBump": {"Filter Width"},
    "ShaderNodeVectorTransform": {"LightIndex"},
    "ShaderNodeVolumeScatter": {"IOR", "Backscatter", "Alpha", "Diameter"},
}
"""Inputs of nodes that Blender 4.2 lacks; their values do not count."""
_RENAMED = {"dust_density": "aerosol_density", "NISHITA": "SINGLE_SCATTERING"}
"""Names and values of RNA properties of Blender 4.2: what they are called in 5.3."""
_CONSTANTS = ("ShaderNodeValue", "ShaderNodeRGB", "ShaderNodeNormal")
"""Nodes whose outputs hold values."""
_RAYS = ("diffuse", "glossy", "transmission", "volume_scatter", "shadow")
"""Those that bring light, or take it."""
_WHOLE = 300_000
"""Vertices of a mesh up to which all of them count; of larger ones, some."""
_SOME = 500
_ZERO = 1e-6


def state(scene: Any, obj: Any, layer: Any = None) -> str:
    """A checksum of what lights the splats ``obj`` in the view layer ``layer``, the active one by default:
    lamps, sky, and what is rendered, with its modifiers and materials. Of splats, only their places, sizes
    and what deforms them: their light does not come from their nodes."""
    layer = layer or bpy.context.view_layer
    parts: list[Any] = [_numbers(obj.matrix_world), *_deformation(obj)]
    used: dict[Any, None] = {}
    for other in sorted(set(rendered(layer.layer_collection)), key=lambda other: other.name):
        if other != obj and not (other.parent == obj and other.get(meshes.STAND_IN)):
            parts += _object(other, used)
    materials = (block for block in used if isinstance(block, bpy.types.Material))
    parts += [part for material in materials for part in _block(material)]
    world = layer.world_override or scene.world
    if world is not None:
        parts += _block(world)
    return f"{zlib.crc32(repr(parts).encode()):08x}"


def latest(scene: Any, obj: Any, layer: Any = None, *, now: bool = False) -> str:
    """``state``, for the panel, which asks whenever it is drawn: of a large scene, now and then. With
    ``now``, ``state`` itself, which is known then."""
    layer = layer or bpy.context.view_layer
    key = ("light", scene.name, obj.name, layer.name)
    return pacing.paced(key, lambda: state(scene, obj, layer), now=now)


def rendered(place: Any) -> Iterator[Any]:
    """The objects that images show of ``place``, a collection or that of a view layer: those that neither
    are hidden nor are in hidden or excluded collections. Some of them more than once."""
    collection = getattr(place, "collection", place)
    if collection.hide_render:
        return
    if not getattr(place, "exclude", False):
        yield from (obj for obj in collection.objects if not obj.hide_render)
    for child in place.children:
        yield from rendered(child)


def _object(obj: Any, used: dict[Any, None]) -> list[Any]:
    """What it is and where; its materials join what is ``used``, as do collections and shapes, which count
    once however many objects show them."""
    parts = [obj.name, _numbers(obj.matrix_world)]
    if obj.instance_type == "COLLECTION" and obj.instance_collection is not None:
        home = obj.instance_collection
        parts.append(home.name)
        if home not in used:
            used[home] = None
            for inner in sorted(set(rendered(home)), key=lambda inner: inner.name):
                parts += _object(inner, used)
        return parts
    parts += [getattr(obj, f"visible_{way}") for way in _RAYS]
    for linked in (obj.light_linking.receiver_collection, obj.light_linking.blocker_collection):
        parts += [] if linked is None else _members(linked)
    if obj.type == "LIGHT":
        return parts + _block(obj.data)
    if obj.type not in _SHAPES:
        return []
    if LIT in obj.data:
        return [*parts, meshes.size(obj.data), *_deformation(obj)]
    used |= dict.fromkeys(slot.material for slot in obj.material_slots if slot.material is not None)
    parts += [*_deformation(obj), obj.data.name]
    if obj.data not in used:
        used[obj.data] = None
        parts += _shape(obj.data)
    return parts


def _deformation(obj: Any) -> list[Any]:
    """Modifiers and shape keys of ``obj``."""
    parts = []
    for modifier in deforming.deformers(obj):
        parts += [*_values(modifier), *_targets(modifier)] if modifier.show_render else []
    keys = getattr(obj.data, "shape_keys", None)
    return parts + ([] if keys is None else [[k.name, _plain(k.value), k.mute] for k in keys.key_blocks])


def _members(linked: Any) -> list[Any]:
    """What a collection of light linking includes and excludes, whose stand-ins follow their splats."""
    own = zip(linked.objects, linked.collection_objects, strict=True)
    states = [(obj.name, kept.light_linking.link_state) for obj, kept in own if not obj.get(meshes.STAND_IN)]
    children = zip(linked.children, linked.collection_children, strict=True)
    parts: list[Any] = sorted(states)
    for child, kept in children:
        parts += [kept.light_linking.link_state, *_members(child)]
    return parts


def _targets(modifier: Any) -> list[Any]:
    """Places, poses and shapes of the objects that ``modifier`` refers to."""
    parts = []
    for prop in modifier.bl_rna.properties:
        found = prop.type == "POINTER" and prop.fixed_type.identifier == "Object"
        target = getattr(modifier, prop.identifier) if found else None
        if target is None:
            continue
        parts += [target.name, _numbers(target.matrix_world)]
        if target.pose is not None:
            parts += [_numbers(bone.matrix) for bone in target.pose.bones]
        if target.type == "LATTICE":
            parts.append(_numbers(point.co_deform for point in target.data.points))
        elif target.type in _SHAPES:
            parts += _shape(target.data)
    return parts


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
    return [block.name, *_values(block), *nodes(block.node_tree)]


def nodes(tree: Any, outer: frozenset[str] = frozenset(), *, free: Container[str] = ()) -> list[Any]:
    """Kinds, values and links of the nodes of ``tree``, a group in the trees ``outer``; values of those that
    are named in ``free`` do not count."""
    if tree is None or tree.name in outer or _is_as_made(tree):
        return []
    parts: list[Any] = []
    for node in tree.nodes:
        parts += [node.name, node.bl_idname]
        if node.name in free:
            continue
        parts += _values(node)
        newer = _NEWER_INPUTS.get(node.bl_idname, ())
        inputs = (socket for socket in node.inputs if socket.identifier not in newer)
        for socket in (*inputs, *(node.outputs if node.bl_idname in _CONSTANTS else ())):
            if hasattr(socket, "default_value") and not socket.is_linked:
                parts.append(_plain(socket.default_value))
        image = getattr(node, "image", None)
        if image is not None:
            parts += [image.name, image.filepath, tuple(image.size), image.colorspace_settings.name]
        ramp = getattr(node, "color_ramp", None)
        if ramp is not None:
            parts += [ramp.interpolation, *([e.position, *e.color] for e in ramp.elements)]
        parts += nodes(getattr(node, "node_tree", None), outer | {tree.name})
    ends = (
        (link.from_node.name, link.from_socket.identifier, link.to_node.name, link.to_socket.identifier)
        for link in tree.links
    )
    return parts + sorted(ends)


def _is_as_made(tree: Any) -> bool:
    """Whether ``tree`` only has the nodes that every lamp has from Blender 5 on, as they come."""
    kinds = {node.bl_idname: node for node in tree.nodes}
    if len(tree.nodes) != 2 or set(kinds) != {"ShaderNodeEmission", "ShaderNodeOutputLight"}:
        return False
    color, strength = kinds["ShaderNodeEmission"].inputs[:2]
    return _plain(color.default_value) == [1.0] * 4 and strength.default_value == 1


def _values(owner: Any) -> list[Any]:
    """Names and values of the RNA properties of ``owner`` that a user may set, in the order of the names."""
    found = []
    for prop in owner.bl_rna.properties:
        name = prop.identifier
        if prop.type not in _VALUES or prop.is_readonly or name in _SKIPPED or name.startswith(_SHOWN):
            continue
        value = _plain(getattr(owner, name, None))
        if name not in _NEWER or value != _NEWER[name]:
            value = _RENAMED.get(value, value) if isinstance(value, str) else value
            found.append((_RENAMED.get(name, name), value))
    return sorted(found, key=lambda pair: pair[0])


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    if hasattr(value, "bl_rna"):  # another block: its name
        return getattr(value, "name", "")
    return [_plain(part) for part in value] if hasattr(value, "__len__") else str(type(value))


def _numbers(rows: Any) -> list[float]:
    return [_number(value) for row in rows for value in row]


def _number(value: float) -> float:
    """Four digits of ``value``; none of what rounding leaves of zero."""
    return float(f"{value:.4g}") if abs(value) > _ZERO else 0.0
