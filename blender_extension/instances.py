# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel says of splats that instances of collections show, or that are linked."""

import bpy

from .following import BASE
from .settings import LIT, is_splat_mesh

SAME = 1e-4
"""Difference of directions up to which an instance is not turned."""


def instance_warnings(scene, *, now=True):
    """What is wrong with instances of splats and linked splats of ``scene``, a line for each; without
    ``now``, of a large scene what was so a short while ago."""
    if not any(LIT in data for data in bpy.data.meshes):  # or the panel would load our libraries
        return []
    from meshsplats.blender.inside import pacing

    key = ("instances", scene.name, scene.render.engine)
    return pacing.paced(key, lambda: _warnings(scene), now=now)


def _warnings(scene):
    shown = [obj for obj in scene.objects if obj.instance_type == "COLLECTION" and obj.instance_collection]
    homes = {obj.instance_collection for obj in shown}
    found = []
    if "EEVEE" in scene.render.engine:
        splats = {home for home in homes if any(map(is_splat_mesh, home.all_objects))}
        turned = next((obj for obj in shown if obj.instance_collection in splats and is_turned(obj)), None)
        if turned is not None:
            found.append(
                f"EEVEE draws {turned.name}, a turned instance, in the order of the original:"
                " Object > Apply > Make Instances Real"
            )
    every = [*scene.objects, *(member for home in homes for member in home.all_objects)]
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
