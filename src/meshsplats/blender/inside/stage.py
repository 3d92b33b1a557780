"""The surroundings of the mesh in Blender: cameras, sun, sky, ground, mirror and glass ball, in named
collections."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from meshsplats.blender.inside import frame, materials, notes, versions
from meshsplats.blender.inside.host import bpy
from meshsplats.scene.camera import Camera

GREY = (0.6, 0.6, 0.6)
"""Linear colour of the ground."""
MADE = "meshsplats_stage"
"""Property of what was made here: True of collections, of objects the name that they were given, of worlds
what they look like. Duplicates and what the artist has renamed have other names."""
POSE = "meshsplats_pose"
"""Property of the cameras that were made here: where they were put."""
LENS = "meshsplats_lens"
"""And what their ``_lens`` was."""
_LENS = (
    *("type", "lens", "ortho_scale", "sensor_width", "sensor_height", "sensor_fit", "shift_x", "shift_y"),
    *("clip_start", "clip_end"),
)
_FOCUS = ("use_dof", "focus_distance", "aperture_fstop")
FADES = (1.5, 10.0)
"""Distances between which the ground fades, in radii of the subject."""


def collection(name: str, *, lasting: bool = False) -> Any:
    """A new collection in the scene; unless ``lasting``, ``clear`` removes it."""
    made = bpy.data.collections.new(name)
    if not lasting:
        made[MADE] = True
    bpy.context.scene.collection.children.link(made)
    return made


def clear(scene: Any = None) -> None:
    """Removes what was made here from the scene: collections, objects and world. What the artist has put into
    these collections goes to the collection of the scene, as do cameras that were changed, and the world of
    the artist stays in the file; notes say so."""
    scene = scene or bpy.context.scene
    kept = []
    for obj in [o for o in scene.objects if MADE in o]:
        if is_artists(obj):
            kept.append(obj)
        else:
            bpy.data.objects.remove(obj)
    for old in [c for c in scene.collection.children_recursive if c.get(MADE)]:
        for obj in list(old.objects):
            old.objects.unlink(obj)
            if not obj.users_collection:
                scene.collection.objects.link(obj)
                kept += [] if obj in kept else [obj]
        for child in list(old.children):
            with suppress(RuntimeError):  # is there already
                scene.collection.children.link(child)
        bpy.data.collections.remove(old)
    if kept:
        notes.add(f"kept what is yours: {', '.join(obj.name for obj in kept)}")
    world = scene.world
    if world is None:
        return
    if world.get(MADE) != _look(world):
        starts = not bpy.data.filepath and world.name == "World"  # as Blender starts with
        if not (world.use_fake_user or starts):
            notes.add(f"your world {world.name} stays in the file, without a scene")
        world.use_fake_user = True
    elif world.users - world.use_fake_user <= 1:
        bpy.data.worlds.remove(world)


def is_artists(obj: Any) -> bool:
    """Whether ``obj`` is not, or no longer, what was made here: it was renamed or duplicated, or is a camera
    that was moved or animated, or has another lens or focus."""
    if obj.get(MADE) != obj.name:
        return True
    return obj.type == "CAMERA" and MADE in obj and _was_changed(obj)


def is_animated(camera: Any) -> bool:
    """Whether the object ``camera`` or its lens has keys, drivers or constraints."""
    return any(part.animation_data is not None for part in (camera, camera.data)) or bool(camera.constraints)


def _was_changed(camera: Any) -> bool:
    lens = _lens(camera.data)
    if is_animated(camera) or camera.get(LENS, lens) != lens:
        return True
    pose = [value for row in camera.matrix_basis for value in row]
    return not np.allclose(pose, list(camera.get(POSE, pose)), rtol=1e-5, atol=1e-6)


def _lens(data: Any) -> str:
    values = [getattr(data, name) for name in _LENS] + [getattr(data.dof, name) for name in _FOCUS]
    return " ".join(f"{value:.6g}" if isinstance(value, float) else str(value) for value in values)


def _ours(obj: Any, home: Any) -> Any:
    home.objects.link(obj)
    obj[MADE] = obj.name
    return obj


def add_camera(camera: Camera, name: str, rotation: np.ndarray, reach: float, home: Any) -> Any:
    """A Blender camera like ``camera`` that clips beyond ``reach``, and before its near plane or, if it names
    none, a hundred-thousandth of ``reach``. The pixel aspect belongs to the scene: see ``aim``."""
    from mathutils import Matrix

    data = bpy.data.cameras.new(name)
    settings = frame.lens(camera)
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = 36.0
    for key in ("lens", "shift_x", "shift_y"):
        setattr(data, key, settings[key])
    data.clip_start = 1e-5 * reach if camera.near is None else camera.near
    data.clip_end = reach
    obj = bpy.data.objects.new(name, data)
    obj.matrix_world = Matrix(frame.camera_pose(camera, rotation).tolist())
    obj[POSE] = [value for row in obj.matrix_basis for value in row]
    obj[LENS] = _lens(data)
    return _ours(obj, home)


def aim(scene: Any, camera: Camera, obj: Any, factor: int = 1) -> None:
    """Makes ``obj``, the Blender camera of ``camera``, the active one, at ``factor`` times its resolution."""
    settings = frame.lens(camera)
    scene.camera = obj
    scene.render.resolution_x = camera.width * factor
    scene.render.resolution_y = camera.height * factor
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = settings["pixel_aspect_x"]
    scene.render.pixel_aspect_y = settings["pixel_aspect_y"]


def add_sun(
    direction: np.ndarray,
    strength: float,
    size: float,
    detail: float,
    home: Any,
    color: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    name: str = "Sun",
) -> Any:
    """A sun in ``direction`` (3,), Blender's frame; irradiance in W/m^2, size in degrees, linear ``color``.
    ``detail``: smallest feature that EEVEE's shadow maps resolve, scene units."""
    from mathutils import Vector

    data = bpy.data.lights.new(name, "SUN")
    data.energy = strength
    data.color = tuple(color)
    data.angle = float(np.radians(size))
    versions.set_if_there(data, use_shadow=True, shadow_maximum_resolution=detail)
    obj = bpy.data.objects.new(name, data)
    obj.rotation_euler = Vector(direction.tolist()).to_track_quat("Z", "Y").to_euler()
    obj.location = (direction * 5).tolist()
    return _ours(obj, home)


def _show(world: Any) -> None:
    world[MADE] = _look(world)
    bpy.context.scene.world = world


def _look(world: Any) -> str:
    """The name of ``world`` and its nodes: an artist changes either."""
    nodes = () if world.node_tree is None else world.node_tree.nodes
    return f"{world.name}: {' '.join(sorted(node.bl_idname for node in nodes))}"


def even_world(light: Sequence[float], seen: Sequence[float] | None = None) -> Any:
    """A world that gives ``light`` (3,) from everywhere and, to the camera, looks like ``seen`` (3,)."""
    world = bpy.data.worlds.new("World")
    tree = versions.node_tree(world)
    out = tree.nodes.new("ShaderNodeOutputWorld")
    lit = _background(tree, light)
    if seen is None or tuple(seen) == tuple(light):
        tree.links.new(lit.outputs[0], out.inputs["Surface"])
    else:
        mix = tree.nodes.new("ShaderNodeMixShader")
        path = tree.nodes.new("ShaderNodeLightPath")
        tree.links.new(path.outputs["Is Camera Ray"], versions.socket(mix.inputs, "Fac", "Factor"))
        tree.links.new(lit.outputs[0], mix.inputs[1])
        tree.links.new(_background(tree, seen).outputs[0], mix.inputs[2])
        tree.links.new(mix.outputs[0], out.inputs["Surface"])
    _show(world)
    return world


def _background(tree: Any, color: Sequence[float]) -> Any:
    node = tree.nodes.new("ShaderNodeBackground")
    node.inputs["Color"].default_value = (*color, 1)
    return node


def environment_world(path: str, strength: float, rotation: float) -> Any:
    """A world lit by the environment image at ``path``, packed into the file, turned by ``rotation``
    degrees."""
    image = bpy.data.images.load(path)
    if 0 in image.size:
        raise ValueError(f"{path}: Blender cannot read this environment image")
    image.pack()
    world = bpy.data.worlds.new("World")
    tree = versions.node_tree(world)
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    turn = tree.nodes.new("ShaderNodeMapping")
    turn.inputs["Rotation"].default_value[2] = float(np.radians(rotation))
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    light = tree.nodes.new("ShaderNodeBackground")
    light.inputs["Strength"].default_value = strength
    out = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(coordinates.outputs["Generated"], turn.inputs["Vector"])
    tree.links.new(turn.outputs[0], texture.inputs["Vector"])
    tree.links.new(texture.outputs[0], light.inputs["Color"])
    tree.links.new(light.outputs[0], out.inputs["Surface"])
    _show(world)
    return world


def add_ground(center: np.ndarray, radius: float, catcher: bool, home: Any) -> Any:
    """A level square at ``center`` (3,) under a subject of ``radius``, a hundred times as large. It fades
    into the background, so that there is no horizon; a ``catcher`` is visible only where shadows fall."""
    reach = 100 * radius
    corners = [(-reach, -reach, 0), (reach, -reach, 0), (reach, reach, 0), (-reach, reach, 0)]
    obj = _faces("Ground", corners, [(0, 1, 2, 3)], home)
    obj.location = center.tolist()
    material = (
        materials.plain("Ground", GREY)
        if catcher
        else materials.fading("Ground", GREY, FADES[0] * radius, FADES[1] * radius)
    )
    material.use_backface_culling = True  # so that EEVEE's viewports look through it from below
    obj.data.materials.append(material)
    obj.is_shadow_catcher = catcher
    return obj


def add_mirror(center: np.ndarray, facing: np.ndarray, width: float, height: float, home: Any) -> Any:
    """An upright mirror that faces the horizontal direction ``facing`` (3,); ``center`` (3,) is the middle of
    its lower edge."""
    corners = [(-width / 2, 0, 0), (width / 2, 0, 0), (width / 2, 0, height), (-width / 2, 0, height)]
    obj = _faces("Mirror", corners, [(0, 1, 2, 3)], home)
    obj.location = center.tolist()
    obj.rotation_euler[2] = float(np.arctan2(facing[0], -facing[1]))
    obj.data.materials.append(materials.mirror())
    return obj


def add_glass_ball(center: np.ndarray, radius: float, home: Any) -> Any:
    """A smooth ball of glass."""
    import bmesh

    mesh = bpy.data.meshes.new("Glass ball")
    shape = bmesh.new()
    bmesh.ops.create_uvsphere(shape, u_segments=96, v_segments=48, radius=radius)
    shape.to_mesh(mesh)
    shape.free()
    mesh.shade_smooth()
    obj = bpy.data.objects.new("Glass ball", mesh)
    obj.location = center.tolist()
    mesh.materials.append(materials.glass())
    return _ours(obj, home)


def _faces(name: str, corners: Sequence[Sequence[float]], faces: Sequence[Sequence[int]], home: Any) -> Any:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], faces)
    return _ours(bpy.data.objects.new(name, mesh), home)
