"""Where imported splats stand: as their files have them, on the centre of the grid, or, where coordinates are
those of the world, beside what was imported before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats.blender.inside import frame, notes, objects, priors

_WORLD = "meshsplats_world"
"""Property of a scene: the point of the world, turned as ``frame.to_blender`` does it, that is at Blender's
(0, 0, 0), and the up direction of its files."""


def place(scene: Any, objs: Sequence[Any], prepared: Sequence[dict[str, Any]], *, centred: bool) -> None:
    """Moves new ``objs``, each of what was ``prepared``, from where their meshes have them to their places.

    Files of one capture keep theirs to each other, and georeferenced ones also to those of earlier imports,
    as notes say. ``centred``: the foot of the first stands on (0, 0, 0).
    """
    roots = [priors.base_of(obj) or obj for obj in objs]
    worlds = {
        i: (frame.to_blender(p["mesh"].up) @ p["mesh"].origin, p["mesh"].up.astype(np.float64))
        for i, p in enumerate(prepared)
        if p["mesh"].origin.any()
    }
    known = None if centred else _known(scene, objs)
    start, up = known or next(iter(worlds.values()), (np.zeros(3), np.zeros(3)))
    beside, askew = [], []
    for i, (world, own_up) in worlds.items():
        if not np.allclose(own_up, up, atol=1e-6):
            askew.append(objs[i].name)
            continue
        _move(roots[i], world - start)
        if known is not None:
            beside.append(objs[i].name)
    if centred:
        away = _foot(roots[0], prepared[0])
        for root in roots:
            _move(root, -away)
        start = start + away
    if worlds and _known(scene, objs) is None:
        scene[_WORLD] = [*start.tolist(), *up.tolist()]
    if beside:
        notes.add(f"placed by their coordinates beside what was imported before: {', '.join(beside)}")
    if askew:
        notes.add(f"not placed by their coordinates, as another Up in File was chosen: {', '.join(askew)}")


def _known(scene: Any, objs: Sequence[Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Point of the world and up direction of an earlier import whose splats are still in the scene, beside
    ``objs``; else None."""
    stored = np.array(scene.get(_WORLD, ()), np.float64)
    others = (obj for obj in objects.splat_objects(scene) if obj not in objs and objects.WORLD in obj.data)
    return (stored[:3], stored[3:]) if len(stored) == 6 and any(others) else None


def _move(root: Any, by: np.ndarray) -> None:
    root.location = (np.array(root.location, np.float64) + by).tolist()


def _foot(root: Any, prepared: dict[str, Any]) -> np.ndarray:
    """(3,) where the foot of the splats is that ``objects.add`` has made of ``prepared``, Blender's world.
    ``root``: their object, or that of the base that they follow."""
    rotation = frame.to_blender(prepared["mesh"].up)
    foot: np.ndarray = np.array(root.location) + rotation @ (prepared["foot"] - prepared["origin"])
    return foot
