"""Splats as Blender's own importers store them since 5.3, in every Blender that has point clouds to edit."""

from __future__ import annotations

import bpy
import numpy as np


def splat_points(cloud, name: str, collection):
    """A point cloud object with the attributes of Blender's importers, active and selected, which 5.3 draws
    as splats; None where Blender makes no point clouds (4.2)."""
    if bpy.app.version < (4, 5, 0):
        return None
    data = bpy.data.meshes.new(name)
    data.vertices.add(len(cloud))
    data.vertices.foreach_set("co", np.asarray(cloud.means, np.float32).ravel())
    base = np.concatenate([cloud.sh[:, 0], cloud.opacities[:, None]], axis=1)
    # Four numbers that are no colour are a type of attribute since 5.2.
    four = ("FLOAT4", "vector") if bpy.app.version >= (5, 2, 0) else ("FLOAT_COLOR", "color")
    three = ("FLOAT_VECTOR", "vector")
    for attribute, values, (kind, key) in [
        ("scale", cloud.scales, three),
        ("rotation", cloud.quaternions, ("QUATERNION", "value")),
        ("radiance:base", base, four),
        *((f"radiance:sh_{k}", sh, three) for k, sh in enumerate(np.moveaxis(cloud.sh[:, 1:], 1, 0))),
    ]:
        made = data.attributes.new(attribute, kind, "POINT")
        made.data.foreach_set(key, np.ascontiguousarray(values, np.float32).ravel())
    obj = bpy.data.objects.new(name, data)
    collection.objects.link(obj)
    for other in bpy.context.selected_objects:
        other.select_set(False)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    bpy.ops.object.convert(target="POINTCLOUD")
    obj = bpy.context.object
    if hasattr(obj.data, "type"):
        obj.data.type = "GAUSSIAN_SPLAT"
    return obj
