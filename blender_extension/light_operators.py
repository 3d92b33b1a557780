# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators for light: shading of objects, render settings, a stage with lamps and camera, baked light."""

from contextlib import contextmanager

import bpy
from bpy.props import BoolProperty, EnumProperty

from .checks import can_change, can_change_all
from .settings import is_blenders
from .work import (
    LightWork,
    Modal,
    follow_shading,
    hide_start_scene,
    own_warnings,
    report_notes,
    take_over,
    waiting,
)

SHADINGS = [("unlit", "Unlit", "Colours as they are"), ("lit", "Lit", "Light and shadow act on them")]
LINEAR = ("linear", "Linear", "Colours as they are, but in linear light, for any view transform")


DARK = 0.1
"""Brightness of a sky up to which it lights nothing: Blender starts with one of 0.05."""
MIXED = ("MIX_SHADER", "ADD_SHADER")
"""Types of nodes that put backgrounds of a sky together."""


def is_dark(scene):
    """Whether images of ``scene`` have neither a lamp nor a sky that lights anything; what glows does not
    count."""
    if _has_lamp(bpy.context.view_layer.layer_collection):
        return False
    world = scene.world
    if world is None:
        return True
    # Since 5.0, all have nodes, and asking for that warns.
    if world.node_tree is None or (bpy.app.version < (5, 0, 0) and not world.use_nodes):
        return max(world.color) <= DARK
    for node in world.node_tree.nodes:
        if node.type == "BACKGROUND":
            color, strength = node.inputs["Color"], node.inputs["Strength"]
            if color.is_linked or strength.is_linked:
                return False
            if strength.default_value * max(color.default_value[:3]) > DARK:
                return False
    # Of a group, or a texture without a background, it is not known.
    ends = {"OUTPUT_WORLD", *MIXED}
    return all(
        link.from_node.type in {"BACKGROUND", *MIXED}
        for link in world.node_tree.links
        if link.to_node.type in ends and link.to_socket.type == "SHADER"
    )


def _has_lamp(place):
    """Whether images show a lamp in ``place``, as of ``light_state.rendered``, or in instances there."""
    from meshsplats.blender.inside.light_state import rendered

    for obj in rendered(place):
        home = obj.instance_collection if obj.instance_type == "COLLECTION" else None
        if (obj.type == "LIGHT" and obj.data.energy > 0) or (home is not None and _has_lamp(home)):
            return True
    return False


class SetShading(Modal, bpy.types.Operator):
    """Change between unlit, lit and the colours of lit ones without any light; edits since the import are
    kept"""

    bl_idname = "object.meshsplats_shading"
    bl_label = "Change Shading"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    shading: EnumProperty(items=[*SHADINGS, LINEAR])

    @classmethod
    def description(cls, context, properties):
        (text,) = (text for name, _, text in (*SHADINGS, LINEAR) if name == properties.shading)
        return f"{text}. {cls.__doc__}"

    @classmethod
    def poll(cls, context):
        obj = context.object
        mesh = obj is not None and (obj.type == "MESH" or is_blenders(obj))
        return mesh and can_change(cls, [obj])

    def execute(self, context):
        from meshsplats.blender.inside import foreign, levels, lit_points, objects

        lit, self._own = self.shading != "unlit", is_blenders(context.object)
        if self._own and not lit:
            lit_points.unlight(context.object)
            return {"FINISHED"}
        try:
            chosen = levels.with_levels(context.object)
            self._changed = any(objects.is_lit(obj) != lit for obj in chosen)  # also imports of Blender's own
            meshes = {
                obj.name: objects.light_source(obj)
                if self._own or objects.LIT in obj.data
                else foreign.splat_mesh(obj)
                for obj in chosen
            }
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        fast = lit and context.scene.meshsplats_fast
        return self.begin(context, LightWork(meshes, "lit" if lit else "unlit", fast))

    def done(self, context, work):
        from meshsplats.blender.inside import baking, objects

        done, linear = take_over(self, work), self.shading == "linear"
        for obj in map(bpy.data.objects.get, done):
            if linear:
                objects.show_even(obj)
            elif objects.is_even(obj):
                baking.forget([obj])
        if self._changed and not (linear and context.scene.view_settings.view_transform != "Raw"):
            follow_shading(self, context.scene, self.shading != "unlit")
        if linear:  # right under any view transform but Raw, without light
            return
        if self._own:  # lamps alone do not light them
            bake(self, context, done, work.choices["fast"])
        if self.shading == "lit" and is_dark(context.scene):
            self.report(
                {"WARNING"}, "MeshSplats: nothing lights the splats: click Sun, Noon, Overcast or Studio"
            )


class SetUpRender(bpy.types.Operator):
    """Set bounce limits and colour management for the splat meshes of the scene"""

    bl_idname = "scene.meshsplats_set_up"
    bl_label = "Set up Render"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    shading: EnumProperty(items=SHADINGS)

    def execute(self, context):
        from meshsplats.blender.inside import bounces, notes, objects

        notes.take()  # of what scripts did before
        every, lit = objects.splat_objects(context.scene), self.shading == "lit"
        limit = objects.render_settings(context.scene, every, lit)
        report_notes(self)
        clash = objects.clash([*every, *bounces.instanced(context.scene.objects)], lit)
        if clash:
            self.report({"WARNING"}, f"MeshSplats: {clash}")
        layers = bounces.layers_of(context.scene.objects)
        if layers > limit:
            self.report(
                {"WARNING"}, f"Up to {layers} layers, and Cycles follows {limit}: beyond, pixels turn black"
            )
        return {"FINISHED"}


LIGHTS = [
    ("sun", "Sun", "An afternoon's sun and an even sky"),
    ("noon", "Noon", "The sun high in a clear sky"),
    ("overcast", "Overcast", "Clouds: no shadows with edges"),
    ("studio", "Studio", "A large lamp on the left, a weaker one on the right"),
]


class SetUpStage(Modal, bpy.types.Operator):
    """Set up light, sky, ground and a camera around the splat meshes, in place of an earlier set-up"""

    bl_idname = "scene.meshsplats_stage"
    bl_label = "Set up Light and Camera"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    lights: EnumProperty(name="Light", items=LIGHTS, default="sun")
    camera: BoolProperty(
        name="New Camera",
        description="Make the active camera one that sees all of them. Where it is not chosen, a camera of"
        " your own stays",
        default=True,
        options={"SKIP_SAVE"},
    )
    make_lit: BoolProperty(
        name="Make Lit",
        description="Give unlit splat meshes the lit material, which light acts on",
        default=True,
    )

    fast: BoolProperty(
        name="Fast",
        description="A preview: rougher light and colours, in less time",
        default=False,
    )

    @classmethod
    def poll(cls, context):
        return can_change_all(cls, context.scene)

    @classmethod
    def description(cls, context, properties):
        (light,) = (text for name, _, text in LIGHTS if name == properties.lights)
        return f"{light}. {cls.__doc__}"

    def execute(self, context):
        from meshsplats.blender.inside import objects

        wanted = {}
        try:
            for obj in objects.subjects(context.scene):
                if (not objects.is_lit(obj) and self.make_lit) or objects.needs_light(obj, fast=self.fast):
                    wanted[obj.name] = objects.light_source(obj)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self.begin(context, LightWork(wanted, "lit", self.fast))

    def done(self, context, work):
        from meshsplats.blender.inside import objects, setting

        take_over(self, work)
        hide_start_scene(self, context.scene)
        with waiting(context), telling(self):
            every = objects.subjects(context.scene)
            camera = self.camera if self.properties.is_property_set("camera") else None
            setting.set_up(context.scene, every, self.lights, camera=camera, fast=self.fast)
        if "EEVEE" in context.scene.render.engine:  # Material Preview shows no lamps of the scene
            setting.show_colors(context.window_manager.windows, "RENDERED")


@contextmanager
def telling(operator):
    """``operator`` reports what MeshSplats warns of meanwhile."""
    with own_warnings() as caught:
        yield
    for warning in caught:
        operator.report({"WARNING"}, f"MeshSplats: {warning.message}")


def bake(operator, context, names, fast):
    """Gathers the light of the scene on the lit splats with these ``names``. Returns how many of them can
    take it."""
    from meshsplats.blender.inside import baking
    from meshsplats.blender.options import CAREFUL, FAST

    objs = [obj for name in names if (obj := bpy.data.objects.get(name)) is not None]
    with waiting(context), telling(operator):
        baking.bake(context.scene, objs, samples=(FAST if fast else CAREFUL).samples)
    return sum(baking.points_of(obj) is not None for obj in objs)


class BakeLight(Modal, bpy.types.Operator):
    """Bake the light of the scene onto its lit splat meshes, which then show it without noise. Bake again
    after lamps, sky or other objects have changed"""

    bl_idname = "scene.meshsplats_bake_light"
    bl_label = "Bake Light"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    live: BoolProperty(
        name="Live",
        description="Lamps light the splats in every image, slower and with noise; baked light is dropped",
        default=False,
    )
    fast: BoolProperty(name="Fast", description="A preview: rougher light, in less time", default=False)
    only_active: BoolProperty(
        name="Only Active", description="Of the active object, not of all", default=False
    )

    @classmethod
    def poll(cls, context):
        return can_change_all(cls, context.scene)

    def execute(self, context):
        from meshsplats.blender.inside import baking, objects, stand_ins

        stand_ins.remove_strays(context.scene)
        lit = [obj for obj in objects.subjects(context.scene) if objects.is_lit(obj)]
        if self.only_active:
            lit = [obj for obj in lit if obj == context.object]
        else:  # linear ones are to keep their own colours
            lit = [obj for obj in lit if not objects.is_even(obj)]
        if not lit:
            what = "the active object is not lit" if self.only_active else "no splats are lit"
            self.report({"ERROR"}, f"{what}: choose Lit for it first")
            return {"CANCELLED"}
        if self.live:
            meshes = [obj for obj in lit if obj.type == "MESH"]
            if len(meshes) < len(lit):
                what = (
                    "splats that Blender draws take baked light alone: Convert Splats to Mesh for live light"
                )
                self.report({"WARNING"} if meshes else {"ERROR"}, what)
            baking.forget(meshes)
            return {"FINISHED"} if meshes else {"CANCELLED"}
        self._names = [obj.name for obj in lit]
        stale = [obj for obj in lit if objects.needs_light(obj, fast=self.fast)]
        try:
            sources = {obj.name: objects.light_source(obj) for obj in stale}
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self.begin(context, LightWork(sources, "lit", self.fast))

    def done(self, context, work):
        renewed = take_over(self, work)
        count = bake(self, context, self._names, self.fast)
        if renewed:
            self.report({"INFO"}, f"MeshSplats: made for their shape as it is now: {', '.join(renewed)}")
        if not count:
            self.report({"WARNING"}, "MeshSplats: nothing baked: nothing is solid, or splats follow a base")


register, unregister = bpy.utils.register_classes_factory((SetShading, SetUpRender, SetUpStage, BakeLight))
