"""Light from a scene's lamps and sky, gathered by Cycles at points and carried to the splats.

The splats then glow with their colour times that light. Their image has no noise of its own, and takes as
long as an unlit one; the light stays as it was when it was gathered.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from meshsplats.blender.inside import deforming, levels, light_state, materials, meshes, versions
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.materials import LIGHT
from meshsplats.blender.inside.meshes import POINTS as POINTS
from meshsplats.blender.options import CAREFUL
from meshsplats.errors import DataWarning

POINT = "light_point"
"""Attribute of the splats: index of the point whose light each vertex takes."""
SIZE = "meshsplats_spacing"
"""Property of the points' mesh: distance of neighbouring points, scene units."""
STATE = "meshsplats_light_state"
"""Property of the splats: the ``light_state`` of the scene when their light was baked, and the name of the
view layer."""
_RAYS = ("camera", "diffuse", "glossy", "transmission", "volume_scatter", "shadow")
"""Cycles leaves out what none of these rays can see."""
_BOUNCES = 4
"""Least bounces: images of unlit splats have none."""
_AGREE = 4
"""Power of the cosine between the normals of two points that share their light."""
_WIDTH = 1.0
"""Standard deviation of the Gaussian that removes noise, in spacings of the points."""


def make_points(name: str, points: np.ndarray, normals: np.ndarray, size: float) -> Any:
    """A bpy mesh with a small triangle at each of the ``points`` (n, 3), facing along ``normals`` (n, 3), a
    fifth of ``size`` wide."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [1.0, 0, 0], [0, 1.0, 0])
    first = np.cross(normals, helper)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    angles = np.radians([0, 120, 240])
    corners = points[:, None] + 0.1 * size * (
        np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    )
    mesh = meshes.make_plain(name, corners.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3))
    mesh.update(calc_edges=True)
    mesh.attributes.new(LIGHT, "FLOAT_COLOR", "CORNER")
    mesh.color_attributes.active_color = mesh.color_attributes[LIGHT]
    mesh[SIZE] = float(size)
    mesh.materials.append(materials.plain("Light points", (1.0, 1.0, 1.0)))
    return mesh


def points_of(obj: Any) -> Any:
    """The object of the points of the splats ``obj``; None if there is none, or it was deleted."""
    target = obj.get(POINTS) if obj is not None else None
    # What is deleted in the window stays in the file while a property refers to it.
    return target if target is not None and target.users_collection else None


def places_of(obj: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """(n, 3) the points of the splats ``obj``, (n, 3) unit normals there, and the distance of neighbours, in
    Blender's world; n is 0 if it has none."""
    target = points_of(obj)
    if target is None:
        return np.zeros((0, 3)), np.zeros((0, 3)), 0.0
    world = np.array(obj.matrix_world)
    corners = versions.positions(target.data).astype(np.float64) @ world[:3, :3].T + world[:3, 3]
    a, b, c = corners.reshape(-1, 3, 3).swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return (a + b + c) / 3, normals, target.data[SIZE] * obj.matrix_world.median_scale


def bake(scene: Any, objs: list[Any], *, samples: int = CAREFUL.samples) -> int:
    """Gathers the light of ``scene`` on the splat objects ``objs`` and shows them in it.

    Everything that images of the active view layer show lights them and casts shadows on them, their own
    stand-ins, too, also where they themselves are hidden, held out or left out there. The render settings
    stay as they are. Needs Cycles.

    Objects without points (``stand_ins.add``) are left out, and with a DataWarning those that Cycles cannot
    bake. Of a chain of levels of detail, each is lit as if it were the visible one.

    Returns:
        The number of objects that were lit.
    """
    targets = {obj.name: target for obj in objs if (target := points_of(obj)) is not None}
    chosen = [obj for obj in objs if obj.name in targets]
    if not chosen:
        return 0
    versions.enable_cycles()
    settings = [
        (scene.render, "engine", versions.engine_name("cycles")),
        (scene.cycles, "samples", samples),
        (scene.cycles, "use_denoising", False),
        (scene.cycles, "use_adaptive_sampling", False),
        (scene.cycles, "film_exposure", 1.0),  # images have it once more
        (scene.cycles, "max_bounces", max(scene.cycles.max_bounces, _BOUNCES)),
    ]
    # Not by ``hide_render``, which hides their stand-ins, too.
    unseen = [(obj, f"visible_{way}", False) for obj in chosen for way in _RAYS]
    lit = []
    with _held(settings + unseen), _layer(scene) as layer:
        for obj in chosen:
            target = targets[obj.name]
            chain = levels.chain_of(obj)
            shown = {} if chain is None else {w: levels.visible_level(chain, w) for w in ("view", "render")}
            if None in shown.values():  # all levels are hidden, and stay so
                shown = {}
            if shown:
                levels.show(chain, obj[levels.LEVEL])
            shows = [(target, "hide_render", False), (target, "hide_viewport", False)]
            stand_in = [child for child in obj.children if child.get(meshes.STAND_IN)]
            try:
                deforming.follow(obj)
                # Lit as if it were visible.
                with _held([*shows, (obj, "hide_render", False)]), _at_hand(scene, stand_in):
                    _bake(target, layer)
            except RuntimeError as error:
                what = str(error).strip().removeprefix("Error: ")
                warnings.warn(f"{obj.name} was left out, it cannot be baked: {what}", DataWarning, 2)
            else:
                show(obj.data, smoothed(target.data))
                lit.append(obj)
            finally:
                for where, level in shown.items():
                    if level is not None:
                        levels.show(chain, level, where)
    layer = bpy.context.view_layer
    for obj in lit:
        obj[STATE] = f"{light_state.latest(scene, obj, layer, now=True)} {layer.name}"
    return len(lit)


def is_older(scene: Any, obj: Any) -> bool:
    """Whether the splats ``obj`` show baked light, and lamps, sky, other objects or they themselves have
    moved or changed since."""
    if not any(materials.shows_baked(material) for material in obj.data.materials):
        return False
    baked, _, layer = obj.get(STATE, "").partition(" ")
    return bool(baked != light_state.latest(scene, obj, scene.view_layers.get(layer)))


def forget(objs: list[Any]) -> None:
    """Has the lamps of the scene light the splat objects ``objs`` in every image, instead of baked light."""
    for obj in objs:
        _part_materials(obj.data)
        for material in obj.data.materials:
            materials.set_baked(material, False)


def show(data: Any, light: np.ndarray) -> None:
    """Gives the splats ``data`` the ``light`` (n, 3) of their points, and switches their material to it."""
    points = data.attributes[POINT].data
    index = np.empty(len(points), np.int32)
    points.foreach_get("value", index)
    values = np.ones((len(index), 4), np.float32)
    values[:, :3] = light[index]
    attribute = data.attributes.get(LIGHT) or data.attributes.new(LIGHT, "FLOAT_COLOR", "POINT")
    attribute.data.foreach_set("color", values.ravel())
    _part_materials(data)
    for material in data.materials:
        materials.set_baked(material, True)
    data.update_tag()


def _part_materials(data: Any) -> None:
    """Gives the splats ``data`` copies of lit materials that others use, too, as duplicates by Shift D do:
    which light they show is for each to choose."""
    for i, material in enumerate(data.materials):
        lit = material is not None and material.node_tree and materials.BAKED in material.node_tree.nodes
        if lit and material.users - material.use_fake_user > 1:
            data.materials[i] = material.copy()


def smoothed(data: Any) -> np.ndarray:
    """(n, 3) float64 linear RGB of the light on the points' mesh ``data``, without noise: means over points
    within a spacing or two whose normals agree."""
    light = np.empty(12 * len(data.polygons), np.float32)
    data.attributes[LIGHT].data.foreach_get("color", light)
    light = light.reshape(-1, 3, 4)[:, :, :3].mean(axis=1, dtype=np.float64)
    corners = versions.positions(data).reshape(-1, 3, 3).astype(np.float64)
    centers = corners.mean(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return mean_light(centers, normals, light, float(data[SIZE]))


def mean_light(centers: np.ndarray, normals: np.ndarray, light: np.ndarray, size: float) -> np.ndarray:
    """(n, 3) ``light`` (n, 3) averaged over points nearer than about two ``size`` whose ``normals`` (n, 3)
    agree."""
    steps = np.clip((centers - centers.min(axis=0)) / size, 0, 2**20 - 4).astype(np.int64) + 1
    keys = steps[:, 0] << 42 | steps[:, 1] << 21 | steps[:, 2]
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    total, weights = light.copy(), np.ones(len(light))
    for step in ((x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)):
        first = np.searchsorted(ranked, keys + step)
        # Points that share a cell have normals in different octants: eight at most.
        for k in range(8):
            at = np.minimum(first + k, len(ranked) - 1)
            near = order[at]
            row = np.flatnonzero((first + k < len(ranked)) & (ranked[at] == keys + step))
            row = row[near[row] != row]
            if not len(row):
                break
            other = near[row]
            away = np.square(centers[other] - centers[row]).sum(axis=1) / (_WIDTH * size) ** 2
            cosine = np.maximum(np.einsum("ij,ij->i", normals[row], normals[other]), 0)
            weight = np.exp(-away / 2) * cosine**_AGREE
            total[row] += weight[:, None] * light[other]
            weights[row] += weight
    return total / weights[:, None]


def _bake(target: Any, layer: Any) -> None:
    layer.update()
    # Whatever is selected, and shown by a window's local view.
    chosen = {"object": target, "active_object": target, "selected_objects": [target]}
    with bpy.context.temp_override(view_layer=layer, **chosen):
        done = bpy.ops.object.bake(
            type="DIFFUSE",
            pass_filter={"DIRECT", "INDIRECT"},
            target="VERTEX_COLORS",
            use_clear=True,
            use_selected_to_active=False,
        )
    if "FINISHED" not in done:
        raise RuntimeError("it was stopped")


@contextmanager
def _layer(scene: Any) -> Iterator[Any]:
    """A view layer of ``scene`` that has the light of the active one, but holds nothing out, and shows only
    indirectly, hides and selects nothing."""
    active = bpy.context.view_layer
    layer = scene.view_layers.new("Baked light")
    try:
        layer.world_override = active.world_override
        _exclude_as(active.layer_collection, layer.layer_collection)
        yield layer
    finally:
        scene.view_layers.remove(layer)
        active.update()


def _exclude_as(these: Any, those: Any) -> None:
    """Excludes children of the layer collection ``those`` where their twins in ``these`` are."""
    for this, that in zip(these.children, those.children, strict=True):
        if that.exclude != this.exclude:
            that.exclude = this.exclude
        _exclude_as(this, that)


@contextmanager
def _at_hand(scene: Any, objs: list[Any]) -> Iterator[None]:
    """The objects ``objs`` are in the collection of ``scene``, too, which no view layer leaves out."""
    home = scene.collection.objects
    added = [obj for obj in objs if scene.collection not in obj.users_collection]
    for obj in added:
        home.link(obj)
    try:
        yield
    finally:
        for obj in added:
            home.unlink(obj)


@contextmanager
def _held(values: list[tuple[Any, str, Any]]) -> Iterator[None]:
    """Properties hold other ``values``: owner, name, value. Afterwards they have those from before."""
    old = [(owner, name, getattr(owner, name)) for owner, name, _ in values]
    try:
        for owner, name, value in values:
            setattr(owner, name, value)
        bpy.context.view_layer.update()
        yield
    finally:
        for owner, name, value in reversed(old):
            setattr(owner, name, value)
