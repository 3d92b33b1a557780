"""Cuts splat meshes between splats: by another object, by opacity, size and colour, and floaters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from meshsplats.blender.inside import objects, remaking
from meshsplats.blender.inside.host import bpy
from meshsplats.conversion import surroundings
from meshsplats.conversion.cleaning import find
from meshsplats.conversion.cleaning_rules import FLOATERS, CleaningRules
from meshsplats.scene.mesh import SplatMesh


class Cut(NamedTuple):
    """What ``cut`` has made, and what it could not keep."""

    made: Any
    """The new object, or None."""
    lost: list[str]
    """What an artist has added to the mesh that went (``remaking.added``)."""


def chosen_splats(
    obj: Any,
    region: Any = None,
    *,
    shape: str = "box",
    outside: bool = False,
    below_opacity: float = 1.0,
    above_size: float = 0.0,
    color: Sequence[float] | None = None,
    color_distance: float = 0.1,
) -> tuple[SplatMesh, np.ndarray]:
    """The mesh of the splats ``obj``, and (f,) bool: the triangles of its splats that meet all conditions.

    Args:
        region: an object; its centre must lie in its bounds (``outside``: not in them). None: anywhere.
        shape: 'box', the bounds of ``region``, turned as it is, or 'sphere', the ellipsoid within them.
        below_opacity: no corner of the splat is more opaque.
        above_size: least distance of its farthest corner from its centre, scene units.
        color: display RGB from which its mean colour is at most ``color_distance`` away; None: any colour.

    Raises:
        ValueError: not a splat mesh, a mesh prior, or a region without extent.
    """
    mesh = objects.as_splat_mesh(obj)
    if mesh.binding is not None:
        raise ValueError("the splats follow a base: cutting would lose that; unbind them first")
    world = np.array(obj.matrix_world)
    origin = np.array(obj.data.get(objects.ORIGIN, (0, 0, 0)))
    corners = (mesh.vertices[mesh.faces] - origin) @ world[:3, :3].T + world[:3, 3]
    splats = mesh.splats
    centers = splats.sums(corners.mean(axis=1)) / splats.counts[:, None]
    found = np.ones(len(splats), bool)
    if region is not None:
        within = _within(region, centers, shape)
        found &= ~within if outside else within
    if below_opacity < 1 and len(found):
        found &= np.maximum.reduceat(mesh.colors[mesh.faces, 3].max(axis=1), splats.starts) <= below_opacity
    if above_size > 0 and len(found):
        away = np.linalg.norm(corners - centers[splats.of_face][:, None], axis=2).max(axis=1)
        found &= np.maximum.reduceat(away, splats.starts) >= above_size
    if color is not None and len(found):
        own = mesh.colors[mesh.faces].astype(np.float64)
        weight = own[:, :, 3] + 1e-6
        mean = splats.sums(np.einsum("fk,fkc->fc", weight, own[:, :, :3]))
        mean /= splats.sums(weight.sum(axis=1))[:, None]
        found &= np.linalg.norm(mean - np.array(color), axis=1) <= color_distance
    return mesh, found[splats.of_face]


def floaters(obj: Any, rules: CleaningRules = FLOATERS) -> tuple[SplatMesh, np.ndarray]:
    """As ``chosen_splats``: the splats that ``rules`` name; by default less what surrounds a place, as
    ``meshsplats clean`` does.

    Raises:
        ValueError: as ``chosen_splats``; no splat would be left.
    """
    mesh, _ = chosen_splats(obj)
    found = surroundings.floaters(mesh) if rules == FLOATERS else find(mesh, rules)
    return mesh, ~found.kept[mesh.splats.of_face]


def _within(region: Any, points: np.ndarray, shape: str) -> np.ndarray:
    """(n,) bool: the ``points`` (n, 3), Blender's world, inside the bounds of the object ``region``."""
    bounds = np.array([tuple(corner) for corner in region.bound_box])
    half = np.ptp(bounds, axis=0) / 2
    matrix = np.array(region.matrix_world)
    if not (half > 0).all() or abs(np.linalg.det(matrix)) < 1e-30:
        raise ValueError(f"{region.name} encloses nothing: take an object with length, width and height")
    local = (points - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
    share = (local - bounds.mean(axis=0)) / half
    return (np.square(share).sum(axis=1) <= 1) if shape == "sphere" else (np.abs(share) <= 1).all(axis=1)


def cut(obj: Any, mesh: SplatMesh, faces: np.ndarray, *, separate: bool, collection: Any) -> Cut:
    """Takes the triangles ``faces`` (f,) bool of ``mesh``, as from ``chosen_splats``, out of ``obj``. With
    ``separate``, they become a new object at the same place.

    Raises:
        ValueError: none are chosen, or all.
    """
    count = int(np.count_nonzero(faces))
    if count in (0, len(faces)):
        raise ValueError(f"{'all' if count else 'none'} of the splats meet the conditions: nothing was cut")
    lit, fast = bool(obj.data[objects.LIT]), bool(obj.get(objects.ROUGH))
    views = objects.views_within(obj) if lit else None
    added, made = remaking.added(obj), None
    origin = np.array(obj.data[objects.ORIGIN])
    if separate:
        prepared = objects.prepare(mesh.take(np.flatnonzero(faces)), lit, fast=fast)
        onto = _part(obj.data.copy(), prepared, faces) if added else None
        made = objects.add(prepared, obj.name, collection, onto)
        away = np.array(made.data[objects.ORIGIN]) - origin
        made.matrix_world = obj.matrix_world.copy()
        made.location = obj.matrix_world @ type(made.location)(away.tolist())
        if onto is None:
            remaking.take_properties(made.data, obj.data)
    rest = objects.prepare(mesh.take(np.flatnonzero(~faces)), lit, fast=fast, views=views)
    rest["origin"] = origin
    onto = _part(remaking.copied(obj.data), rest, ~faces) if added else None
    objects.replace_mesh(obj, rest, onto)
    return Cut(made, added if onto is None else [])


def _part(data: Any, prepared: dict[str, Any], faces: np.ndarray) -> Any:
    """The mesh ``data`` cut to the triangles ``faces`` (f,) bool, which were ``prepared``, with its origin
    where they have it; None where its faces are others."""
    if len(data.polygons) != len(faces) or len(data.loops) != 3 * len(faces):
        if not data.users:
            bpy.data.meshes.remove(data)
        return None
    away = np.array(data[objects.ORIGIN]) - prepared["origin"]
    remaking.part(data, faces)
    if away.any():
        from mathutils import Matrix

        data.transform(Matrix.Translation(away.tolist()), shape_keys=True)
    return data if objects.fits(data, prepared) else None


def hide(obj: Any) -> None:
    """Hides ``obj``, with what casts its shadows, in viewports and images: in a collection of its own, whose
    eye and camera in the outliner show all of it again."""
    home = bpy.data.collections.new(f"{obj.name} hidden")
    bpy.context.scene.collection.children.link(home)
    for part in (obj, *obj.children):
        for other in list(part.users_collection):
            other.objects.unlink(part)
        home.objects.link(part)
    home.hide_viewport = home.hide_render = True


def select(obj: Any, faces: np.ndarray) -> None:
    """Goes to edit mode of ``obj``, the active object, where the triangles ``faces`` (f,) bool are selected,
    and nothing else."""
    import bmesh

    bpy.ops.object.mode_set(mode="EDIT")
    edited = bmesh.from_edit_mesh(obj.data)
    for elements in (edited.verts, edited.edges, edited.faces):
        for element in elements:
            element.select = False
    edited.faces.ensure_lookup_table()
    for index in np.flatnonzero(faces).tolist():
        edited.faces[index].select_set(True)  # with its corners and edges
    bmesh.update_edit_mesh(obj.data, loop_triangles=False, destructive=False)
