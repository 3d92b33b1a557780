"""Splat meshes as objects of an open Blender file, for the extension."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from meshsplats.blender.inside import (
    bounces,
    far_to_near,
    frame,
    levels,
    lit_points,
    materials,
    meshes,
    priors,
    remaking,
    rendering,
    scene_linear,
    sorted_copies,
    sources,
    stand_ins,
    turning,
    versions,
    views,
)
from meshsplats.blender.inside.bounces import LAYERS as LAYERS
from meshsplats.blender.inside.bounces import count_layers as count_layers
from meshsplats.blender.inside.bounces import splat_objects as splat_objects
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.materials import LIT as LIT
from meshsplats.blender.inside.stand_ins import ROUGH as ROUGH
from meshsplats.blender.layers import bounce_limit, most_layers
from meshsplats.blender.options import CAREFUL, FAST, LightOptions
from meshsplats.blender.subject import Announce, lit_subject, lowest, vertex_harmonics
from meshsplats.cameras.framing import scene_bounds
from meshsplats.conversion.baking import bake_filter
from meshsplats.prior.model import MeshPrior
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.mesh import MAX_COLOR, Blending, SplatMesh

LINEAR = "meshsplats_linear"
"""Property of the mesh data: whether the mesh was made for blending in linear light."""
UP = "meshsplats_up"
"""Property of the mesh data: its up direction, in its own frame."""
ORIGIN = "meshsplats_origin"
"""Property of the mesh data: the object's origin, under the subject, in the mesh's own frame."""
WORLD = "meshsplats_world"
"""Property of the mesh data, where it is not zero: ``SplatMesh.origin``, the point of the world that its
frame is relative to. Blender's places are float32, so objects stand near (0, 0, 0)."""


def prepare(
    mesh: SplatMesh | lit_points.Source,
    lit: bool,
    *,
    fast: bool = False,
    views: Sequence[Camera] | None = None,
    announce: Announce = lambda phase: None,
) -> dict[str, Any]:
    """Everything that takes time and does not touch Blender, so that it may run in another thread. Coplanar
    layers of a mesh prior are separated, as in exports; a filter is baked for images of the whole subject.
    ``fast``: a lit mesh for a preview. ``views``: those within a place, as in ``lit_subject``. ``announce``
    is told the phases of a lit one, and may raise. Splats that Blender draws (``light_source``) are lit."""
    if isinstance(mesh, lit_points.Source):
        return lit_points.prepare(mesh, fast=fast, within=views, announce=announce)
    if mesh.binding is not None and mesh.normals is not None:
        prior = MeshPrior(mesh)
        mesh = prior.pose(lift=prior.export_lift)
    if mesh.filter_px2:
        mesh = bake_filter(mesh)
    shown = mesh.plain if lit else mesh
    arrays: dict[str, Any] = {
        "faces": mesh.faces,
        "colors": shown.colors,
        "normals": None,
        "self_shadow": 0.0,
        "harmonics": vertex_harmonics(shown),
    }
    if lit:
        made, facts = lit_subject(mesh, within=views, effort=FAST if fast else CAREFUL, announce=announce)
        arrays |= made | facts
    below = foot(mesh) if len(mesh.faces) else np.zeros(3)
    arrays |= {"mesh": mesh, "lit": lit, "fast": fast, "layers": most_layers(mesh), "foot": below}
    # Splats on a base keep the base's frame.
    return arrays | {"origin": np.zeros(3) if mesh.binding is not None else below}


def foot(mesh: SplatMesh) -> np.ndarray:
    """(3,) float64 point under the centre of the subject of ``mesh``, at the height of its lowest part; frame
    of the mesh."""
    bounds, up = scene_bounds(mesh), mesh.up.astype(np.float64)
    return bounds.center + (lowest(bounds, up) - bounds.center @ up) * up


def add(prepared: dict[str, Any], name: str, collection: Any, onto: Any = None) -> Any:
    """A new object in ``collection``, upright in Blender's frame, with its material. Its origin lies under
    the subject. The splats of a mesh prior are a child of a new object of their base, which they follow.
    ``onto``: a mesh of this shape, which it takes (``cutting``)."""
    prepared = _in_working_space(prepared)
    rotation = frame.to_blender(prepared["mesh"].up)
    obj = meshes.make_object(_data(prepared, name, onto), name, rotation, collection)
    obj.location = (rotation @ prepared["origin"]).tolist()
    far_to_near.add(obj, viewport=False)
    _give_stand_in(obj, prepared)
    if prepared["mesh"].binding is not None:
        priors.give_base(obj, prepared["mesh"].binding, collection)
    bpy.context.view_layer.objects.active = obj
    return obj


def add_chain(
    prepared: Sequence[dict[str, Any]], name: str, screen_sizes: Sequence[int], collection: Any
) -> list[Any]:
    """New objects for the levels of a chain, the finest first, each in a collection of its own inside a new
    one called ``name``. All stand where the finest does, and only that is visible (``levels.show``)."""
    homes = levels.add_collections(name, screen_sizes, collection)
    origin = prepared[0]["origin"]
    objs = [add(p | {"origin": origin}, home.name, home) for p, home in zip(prepared, homes, strict=True)]
    levels.tie(objs)
    bpy.context.view_layer.objects.active = objs[0]
    return objs


def subjects(scene: Any) -> list[Any]:
    """What light can act on: the splat meshes of ``scene``, and the splats that Blender draws itself, without
    those that images do not show, as meshes may have taken their place."""
    drawn = (obj for obj in scene.objects if lit_points.can_be_lit(obj) and not obj.hide_render)
    return [*splat_objects(scene), *drawn]


def is_lit(obj: Any) -> bool | None:
    """Whether the splats ``obj`` are lit; None for other objects."""
    if lit_points.can_be_lit(obj):
        return bool(obj.data.get(LIT))
    return bool(obj.data[LIT]) if obj.type == "MESH" and LIT in obj.data else None


def is_even(obj: Any) -> bool:
    """Whether the splats ``obj`` are lit, but glow with their own colours whatever light there is."""
    return any(map(materials.shows_even, obj.data.materials))


def show_even(obj: Any) -> None:
    """Has the lit splats ``obj`` glow with their own colours, in linear light."""
    for material in obj.data.materials:
        materials.set_even(material)


def replace_mesh(obj: Any, prepared: dict[str, Any], onto: Any = None) -> list[str]:
    """Gives ``obj`` another mesh and material; its transform, parent, modifiers and name stay. So does what
    an artist has added to a mesh of the same triangles, or to ``onto``, a part of it (``cutting``).

    Returns:
        What could not stay (``remaking.added``).
    """
    old, as_made = obj.data, sources.is_as_made(obj)
    prepared = _in_working_space(prepared) | {"origin": np.array(old.get(ORIGIN, (0, 0, 0)))}
    name, lost = old.name, []
    modifier = far_to_near.modifier_of(obj)
    if modifier is not None:
        sorted_copies.drop(modifier)
    if onto is None and fits(old, prepared):
        onto = remaking.copied(old)
    elif onto is None:
        lost = remaking.added(obj)
    even = is_even(obj)
    data = _data(prepared, name, onto)
    obj.data = data
    if prepared["lit"] and even:
        show_even(obj)
    if onto is None:
        remaking.take_properties(data, old)
    far_to_near.add(obj, viewport=False)
    stand_ins.remove(obj)
    _give_stand_in(obj, prepared)
    if as_made:
        sources.mark(obj)
    if old.users == 0:
        bpy.data.meshes.remove(old)
    return lost


def fits(data: Any, prepared: dict[str, Any]) -> bool:
    """Whether the mesh ``data`` has the shape that was ``prepared``, but for rounding. What follows a base is
    moved anyway."""
    mesh: SplatMesh = prepared["mesh"]
    largest = float(np.abs(mesh.vertices).max(initial=0)) + float(np.abs(prepared["origin"]).max())
    away = 1e-6 * largest if mesh.binding is None else None
    return remaking.fits(data, mesh.vertices - prepared["origin"].astype(np.float32), mesh.faces, away)


def renew_light(scene: Any, objs: Iterable[Any], *, fast: bool = False) -> list[str]:
    """Makes the stand-ins of the lit splats among ``objs`` anew that were edited, joined or duplicated since,
    or made for previews unless ``fast``, and removes those that were left behind in ``scene``. Returns the
    names of the splats."""
    stand_ins.remove_strays(scene)
    found = []
    for obj in objs:
        if needs_light(obj, fast=fast):
            take_light(obj, prepare(light_source(obj), True, fast=fast, views=views_within(obj)))
            found.append(obj.name)
    return found


def light_source(obj: Any) -> SplatMesh | lit_points.Source:
    """What light is prepared for: the unlit mesh of ``obj``, or the splats that Blender draws.

    Raises:
        ValueError: the object is neither.
    """
    if lit_points.can_be_lit(obj):
        return lit_points.Source(obj, bpy.context.evaluated_depsgraph_get())
    return as_splat_mesh(obj)


def take_light(obj: Any, prepared: dict[str, Any]) -> list[str]:
    """Gives ``obj`` what was prepared for its ``light_source``. Returns what that has lost, as
    ``replace_mesh``."""
    if lit_points.can_be_lit(obj):
        lit_points.light(obj, prepared)
        return []
    return replace_mesh(obj, prepared)


def views_within(obj: Any) -> list[Camera] | None:
    """The views of ``obj`` from within that its import has found, for ``prepare``, in the frame of
    ``as_splat_mesh``; none of what is seen from around. None where they are to be looked for."""
    origin = np.array(obj.data.get(ORIGIN, (0, 0, 0)), np.float64)
    # All levels of a chain stand where the finest does, which has them.
    own = views.within(obj, origin)
    return views.within(levels.with_levels(obj)[0], origin) if own is None else own


def needs_light(obj: Any, *, fast: bool = False) -> bool:
    """Whether the splats ``obj`` are lit, and their stand-in is not of their shape as it is now, or for
    previews unless ``fast``."""
    if not is_lit(obj) or priors.base_of(obj) is not None:
        return False
    return not stand_ins.is_current(obj) or bool(obj.get(ROUGH) and not fast)


def _in_working_space(prepared: dict[str, Any]) -> dict[str, Any]:
    if not prepared["lit"] and prepared["mesh"].blending != "linear":
        return prepared
    names = prepared.keys() & {"colors", "surface_colors"}
    return prepared | {name: scene_linear.from_rec709(prepared[name]) for name in names}


def _give_stand_in(obj: Any, prepared: dict[str, Any]) -> None:
    if prepared["lit"]:
        obj[stand_ins.SHAPE] = stand_ins.shape(obj.data)
        obj[ROUGH] = prepared["fast"]
    if "surface_vertices" not in prepared:
        return
    origin = prepared["origin"].astype(np.float32)
    whole = prepared | {"vertices": prepared["mesh"].vertices}
    arrays = {name: whole[name] for name in (*stand_ins.SPLATS, *stand_ins.ARRAYS)}
    for name in ("vertices", "surface_vertices", "light_points"):
        arrays[name] = arrays[name] - origin
    stand_ins.add(
        obj,
        arrays,
        prepared["light_spacing"],
        self_shadow=prepared["self_shadow"],
        home=bpy.context.scene.collection,
    )


def _data(prepared: dict[str, Any], name: str, onto: Any = None) -> Any:
    """A mesh of what was ``prepared``: a new one, or ``onto``, which has its shape."""
    mesh: SplatMesh = prepared["mesh"]
    arrays = {"normals": prepared["normals"], "face_splat": mesh.face_splat}
    arrays["display"] = prepared.get("display")
    vertices = mesh.vertices - prepared["origin"].astype(np.float32)
    if onto is None:
        data = meshes.make_mesh(name, vertices, prepared["faces"], prepared["colors"], **arrays)
    else:
        data = onto
        if data.name != name:
            data.name = name
        if mesh.binding is not None:
            versions.set_positions(data, vertices)
        remaking.fill(data, prepared["faces"], prepared["colors"], **arrays)
    if mesh.binding is not None:
        priors.store(data, mesh.binding)
    if prepared["lit"]:
        remaking.set_material(data, materials.lit(self_shadow=prepared["self_shadow"]))
    else:
        harmonics = prepared["harmonics"]
        if harmonics is not None:
            meshes.store_harmonics(data, harmonics)
        remaking.set_material(data, materials.unlit(terms=meshes.terms_of(harmonics)))
    mark(
        data,
        up=mesh.up,
        origin=prepared["origin"],
        lit=prepared["lit"],
        linear=mesh.blending == "linear",
        layers=prepared["layers"],
    )
    turning.remember(data)
    if mesh.origin.any():
        data[WORLD] = mesh.origin.tolist()
    elif WORLD in data:
        del data[WORLD]
    return data


def mark(data: Any, *, up: np.ndarray, origin: np.ndarray, lit: bool, linear: bool, layers: int) -> None:
    """Stores with the mesh ``data`` the facts that ``as_splat_mesh`` and ``render_settings`` need; ``up``
    (3,) and ``origin`` (3,) in the frame of the splats."""
    data[UP] = np.asarray(up, np.float64).tolist()
    data[ORIGIN] = np.asarray(origin, np.float64).tolist()
    data[LIT] = lit
    data[LINEAR] = linear
    data[LAYERS] = layers


def as_splat_mesh(obj: Any) -> SplatMesh:
    """The unlit mesh that ``obj`` was made from, in the frame and colours of its file.

    Where a lit mesh was painted, the new colour counts, as display values, and so does a new opacity.

    Raises:
        ValueError: not a mesh of triangles that MeshSplats made.
    """
    return splat_mesh_of(obj, getattr(obj, "data", None))


def splat_mesh_of(obj: Any, data: Any) -> SplatMesh:
    """As ``as_splat_mesh``, from another mesh ``data`` of ``obj``, as its modifiers make it. Faces of more
    corners are cut into triangles."""
    if obj is None or obj.type != "MESH" or LIT not in obj.data or meshes.COLOR not in data.attributes:
        raise ValueError("the object was not made by MeshSplats")
    vertices = versions.positions(data)
    faces, polygon = meshes.triangles(data)
    facts, colors = obj.data, _unlit_colors(data, obj.data)
    owner = None
    if meshes.SPLAT in data.attributes:
        owner = meshes.owners(data)[polygon]
        if (
            np.diff(owner) < 0
        ).any():  # joined with others, or edited: what lies side by side belongs together
            owner = np.cumsum(np.diff(owner, prepend=owner[:1]) != 0, dtype=np.int32)
    blending: Blending = "linear" if facts[LINEAR] else "display"
    found = SplatMesh(
        vertices + np.array(facts.get(ORIGIN, (0, 0, 0)), np.float32),
        faces,
        colors,
        face_splat=owner,
        harmonics=None
        if owner is None
        else turning.harmonics_of(data, FaceSplats(faces, owner, len(vertices))),
        up=frame.up_of(obj),  # the rotation may have been applied to the mesh
        blending=blending,
        origin=np.array(facts.get(WORLD, (0, 0, 0)), np.float64),
    )
    if priors.base_of(obj) is None or data != obj.data:
        return found
    binding = priors.binding_of(obj)
    return found.moved(binding.positions(), normals=binding.normals(), binding=binding)


def unlit_colors(data: Any) -> np.ndarray:
    """(v, 4) float32 RGBA of the mesh ``data`` as composited unlit."""
    return _unlit_colors(data, data)


def _unlit_colors(data: Any, facts: Any) -> np.ndarray:
    """As ``unlit_colors``, of a mesh ``data`` that has its properties from ``facts``."""
    shown = meshes.read_colors(data, meshes.COLOR)
    light = facts[LIT] or facts[LINEAR]
    colors = np.clip(scene_linear.to_rec709(shown) if light else shown, 0, 1)
    if not light:
        colors[:, :3] = np.clip(shown[:, :3], 0, MAX_COLOR)
    if not facts[LIT]:
        return colors
    if not facts[LINEAR]:
        colors[:, :3] = np.clip(linear_to_srgb(colors[:, :3]), 0, 1)
    if meshes.DISPLAY in data.attributes and meshes.MADE in data.attributes:
        kept = shown == meshes.read_colors(data, meshes.MADE)
        kept[:, :3] = kept[:, :3].all(axis=1, keepdims=True)
        display = np.clip(meshes.read_colors(data, meshes.DISPLAY), 0, 1)
        colors = np.where(kept, display, colors)
        # Joined from an unlit mesh, which lacks both attributes.
        unlit = ~(meshes.read_colors(data, meshes.MADE).any(axis=1) | display.any(axis=1))
        colors[unlit] = np.clip(shown[unlit], 0, 1)
    return colors


def render_settings(scene: Any, objs: list[Any], lit: bool, light: LightOptions | None = None) -> int:
    """Sets up engine, colour management and bounce limits of the scene for ``objs`` and the splats that
    instances of collections show.

    Keeps the engine, or chooses Cycles where it is neither Cycles nor EEVEE. A scene cannot be right for
    unlit meshes of both display and linear blending: display wins. Lit images are denoised, with the exposure
    of ``light``.

    Returns:
        The limit on transparent bounces.
    """
    light = light or LightOptions(exposure=0.0)
    engine = "eevee" if "EEVEE" in scene.render.engine else "cycles"
    versions.enable_cycles()
    objs = [obj for obj in objs if obj.type == "MESH"]  # splats that Blender draws have no triangles
    others = [obj for obj in scene.objects if obj.type == "EMPTY"]
    limit = bounce_limit(bounces.layers_of([*objs, *others]))
    shown = [*objs, *bounces.instanced(others)]
    linear = bool(shown) and all(obj.data.get(LINEAR) for obj in shown)
    if lit:
        rendering.lit_settings(scene, engine, limit=limit, denoise=True, exposure=light.exposure)
    else:
        rendering.exact_settings(scene, engine, linear=linear)
        limit = 1024
    return limit


def clash(objs: list[Any], lit: bool) -> str:
    """Message if ``objs`` cannot all be right in one unlit scene, else ''."""
    kinds = {bool(obj.data.get(LINEAR)) for obj in objs}
    if lit or len(kinds) < 2:
        return ""
    return "some meshes blend display values and others linear light: unlit, the latter look too dark here"
