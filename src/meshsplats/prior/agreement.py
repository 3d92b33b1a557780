"""Whether a base and the splats that it is to carry are in one frame and one unit."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from meshsplats._common.words import direction_in_words
from meshsplats.cameras.framing import scene_bounds
from meshsplats.errors import DataWarning
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.gaussians import GaussianCloud

_LARGER, _SMALLER = 5.0, 1 / 30
"""How many times as large as the splats a base may be; one may be of a small part of them."""
_APART = 2.0
"""Distance between their middles, in the sum of their radii, from which on they do not belong together."""
_TURN = 10.0
"""Degrees between their up directions that are no rounding."""
_DECLARES_UP = (".glb", ".gltf", ".usdc", ".usda", ".usd", ".usdz")


def warn_of_contradictions(base: BaseMesh, cloud: GaussianCloud, source: Path, splats: Path) -> None:
    """A DataWarning where ``base``, of the file ``source``, is of another size than ``cloud``, of ``splats``,
    far from it, or declares another direction as up; it names the factor or the turn."""
    if not len(cloud) or not len(base.vertices):
        return
    held, shown = scene_bounds(base.vertices), scene_bounds(cloud)
    ratio, said = held.radius / shown.radius, []
    away = float(np.linalg.norm(held.center - shown.center)) / (held.radius + shown.radius)
    if not _SMALLER <= ratio <= _LARGER:
        times, factor = (float(f"{x:.2g}") for x in (ratio, 1 / ratio))
        said.append(f"it is about {times:g} times as large (scale it by {factor:g})")
    elif away > _APART:
        step = ", ".join(f"{x:.3g}" for x in shown.center - held.center)
        said.append(f"it is far away from them (move it by {step})")
    if cloud.up is not None and source.suffix.lower() in _DECLARES_UP:
        up, wanted = (direction / np.linalg.norm(direction) for direction in (base.up, cloud.up))
        angle = float(np.degrees(np.arccos(np.clip(up @ wanted, -1, 1))))
        if angle > _TURN:
            names = direction_in_words(up), direction_in_words(wanted)
            said.append(f"its {names[0]} points up, theirs is {names[1]} ({_turn(up, wanted, angle)})")
    if said:
        warnings.warn(
            f"{source}: does not fit the splats of {splats}: {'; '.join(said)}. They must be in one frame and"
            " one unit, or the splats on it cannot show what those show",
            DataWarning,
            stacklevel=4,
        )


def _turn(up: np.ndarray, wanted: np.ndarray, angle: float) -> str:
    axis = np.cross(up, wanted)
    if np.linalg.norm(axis) < 1e-6:  # upside down: around any axis that is level
        axis = np.eye(3)[np.abs(up).argmin()]
    return f"turn it by {angle:.0f} degrees around {direction_in_words(axis / np.linalg.norm(axis))}"
