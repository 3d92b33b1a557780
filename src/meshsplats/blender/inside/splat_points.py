"""Splats that Blender itself imported: since 5.3, .ply, .spz and USD files become point clouds with the
attributes of splats, which it draws as they are, unlit."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.formats.splats._cloud_builder import CloudBuilder
from meshsplats.gaussians import GaussianCloud

WIDTHS = {"position": 3, "scale": 3, "rotation": 4, "radiance:base": 4}
"""Attributes of a splat: centre, standard deviations, quaternion w, x, y, z; the harmonic of degree 0 in red,
green, blue, and opacity. Blender's importers decode logits and logarithms."""
KEYS = {"FLOAT_VECTOR": "vector", "FLOAT4": "vector", "FLOAT_COLOR": "color", "QUATERNION": "value"}
"""Blender's name of the value, by the type of the attribute."""


def is_splats(obj: Any) -> bool:
    """Whether ``obj`` is a point cloud with the attributes of splats."""
    if obj is None or not hasattr(obj.data, "points"):
        return False
    found = (obj.data.attributes.get(name) for name in WIDTHS)
    return all(a is not None and a.domain == "POINT" and a.data_type in KEYS for a in found)


def cloud_of(obj: Any, depsgraph: Any) -> GaussianCloud:
    """The splats of ``obj`` with its modifiers, in its own frame, of degree 0. A mesh has one colour per
    vertex, so higher degrees are not read.

    Raises:
        FileFormatError: no splat with finite values is there.
        ValueError: the modifiers leave no point cloud of splats.
    """
    evaluated = obj.evaluated_get(depsgraph)
    if not is_splats(evaluated):
        raise ValueError(f"{obj.name}: its modifiers leave no splats")
    data = evaluated.data
    count = len(data.points)
    builder = CloudBuilder(count, 1, obj.name)
    rows = builder.next(count)
    rows.means[:] = _values(data, "position")
    np.abs(_values(data, "scale"), out=rows.scales)
    rows.quaternions[:] = _values(data, "rotation")
    base = _values(data, "radiance:base")
    rows.sh[:, 0] = base[:, :3]
    np.clip(base[:, 3], 0, 1, out=rows.opacities)
    builder.keep(rows)
    return builder.finish("3dgs", strict=False)


def _values(data: Any, name: str) -> np.ndarray:
    """(n, width) float32 values of an attribute."""
    attribute = data.attributes[name]
    flat = np.empty(WIDTHS[name] * len(attribute.data), np.float32)
    attribute.data.foreach_get(KEYS[attribute.data_type], flat)
    return flat.reshape(-1, WIDTHS[name])


def take_place(obj: Any, splats: Any, origin: np.ndarray) -> None:
    """Puts ``obj``, made from ``splats``, where they are: the same parent and transform. ``origin`` (3,) is
    its origin in their frame."""
    place = np.array(splats.matrix_world)
    place[:3, 3] += place[:3, :3] @ origin
    obj.parent = splats.parent
    obj.matrix_parent_inverse = splats.matrix_parent_inverse
    obj.matrix_world = place.T.tolist()
