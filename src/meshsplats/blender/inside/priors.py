"""Mesh priors in an open Blender file: the base as an object of its own, and splats that follow it.

The splats are a child of the base, so they move with it. When the base deforms (edit mode, shape keys, an
armature, cloth, soft bodies), ``follow`` computes their vertices from its own, as ``MeshPrior.pose`` does.
The extension calls it after every change and on every frame, also of those that are rendered.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from meshsplats.blender.inside import far_to_near, meshes, versions
from meshsplats.blender.inside.host import bpy
from meshsplats.scene.binding import Binding

BASE = "meshsplats_base"
"""Property of the splats' object: the object of its base."""
PROBLEM = "meshsplats_problem"
"""Property of the splats' object: why it could not follow its base; empty if it could."""
TIE = "Follows base"
"""Name of a constraint of the splats, without influence: it has Blender evaluate the base wherever it
evaluates the splats. Bases are hidden in images, and hidden objects are left as they are at rest."""
LIFT = "meshsplats_lift"
"""Property of the mesh data: distance between layers."""
REST = "meshsplats_rest"
"""Property of the mesh data: positions of the base that the distance between layers is meant for."""
STRETCH = "meshsplats_stretch"
"""Property of the mesh data: what that distance is multiplied by at the base's vertices, if not by 1."""
ATTRIBUTES = {"vertex_face": meshes.BASE_FACE, "weights": "splat_base_weights", "layers": "splat_layer"}
"""Attributes of the vertices: the arrays of the binding."""
FACE = ATTRIBUTES["vertex_face"]
_FIELDS = [
    (field, ATTRIBUTES[field.name], *(("FLOAT_VECTOR", "vector") if field.columns else ("INT", "value")))
    for field in Binding.FIELDS
    if field.per == "vertex"
]
"""Each array with the name, the type and the property of its attribute."""


def store(data: Any, binding: Binding) -> None:
    """Stores ``binding`` with the bpy mesh ``data`` of its splats, except the base, which is an object, but
    for its positions: that object may be edited."""
    for field, name, kind, key in _FIELDS:
        attribute = data.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(key, getattr(binding, field.name).ravel())
    data[LIFT] = binding.lift
    data[REST] = binding.base_vertices.ravel()
    if binding.stretch is not None:
        data[STRETCH] = binding.stretch
    elif STRETCH in data:  # of splats that these are made onto
        del data[STRETCH]


def give_base(obj: Any, binding: Binding, collection: Any) -> Any:
    """Makes the base of ``obj``, the object of the splats, as an object in ``collection``: drawn as wire, not
    rendered, with the transform of the splats, which become its child. Returns it."""
    data = meshes.make_plain(f"{obj.name} base", binding.base_vertices, binding.base_faces)
    data.update(calc_edges=True)
    base = bpy.data.objects.new(f"{obj.name} base", data)
    base.display_type = "WIRE"
    base.hide_render = True
    base.matrix_world = obj.matrix_world.copy()
    collection.objects.link(base)
    obj.parent = base
    obj.matrix_parent_inverse.identity()
    obj.matrix_basis.identity()
    obj[BASE] = base
    obj[PROBLEM] = ""
    tie(obj)
    return base


def tie(obj: Any) -> None:
    """Gives the splats ``obj`` what following their base needs, where it is missing: the constraint ``TIE``,
    and, to a library override, a mesh of its own, as linked ones cannot be changed."""
    base = base_of(obj)
    if base is None or obj.library is not None:
        return
    if obj.data.library is not None:
        obj.data = obj.data.copy()
    if not is_tied(obj):
        constraint = obj.constraints.get(TIE) or obj.constraints.new("SHRINKWRAP")
        constraint.name, constraint.target, constraint.influence = TIE, base, 0
        constraint.mute = constraint.show_expanded = False


def is_tied(obj: Any) -> bool:
    """Whether Blender evaluates the base of ``obj`` wherever it evaluates ``obj``."""
    found = obj.constraints.get(TIE)
    return found is not None and not found.mute and found.target == base_of(obj)


def tie_all() -> None:
    """Ties the splats of files that an earlier release saved."""
    for obj in bpy.data.objects:
        if BASE in obj and not obj.override_library:
            tie(obj)


def base_of(obj: Any) -> Any:
    """The object of the base that ``obj`` follows; None if there is none, or it was deleted."""
    base = obj.get(BASE) if obj is not None and obj.type == "MESH" else None
    if base is None or base.type != "MESH" or FACE not in obj.data.attributes:
        return None
    if obj.override_library and obj.parent is not None and obj.parent.override_library:
        return obj.parent if obj.parent.override_library.reference == base else base
    return base


def binding_of(obj: Any) -> Binding:
    """The binding of ``obj`` to its base without modifiers.

    Raises:
        ValueError: the base does not have the vertices or faces that the splats were bound to.
    """
    return _made_binding(obj).posed(versions.positions(base_of(obj).data))


def _made_binding(obj: Any) -> Binding:
    """The binding of ``obj`` to its base as it was when they were made. Raises what ``binding_of`` raises."""
    base = base_of(obj)
    if base is None:
        raise ValueError("the object is bound to no base")
    data = obj.data
    arrays = {}
    for field, name, _, key in _FIELDS:
        arrays[field.name] = np.empty(field.shape({"vertex": len(data.vertices)}), field.dtype)
        data.attributes[name].data.foreach_get(key, arrays[field.name].reshape(-1))
    corners = versions.corners(base.data)
    if len(corners) != 3 * len(base.data.polygons):
        raise ValueError("the base has faces that are not triangles: undo that, or bind the splats anew")
    now = versions.positions(base.data)
    rest, stretch = (np.array(data.get(name, ()), np.float32) for name in (REST, STRETCH))
    if len(rest) != now.size:  # of an earlier release, or vertices were added
        rest, stretch = now, stretch[:0]
    return Binding(
        rest.reshape(-1, 3),
        corners.reshape(-1, 3),
        **arrays,
        lift=data[LIFT],
        stretch=stretch if len(stretch) else None,
    )


def follow(objs: Iterable[Any], depsgraph: Any) -> int:
    """Moves the splats ``objs`` with their bases as evaluated in ``depsgraph``, with modifiers and
    simulations. Splats stay as they are where it does not evaluate the base. Returns how many moved; the
    property ``PROBLEM`` of the others says why not."""
    moved = 0
    for obj in objs:
        problem = "" if is_tied(obj) else "rendered images may miss how the base moves: Follow Base Now"
        try:
            moved += _move(obj, depsgraph)
        except ValueError as error:
            problem = str(error)
        if obj.get(PROBLEM) != problem:
            obj[PROBLEM] = problem
    return moved


def followers(scene: Any) -> list[Any]:
    """The objects of ``scene``, and of collections that it shows as instances, that follow a base. Linked
    ones cannot."""
    return [obj for obj in dict.fromkeys(_shown(scene.objects)) if not obj.library and base_of(obj)]


def _shown(objs: Iterable[Any], known: set[Any] | None = None) -> Iterator[Any]:
    """``objs`` and the objects of collections that they show, other than those that are ``known``."""
    known = set() if known is None else known
    for obj in objs:
        yield obj
        home = obj.instance_collection if obj.instance_type == "COLLECTION" else None
        if home is not None and home not in known:
            known.add(home)
            yield from _shown(home.all_objects, known)


def _move(obj: Any, depsgraph: Any) -> bool:
    """Whether ``depsgraph`` evaluates the base of ``obj``, whose splats were moved then."""
    if obj.data.library is not None:
        raise ValueError(f"its mesh is linked from {obj.data.library.name}: Follow Base Now makes it local")
    binding, base = _made_binding(obj), base_of(obj)
    vertices = _evaluated(base, depsgraph, {base, obj} if is_tied(obj) else {base})
    if vertices is None:
        return False
    if len(vertices) != len(binding.base_vertices):
        raise ValueError(
            f"the base has {len(binding.base_vertices):,} vertices, with its modifiers {len(vertices):,}:"
            " splats follow modifiers that move vertices, not those that add some"
        )
    if not np.isfinite(vertices).all():
        raise ValueError("the base has vertices that are not finite")
    moved = binding.posed(vertices)
    data = obj.data
    versions.set_positions(data, moved.positions())
    if meshes.NORMAL in data.attributes:
        normals = moved.normals()
        data.attributes[meshes.NORMAL].data.foreach_set("vector", normals.ravel())
        versions.set_normals(data, normals)
    far_to_near.set_centers(data)
    data.update()
    return True


def _evaluated(base: Any, depsgraph: Any, shown: set[Any]) -> np.ndarray | None:
    """(n, 3) float32 vertices of the object ``base`` as displayed, in its own frame; None where ``depsgraph``
    has not evaluated them, as it shows none of the objects ``shown``."""
    if base.mode == "EDIT":  # no evaluated mesh while it is edited
        import bmesh

        edited = bmesh.from_edit_mesh(base.data)
        return np.array([vertex.co[:] for vertex in edited.verts], np.float32).reshape(-1, 3)
    evaluated = base.evaluated_get(depsgraph)
    if not evaluated.is_evaluated:
        return None
    if evaluated.data.is_evaluated and _deforms(base, depsgraph) and not versions.shows(depsgraph, shown):
        return None  # the mesh is a mere copy of the one at rest
    mesh = evaluated.to_mesh()
    try:
        return versions.positions(mesh)
    finally:
        evaluated.to_mesh_clear()


def _deforms(base: Any, depsgraph: Any) -> bool:
    """Whether modifiers or shape keys of ``base`` act where ``depsgraph`` is for."""
    shown = "show_render" if depsgraph.mode == "RENDER" else "show_viewport"
    return base.data.shape_keys is not None or any(getattr(m, shown) for m in base.modifiers)


def after_update(scene: Any, depsgraph: Any) -> None:
    """Follows the bases whose shape has changed, a handler of ``depsgraph_update_post``. Moved splats change
    too, but are no bases."""
    changed = {update.id.original for update in depsgraph.updates if update.is_updated_geometry}
    following = followers(scene) if changed else []
    follow([t for t in following if base_of(t) in changed or base_of(t).data in changed], depsgraph)


def after_frame(scene: Any, depsgraph: Any) -> None:
    """Follows all bases, a handler of ``frame_change_post``."""
    follow(followers(scene), depsgraph)
