"""Sun, sky, ground and a camera around splat meshes in an open Blender file, as the command line sets them
up."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.blender.inside import baking, meshes, objects, scene, stage
from meshsplats.blender.options import LIGHTS, LightOptions
from meshsplats.blender.subject import ground_height, lowest
from meshsplats.cameras.framing import scene_bounds
from meshsplats.cameras.trajectories import orbit

UP = (0.0, 0.0, 1.0)


def set_up(view: Any, objs: list[Any], lights: str = "sun", *, camera: bool = True) -> LightOptions:
    """Gives the scene ``view`` the named ``lights``, a sky, a ground under ``objs`` and, with ``camera``, a
    camera that sees all of them at the scene's resolution. Replaces those of an earlier call.

    Returns:
        The light.

    Raises:
        ValueError: ``objs`` have no visible vertices.
    """
    points = np.concatenate([meshes.world_points(obj) for obj in objs] or [np.zeros((0, 3))])
    if not len(points):
        raise ValueError("there is no splat mesh in the scene: import one, or choose Unlit or Lit for a mesh")
    light, bounds = LIGHTS[lights], scene_bounds(points)
    low = lowest(bounds, np.array(UP))
    for obj in objs:
        places, normals, size = baking.places_of(obj)
        low = ground_height(low, places[:, 2], normals[:, 2], size)
    stage.clear()
    viewer = None
    if camera:
        width, height = view.render.resolution_x, view.render.resolution_y
        seen = orbit(points, 1, elevation=15, azimuth=20, up=UP, width=width, height=height)[0]
        home = stage.collection("Cameras")
        away = float(np.linalg.norm(seen.center - bounds.center))
        view.camera = stage.add_camera(seen, "Camera", np.eye(3), 2 * away + 1000 * bounds.radius, home)
        view.render.pixel_aspect_x = view.render.pixel_aspect_y = 1
        viewer = seen.center
    floor = np.array([bounds.center[0], bounds.center[1], low])
    scene.surround(floor, bounds.radius, light, viewer, (1.0, 1.0, 1.0))
    objects.render_settings(view, objs, True, light)
    baking.bake(view, objs)
    return light
