"""Splats that Blender itself imported: since 5.3, .ply, .spz and USD files become point clouds with the
attributes of splats, which it draws as they are, unlit."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.formats.splats._cloud_builder import CloudBuilder
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.spherical_harmonics import TERMS

WIDTHS = {"position": 3, "scale": 3, "rotation": 4, "radiance:base": 4}
"""Attributes of a splat: centre, standard deviations, quaternion w, x, y, z; the harmonic of degree 0 in red,
green, blue, and opacity. Blender's importers decode logits and logarithms."""
HARMONIC = "radiance:sh_{}"
"""Name of the attribute with harmonic k from 0, of degree 1 and more, in red, green, blue."""
OPACITY = "meshsplats_opacity"
"""Attribute of lit splats (``lit_points``): the opacity that they were imported with."""
COLOR = "meshsplats_color"
"""Attribute of lit splats: their linear RGB."""
KEYS = {"FLOAT_VECTOR": "vector", "FLOAT4": "vector", "FLOAT_COLOR": "color", "QUATERNION": "value"}
"""Blender's name of the value, by the type of the attribute."""


def is_splats(obj: Any) -> bool:
    """Whether ``obj`` is a point cloud with the attributes of splats."""
    if obj is None or not hasattr(obj.data, "points"):
        return False
    found = (obj.data.attributes.get(name) for name in WIDTHS)
    return all(a is not None and a.domain == "POINT" and a.data_type in KEYS for a in found)


def cloud_of(obj: Any, depsgraph: Any) -> GaussianCloud:
    """The splats of ``obj`` with its modifiers, in its own frame, as they were imported.

    Raises:
        FileFormatError: no splat with finite values is there.
        ValueError: the modifiers leave no point cloud of splats.
    """
    return usable(obj, depsgraph)[0]


def usable(obj: Any, depsgraph: Any) -> tuple[GaussianCloud, np.ndarray]:
    """``cloud_of``, and (n,) the indices of its splats among the points of ``obj`` with its modifiers."""
    evaluated = obj.evaluated_get(depsgraph)
    if not is_splats(evaluated):
        raise ValueError(f"{obj.name}: its modifiers leave no splats")
    data = evaluated.data
    count, terms = len(data.points), _terms(data)
    builder = CloudBuilder(count, 1 + terms, obj.name)
    rows = builder.next(count)
    rows.means[:] = values(data, "position")
    np.abs(values(data, "scale"), out=rows.scales)
    rows.quaternions[:] = values(data, "rotation")
    base = values(data, "radiance:base")
    rows.sh[:, 0] = base[:, :3]
    for k in range(terms):
        rows.sh[:, 1 + k] = values(data, HARMONIC.format(k))
    np.clip(imported_opacities(data), 0, 1, out=rows.opacities)
    kept = np.flatnonzero(builder.keep(rows))
    return builder.finish("3dgs", strict=False), kept


def imported_opacities(data: Any) -> np.ndarray:
    """(n,) float32 opacities that the splats ``data`` were imported with, also where they are lit. Of splats
    that were joined to lit ones, which lack the attribute of these, those that they have."""
    shown = values(data, "radiance:base")[:, 3]
    if OPACITY not in data.attributes:
        return shown
    before = np.empty(len(shown), np.float32)
    data.attributes[OPACITY].data.foreach_get("value", before)
    return np.where(before == 0, shown, before)


def _terms(data: Any) -> int:
    """Harmonics of degree 1 and more that ``data`` has: those of whole degrees, as vectors of its points."""
    found = 0
    while (a := data.attributes.get(HARMONIC.format(found))) is not None:
        if (a.domain, a.data_type) != ("POINT", "FLOAT_VECTOR"):
            break
        found += 1
    return max((terms for terms in TERMS if terms <= found), default=0)


def values(data: Any, name: str) -> np.ndarray:
    """(n, width) float32 values of an attribute of ``data``."""
    attribute = data.attributes[name]
    flat = np.empty(WIDTHS.get(name, 3) * len(attribute.data), np.float32)
    attribute.data.foreach_get(KEYS[attribute.data_type], flat)
    return flat.reshape(len(attribute.data), -1)


def take_place(obj: Any, splats: Any, origin: np.ndarray) -> None:
    """Puts ``obj``, made from ``splats``, where they are: the same parent and transform. ``origin`` (3,) is
    its origin in their frame."""
    place = np.array(splats.matrix_world)
    place[:3, 3] += place[:3, :3] @ origin
    obj.parent = splats.parent
    obj.matrix_parent_inverse = splats.matrix_parent_inverse
    obj.matrix_world = place.T.tolist()
