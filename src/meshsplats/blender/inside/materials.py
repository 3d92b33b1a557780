"""Materials: the splat mesh's own, unlit and lit, and those of ground, mirror and glass."""

from __future__ import annotations

from typing import Any

from meshsplats.blender.inside import versions
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.meshes import COLOR, HARMONICS, NORMAL
from meshsplats.scene.spherical_harmonics import harmonic_terms

SELF_SHADOW = "Self-shadow distance"
"""Name and label of the node with the distance within which layers do not shade each other."""
BAKED = "Baked light"
"""Name and label of the node that is 1 where the splats glow with the light of ``LIGHT``, 2 where they glow
with their own colours, in linear light, and 0 where the lamps of the scene light them."""
NORMAL_AOV = "Splat normal"
"""Name of the shader AOV with the smoothed normals in the world, whose length means nothing."""
LIT = "meshsplats_lit"
"""Property of the data of splats: whether their colours are linear light and their material lit."""
LIGHT = "Light"
"""Attribute with the linear RGB of the light on a white matt surface there."""


class _Tree:
    """A node tree with nodes placed from left to right."""

    def __init__(self, owner: Any) -> None:
        self.tree = versions.node_tree(owner)

    def node(self, kind: str, x: int, y: int = 0, **settings: Any) -> Any:
        node = self.tree.nodes.new(kind)
        node.location = (x * 220, -y * 180)
        for name, value in settings.items():
            setattr(node, name, value)
        return node

    def link(self, output: Any, target: Any) -> None:
        self.tree.links.new(output, target)

    def math(self, operation: str, x: int, y: int, a: Any, b: Any) -> Any:
        """Output of a Math node; a and b are sockets or numbers."""
        node = self.node("ShaderNodeMath", x, y, operation=operation)
        for index, value in enumerate((a, b)):
            if isinstance(value, (int, float)):
                node.inputs[index].default_value = value
            else:
                self.link(value, node.inputs[index])
        return node.outputs[0]


def unlit(name: str = "Splats, unlit", *, attribute: str = COLOR, terms: int = 0) -> Any:
    """Emits the colours of ``attribute`` unchanged, composited by opacity: from any side, in mirrors and
    through glass.

    ``terms``: number of harmonics of each splat, 3, 8 or 15, which add what depends on the direction that a
    ray comes along; 0: none.
    """
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    color = tree.node("ShaderNodeAttribute", 0, 1, attribute_name=attribute)
    emission = tree.node("ShaderNodeEmission", 2, 1)
    shown = color.outputs["Color"] if not terms else _seen(tree, color.outputs["Color"], terms)
    tree.link(shown, emission.inputs["Color"])
    _translucent(tree, material, color.outputs["Alpha"], emission.outputs[0])
    return material


def stock(attribute: str, name: str = "Splats") -> Any:
    """Emits the linear colours of ``attribute``, composited by opacity, by the nodes that Blender's exporters
    know."""
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    color = tree.node("ShaderNodeVertexColor", 0, 1, layer_name=attribute)
    # A colour in place of a shader glows; the glTF exporter loses the opacity beside an Emission node.
    _translucent(tree, material, color.outputs["Alpha"], color.outputs["Color"])
    return material


def lit(
    name: str = "Splats, lit",
    *,
    self_shadow: float,
    roughness: float = 1.0,
    specular: float = 0.0,
    smooth: bool = True,
    attribute: str = COLOR,
) -> Any:
    """A diffuse, translucent surface with linear colours and opacity from ``attribute``.

    Many translucent layers form one surface, so each is shaded by the smoothed normal of that surface
    (attribute ``splat_normal``; ``smooth`` False: by the triangle's own). Rays that start on a layer ignore
    layers within ``self_shadow`` (units of the mesh), which would shade half of it at random. Shadows of
    objects farther away stay.
    """
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    color = tree.node("ShaderNodeAttribute", 0, 1, attribute_name=attribute)
    surface = tree.node("ShaderNodeBsdfDiffuse", 3, 1)
    tree.link(color.outputs["Color"], surface.inputs["Color"])
    shader = surface.outputs[0]
    if smooth:
        normal = tree.node("ShaderNodeAttribute", 0, 3, attribute_name=NORMAL)
        turned = tree.node(
            "ShaderNodeVectorTransform", 1, 3, vector_type="NORMAL", convert_from="OBJECT", convert_to="WORLD"
        )
        tree.link(normal.outputs["Vector"], turned.inputs["Vector"])
        tree.link(turned.outputs[0], surface.inputs["Normal"])
        # Cycles adds it up over the layers; its pass Normal takes the first one that is half opaque.
        weighted = tree.node("ShaderNodeVectorMath", 2, 4, operation="SCALE")
        tree.link(turned.outputs[0], weighted.inputs[0])
        tree.link(color.outputs["Alpha"], weighted.inputs["Scale"])
        shown = tree.node("ShaderNodeOutputAOV", 3, 4, aov_name=NORMAL_AOV)
        tree.link(weighted.outputs[0], shown.inputs["Color"])
        # Bump map correction darkens wherever the shading normal differs from the triangle's own.
        versions.set_if_there(material.cycles, use_bump_map_correction=False)
    if specular > 0:
        gloss = tree.node("ShaderNodeBsdfGlossy", 3, 2)
        gloss.inputs["Roughness"].default_value = roughness
        if smooth:
            tree.link(turned.outputs[0], gloss.inputs["Normal"])
        coat = tree.node("ShaderNodeMixShader", 4, 2)
        # As in the Principled shader: 0.5 means 4 % reflected head on, index of refraction 1.5.
        versions.socket(coat.inputs, "Fac", "Factor").default_value = 0.08 * specular
        tree.link(shader, coat.inputs[1])
        tree.link(gloss.outputs[0], coat.inputs[2])
        shader = coat.outputs[0]
    distance = tree.node("ShaderNodeValue", 0, 7, name=SELF_SHADOW, label=SELF_SHADOW)
    distance.outputs[0].default_value = self_shadow
    alpha = tree.math("MULTIPLY", 2, 5, color.outputs["Alpha"], _beyond(tree, distance.outputs[0]))
    baked = tree.node("ShaderNodeValue", 0, 8, name=BAKED, label=BAKED)
    baked.outputs[0].default_value = 0
    glow = _glow(tree, color.outputs["Color"], baked.outputs[0])
    both = tree.node("ShaderNodeMixShader", 4, 0)
    tree.link(baked.outputs[0], versions.socket(both.inputs, "Fac", "Factor"))
    tree.link(shader, both.inputs[1])
    tree.link(glow, both.inputs[2])
    _translucent(tree, material, alpha, both.outputs[0])
    return material


def glowing(attribute: str, name: str = "Splats, lit") -> Any:
    """For splats that Blender draws itself, which have their opacity from it: they glow with their linear
    colours of ``attribute`` times the light of ``LIGHT``."""
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    color = tree.node("ShaderNodeAttribute", 0, 1, attribute_name=attribute)
    out = tree.node("ShaderNodeOutputMaterial", 4, 0)
    baked = tree.node("ShaderNodeValue", 0, 2, name=BAKED, label=BAKED)
    baked.outputs[0].default_value = 1
    tree.link(_glow(tree, color.outputs["Color"], baked.outputs[0]), out.inputs["Surface"])
    material.cycles.emission_sampling = "NONE"
    return material


def _glow(tree: _Tree, color: Any, baked: Any) -> Any:
    """Output that glows with ``color`` times the light of ``LIGHT``, or 1 where ``baked`` is 2."""
    stored = tree.node("ShaderNodeAttribute", 0, 0, attribute_name=LIGHT)
    light = tree.node("ShaderNodeVectorMath", 1, -1, operation="MULTIPLY_ADD")
    tree.link(stored.outputs["Color"], light.inputs[0])
    tree.link(tree.math("SUBTRACT", 0, -1, 2.0, baked), light.inputs[1])
    tree.link(tree.math("SUBTRACT", 0, -2, baked, 1.0), light.inputs[2])
    product = tree.node("ShaderNodeVectorMath", 1, 0, operation="MULTIPLY")
    tree.link(color, product.inputs[0])
    tree.link(light.outputs[0], product.inputs[1])
    glow = tree.node("ShaderNodeEmission", 3, 0)
    tree.link(product.outputs[0], glow.inputs["Color"])
    return glow.outputs[0]


def _seen(tree: _Tree, color: Any, terms: int) -> Any:
    """Output with the colour of a splat in a view: ``color`` and its harmonics, at least 0."""
    coming = tree.node("ShaderNodeNewGeometry", -9, 8)
    turned = tree.node(
        "ShaderNodeVectorTransform", -8, 8, vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT"
    )
    tree.link(coming.outputs["Incoming"], turned.inputs["Vector"])  # Blender 5.3 hides one before it
    # The object's axes are those of the splats but for its rotation and one scale.
    length = tree.node("ShaderNodeVectorMath", -7, 8, operation="NORMALIZE")
    tree.link(turned.outputs[0], length.inputs[0])
    axes = tree.node("ShaderNodeSeparateXYZ", -6, 8)
    tree.link(length.outputs[0], axes.inputs[0])
    # Incoming points to the camera: the direction from it is the opposite.
    x, y, z = (tree.math("MULTIPLY", -5, 8 + i, axes.outputs[i], -1.0) for i in range(3))
    basis = [_polynomial(tree, (x, y, z), k) for k in range(1, terms + 1)]
    sums = []
    for channel, name in enumerate(HARMONICS):
        total: Any = None
        for i in range(-(-terms // 4)):
            four = tree.node("ShaderNodeAttribute", -3, 10 + 5 * channel + i, attribute_name=f"{name}_{i}")
            parts = tree.node("ShaderNodeSeparateXYZ", -2, 10 + 5 * channel + i)
            tree.link(four.outputs["Vector"], parts.inputs[0])
            values = [*parts.outputs, four.outputs["Alpha"]]
            for value, b in zip(values, basis[4 * i : 4 * i + 4], strict=False):
                product = tree.math("MULTIPLY", -1, 10 + 5 * channel + i, value, b)
                total = product if total is None else tree.math("ADD", 0, 10 + 5 * channel, total, product)
        sums.append(total)
    together = tree.node("ShaderNodeCombineXYZ", 1, 10)
    for value, target in zip(sums, together.inputs, strict=True):
        tree.link(value, target)
    added = tree.node("ShaderNodeVectorMath", 1, 2, operation="ADD")
    tree.link(color, added.inputs[0])
    tree.link(together.outputs[0], added.inputs[1])
    above = tree.node("ShaderNodeVectorMath", 2, 2, operation="MAXIMUM")
    tree.link(added.outputs[0], above.inputs[0])
    above.inputs[1].default_value = (0, 0, 0)
    return above.outputs[0]


def _polynomial(tree: _Tree, d: tuple[Any, Any, Any], k: int) -> Any:
    """Output with harmonic ``k``, from 1, of the direction with the outputs ``d``."""
    total: Any = None
    for factor, powers in harmonic_terms(k):
        product: Any = None
        for axis, power in enumerate(powers):
            for _ in range(power):
                product = d[axis] if product is None else tree.math("MULTIPLY", -4, k, product, d[axis])
        product = tree.math("MULTIPLY", -4, k, product, factor)
        total = product if total is None else tree.math("ADD", -4, k, total, product)
    return total


def _beyond(tree: _Tree, distance: Any) -> Any:
    """Output that is 1 for rays longer than ``distance``, which grows with the object; else 0."""
    path = tree.node("ShaderNodeLightPath", 0, 5)
    unit = tree.node(
        "ShaderNodeVectorTransform", -2, 7, vector_type="VECTOR", convert_from="OBJECT", convert_to="WORLD"
    )
    unit.inputs["Vector"].default_value = (3**-0.5, 3**-0.5, 3**-0.5)
    scale = tree.node("ShaderNodeVectorMath", -1, 7, operation="LENGTH")
    tree.link(unit.outputs[0], scale.inputs[0])
    scaled = tree.math("MULTIPLY", 1, 7, scale.outputs["Value"], distance)
    return tree.math("GREATER_THAN", 1, 5, path.outputs["Ray Length"], scaled)


def set_baked(material: Any, baked: bool) -> None:
    """Has the lit ``material`` show baked light, or that of the scene's lamps."""
    _set_light(material, float(baked))


def set_even(material: Any) -> None:
    """Has the lit ``material`` glow with its own colours, in linear light, whatever light there is."""
    _set_light(material, 2.0)


def shows_baked(material: Any) -> bool:
    """Whether the lit ``material`` shows baked light."""
    return _light_of(material) == 1


def shows_even(material: Any) -> bool:
    """Whether the lit ``material`` glows with its own colours."""
    return _light_of(material) == 2


def _set_light(material: Any, value: float) -> None:
    node = material.node_tree.nodes.get(BAKED) if material is not None and material.node_tree else None
    if node is not None:
        node.outputs[0].default_value = value


def _light_of(material: Any) -> float:
    """The value of the node ``BAKED``; 0 where there is none."""
    node = material.node_tree.nodes.get(BAKED) if material is not None and material.node_tree else None
    return 0.0 if node is None else node.outputs[0].default_value


def stand_in(name: str = "Stand-in", *, fine: bool = False, self_shadow: float = 0.0) -> Any:
    """The surface that takes the place of the splats for light: matt, in the linear colours of ``COLOR``.

    Light that leaves through it from below passes, so that places under it are lit like those above.
    ``fine``: splats instead, translucent and seen from both sides, which rays that start within
    ``self_shadow`` (units of the mesh) ignore.
    """
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    color = tree.node("ShaderNodeAttribute", 0, 1, attribute_name=COLOR)
    surface = tree.node("ShaderNodeBsdfDiffuse", 1, 1)
    tree.link(color.outputs["Color"], surface.inputs["Color"])
    clear = tree.node("ShaderNodeBsdfTransparent", 1, 2)
    mix = tree.node("ShaderNodeMixShader", 2, 1)
    out = tree.node("ShaderNodeOutputMaterial", 3, 1)
    if fine:
        share = tree.math("MULTIPLY", 2, 3, color.outputs["Alpha"], _beyond(tree, self_shadow))
        first, second = clear, surface
    else:
        share = tree.node("ShaderNodeNewGeometry", 0, 3).outputs["Backfacing"]
        first, second = surface, clear
    tree.link(share, versions.socket(mix.inputs, "Fac", "Factor"))
    tree.link(first.outputs[0], mix.inputs[1])
    tree.link(second.outputs[0], mix.inputs[2])
    tree.link(mix.outputs[0], out.inputs["Surface"])
    versions.set_if_there(material, use_transparent_shadow=True)
    return material


def _translucent(tree: _Tree, material: Any, alpha: Any, shader: Any) -> None:
    """Completes ``material``: ``shader`` composited over the background by ``alpha``."""
    clear = tree.node("ShaderNodeBsdfTransparent", 5, 3)
    mix = tree.node("ShaderNodeMixShader", 6, 1)
    out = tree.node("ShaderNodeOutputMaterial", 7, 1)
    tree.link(alpha, versions.socket(mix.inputs, "Fac", "Factor"))
    tree.link(clear.outputs[0], mix.inputs[1])
    tree.link(shader, mix.inputs[2])
    tree.link(mix.outputs[0], out.inputs["Surface"])
    # 'AUTO' makes every triangle a light: minutes of set-up and twice the memory for millions of them.
    material.cycles.emission_sampling = "NONE"
    # EEVEE: all layers, both sides, blended in face order.
    material.surface_render_method = "BLENDED"
    versions.set_if_there(
        material, use_transparency_overlap=True, show_transparent_back=True, use_transparent_shadow=True
    )


def plain(name: str, color: tuple[float, float, float]) -> Any:
    """A matt surface of linear ``color``."""
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    surface = tree.node("ShaderNodeBsdfDiffuse", 0)
    surface.inputs["Color"].default_value = (*color, 1)
    out = tree.node("ShaderNodeOutputMaterial", 1)
    tree.link(surface.outputs[0], out.inputs["Surface"])
    return material


def fading(name: str, color: tuple[float, float, float], inner: float, outer: float) -> Any:
    """A matt surface of linear ``color`` that fades with the distance from the object's origin: opaque up to
    ``inner``, fully transparent from ``outer`` on; scene units."""
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    position = tree.node("ShaderNodeTexCoord", 0, 2)
    away = tree.node("ShaderNodeVectorMath", 1, 2, operation="LENGTH")
    tree.link(position.outputs["Object"], away.inputs[0])
    share = tree.node("ShaderNodeMapRange", 2, 2, interpolation_type="SMOOTHSTEP")
    tree.link(away.outputs["Value"], share.inputs["Value"])
    share.inputs["From Min"].default_value = inner
    share.inputs["From Max"].default_value = outer
    surface = tree.node("ShaderNodeBsdfDiffuse", 2)
    surface.inputs["Color"].default_value = (*color, 1)
    clear = tree.node("ShaderNodeBsdfTransparent", 2, 1)
    mix = tree.node("ShaderNodeMixShader", 3)
    tree.link(share.outputs[0], versions.socket(mix.inputs, "Fac", "Factor"))
    tree.link(surface.outputs[0], mix.inputs[1])
    tree.link(clear.outputs[0], mix.inputs[2])
    out = tree.node("ShaderNodeOutputMaterial", 4)
    tree.link(mix.outputs[0], out.inputs["Surface"])
    return material


def mirror(name: str = "Mirror") -> Any:
    """A perfect mirror that reflects 95 % of the light."""
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    surface = tree.node("ShaderNodeBsdfPrincipled", 0)
    surface.inputs["Base Color"].default_value = (0.95, 0.95, 0.95, 1)
    surface.inputs["Metallic"].default_value = 1
    surface.inputs["Roughness"].default_value = 0
    out = tree.node("ShaderNodeOutputMaterial", 2)
    tree.link(surface.outputs[0], out.inputs["Surface"])
    return material


def glass(name: str = "Glass") -> Any:
    """Clear glass of refractive index 1.45, whose shadow lets light through."""
    material = bpy.data.materials.new(name)
    tree = _Tree(material)
    surface = tree.node("ShaderNodeBsdfGlass", 0)
    surface.inputs["Roughness"].default_value = 0
    surface.inputs["IOR"].default_value = 1.45
    # Light through glass is a caustic, which path tracing samples poorly: let shadow rays pass instead.
    path = tree.node("ShaderNodeLightPath", 0, 2)
    clear = tree.node("ShaderNodeBsdfTransparent", 0, 1)
    clear.inputs[0].default_value = (0.9, 0.9, 0.9, 1)
    mix = tree.node("ShaderNodeMixShader", 1)
    tree.link(path.outputs["Is Shadow Ray"], versions.socket(mix.inputs, "Fac", "Factor"))
    tree.link(surface.outputs[0], mix.inputs[1])
    tree.link(clear.outputs[0], mix.inputs[2])
    out = tree.node("ShaderNodeOutputMaterial", 2)
    tree.link(mix.outputs[0], out.inputs["Surface"])
    versions.set_if_there(material, use_raytrace_refraction=True)
    return material
