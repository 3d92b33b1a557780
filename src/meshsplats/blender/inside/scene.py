"""A whole Blender scene of a mesh, as the command line renders and saves it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from meshsplats.blender.inside import (
    baking,
    far_to_near,
    frame,
    levels,
    materials,
    meshes,
    objects,
    remaking,
    rendering,
    stage,
    stand_ins,
    versions,
)
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.options import LightOptions, SceneOptions
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import srgb_to_linear


@dataclass(frozen=True, eq=False)
class Subject:
    """The mesh as Blender gets it, and its bounds."""

    vertices: np.ndarray
    """(v, 3) float32, world frame of the splats."""
    faces: np.ndarray
    """(f, 3) int32."""
    colors: np.ndarray
    """(v, 4) float32: linear light if lit, else as composited."""
    up: np.ndarray
    """(3,) up direction in the world frame."""
    center: np.ndarray
    """(3,) centre of the subject, world frame."""
    radius: float
    """Distance from ``center`` within which most of it lies, scene units."""
    floor: float
    """Height of its lowest part along ``up``, scene units."""
    reach: float
    """Distance from ``center`` within which everything lies, scene units."""
    layers: int
    """Most layers behind each other."""
    self_shadow: float
    """Distance within which layers do not shade each other, scene units."""
    linear: bool = False
    """Whether the mesh was made for blending in linear light: then unlit colours are linear light, too."""
    normals: np.ndarray | None = None
    """(v, 3) float32 unit shading normals, if lit."""
    face_splat: np.ndarray | None = None
    """(f,) int32."""
    display: np.ndarray | None = None
    """(v, 4) float32 RGBA as composited unlit, if lit."""
    harmonics: np.ndarray | None = None
    """(v, k, 3) float32 spherical harmonics of the vertices' splats, if unlit and colours depend on the
    view."""
    surface_vertices: np.ndarray | None = None
    """(w, 3) float32; this and the following are the fields of ``StandIn``, if lit and solid."""
    surface_faces: np.ndarray | None = None
    surface_colors: np.ndarray | None = None
    fine_faces: np.ndarray | None = None
    light_points: np.ndarray | None = None
    light_normals: np.ndarray | None = None
    light_point_of: np.ndarray | None = None
    light_spacing: float = 0.0
    screen_size: int = 0
    """Of a level of detail: side in pixels of the images for which it was made; else 0."""
    name: str = "Splats"


@dataclass(frozen=True, eq=False)
class Built:
    """A scene that was built."""

    scene: Any
    obj: Any
    """The object of the splats."""
    cameras: list[Any]
    rotation: np.ndarray
    """(3, 3) from the splats' world to Blender's."""


def build(
    subject: Subject,
    cameras: Sequence[Camera],
    options: SceneOptions,
    limit: int,
    *,
    edges: bool,
    coarser: Sequence[Subject] = (),
    announce: Callable[[str], object] = lambda phase: None,
) -> Built:
    """A new file with the subject, its cameras and surroundings, ready to render.

    Args:
        limit: that of transparent bounces.
        edges: as in ``meshes.make_mesh``.
        coarser: further levels of detail, if the subject is one; hidden at first (``levels.show``).
        announce: told a phase of the work that takes long, before it begins.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    scene = bpy.context.scene
    scene.name = "MeshSplats"
    rotation = frame.to_blender(subject.up)
    if subject.screen_size:
        chain = [subject, *coarser]
        homes = levels.add_collections(subject.name, [level.screen_size for level in chain], scene.collection)
        objs = [
            _add_splats(replace(level, name=home.name), options, rotation, edges, home)
            for level, home in zip(chain, homes, strict=True)
        ]
        levels.tie(objs)
        obj = objs[0]
    else:
        obj = _add_splats(subject, options, rotation, edges, stage.collection("Splats", lasting=True))
    center = rotation @ subject.center
    home = stage.collection("Cameras")
    made = []
    for i, camera in enumerate(cameras):
        away = float(np.linalg.norm(camera.center - subject.center))
        reach = 2 * (away + subject.reach) + 1000 * subject.radius * (options.light is not None)
        made.append(stage.add_camera(camera, camera.name or f"view_{i:04d}", rotation, reach, home))
    rendering.new_file(scene)
    light = options.light
    if light is None:
        background = np.array(options.background or (0, 0, 0))
        stage.even_world((srgb_to_linear(background) if subject.linear else background).tolist())
        rendering.exact_settings(scene, options.engine, linear=subject.linear)
    else:
        viewer = np.array(made[0].matrix_world.translation) if made else None
        floor = np.array([center[0], center[1], subject.floor])
        surround(floor, subject.radius, light, viewer, options.background)
        rendering.lit_settings(
            scene,
            options.engine,
            samples=options.samples,
            limit=limit,
            bounces=light.bounces,
            denoise=options.denoise,
            raytracing=light.mirror or light.glass,
            exposure=light.exposure,
        )
        if options.fast:
            rendering.preview_settings(scene)
    catcher = light is not None and light.ground == "catcher"
    scene.render.film_transparent = options.background is None or catcher
    if options.threads is not None:
        scene.render.threads_mode = "FIXED"
        scene.render.threads = min(options.threads, 1024)
    _timeline(scene, made)
    if made:
        stage.aim(scene, cameras[0], made[0])
    bpy.context.view_layer.objects.active = obj
    if light is not None:
        announce("light")
        baking.bake(scene, objects.splat_objects(scene), samples=options.effort.samples)
    return Built(scene, obj, made, rotation)


def _add_splats(subject: Subject, options: SceneOptions, rotation: np.ndarray, edges: bool, home: Any) -> Any:
    """The object of ``subject`` in the collection ``home``, with its material, its order for EEVEE and its
    stand-in."""
    mesh = meshes.make_mesh(
        subject.name,
        subject.vertices,
        subject.faces,
        subject.colors,
        normals=subject.normals,
        face_splat=subject.face_splat,
        display=subject.display,
        edges=edges,
    )
    obj = meshes.make_object(mesh, subject.name, rotation, home)
    light = options.light
    objects.mark(
        mesh,
        up=subject.up,
        origin=np.zeros(3),
        lit=light is not None,
        linear=subject.linear,
        layers=subject.layers,
    )
    if edges or options.engine == "eevee":  # a file may be drawn by either
        far_to_near.add(obj)
    if light is None:
        if subject.harmonics is not None:
            meshes.store_harmonics(mesh, subject.harmonics)
        remaking.set_material(mesh, materials.unlit(terms=meshes.terms_of(subject.harmonics)))
        return obj
    material = materials.lit(
        self_shadow=subject.self_shadow,
        roughness=light.roughness,
        specular=light.specular,
        smooth=subject.normals is not None,
    )
    remaking.set_material(mesh, material)
    if subject.surface_vertices is not None:
        stand_ins.add(
            obj,
            {name: getattr(subject, name) for name in (*stand_ins.SPLATS, *stand_ins.ARRAYS)},
            subject.light_spacing,
            self_shadow=subject.self_shadow,
            home=home,
        )
    return obj


def surround(
    floor: np.ndarray,
    radius: float,
    light: LightOptions,
    viewer: np.ndarray | None,
    background: Sequence[float] | None,
) -> None:
    """Adds sun, world, ground, mirror and glass around a subject of ``radius`` that stands at ``floor`` (3,),
    placed for a viewer at ``viewer`` (3,); Blender's frame. ``background``: display RGB that cameras see."""
    if light.sun_strength > 0:
        direction = frame.sun_direction(*light.sun)
        home = stage.collection("Lights")
        stage.add_sun(direction, light.sun_strength, light.sun_size, 0.004 * radius, home, light.sun_color)
    if light.fill > 0:
        home = stage.collection("Lights") if light.sun_strength <= 0 else home
        direction = frame.sun_direction(*light.fill_direction)
        stage.add_sun(direction, light.fill, 60.0, 0.004 * radius, home, name="Fill")
    if light.hdri is not None:
        stage.environment_world(str(light.hdri), light.hdri_strength, light.hdri_rotation)
    else:
        seen = None
        if background is not None:
            # The displayed background does not depend on the exposure.
            seen = (srgb_to_linear(np.array(background)) / 2**light.exposure).tolist()
        stage.even_world([light.sky * part for part in light.sky_color], seen)
    home = stage.collection("Surroundings")
    if light.ground != "none":
        stage.add_ground(floor, radius, light.ground == "catcher", home)
    towards = np.array([0.0, -1.0, 0.0])
    if viewer is not None:
        level = np.array([viewer[0] - floor[0], viewer[1] - floor[1], 0.0])
        if np.linalg.norm(level) > 1e-6 * radius:
            towards = level / np.linalg.norm(level)
    right = np.array([-towards[1], towards[0], 0.0])
    if light.mirror:
        # A little to the left and turned to the viewer, so that it shows the back of the subject.
        position = floor - 1.5 * radius * towards - 0.7 * radius * right
        facing = towards + 0.45 * right
        stage.add_mirror(position, facing / np.linalg.norm(facing), 2.6 * radius, 2.2 * radius, home)
    if light.glass:
        size = 0.35 * radius
        position = floor + 0.9 * radius * towards + 0.95 * radius * right + [0, 0, 1.001 * size]
        stage.add_glass_ball(position, size, home)


def _timeline(scene: Any, cameras: Sequence[Any]) -> None:
    """One frame per camera, so that the timeline steps through the views."""
    scene.frame_start, scene.frame_end = 0, max(len(cameras) - 1, 0)
    if len(cameras) > 1:
        for i, camera in enumerate(cameras):
            marker = scene.timeline_markers.new(camera.name, frame=i)
            marker.camera = camera
    scene.frame_set(0)
