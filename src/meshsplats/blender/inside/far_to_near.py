"""Splats from far to near for EEVEE, which blends the triangles of an object in the order of its mesh.

A Geometry Nodes modifier sorts them, by the splat as ``render(order="splat")`` does. The mesh keeps its own
order, and files need no add-on: images follow the active camera, also an animated one. A viewport follows the
active camera, too, or else the direction that it was given last (``look``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats.blender.inside import meshes, versions
from meshsplats.blender.inside.host import bpy

CENTER = "splat_center"
"""Face attribute: centre of the splat that each face was made from, the mean of its triangles' corners."""
MODIFIER = "Far to near"
"""Name of the modifier, and of its node group."""
VIEW = "View"
"""Input of the node group: the direction to the viewer of a viewport, in Blender's world. Zero: the active
camera's."""


def add(obj: Any, *, viewport: bool = True) -> Any:
    """Gives ``obj``, a splat mesh, the modifier, behind those that it has; with ``viewport``, viewports sort,
    too. Returns the modifier, also one that was there."""
    set_centers(obj.data)
    found = modifier_of(obj)
    if found is None:
        found = obj.modifiers.new(MODIFIER, "NODES")
        found.node_group = bpy.data.node_groups.get(MODIFIER) or _group()
        found.show_expanded = False
        found.show_viewport = viewport
    return found


def modifier_of(obj: Any) -> Any:
    """The modifier of ``obj``, or None."""
    return next((m for m in obj.modifiers if m.type == "NODES" and m.name.startswith(MODIFIER)), None)


def set_centers(data: Any) -> None:
    """Stores with the mesh ``data`` the centres of its splats, if they have changed: those of faces that lie
    side by side and belong to one splat."""
    if not len(data.polygons) or meshes.SPLAT not in data.attributes:
        return
    owner = meshes.owners(data)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(owner) != 0]))
    counts = np.diff(starts, append=len(owner))
    centers = np.repeat(
        np.add.reduceat(meshes.face_middles(data), starts) / counts[:, None], counts, axis=0
    ).astype(np.float32)
    attribute = data.attributes.get(CENTER)
    if attribute is None:
        attribute = data.attributes.new(CENTER, "FLOAT_VECTOR", "FACE")
    else:
        before = np.empty(3 * len(owner), np.float32)
        attribute.data.foreach_get("vector", before)
        if (before == centers.ravel()).all():
            return
    attribute.data.foreach_set("vector", centers.ravel())


def look(modifier: Any, direction: Sequence[float] | None) -> None:
    """Sorts for a viewport whose viewer is in ``direction`` (3,), Blender's world; zero: for the active
    camera; None: for no viewport."""
    shown = direction is not None
    if modifier.show_viewport != shown:
        modifier.show_viewport = shown
    if direction is not None:
        versions.set_input(modifier, VIEW, tuple(float(x) for x in direction))
        modifier.id_data.update_tag()


def sorted_objects(scene: Any) -> list[Any]:
    """The objects of ``scene`` that have the modifier."""
    return [obj for obj in scene.objects if obj.type == "MESH" and modifier_of(obj) is not None]


def follow_camera(scene: Any) -> None:
    """Has the splats of ``scene`` sorted again where markers of the timeline have changed the active camera,
    which Blender 4.2 does not notice. For the handlers of frame changes."""
    for obj in sorted_objects(scene):
        obj.update_tag()


def after_update(depsgraph: Any) -> None:
    """Finds the centres of splats again after edits of their meshes, a handler of ``depsgraph_update_post``.
    While a mesh is in edit mode, it is drawn in its own order."""
    for update in depsgraph.updates:
        data = update.id.original
        if isinstance(data, bpy.types.Mesh) and not data.is_editmode and CENTER in data.attributes:
            set_centers(data)


def _group() -> Any:
    """The node group: sorts faces by how near to the viewer their splats are; equal ones keep their order."""
    group = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket(VIEW, in_out="INPUT", socket_type="NodeSocketVector")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    link = group.links.new

    def node(kind: str, x: int, y: int, **settings: Any) -> Any:
        made = group.nodes.new(kind)
        made.location = (x * 200, -y * 200)
        for name, value in settings.items():
            setattr(made, name, value)
        return made

    given, result = node("NodeGroupInput", 0, 0), node("NodeGroupOutput", 7, 0)
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
    link(node("GeometryNodeIsViewport", 1, 1).outputs[0], told.inputs[1])
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
    stored = node("GeometryNodeInputNamedAttribute", 3, 1, data_type="FLOAT_VECTOR")
    stored.inputs["Name"].default_value = CENTER
    place = node("GeometryNodeSwitch", 4, 1, input_type="VECTOR")
    link(stored.outputs["Exists"], place.inputs["Switch"])
    link(node("GeometryNodeInputPosition", 3, 0).outputs[0], place.inputs["False"])
    link(stored.outputs["Attribute"], place.inputs["True"])
    near = node("ShaderNodeVectorMath", 5, 1, operation="DOT_PRODUCT")
    link(place.outputs[0], near.inputs[0])
    link(local.outputs[0], near.inputs[1])
    sort = node("GeometryNodeSortElements", 6, 0, domain="FACE")
    link(given.outputs["Geometry"], sort.inputs["Geometry"])
    link(near.outputs["Value"], sort.inputs["Sort Weight"])
    link(sort.outputs[0], result.inputs[0])
    return group
