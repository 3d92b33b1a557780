"""How many transparent layers of splats rays pass in a scene, those of collections' instances too, and the
limit of Cycles that they need: beyond it, pixels turn black."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from meshsplats.blender.inside import levels, light_state, pacing
from meshsplats.blender.layers import bounce_limit

LAYERS = "meshsplats_layers"
"""Property of the mesh data: most layers behind each other."""


def splat_objects(scene: Any) -> list[Any]:
    """The splat meshes of ``scene``, hidden ones too."""
    return [obj for obj in scene.objects if _is_splats(obj)]


def instanced(objs: Iterable[Any]) -> list[Any]:
    """The splat meshes that those of ``objs`` show that are instances of collections."""
    homes = dict.fromkeys(filter(None, map(_instances, objs)))
    within = dict.fromkeys(obj for home in homes for obj in home.all_objects)
    return list(dict.fromkeys([*filter(_is_splats, within), *(instanced(within) if within else [])]))


def count_layers(objs: Iterable[Any]) -> int:
    """Most layers behind each other of ``objs``; of the levels of a chain, one is shown at a time."""
    most: dict[tuple[bool, str], int] = {}
    for obj in objs:
        chain = levels.chain_of(obj)
        key = (True, chain.name) if chain is not None else (False, obj.name)
        most[key] = max(most.get(key, 0), int(obj.data.get(LAYERS, 256)))
    return sum(most.values())


def layers_of(objs: Iterable[Any], known: dict[Any, int] | None = None) -> int:
    """Most layers behind each other of the splat meshes among ``objs`` and of what their instances of
    collections show, each of them. ``known``: the layers of collections, which are counted once."""
    unique, known = set(objs), {} if known is None else known
    layers = count_layers(filter(_is_splats, unique))
    for home in filter(None, map(_instances, unique)):
        if home not in known:
            known[home] = layers_of(light_state.rendered(home), known)
        layers += known[home]
    return layers


def missing(scene: Any, *, now: bool = True) -> int:
    """The limit on transparent bounces that the splats in images of ``scene`` need, where images are made by
    Cycles and it has less than there are layers; else 0. Without ``now``, layers of a large scene may have
    been counted a short while ago."""
    if scene.render.engine != "CYCLES":
        return 0
    layers = pacing.paced(("layers", scene.name), lambda: _rendered_layers(scene), now=now)
    limit = bounce_limit(layers)
    return limit if scene.cycles.transparent_max_bounces < min(layers, limit) else 0


def _rendered_layers(scene: Any) -> int:
    shown = (light_state.rendered(layer.layer_collection) for layer in scene.view_layers if layer.use)
    return max(map(layers_of, shown), default=0)


def _is_splats(obj: Any) -> bool:
    return obj.type == "MESH" and LAYERS in obj.data


def _instances(obj: Any) -> Any:
    """The collection that ``obj`` is an instance of, or None."""
    return obj.instance_collection if obj.instance_type == "COLLECTION" else None
