"""Hue, saturation, brightness, contrast and opacity of splat meshes in an open Blender file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from meshsplats.blender.inside import meshes, objects, scene_linear
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.mesh import MAX_COLOR

_LUMA = np.array([0.213, 0.715, 0.072])
_TURN_COS = np.eye(3) - _LUMA
_TURN_SIN = np.array([[-0.213, -0.715, 0.928], [0.143, 0.140, -0.283], [-0.787, 0.715, 0.072]])
_DARK = 1e-6


@dataclass(frozen=True)
class Adjustment:
    """Changes of display values, in this order; the defaults change nothing."""

    hue: float = 0.0
    """Degrees by which hues turn at their brightness."""
    saturation: float = 1.0
    """0: grey."""
    brightness: float = 1.0
    """Factor on colours."""
    contrast: float = 1.0
    """Factor on the distance from middle grey."""
    opacity: float = 1.0
    """Factor on opacities."""

    @property
    def color_map(self) -> tuple[np.ndarray, float]:
        """(3, 3) matrix and shift: display RGB c becomes ``matrix @ c + shift``. The matrices of hue and
        saturation are those of the W3C's Filter Effects (https://www.w3.org/TR/filter-effects-1/)."""
        angle = np.radians(self.hue)
        turned = _LUMA + np.cos(angle) * _TURN_COS + np.sin(angle) * _TURN_SIN
        grey = _LUMA + self.saturation * (np.eye(3) - _LUMA)
        return self.contrast * self.brightness * grey @ turned, 0.5 - 0.5 * self.contrast


def adjust(data: Any, change: Adjustment) -> None:
    """Applies ``change`` to the splat mesh ``data``, unlit or lit: colours, those that depend on the view,
    and opacities."""
    matrix, shift = change.color_map
    before = objects.unlit_colors(data)
    lit, linear = data[objects.LIT], data[objects.LINEAR]
    display = linear_to_srgb(before[:, :3]) if linear else before[:, :3]
    largest = 1 if lit or linear else MAX_COLOR
    after = before.copy()
    after[:, :3] = np.clip(display @ matrix.T.astype(np.float32) + np.float32(shift), 0, largest)
    after[:, 3] = np.clip(change.opacity * before[:, 3], 0, 1)
    light = srgb_to_linear(np.clip(after[:, :3], 0, 1))
    if not lit:
        if linear:
            after[:, :3] = light
        _store(data, meshes.COLOR, scene_linear.from_rec709(after) if linear else after)
        harmonics = meshes.read_harmonics(data)
        if harmonics is not None:
            meshes.store_harmonics(data, (harmonics @ matrix.T).astype(np.float32))
    else:
        # The factor and the exponent that fit a lit splat's colours to linear light stay.
        shown = scene_linear.to_rec709(meshes.read_colors(data, meshes.COLOR))
        old = before[:, :3] if linear else srgb_to_linear(before[:, :3])
        fitted = np.where(old > _DARK, shown[:, :3] / np.maximum(old, _DARK), 1)
        clear = np.log1p(-np.minimum(before[:, 3], np.float32(0.9999)))
        exponent = np.where(
            clear < -_DARK, np.log1p(-np.minimum(shown[:, 3], 0.9999)) / np.minimum(clear, -_DARK), 1
        )
        made = np.empty_like(shown)
        made[:, :3] = np.clip(fitted * light, 0, 1)
        opaque = -np.expm1(exponent * np.log1p(-np.minimum(after[:, 3], np.float32(0.9999))))
        made[:, 3] = np.where(after[:, 3] >= 1, 1, opaque)
        if linear:
            after[:, :3] = light
        made = scene_linear.from_rec709(made)
        for name, values in ((meshes.COLOR, made), (meshes.MADE, made), (meshes.DISPLAY, after)):
            _store(data, name, values)
    data.update()


def kept_colors(data: Any) -> dict[str, np.ndarray]:
    """All colours of the vertices of the mesh ``data`` by name, those that depend on the view, too; (v, 4)
    float32 each. ``put_back`` takes them."""
    return {name: meshes.read_colors(data, name) for name in _color_names(data)}


def put_back(data: Any, kept: dict[str, np.ndarray]) -> None:
    """Undoes what ``adjust`` has done to the mesh ``data`` since its colours were ``kept``."""
    for name in _color_names(data):
        if name in kept:
            _store(data, name, kept[name])
        else:
            data.attributes.remove(data.attributes[name])
    data.update()


def _color_names(data: Any) -> list[str]:
    return [a.name for a in data.attributes if a.data_type == "FLOAT_COLOR" and a.domain == "POINT"]


def _store(data: Any, name: str, colors: np.ndarray) -> None:
    attribute = data.attributes.get(name) or data.attributes.new(name, "FLOAT_COLOR", "POINT")
    attribute.data.foreach_set("color", np.ascontiguousarray(colors, np.float32).ravel())
