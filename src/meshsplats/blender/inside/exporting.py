"""Splat meshes out of an open Blender file: as a mesh of ours or as splats, in Blender's world, and in a form
that Blender's own exporters write rightly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from meshsplats.blender.inside import far_to_near, frame, materials, meshes, objects, stage, stand_ins
from meshsplats.blender.inside.host import bpy
from meshsplats.cameras.framing import DEFAULT_UP
from meshsplats.conversion.recovery import recover_splats
from meshsplats.scene.colors import srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.spherical_harmonics import moved_harmonics

UP = np.array([0.0, 0.0, 1.0])
LINEAR = "Color linear"
"""Colour attribute, during an export by Blender, with linear light: what file formats hold."""


class Instance(NamedTuple):
    """A splat mesh that another object shows: of a collection, or scattered by its nodes."""

    obj: Any
    world: np.ndarray
    """(4, 4) float64, from the object's own frame to Blender's world."""


def exported(objs: Sequence[Any], instances: Sequence[Instance] = ()) -> SplatMesh:
    """One unlit mesh of the splat meshes ``objs``: where they are in Blender's world, z up, with what their
    modifiers make of them, and of ``instances`` of others. Each keeps its splats.

    Raises:
        ValueError: no splat mesh, one without triangles, or meshes for different blending.
    """
    if not objs and not instances:
        raise ValueError("there is no splat mesh to export: import one, or select one")
    placed = [*(Instance(obj, np.array(obj.matrix_world)) for obj in objs), *instances]
    parts = [_in_world(obj, world) for obj, world in placed]
    if any(part.face_splat is None for part in parts):
        parts = [replace(part, face_splat=None) for part in parts]
    return SplatMesh.joined(parts)


def exported_splats(objs: Sequence[Any], instances: Sequence[Instance] = ()) -> tuple[GaussianCloud, int]:
    """The splats of the meshes ``objs`` and of ``instances``, as ``exported``, with y down as files of splats
    have it, and how many were left out: those that edits or modifiers have cut.

    Raises:
        ValueError: as ``exported`` and ``recover_splats``.
    """
    cloud, whole = recover_splats(exported(objs, instances))
    return cloud.transformed(frame.to_blender(np.array(DEFAULT_UP)).T), int((~whole).sum())


def chosen(view_layer: Any, *, selected: bool) -> list[Any]:
    """The splat meshes that are visible in ``view_layer``; with ``selected``, those of them that are
    selected."""
    return [
        obj
        for obj in view_layer.objects
        if obj.type == "MESH"
        and objects.LIT in obj.data
        and obj.visible_get(view_layer=view_layer)
        and (not selected or obj.select_get(view_layer=view_layer))
    ]


def instances(depsgraph: Any, *, selected: bool) -> list[Instance]:
    """The instances of splat meshes that are visible in ``depsgraph``; with ``selected``, those that selected
    objects show."""
    return [
        Instance(one.object.original, np.array(one.matrix_world))
        for one in depsgraph.object_instances
        if one.is_instance
        and one.show_self
        and one.object.type == "MESH"
        and objects.LIT in one.object.original.data
        and (not selected or one.parent.original.select_get())
    ]


def _in_world(obj: Any, world: np.ndarray) -> SplatMesh:
    with _without_sorting(obj):
        found = objects.splat_mesh_of(obj, obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data)
    if not len(found.faces):
        raise ValueError(f"{obj.name} has no triangles")
    local = found.vertices.astype(np.float64) - np.array(obj.data.get(objects.ORIGIN, (0, 0, 0)))
    vertices = local @ world[:3, :3].T + world[:3, 3]
    faces = found.faces[:, [0, 2, 1]] if np.linalg.det(world[:3, :3]) < 0 else found.faces
    harmonics = None if found.harmonics is None else moved_harmonics(found.harmonics, world[:3, :3])
    return replace(
        found,
        vertices=vertices.astype(np.float32),
        faces=faces,
        harmonics=harmonics,
        up=UP,
        origin=np.zeros(3),
        binding=None,
    )


@contextmanager
def _without_sorting(obj: Any) -> Iterator[None]:
    modifier = far_to_near.modifier_of(obj)
    shown = modifier is not None and modifier.show_viewport
    try:
        if shown:
            modifier.show_viewport = False
        bpy.context.view_layer.update()
        yield
    finally:
        if shown:
            modifier.show_viewport = True


class Stock:
    """Splat meshes with colours in linear light and a material of stock nodes, from which Blender's exporters
    write what viewers need; ``restore`` gives them their own back."""

    def __init__(self, objs: Sequence[Any]) -> None:
        self._before: list[tuple[Any, Any, str]] = []
        self._material = materials.stock(LINEAR)
        for data in {obj.data for obj in objs}:
            colors = objects.unlit_colors(data)
            if not data[objects.LINEAR]:
                colors[:, :3] = srgb_to_linear(colors[:, :3])
            active = data.color_attributes.active_color
            self._before.append(
                (data, data.materials[0], active.name if active is not None else meshes.COLOR)
            )
            attribute = data.attributes.new(LINEAR, "FLOAT_COLOR", "POINT")
            attribute.data.foreach_set("color", np.ascontiguousarray(colors, np.float32).ravel())
            _activate(data, LINEAR)
            data.materials[0] = self._material

    def restore(self) -> None:
        for data, material, active in self._before:
            data.materials[0] = material
            data.attributes.remove(data.attributes[LINEAR])
            _activate(data, active)
        bpy.data.materials.remove(self._material)
        self._before = []


def _activate(data: Any, name: str) -> None:
    data.color_attributes.active_color = data.color_attributes[name]
    data.color_attributes.render_color_index = data.color_attributes.find(name)


def is_helper(obj: Any) -> bool:
    """Whether ``obj`` only serves images here: a stand-in, points of light, or the ground."""
    return bool(obj.get(stand_ins.STAND_IN)) or any(
        stage.MADE in home and home.name.startswith("Surroundings") for home in obj.users_collection
    )
