"""Splats from far to near for EEVEE, which blends the triangles of an object in the order of its mesh.

A Geometry Nodes modifier sorts them, by the splat as ``render(order="splat")`` does, and by where shape keys
and the modifiers before it have put them. The mesh keeps its own order, and files need no add-on: images
follow the active camera, also an animated one. A viewport follows the active camera, too, or else the
direction that it was given last (``look``), by a sorted copy of the mesh where that will do
(``sorted_copies``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.blender.inside import meshes, sorted_copies, turning, versions
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.sorted_copies import CENTER, SORTED, VIEW

MODIFIER = "Far to near"
"""Name of the modifier, and of its node group."""
_STEPS = 2.0**20
"""Steps of depth in the distance within which half of the splats lie from the middle."""
_TOTAL = "GeometryNodeAccumulateField"
"""The node of sums over splats."""
_SOME = 10_000
"""Splats whose median that distance is."""
_FARTHEST = 2.0**29
"""Steps beyond which strays are not told apart: sums of three must fit into 32 bits."""


def add(obj: Any, *, viewport: bool = True) -> Any:
    """Gives ``obj``, a splat mesh, the modifier, behind those that it has or will have; with ``viewport``,
    viewports sort, too. Returns the modifier, also one that was there."""
    set_centers(obj.data)
    found = modifier_of(obj)
    if found is None:
        found = obj.modifiers.new(MODIFIER, "NODES")
        found.node_group = _latest_group()
        found.show_expanded = False
        found.show_viewport = viewport
        found.use_pin_to_last = True
    return found


def renew() -> None:
    """Has the modifiers of files that an earlier release saved sort by where splats are, not by where they
    are at rest, and their meshes know when they are turned, as those of the command."""
    for obj in bpy.data.objects:
        mesh = obj.data if obj.type == "MESH" else None
        # In edit mode, in which files are opened that were saved in it, attributes cannot be read.
        if mesh and not (mesh.library or mesh.is_editmode or turning.REST in mesh.attributes):
            turning.remember(mesh)
        found = modifier_of(obj) if obj.type == "MESH" and not obj.library else None
        if found is None or obj.override_library or _is_latest(found.node_group):
            continue
        found.node_group = _latest_group()
        found.use_pin_to_last = True
        obj.modifiers.move(list(obj.modifiers).index(found), len(obj.modifiers) - 1)


def _latest_group() -> Any:
    return next((group for group in bpy.data.node_groups if _is_latest(group)), None) or _group()


def _is_latest(group: Any) -> bool:
    """Whether ``group`` is the node group of this release, in this file."""
    ours = group is not None and group.name.startswith(MODIFIER) and group.library is None
    return ours and any(node.bl_idname == _TOTAL for node in group.nodes)


def modifier_of(obj: Any) -> Any:
    """The modifier of ``obj``, or None."""
    return next((m for m in obj.modifiers if m.type == "NODES" and m.name.startswith(MODIFIER)), None)


def set_centers(data: Any) -> bool:
    """Stores with the mesh ``data`` the centres of its splats, if they have changed: those of faces that lie
    side by side and belong to one splat; where faces have no splats, each is one. Returns whether they
    have."""
    if not len(data.polygons):
        return False
    middles = meshes.face_middles(data)
    if meshes.SPLAT in data.attributes:
        owner = meshes.owners(data)
        starts = np.flatnonzero(np.concatenate([[True], np.diff(owner) != 0]))
        counts = np.diff(starts, append=len(owner))
        middles = np.add.reduceat(middles, starts) / counts[:, None]
    else:
        counts = np.ones(len(middles), np.int64)
    centers = np.repeat(_in_steps(middles), counts, axis=0).ravel()
    attribute = data.attributes.get(CENTER)
    if attribute is None:
        attribute = data.attributes.new(CENTER, "FLOAT_VECTOR", "FACE")
    else:
        before = np.empty(len(centers), np.float32)
        attribute.data.foreach_get("vector", before)
        if (before == centers).all():
            return False
    attribute.data.foreach_set("vector", centers)
    return True


def _in_steps(places: np.ndarray) -> np.ndarray:
    """(n, 3) float32 ``places`` (n, 3) relative to their middle, in steps."""
    some = subsample(places, _SOME)
    middle = np.median(some, axis=0)
    spread = float(np.median(np.linalg.norm(some - middle, axis=1)))
    away = (places - middle) * (_STEPS / (spread or 1.0))
    return np.clip(away, -_FARTHEST, _FARTHEST).astype(np.float32)


def look(modifier: Any, direction: Sequence[float] | None) -> None:
    """Sorts for a viewport whose viewer is in ``direction`` (3,), Blender's world; zero: for the active
    camera; None: for no viewport."""
    shown = direction is not None
    if modifier.show_viewport != shown:
        modifier.show_viewport = shown
    given = tuple(float(x) for x in direction or (0, 0, 0))
    if not (_knows_copies(modifier) and any(given) and sorted_copies.show(modifier, given)):
        sorted_copies.drop(modifier)
        versions.set_input(modifier, VIEW, given)
        if shown:
            modifier.id_data.update_tag()


def _knows_copies(modifier: Any) -> bool:
    """Whether the node group can show sorted copies; those of older files cannot."""
    return any(item.name == SORTED for item in modifier.node_group.interface.items_tree)


def sorted_objects(scene: Any) -> list[Any]:
    """The objects of ``scene`` that have the modifier."""
    return [obj for obj in scene.objects if obj.type == "MESH" and modifier_of(obj) is not None]


def follow_camera(scene: Any) -> None:
    """Has the splats of ``scene`` sorted again where markers of the timeline have changed the active camera,
    which Blender 4.2 does not notice. For the handlers of frame changes."""
    for obj in sorted_objects(scene):
        obj.update_tag()


def after_update(depsgraph: Any) -> None:
    """Finds the centres of splats again after edits of their meshes, with what turns along, and has nodes
    sort those that were edited or turned, a handler of ``depsgraph_update_post``. While a mesh is in edit
    mode, it is drawn in its own order."""
    for update in depsgraph.updates:
        changed = update.id.original
        if isinstance(changed, bpy.types.Object):
            modifier = modifier_of(changed)
            if modifier is not None and sorted_copies.has_turned(modifier):
                sorted_copies.drop(modifier)
        elif isinstance(changed, bpy.types.Mesh) and CENTER in changed.attributes:
            for obj in sorted_objects(depsgraph.scene):
                if obj.data == changed and sorted_copies.is_stale(modifier_of(obj)):
                    sorted_copies.drop(modifier_of(obj))
            if changed.is_editmode:
                continue
            if set_centers(changed):
                turning.follow(changed)
            elif turning.REST not in changed.attributes and not changed.library:
                # Appended from a file of an earlier release, or of the command.
                turning.remember(changed)


def drop_copies() -> None:
    """Removes all sorted copies: before a file is saved, and when another one, or another state of it, was
    loaded."""
    found = [modifier_of(obj) for obj in bpy.data.objects if obj.type == "MESH"]
    for modifier in found:
        if modifier is not None:
            sorted_copies.drop(modifier)
    sorted_copies.drop_strays()


def _group() -> Any:
    """The node group: sorts faces by how near to the viewer their splats are; equal ones keep their order."""
    group = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket(VIEW, in_out="INPUT", socket_type="NodeSocketVector")
    group.interface.new_socket(SORTED, in_out="INPUT", socket_type="NodeSocketObject")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    link = group.links.new

    def node(kind: str, x: int, y: int, **settings: Any) -> Any:
        made = group.nodes.new(kind)
        made.location = (x * 200, -y * 200)
        for name, value in settings.items():
            setattr(made, name, value)
        return made

    given, result = node("NodeGroupInput", 0, 0), node("NodeGroupOutput", 11, 0)
    # A camera looks along its own -z.
    camera = node("GeometryNodeObjectInfo", 1, 3, transform_space="ORIGINAL")
    link(node("GeometryNodeInputActiveCamera", 0, 3).outputs[0], camera.inputs["Object"])
    behind = node("FunctionNodeTransformDirection", 2, 3)
    behind.inputs["Direction"].default_value = (0.0, 0.0, 1.0)
    link(camera.outputs["Transform"], behind.inputs["Transform"])
    length = node("ShaderNodeVectorMath", 1, 2, operation="LENGTH")
    link(given.outputs[VIEW], length.inputs[0])
    told = node("ShaderNodeMath", 2, 2, operation="MULTIPLY")
    link(length.outputs["Value"], told.inputs[0])
    viewport = node("GeometryNodeIsViewport", 1, 1)
    link(viewport.outputs[0], told.inputs[1])
    viewer = node("GeometryNodeSwitch", 3, 2, input_type="VECTOR")
    link(told.outputs[0], viewer.inputs["Switch"])
    link(behind.outputs[0], viewer.inputs["False"])
    link(given.outputs[VIEW], viewer.inputs["True"])
    # (M c) . v = c . (M^T v): one vector is turned instead of one per face.
    own = node("GeometryNodeObjectInfo", 2, 4, transform_space="ORIGINAL")
    link(node("GeometryNodeSelfObject", 1, 4).outputs[0], own.inputs["Object"])
    transposed = node("FunctionNodeTransposeMatrix", 3, 4)
    link(own.outputs["Transform"], transposed.inputs[0])
    local = node("FunctionNodeTransformDirection", 4, 2)
    link(viewer.outputs[0], local.inputs["Direction"])
    link(transposed.outputs[0], local.inputs["Transform"])
    unit = node("ShaderNodeVectorMath", 4, 1, operation="NORMALIZE")
    link(local.outputs["Direction"], unit.inputs[0])
    # The mean depth of a splat, of faces that lie side by side and have one number; else of each face.
    number = node("GeometryNodeInputNamedAttribute", 4, 6, data_type="INT")
    number.inputs["Name"].default_value = meshes.SPLAT
    index = node("GeometryNodeInputIndex", 3, 5)
    last = node(versions.integer_math(), 4, 5, operation="SUBTRACT")
    link(index.outputs[0], last.inputs[0])
    last.inputs[1].default_value = 1
    before = node("GeometryNodeFieldAtIndex", 5, 5, data_type="INT", domain="FACE")
    link(last.outputs[0], before.inputs["Index"])
    link(number.outputs["Attribute"], before.inputs["Value"])
    begins = node("FunctionNodeCompare", 6, 5, data_type="INT", operation="NOT_EQUAL")
    one, other = (socket for socket in begins.inputs if socket.enabled)
    link(number.outputs["Attribute"], one)
    link(before.outputs[0], other)
    splat = node(_TOTAL, 7, 5, data_type="INT", domain="FACE")
    link(begins.outputs[0], splat.inputs["Value"])
    owner = node("GeometryNodeSwitch", 8, 5, input_type="INT")
    link(number.outputs["Exists"], owner.inputs["Switch"])
    link(index.outputs[0], owner.inputs["False"])
    link(splat.outputs["Leading"], owner.inputs["True"])
    near = node("ShaderNodeVectorMath", 5, 1, operation="DOT_PRODUCT")
    link(node("GeometryNodeInputPosition", 4, 0).outputs[0], near.inputs[0])
    link(unit.outputs[0], near.inputs[1])
    total = node(_TOTAL, 9, 4, data_type="FLOAT", domain="FACE")
    link(near.outputs["Value"], total.inputs["Value"])
    faces = node(_TOTAL, 9, 5, data_type="INT", domain="FACE")
    faces.inputs["Value"].default_value = 1
    mean = node("ShaderNodeMath", 10, 4, operation="DIVIDE")
    for i, part in enumerate((total, faces)):
        link(owner.outputs[0], versions.socket(part.inputs, "Group ID", "Group Index"))
        link(part.outputs["Total"], mean.inputs[i])
    # What is not carried along needs no time.
    less = node("GeometryNodeRemoveAttribute", 8, 0)
    less.inputs["Name"].default_value = CENTER
    link(given.outputs["Geometry"], less.inputs["Geometry"])
    sort = node("GeometryNodeSortElements", 9, 0, domain="FACE")
    link(less.outputs[0], sort.inputs["Geometry"])
    link(mean.outputs[0], sort.inputs["Sort Weight"])
    copy = node("GeometryNodeObjectInfo", 7, 2, transform_space="ORIGINAL")
    link(given.outputs[SORTED], copy.inputs["Object"])
    count = node("GeometryNodeAttributeDomainSize", 8, 2, component="MESH")
    link(copy.outputs["Geometry"], count.inputs["Geometry"])
    there = node("ShaderNodeMath", 9, 2, operation="MULTIPLY")
    link(count.outputs["Face Count"], there.inputs[0])
    link(viewport.outputs[0], there.inputs[1])
    shown = node("GeometryNodeSwitch", 10, 0, input_type="GEOMETRY")
    link(there.outputs[0], shown.inputs["Switch"])
    link(sort.outputs[0], shown.inputs["False"])
    link(copy.outputs["Geometry"], shown.inputs["True"])
    link(shown.outputs[0], result.inputs[0])
    return group
