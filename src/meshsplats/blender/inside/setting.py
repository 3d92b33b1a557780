"""Sun, sky, ground and a camera around splat meshes in an open Blender file, as the command line sets them
up."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from meshsplats.blender.inside import (
    baking,
    bounces,
    exporting,
    meshes,
    notes,
    objects,
    rendering,
    scene,
    stage,
    versions,
    views,
)
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.layers import bounce_limit
from meshsplats.blender.options import CAREFUL, FAST, LIGHTS, LightOptions
from meshsplats.blender.subject import ground_height, lowest
from meshsplats.cameras.framing import scene_bounds
from meshsplats.cameras.trajectories import orbit

UP = (0.0, 0.0, 1.0)
_AWAY = 2.5
"""Distance from which a viewport shows a subject, in radii of it, for a lens of 36 mm."""
_START_CAMERA = (7.3589, -6.9258, 4.9583)
"""Where the camera stands that Blender starts with."""
_START_LAMP = (4.0762, 1.0055, 5.9039)
"""And the lamp."""
_HID = "meshsplats_hid"
"""Property of what ``hide_start_scene`` has hidden: who shows it again wants it."""
_RENDERED = ("MESH", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD")
"""Types of objects that images show."""
_ROOM = 1.1
"""Half the height of an image, in radii of the subject that the camera is moved to."""


def set_up(
    view: Any, objs: list[Any], lights: str = "sun", *, camera: bool | None = None, fast: bool = False
) -> LightOptions:
    """Gives the scene ``view`` the named ``lights``, a sky, a ground under ``objs`` and, with ``camera``, a
    camera that sees all of them at the scene's resolution, or a place from within; None: unless
    ``has_own_camera``. Replaces those of an earlier call, but for a camera that was moved or animated since.
    Notes name the camera that is kept or replaced. ``fast``: light for a preview.

    Returns:
        The light.

    Raises:
        ValueError: ``objs`` have no visible vertices.
    """
    points = _points(objs)
    if not len(points):
        raise ValueError("there is no splat mesh in the scene: import one, or choose Unlit or Lit for a mesh")
    objects.renew_light(view, objs, fast=fast)
    light, bounds = LIGHTS[lights], scene_bounds(points)
    low = lowest(bounds, np.array(UP))
    for obj in objs:
        places, normals, size = baking.places_of(obj)
        low = ground_height(low, places[:, 2], normals[:, 2], size)
    stage.clear(view)
    if camera is None:
        camera = not has_own_camera(view)
        if not camera and stage.MADE not in view.camera:  # or it is named already
            notes.add(f"{view.camera.name} stays the active camera: New Camera in the panel makes another")
    if camera:
        _add_camera(view, objs, points)
    viewer = None if view.camera is None else np.array(view.camera.matrix_world.translation)
    floor = np.array([bounds.center[0], bounds.center[1], low])
    scene.surround(floor, bounds.radius, light, viewer, (1.0, 1.0, 1.0))
    versions.enable_cycles()
    with rendering.told(view):
        objects.render_settings(view, objs, True, light)
        if fast:
            rendering.preview_settings(view)
    baking.bake(view, objs, samples=(FAST if fast else CAREFUL).samples)
    return light


def _add_camera(view: Any, objs: list[Any], points: np.ndarray) -> None:
    """Makes a camera that sees ``objs``, or a place from within, the active one of the scene ``view``."""
    before, bounds = view.camera, scene_bounds(points)
    # Of square pixels: what images show at the scene's pixel aspect.
    width, height = (round(side) for side in _shown_size(view))
    within = views.opening(objs)
    if within is None:
        seen = orbit(points, 1, elevation=15, azimuth=20, up=UP, width=width, height=height)[0]
    else:
        seen = within.camera(width, height)
    reach = 2 * float(np.linalg.norm(seen.center - bounds.center)) + 1000 * bounds.radius
    view.camera = stage.add_camera(seen, "Camera", np.eye(3), reach, stage.collection("Cameras"))
    if before is not None:
        notes.add(f"the active camera is {view.camera.name}, in place of {before.name}")


def has_own_camera(scene: Any) -> bool:
    """Whether the active camera is the artist's: it is animated, or one of ours that was changed; images show
    other objects than splats, what was made for them and the cube that Blender starts with; or, in a saved
    file, it is not where Blender starts with it."""
    camera = scene.camera
    if camera is None:
        return False
    if stage.MADE in camera:
        return stage.is_artists(camera)
    if stage.is_animated(camera) or any(_is_others(obj) and not _is_start(obj) for obj in scene.objects):
        return True
    return bool(bpy.data.filepath) and not _stands_at_start(camera)


def set_up_render(scene: Any, objs: list[Any], lit: bool, *, chosen: bool = False) -> None:
    """Sets up the render for the splat meshes ``objs``; in a saved file that renders other objects, too, only
    the layers that rays pass, unless the artist has ``chosen`` more."""
    if chosen or not _has_others(scene):
        objects.render_settings(scene, objs, lit)
        return
    versions.enable_cycles()
    rendering.layers_alone(scene, bounce_limit(bounces.layers_of(scene.objects)) if lit else 1024)
    button, seen = "Lit" if lit else "Exact", scene.view_settings.view_transform
    notes.add(f"this file has other objects, so its render settings stay: {button} in the panel sets them")
    if not lit and seen != "Raw" and not all(obj.data.get(objects.LINEAR) for obj in objs):
        notes.add(f"unlit, splats look pale under the view transform {seen}: Linear in the panel is for it")


def _has_others(scene: Any) -> bool:
    """Whether the file was saved, and images show other objects than splats and what was made for them."""
    return bool(bpy.data.filepath) and any(_is_others(obj) for obj in scene.objects)


def _is_others(obj: Any) -> bool:
    """Whether images show ``obj``, and it is neither splats nor made for them."""
    return (
        obj.type in _RENDERED
        and not obj.hide_render
        and objects.is_lit(obj) is None
        and stage.MADE not in obj
        and not exporting.is_helper(obj)
    )


def _is_start(obj: Any) -> bool:
    """Whether ``obj`` is the cube or the lamp that Blender starts with, as it is and where it is then."""
    if obj.type == "MESH":
        if obj.name != "Cube" or len(obj.data.vertices) != 8 or len(obj.modifiers):
            return False
        large = bool((np.abs(versions.positions(obj.data)) == 1).all()) and tuple(obj.scale) == (1, 1, 1)
        return large and _stands_at(obj, (0, 0, 0))
    lamp = obj.type == "LIGHT" and obj.name == "Light" and obj.data.energy == 1000
    return lamp and _stands_at(obj, _START_LAMP)


def hide_start_scene(scene: Any) -> list[str]:
    """Hides the cube and the lamp that Blender starts with, from a file that was not saved yet: one stands
    in the middle of what is imported, the other would be baked into its light. Returns their names."""
    if bpy.data.filepath:
        return []
    hidden, layer = [], bpy.context.view_layer
    layer.update()  # or it has objects of collections that were excluded just now
    for obj in scene.objects:
        if _is_start(obj) and _HID not in obj and not obj.hide_render and obj.name in layer.objects:
            obj.hide_render = obj[_HID] = True
            obj.hide_set(True)
            hidden.append(obj.name)
    return hidden


def frame_in_viewports(windows: Any, objs: list[Any]) -> None:
    """Turns the 3D views of ``windows`` to ``objs``, from the direction that they have."""
    points = _points(objs)
    if not len(points):
        return
    bounds = scene_bounds(points)
    for space in _views(windows):
        view = space.region_3d
        if view.view_perspective == "CAMERA":
            view.view_perspective = "PERSP"
        view.view_location = bounds.center.tolist()
        view.view_distance = _AWAY * bounds.radius * space.lens / 36
        space.clip_end = max(space.clip_end, 100 * bounds.radius)
        space.clip_start = min(space.clip_start, bounds.radius / 100)


def frame_in_start_camera(scene: Any, objs: list[Any]) -> None:
    """Moves the camera that Blender starts with, in a file that was not saved yet, until it sees ``objs``.
    Its direction stays."""
    camera = _start_camera(scene)
    points = _points(objs)
    if camera is None or not len(points):
        return
    bounds, lens = scene_bounds(points), camera.data
    away = _ROOM * bounds.radius / np.sin(_narrowest_angle(scene, lens) / 2)
    axis = np.array(camera.matrix_world)[:3, 2]
    camera.location = (bounds.center + away * axis / np.linalg.norm(axis)).tolist()
    lens.clip_start = min(lens.clip_start, bounds.radius / 100)
    lens.clip_end = max(lens.clip_end, away + 100 * bounds.radius)


def look_from(view: views.View, windows: Any, scene: Any) -> None:
    """Shows a place by ``view``, in the 3D views of ``windows`` and by the camera that Blender starts with,
    in a file that was not saved yet."""
    from mathutils import Matrix

    pose, far = view.pose, 100 * view.away
    for space in _views(windows):
        seen = space.region_3d
        seen.view_perspective = "PERSP"
        seen.view_distance = view.away
        seen.view_rotation = Matrix(pose[:3, :3].tolist()).to_quaternion()
        seen.view_location = (pose[:3, 3] - view.away * pose[:3, 2]).tolist()
        space.lens = min(max(36 * 9 / 16 / view.half, 1), 250)  # 72 mm for the width of about 16 : 9
        space.clip_start, space.clip_end = min(space.clip_start, view.near), max(space.clip_end, far)
    camera = _start_camera(scene)
    if camera is None:
        return
    camera.matrix_world = Matrix(pose.tolist())
    lens = camera.data
    wider = np.tan(lens.angle / 2) / np.tan(_narrowest_angle(scene, lens) / 2)
    lens.angle = 2 * float(np.arctan(wider * view.half))
    lens.clip_start, lens.clip_end = min(lens.clip_start, view.near), max(lens.clip_end, far)


def _start_camera(scene: Any) -> Any:
    """The camera that Blender starts with, where it starts, in a file that was not saved yet; else None."""
    camera = scene.camera
    return None if bpy.data.filepath or camera is None or not _stands_at_start(camera) else camera


def _stands_at_start(camera: Any) -> bool:
    return camera.name == "Camera" and _stands_at(camera, _START_CAMERA)


def _stands_at(obj: Any, place: tuple[float, float, float]) -> bool:
    return np.allclose(obj.location, place, atol=1e-3)


def _shown_size(scene: Any) -> tuple[float, float]:
    """Width and height of images as they are shown, in pixels of the scene's but square."""
    render = scene.render
    return render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y


def _narrowest_angle(scene: Any, lens: Any) -> float:
    """The angle, in radians, that the camera ``lens`` sees along the shorter side of images."""
    sides = sorted(_shown_size(scene))
    return 2 * float(np.arctan(np.tan(lens.angle / 2) * sides[0] / sides[1]))


def show_colors(windows: Any, shading: str) -> None:
    """Switches the 3D views of ``windows`` from Solid to ``shading``, MATERIAL or RENDERED; to RENDERED from
    MATERIAL, too."""
    lesser = {"SOLID"} if shading == "MATERIAL" else {"SOLID", "MATERIAL"}
    for space in _views(windows):
        if space.shading.type in lesser:
            with suppress(TypeError):  # the engine Workbench has no Material Preview
                space.shading.type = shading


def _points(objs: list[Any]) -> np.ndarray:
    """(n, 3) vertices of ``objs`` in Blender's world."""
    return np.concatenate([meshes.world_points(obj) for obj in objs] or [np.zeros((0, 3))])


def _views(windows: Any) -> list[Any]:
    """The 3D views of ``windows``."""
    return [
        area.spaces.active for window in windows for area in window.screen.areas if area.type == "VIEW_3D"
    ]
