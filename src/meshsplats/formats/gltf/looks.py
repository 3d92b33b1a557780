"""What colour a material of glTF shows: its base colour, or what stands in for that."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty

_SPECULAR = "KHR_materials_pbrSpecularGlossiness"
_UNLIT = "KHR_materials_unlit"


class Look(NamedTuple):
    """What a material shows."""

    factor: np.ndarray | None
    """(4,) float64 linear RGBA; None where the material names none."""
    texture: dict[str, Any]
    """Its texture as the file refers to it; empty without one."""
    alpha_mode: str
    cutoff: float
    """Of the alpha mode MASK."""
    emits: bool
    """Whether it is the light of the material's own, which vertex colours do not change."""


def look_of(document: GltfDocument, primitive: dict[str, Any]) -> Look:
    """What the material of a primitive shows: its base colour; that of KHR_materials_pbrSpecularGlossiness
    where it names no other; or, where the base colour is black, what it emits. FileFormatError for broken
    materials."""
    material: dict[str, Any] = {}
    if "material" in primitive:
        material = document.item("materials", primitive["material"], "a primitive")
    extensions = dict_or_empty(material.get("extensions"))
    pbr, names = dict_or_empty(material.get("pbrMetallicRoughness")), ("baseColorFactor", "baseColorTexture")
    if _SPECULAR in extensions and not pbr.keys() & set(names):
        pbr, names = dict_or_empty(extensions[_SPECULAR]), ("diffuseFactor", "diffuseTexture")
    factor = document.numbers(pbr[names[0]], 4, names[0]) if names[0] in pbr else None
    texture = dict_or_empty(pbr.get(names[1]))
    emits = False
    if factor is not None and not factor[:3].any() and _UNLIT not in extensions:
        light = document.numbers(material.get("emissiveFactor", [0, 0, 0]), 3, "emissiveFactor")
        if emits := bool(light.any()):
            factor, texture = np.append(light, factor[3]), dict_or_empty(material.get("emissiveTexture"))
    cutoff = float(document.numbers([material.get("alphaCutoff", 0.5)], 1, "alphaCutoff")[0])
    return Look(factor, texture, str(material.get("alphaMode", "OPAQUE")), cutoff, emits)
