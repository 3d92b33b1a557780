"""What a UsdPreviewSurface gives the faces of a mesh: a colour, or a texture. For the processes that
``reader`` starts.

Schema: https://openusd.org/release/spec_usdpreviewsurface.html.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from meshsplats.errors import FileFormatError

GREY = 0.18
"""The specification's fallback for diffuseColor, linear."""
_TEXTURE, _TRANSFORM, _READER = "UsdUVTexture", "UsdTransform2d", "UsdPrimvarReader_float2"
_WRAPS = {"mirror": "mirror", "clamp": "clamp", "black": "clamp"}
"""Of a texture; others, such as useMetadata, are 'repeat'."""
_MOST_TRANSFORMS = 16
"""One behind the other; there may be a circle of them."""


class TextureUse(NamedTuple):
    """A texture, and how a material uses it."""

    file: str
    """As the stage names it; empty if it does not."""
    wrap: tuple[str, str]
    factor: tuple[float, float, float, float]
    """Linear RGBA."""
    cutoff: float | None
    """The least alpha, 0 to 1, of pixels that are opaque; others are not there. None: alpha blends."""
    raw: bool
    """Whether pixels are linear, not display values."""
    primvar: str
    """Has the texture coordinates."""
    matrix: list[list[float]]
    """(3, 3), from the values of the primvar, and 1, to texture coordinates with v up."""


class Look(NamedTuple):
    """What a material shows."""

    color: tuple[float, float, float] | None = None
    """Linear RGB; None if there is a texture, or the material names no colour."""
    opacity: float = 1.0
    """NaN: the material leaves it to the mesh."""
    texture: TextureUse | None = None


class Looks:
    """The materials that the meshes of a stage show, each looked at once."""

    def __init__(self) -> None:
        self.found: list[Look] = []
        self.warnings: list[str] = []
        self._numbers: dict[str, int] = {}

    @property
    def textured(self) -> bool:
        """Whether any has a texture."""
        return any(look.texture for look in self.found)

    def of_faces(self, shape: Any, n: int) -> np.ndarray:
        """(n,) int32 index in ``found`` of what each of the ``n`` faces of a UsdGeom.Mesh shows; -1: faces
        without a material. FileFormatError for subsets with other faces, and broken materials."""
        from pxr import Usd, UsdShade

        bindings = UsdShade.MaterialBindingAPI(shape)
        number = np.full(n, self._number(bindings), np.int32)
        for subset in bindings.GetMaterialBindSubsets():
            faces = np.array(subset.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime()) or [], np.int64)
            if len(faces) and (faces.min() < 0 or faces.max() >= n):
                raise FileFormatError(
                    f"subset {str(subset.GetPath())[-100:]}: faces {faces.min()} to {faces.max()} of {n:,}"
                )
            number[faces] = self._number(UsdShade.MaterialBindingAPI(subset))
        return number

    def colors(self, number: np.ndarray) -> tuple[np.ndarray | None, str]:
        """Linear RGBA and its interpolation, as of a primvar, of faces that show the looks ``number`` (n,);
        NaN of those without a plain colour, (None, '') where none of them has one."""
        shown = np.unique(number).tolist()
        plain = [self.found[i] if i >= 0 else Look() for i in shown]
        if all(look.color is None for look in plain):
            return None, ""
        rows = np.array(
            [4 * (math.nan,) if look.color is None else (*look.color, look.opacity) for look in plain],
            np.float32,
        )
        return (rows, "constant") if len(rows) == 1 else (rows[np.searchsorted(shown, number)], "uniform")

    def _number(self, bindings: Any) -> int:
        from pxr import UsdShade

        material, _ = bindings.ComputeBoundMaterial(UsdShade.Tokens.preview)
        if not material:
            return -1
        name = str(material.GetPath())
        if name not in self._numbers:
            self._numbers[name] = len(self.found)
            self.found.append(self._look(material))
        return self._numbers[name]

    def _look(self, material: Any) -> Look:
        surface, *_ = material.ComputeSurfaceSource()
        if not surface or surface.GetShaderId() != "UsdPreviewSurface":
            return Look()
        shown, (cutoff,) = "diffuseColor", _numbers(surface, "opacityThreshold", (0.0,))
        texture = _upstream(surface, shown, _TEXTURE)
        color = _numbers(surface, shown, (math.nan,) * 3)
        if not texture and color == (0, 0, 0):  # an unlit material: all light is its own
            shown = "emissiveColor"
            texture = _upstream(surface, shown, _TEXTURE)
            color = _numbers(surface, shown, 3 * (math.nan,) if _is_connected(surface, shown) else color)
        (opacity,) = _numbers(surface, "opacity", (1.0,))
        if cutoff > 0:
            opacity = float(opacity >= cutoff)
        if texture:
            return Look(texture=self._use(surface, texture, opacity, cutoff))
        if math.isnan(color[0]):
            return Look()
        return Look(color, math.nan if _is_connected(surface, "opacity") else opacity)

    def _use(self, surface: Any, texture: Any, opacity: float, cutoff: float) -> TextureUse:
        file = _file(texture)
        red, green, blue, alpha = _numbers(texture, "scale", (1.0,) * 4)
        if any(_numbers(texture, "bias", (0.0,) * 4)):
            self.warnings.append(f"{texture.GetPath()}: its scale and bias are not read")
            red = green = blue = alpha = 1.0
        least: float | None = 0.0
        source = _upstream(surface, "opacity", _TEXTURE, ("a",))
        if source and _file(source) == file:
            least = None if cutoff <= 0 else cutoff / alpha if alpha > 0 else math.inf
            opacity = 1.0 if cutoff > 0 else alpha
        primvar, matrix = _coordinates(texture)
        wrap = tuple(_WRAPS.get(str(_value(texture, f"wrap{axis}")), "repeat") for axis in "ST")
        raw = str(_value(texture, "sourceColorSpace")) == "raw"
        return TextureUse(
            file, (wrap[0], wrap[1]), (red, green, blue, opacity), least, raw, primvar, matrix.tolist()
        )


def _coordinates(texture: Any) -> tuple[str, np.ndarray]:
    """The primvar with the coordinates of a UsdUVTexture, and the (3, 3) matrix of the transforms between."""
    matrix, node, name = np.eye(3), texture, "st"
    for _ in range(_MOST_TRANSFORMS):
        transform = _upstream(node, name, _TRANSFORM)
        if not transform:
            break
        (degrees,) = _numbers(transform, "rotation", (0.0,))
        cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        own = np.eye(3)
        own[:2, :2] = np.array([[cos, -sin], [sin, cos]]) * _numbers(transform, "scale", (1.0, 1.0))
        own[:2, 2] = _numbers(transform, "translation", (0.0, 0.0))
        matrix, node, name = matrix @ own, transform, "in"
    reader = _upstream(node, name, _READER)
    primvar = _value(reader, "varname") if reader else None
    return str(primvar or "st"), matrix


def _file(texture: Any) -> str:
    """The image that a UsdUVTexture names; nothing looks for it, as reading the attribute's value would."""
    attribute = _producer(texture, "file")
    stack = attribute.GetPropertyStack() if attribute else []
    named = next((spec.default for spec in stack if spec.default is not None), None)
    return str(getattr(named, "path", ""))


def _producer(shader: Any, name: str) -> Any:
    """The attribute that an input takes its value from: its own, one of an interface, or the output of a
    shader; None without any."""
    from pxr import UsdShade

    given = shader.GetInput(name)
    found = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
    return found[0] if found else None


def _is_connected(shader: Any, name: str) -> bool:
    """Whether an input takes the output of a shader."""
    from pxr import UsdShade

    attribute = _producer(shader, name)
    return bool(attribute) and UsdShade.Output.IsOutput(attribute)


def _upstream(shader: Any, name: str, kind: str, outputs: tuple[str, ...] = ()) -> Any:
    """The shader of this ``kind`` whose output, one of ``outputs`` if any are named, an input takes; else
    None."""
    from pxr import UsdShade

    if not _is_connected(shader, name):
        return None
    attribute = _producer(shader, name)
    node = UsdShade.Shader(attribute.GetPrim())
    if not node or node.GetShaderId() != kind:
        return None
    return node if not outputs or UsdShade.Output(attribute).GetBaseName() in outputs else None


def _value(shader: Any, name: str) -> Any:
    """The constant that an input has; None without any."""
    from pxr import Usd

    attribute = _producer(shader, name)
    if not attribute or _is_connected(shader, name):
        return None
    return attribute.Get(Usd.TimeCode.EarliestTime())


def _numbers(shader: Any, name: str, fallback: tuple[float, ...]) -> Any:
    """The numbers that an input has, as many as ``fallback``. FileFormatError if they are others."""
    value = _value(shader, name)
    if value is None:
        return fallback
    try:
        numbers = tuple(np.asarray(value, np.float64).ravel().tolist())
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != len(fallback) or not np.isfinite(numbers).all():
        raise FileFormatError(
            f"{str(shader.GetPath())[-100:]}: {name} must be {len(fallback)} finite numbers, got"
            f" {str(value)[:60]}"
        )
    return numbers
