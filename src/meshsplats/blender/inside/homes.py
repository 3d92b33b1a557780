"""The collections that objects are in: those of scenes and assets, those of light linking, and that of
physics, which makes a rigid body of whatever is put into it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from meshsplats.blender.inside.host import bpy

Homes = dict[Any, str]
"""Collections, with what light linking does with an object in each: INCLUDE, as in all others, or EXCLUDE."""


def of(objs: Iterable[Any]) -> dict[Any, Homes]:
    """By each of ``objs``, the collections that it is in. All are looked at once: ``users_collection`` lists
    the objects of all collections of the file for each object."""
    found: dict[Any, Homes] = {obj: {} for obj in objs}
    for home in (*bpy.data.collections, *(scene.collection for scene in bpy.data.scenes)):
        for i, obj in enumerate(home.objects):
            if obj in found:
                found[obj][home] = home.collection_objects[i].light_linking.link_state
    return found


def without_physics(places: Homes) -> Homes:
    """``places`` but for the collections by which Blender simulates rigid bodies."""
    worlds = [scene.rigidbody_world for scene in bpy.data.scenes if scene.rigidbody_world is not None]
    physics = {home for world in worlds for home in (world.collection, world.constraints)}
    return {home: state for home, state in places.items() if home not in physics}


def put(obj: Any, mine: Homes, wanted: Homes) -> None:
    """Moves ``obj`` from the collections ``mine`` to those ``wanted``."""
    for home in wanted.keys() - mine.keys():
        home.objects.link(obj)
    for home in mine.keys() - wanted.keys():
        home.objects.unlink(obj)
    for home, state in wanted.items():
        if mine.get(home, "INCLUDE") != state:
            home.collection_objects[list(home.objects).index(obj)].light_linking.link_state = state


def shown_by(layer: Any, obj: Any) -> Any:
    """The first collection by which the view layer ``layer`` has ``obj``: what is put there can be seen."""
    return _shown_by(layer.layer_collection, obj)


def _shown_by(place: Any, obj: Any) -> Any:
    if not place.exclude and obj in list(place.collection.objects):
        return place.collection
    return next((home for child in place.children if (home := _shown_by(child, obj)) is not None), None)
