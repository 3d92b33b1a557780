# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators on objects and scenes: conversion, shading, render settings, stage, mesh priors, levels of
detail."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from .settings import CHOICES, SCENE_CHOICES, Choices, SceneChoice, copy_choices, draw_choices
from .work import (
    AgainWork,
    CloudWork,
    LightWork,
    Modal,
    follow_shading,
    own_warnings,
    settle,
    take_over,
    waiting,
)

SHADINGS = [("unlit", "Unlit", "Colours as they are"), ("lit", "Lit", "Light and shadow act on them")]


class ConvertAgain(Modal, bpy.types.Operator):
    """Convert the file of the active object again, with the settings shown. Where it was edited or joined
    with others since, its own splats are converted, so that nothing of that is lost"""

    bl_idname = "object.meshsplats_convert_again"
    bl_label = "Convert Again"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    @classmethod
    def poll(cls, context):
        obj = context.object
        return obj is not None and bool(obj.meshsplats.path) and not obj.meshsplats.busy

    def execute(self, context):
        from meshsplats.blender.inside import levels, objects, sources

        source = context.object.meshsplats
        self._active = context.object.name
        self._names, paths, own, views = [], {}, {}, {}  # by name: of the object and its chain's other levels
        self._was_lit = objects.is_lit(context.object)
        for obj in levels.with_levels(context.object):
            if not obj.meshsplats.path:
                continue
            if sources.is_as_made(obj):
                paths[obj.name] = bpy.path.abspath(obj.meshsplats.path)
            else:
                try:
                    sources.check_own(obj)
                    own[obj.name] = objects.as_splat_mesh(obj)
                except ValueError as error:
                    self.report({"ERROR"}, str(error))
                    return {"CANCELLED"}
            views[obj.name] = objects.views_within(obj)
            self._names.append(obj.name)
        for name in self._names:
            obj = bpy.data.objects[name]
            copy_choices(obj.meshsplats, source)
            obj.meshsplats.busy = not bpy.app.background
        choices = {name: getattr(source, name) for name in CHOICES} | {"fast": context.scene.meshsplats_fast}
        return self.begin(context, AgainWork(paths, own, views, choices))

    def cancelled(self):
        for name in self._names:
            obj = bpy.data.objects.get(name)
            if obj is not None:
                obj.meshsplats.busy = False

    def done(self, context, work):
        from meshsplats.blender.inside import objects, sources

        self.cancelled()
        for result in work.results:
            obj = bpy.data.objects.get(result.name)
            if obj is not None:
                objects.replace_mesh(obj, result.prepared[0])
                if result.path:
                    sources.mark(obj)
        obj = bpy.data.objects.get(self._active)
        if obj is None:
            self.report({"WARNING"}, "MeshSplats: the object is gone")
            return
        if objects.is_lit(obj) != self._was_lit:
            follow_shading(self, context.scene, not self._was_lit)
        edited = ", of its splats as they were edited or joined" if self._active in work.own else ""
        self.report({"INFO"}, f"MeshSplats: {len(obj.data.polygons):,} triangles{edited}")


class ConvertSplats(Modal, Choices, SceneChoice, bpy.types.Operator):
    """Make a mesh of splats that Blender imported itself: it takes light, casts shadows and can be edited"""

    bl_idname = "object.meshsplats_from_splats"
    bl_label = "Convert Splats to Mesh"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    hide_splats: BoolProperty(
        name="Hide Splats", description="Hide the splats, whose place the mesh takes", default=True
    )

    @classmethod
    def poll(cls, context):
        # Loads no library of ours: the panel asks whenever it is drawn.
        obj = context.object
        return obj is not None and obj.type == "POINTCLOUD" and "radiance:base" in obj.data.attributes

    def invoke(self, context, event):
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        draw_choices(self, layout, [name for name in CHOICES if name != "axes"])
        layout.use_property_split = False
        layout.prop(self, "hide_splats")
        draw_choices(self, layout, SCENE_CHOICES)

    def execute(self, context):
        from meshsplats.blender.inside import frame, splat_points

        source = context.object
        self._source = source.name
        try:
            with own_warnings() as caught:
                cloud = splat_points.cloud_of(source, context.evaluated_depsgraph_get())
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for warning in caught:
            self.report({"WARNING"}, str(warning.message))
        choices = {name: getattr(self, name) for name in CHOICES} | {"fast": context.scene.meshsplats_fast}
        return self.begin(context, CloudWork(cloud, f"{source.name} mesh", frame.up_of(source), choices))

    def done(self, context, work):
        from meshsplats.blender.inside import objects, splat_points

        (result,) = work.results
        obj = objects.add(result.prepared[0], result.name, context.collection)
        copy_choices(obj.meshsplats, self)
        source = bpy.data.objects.get(self._source)
        if source is None:
            self.report({"WARNING"}, "MeshSplats: the splats are gone, the mesh stands upright")
        else:
            splat_points.take_place(obj, source, result.prepared[0]["origin"])
            if self.hide_splats:
                source.hide_viewport = source.hide_render = True
        settle(self, context, [obj])
        self.report({"INFO"}, f"MeshSplats: {len(obj.data.polygons):,} triangles")


class SetShading(Modal, bpy.types.Operator):
    """Change between unlit and lit; edits since the import are kept"""

    bl_idname = "object.meshsplats_shading"
    bl_label = "Change Shading"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    shading: EnumProperty(items=SHADINGS)

    @classmethod
    def poll(cls, context):
        return context.object is not None and context.object.type == "MESH"

    def execute(self, context):
        from meshsplats.blender.inside import foreign, levels, objects

        try:
            chosen = levels.with_levels(context.object)
            lit = self.shading == "lit"
            self._changed = any(objects.is_lit(obj) != lit for obj in chosen)  # also imports of Blender's own
            meshes = {
                obj.name: objects.as_splat_mesh(obj) if objects.LIT in obj.data else foreign.splat_mesh(obj)
                for obj in chosen
            }
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        fast = self.shading == "lit" and context.scene.meshsplats_fast
        return self.begin(context, LightWork(meshes, self.shading, fast))

    def done(self, context, work):
        take_over(work)
        if self._changed:
            follow_shading(self, context.scene, self.shading == "lit")


class SetUpRender(bpy.types.Operator):
    """Set bounce limits and colour management for the splat meshes of the scene"""

    bl_idname = "scene.meshsplats_set_up"
    bl_label = "Set up Render"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    shading: EnumProperty(items=SHADINGS)

    def execute(self, context):
        from meshsplats.blender.inside import objects

        every = objects.splat_objects(context.scene)
        lit = self.shading == "lit"
        limit = objects.render_settings(context.scene, every, lit)
        clash = objects.clash(every, lit)
        if clash:
            self.report({"WARNING"}, f"MeshSplats: {clash}")
        layers = objects.count_layers(every)
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
    camera: BoolProperty(name="Camera", description="Add a camera that sees all of them", default=True)
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
    def description(cls, context, properties):
        (light,) = (text for name, _, text in LIGHTS if name == properties.lights)
        return f"{light}. {cls.__doc__}"

    def execute(self, context):
        from meshsplats.blender.inside import objects

        wanted = {}
        try:
            for obj in objects.splat_objects(context.scene):
                unlit = not obj.data[objects.LIT]
                if (unlit and self.make_lit) or objects.needs_light(obj, fast=self.fast):
                    wanted[obj.name] = objects.as_splat_mesh(obj)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self.begin(context, LightWork(wanted, "lit", self.fast))

    def done(self, context, work):
        from meshsplats.blender.inside import objects, setting

        take_over(work)
        setting.hide_start_scene(context.scene)
        with waiting(context):
            every = objects.splat_objects(context.scene)
            setting.set_up(context.scene, every, self.lights, camera=self.camera, fast=self.fast)
        if "EEVEE" in context.scene.render.engine:  # Material Preview shows no lamps of the scene
            setting.show_colors(context.window_manager.windows, "RENDERED")


class BakeLight(Modal, bpy.types.Operator):
    """Gather the light of the scene on its lit splat meshes, which then show it without noise. Do so again
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

    def execute(self, context):
        from meshsplats.blender.inside import baking, objects, stand_ins

        stand_ins.remove_strays(context.scene)
        lit = [obj for obj in objects.splat_objects(context.scene) if obj.data[objects.LIT]]
        if self.only_active:
            lit = [obj for obj in lit if obj == context.object]
        if not lit:
            what = "the active object is no lit splat mesh" if self.only_active else "no splat mesh is lit"
            self.report({"ERROR"}, f"{what}: choose Lit for it first")
            return {"CANCELLED"}
        if self.live:
            baking.forget(lit)
            return {"FINISHED"}
        self._names = [obj.name for obj in lit]
        stale = [obj for obj in lit if objects.needs_light(obj, fast=self.fast)]
        try:
            meshes = {obj.name: objects.as_splat_mesh(obj) for obj in stale}
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self.begin(context, LightWork(meshes, "lit", self.fast))

    def done(self, context, work):
        from meshsplats.blender.inside import baking
        from meshsplats.blender.options import CAREFUL, FAST

        renewed = take_over(work)
        lit = [obj for name in self._names if (obj := bpy.data.objects.get(name)) is not None]
        with waiting(context):
            count = baking.bake(context.scene, lit, samples=(FAST if self.fast else CAREFUL).samples)
        if renewed:
            self.report({"INFO"}, f"MeshSplats: made for their shape as it is now: {', '.join(renewed)}")
        if not count:
            self.report({"WARNING"}, "MeshSplats: no light to bake: nothing solid, or a mesh prior")


class FollowBase(bpy.types.Operator):
    """Move the splats to their base now; after edits and on each frame this happens by itself"""

    bl_idname = "object.meshsplats_follow"
    bl_label = "Follow Base Now"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    @classmethod
    def poll(cls, context):
        return context.object is not None and context.object.get("meshsplats_base") is not None

    def execute(self, context):
        from meshsplats.blender.inside import priors

        if not priors.follow([context.object], context.evaluated_depsgraph_get()):
            self.report({"ERROR"}, context.object[priors.PROBLEM])
            return {"CANCELLED"}
        return {"FINISHED"}


def find_chain(context, name):
    """The collection of the chain called ``name``; without a name, that of the active object or the only one.
    None if there is none."""
    from meshsplats.blender.inside import levels

    chains = levels.chains(context.scene)
    if name:
        return next((chain for chain in chains if chain.name == name), None)
    active = levels.chain_of(context.object)
    return active if active is not None else chains[0] if len(chains) == 1 else None


class ChainOperator:
    """Mix-in for operators on a chain of levels, which define ``chosen_level``."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    chain: StringProperty(
        name="Chain", description="Collection of the levels; that of the active object if left out"
    )
    where: EnumProperty(
        name="In",
        items=[
            ("both", "Both", "In viewports and images"),
            ("view", "View", "In viewports"),
            ("render", "Render", "In images"),
        ],
    )

    def execute(self, context):
        from meshsplats.blender.inside import levels

        chain = find_chain(context, self.chain)
        try:
            if chain is None:
                raise ValueError(f"no chain of levels of detail {self.chain}".rstrip())
            levels.show(chain, self.chosen_level(context, chain), self.where)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class ShowLevel(ChainOperator, bpy.types.Operator):
    """Show one level of detail, in the viewport and in renders, and hide the others"""

    bl_idname = "scene.meshsplats_level"
    bl_label = "Show Level"

    level: IntProperty(name="Level", description="0 is the finest", default=0, min=0)

    def chosen_level(self, context, chain):
        return self.level


class FitLevel(ChainOperator, bpy.types.Operator):
    """Show the level of detail made for the size that the active camera sees at the render resolution"""

    bl_idname = "scene.meshsplats_fit_level"
    bl_label = "Fit Level to Camera"

    def chosen_level(self, context, chain):
        from meshsplats.blender.inside import levels

        size = levels.screen_size(chain, context.scene)
        level = levels.fitting_level(chain, size)
        self.report({"INFO"}, f"MeshSplats: level {level} for {size:.0f} pixels")
        return level


CLASSES = (
    ConvertAgain,
    ConvertSplats,
    SetShading,
    SetUpRender,
    SetUpStage,
    BakeLight,
    FollowBase,
    ShowLevel,
    FitLevel,
)


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister():
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
