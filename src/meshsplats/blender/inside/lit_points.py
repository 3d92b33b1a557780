"""Light on the splats that Blender draws itself, since 5.3.

By themselves they glow as they were captured, and their display values are blended in linear light, too
bright where layers differ. Lit, they glow with colours and opacities that are right for linear light, times
the light that was baked on the stand-in surface of a mesh made of them, which casts their shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats.blender.inside import (
    baking,
    frame,
    materials,
    scene_linear,
    splat_points,
    stand_ins,
    views,
)
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.materials import LIT
from meshsplats.blender.inside.stand_ins import ROUGH
from meshsplats.blender.options import CAREFUL, FAST
from meshsplats.blender.subject import Announce, lit_subject, views_within
from meshsplats.conversion import convert
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

_MATERIAL = "meshsplats_material"
"""Property of lit splats: the material that they had before, where they had one."""
_OPAQUE = 0.9999
"""Opacity from which an exponent on the transparency cannot be told from colours."""


def can_be_lit(obj: Any) -> bool:
    """Whether ``obj`` is a point cloud that Blender draws as splats."""
    return splat_points.is_splats(obj) and getattr(obj.data, "type", "") == "GAUSSIAN_SPLAT"


class Source:
    """The splats of an object, apart from Blender, so that another thread may prepare light for them."""

    def __init__(self, obj: Any, depsgraph: Any) -> None:
        """Raises ValueError if the splats of ``obj`` are not its own but those of its modifiers."""
        self.cloud: GaussianCloud
        self.cloud, self.points = splat_points.usable(obj, depsgraph)
        self.count = len(obj.evaluated_get(depsgraph).data.points)
        """Points of the object."""
        if self.count != len(obj.data.points):
            raise ValueError(
                f"{obj.name}: its modifiers make other splats, and light is kept with its own: apply them"
            )
        self.up = frame.up_of(obj)


def prepare(
    source: Source,
    *,
    fast: bool = False,
    within: Sequence[Camera] | None = None,
    announce: Announce = lambda phase: None,
) -> dict[str, Any]:
    """Everything that takes time and does not touch Blender. ``fast``: for a preview. ``within``: views
    within a place, which are looked for where they are None.

    Raises:
        ValueError: no splat can be seen, or nothing is solid, so that it takes no light.
    """
    cloud = source.cloud
    announce("conversion")
    mesh = convert(cloud, mode="flat", up=source.up)
    if within is None:
        announce("looking for a view")
        within = views_within(cloud, up=source.up)
    arrays, facts = lit_subject(mesh, within=within, effort=FAST if fast else CAREFUL, announce=announce)
    if "light_points" not in arrays:
        raise ValueError("nothing in these splats is solid, so they take no light: Convert Splats to Mesh")
    assert mesh.face_splat is not None
    first, rows = mesh.faces[mesh.splats.starts, 0], mesh.face_splat[mesh.splats.starts]
    points = source.points[rows]
    colors = np.ones((source.count, 4), np.float32)
    colors[source.points, :3] = srgb_to_linear(cloud.colors)
    colors[points, :3] = arrays["colors"][first, :3]
    index = np.zeros(source.count, np.int32)
    index[points] = arrays["light_point_of"][first]
    return {
        **{name: arrays[name] for name in ("faces", "colors", *stand_ins.ARRAYS)},
        **{"vertices": mesh.vertices, "light_point_of": index, "splat_colors": colors, "points": points},
        "opacities": _with_exponents(mesh, arrays["colors"], first, cloud.opacities[rows]),
        **{"views": list(within), "fast": fast, **facts},
    }


def _with_exponents(
    mesh: SplatMesh, linear: np.ndarray, first: np.ndarray, opacities: np.ndarray
) -> np.ndarray:
    """(n,) ``opacities`` (n,) of splats for linear light: with the exponents on the transparency that took
    the opacities of ``mesh`` to those of its colours ``linear`` (v, 4), at the vertices ``first`` (n,)."""
    before, after = (np.minimum(colors[first, 3], _OPAQUE) for colors in (mesh.colors, linear))
    told = (before > 0) & (before < _OPAQUE)
    exponents = np.ones(len(first))
    exponents[told] = np.log1p(-after[told].astype(np.float64)) / np.log1p(-before[told].astype(np.float64))
    return -np.expm1(exponents * np.log1p(-np.minimum(opacities, _OPAQUE).astype(np.float64)))


def light(obj: Any, prepared: dict[str, Any]) -> None:
    """Has the splats ``obj`` take light, which ``baking.bake`` then gathers; until then, it is 1 everywhere.

    Raises:
        ValueError: there are other points than ``prepared`` was made for.
    """
    data = obj.data
    if len(data.points) != len(prepared["splat_colors"]):
        raise ValueError(f"{obj.name} was edited meanwhile")
    linear = ("colors", "surface_colors", "splat_colors")
    prepared = prepared | {name: scene_linear.from_rec709(prepared[name]) for name in linear}
    unlight(obj)
    data = _own(obj)
    _store(data, splat_points.COLOR, "FLOAT_COLOR", "color", prepared["splat_colors"])
    _store(data, materials.LIGHT, "FLOAT_COLOR", "color", np.ones((len(data.points), 4), np.float32))
    opacities = splat_points.imported_opacities(data)
    _store(data, splat_points.OPACITY, "FLOAT", "value", opacities)
    opacities[prepared["points"]] = prepared["opacities"]
    _show_opacities(data, opacities)
    _take_material(data)
    data[LIT] = True
    stand_ins.add(
        obj,
        prepared,
        prepared["light_spacing"],
        self_shadow=prepared["self_shadow"],
        home=bpy.context.scene.collection,
    )
    obj[stand_ins.SHAPE] = stand_ins.shape(data)
    obj[ROUGH] = prepared["fast"]
    if prepared["views"]:
        views.remember(obj, prepared["views"])
    data.update_tag()


def unlight(obj: Any) -> None:
    """Takes the light from the splats ``obj``, if they are lit: Blender then draws them as they were
    imported. Linked duplicates keep theirs."""
    if obj.data.get(LIT):
        _restore(_own(obj))
    elif baking.POINTS not in obj:
        return
    for name in (stand_ins.SHAPE, ROUGH):
        obj.pop(name, None)
    stand_ins.remove(obj)


def _own(obj: Any) -> Any:
    """The data of ``obj``, from now on its own: its light is that of its place."""
    if obj.data.users - obj.data.use_fake_user > 1:
        obj.data = obj.data.copy()
    return obj.data


def _restore(data: Any) -> None:
    _show_opacities(data, splat_points.imported_opacities(data))
    for name in (splat_points.COLOR, materials.LIGHT, splat_points.OPACITY, baking.POINT):
        if name in data.attributes:
            data.attributes.remove(data.attributes[name])
    if data.get(_MATERIAL) is not None or len(data.materials) > 1:
        data.materials[0] = data.get(_MATERIAL)
    else:
        data.materials.clear()
    for name in (LIT, _MATERIAL):
        data.pop(name, None)
    data.update_tag()


def _take_material(data: Any) -> None:
    """Puts the lit material in the place of the first one, by which Blender draws splats."""
    if not len(data.materials):
        data.materials.append(None)
    if data.materials[0] is not None:
        data[_MATERIAL] = data.materials[0]
    data.materials[0] = materials.glowing(splat_points.COLOR)


def _show_opacities(data: Any, opacities: np.ndarray) -> None:
    base = splat_points.values(data, "radiance:base")
    base[:, 3] = opacities
    attribute = data.attributes["radiance:base"]
    attribute.data.foreach_set(splat_points.KEYS[attribute.data_type], base.ravel())


def _store(data: Any, name: str, kind: str, key: str, values: np.ndarray) -> None:
    attribute = data.attributes.get(name) or data.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(key, np.ascontiguousarray(values, np.float32).ravel())
