# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel says of splats that instances of collections show, or that are linked."""

import bpy

from .following import BASE
from .settings import LIT, is_splat_mesh

SAME = 1e-4
"""Difference of directions up to which an instance is not turned."""


def instance_warnings(scene):
    """What is wrong with instances of splats and linked splats of ``scene``, a line for each."""
    if not any(LIT in data for data in bpy.data.meshes):
        return []
    shown = [obj for obj in scene.objects if obj.instance_type == "COLLECTION" and obj.instance_collection]
    found = []
    if "EEVEE" in scene.render.engine:
        turned = [obj for obj in shown if is_turned(obj) and any(map(is_splat_mesh, _members(obj)))]
        if turned:
            found.append(
                f"EEVEE draws {turned[0].name}, a turned instance, in the order of the original:"
                " Object > Apply > Make Instances Real"
            )
    every = [*scene.objects, *(member for obj in shown for member in _members(obj))]
    linked = next((obj for obj in every if obj.library and BASE in obj), None)
    if linked is not None:
        found.append(
            f"{linked.name}, linked from {linked.library.name}, does not follow its base:"
            " Object > Library Override > Make"
        )
    return found


def is_turned(obj):
    """Whether the instance ``obj`` has other axes than the original, but for their scale."""
    axes = obj.matrix_world.to_3x3()
    scale = axes[0][0]
    return scale <= 0 or any(abs(axes[i][k] / scale - (i == k)) > SAME for i in range(3) for k in range(3))


def _members(obj):
    return obj.instance_collection.all_objects
