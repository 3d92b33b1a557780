# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators on objects: conversion, mesh priors, levels of detail."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from .checks import can_change, report_lost
from .settings import CHOICES, SCENE_CHOICES, Choices, SceneChoice, copy_choices, draw_choices
from .work import (
    AgainWork,
    CloudWork,
    Modal,
    follow_shading,
    own_warnings,
    settle,
)


class ConvertAgain(Modal, bpy.types.Operator):
    """Convert the file of the active object again, with the settings shown. Where it was edited or joined
    with others since, its own splats are converted, so that nothing of that is lost"""

    bl_idname = "object.meshsplats_convert_again"
    bl_label = "Convert Again"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    @classmethod
    def poll(cls, context):
        obj = context.object
        if obj is None or not obj.meshsplats.path or obj.meshsplats.busy:
            return False
        return can_change(cls, [obj])

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
                prepared = result.prepared[0]
                report_lost(self, {obj.name: objects.replace_mesh(obj, prepared)})
                if result.path:
                    sources.turn(obj, prepared["mesh"].up.astype(float), prepared["foot"])
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
        choices = {name: getattr(self, name) for name in (*CHOICES, "frame_view")}
        choices["fast"] = context.scene.meshsplats_fast
        return self.begin(context, CloudWork(cloud, f"{source.name} mesh", frame.up_of(source), choices))

    def done(self, context, work):
        from meshsplats.blender.inside import lit_points, objects, splat_points

        (result,) = work.results
        obj = objects.add(result.prepared[0], result.name, context.collection)
        copy_choices(obj.meshsplats, self)
        source = bpy.data.objects.get(self._source)
        if source is None:
            self.report({"WARNING"}, "MeshSplats: the splats are gone, the mesh stands upright")
        else:
            splat_points.take_place(obj, source, result.prepared[0]["origin"])
            context.view_layer.update()
            result.remember_views(obj)
            if self.hide_splats:
                lit_points.unlight(source)  # or its stand-in still casts a shadow
                source.hide_viewport = source.hide_render = True
        settle(self, context, [obj])
        self.report({"INFO"}, f"MeshSplats: {len(obj.data.polygons):,} triangles")


class FollowBase(bpy.types.Operator):
    """Move the splats to their base now; after edits and on each frame this happens by itself"""

    bl_idname = "object.meshsplats_follow"
    bl_label = "Follow Base Now"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    @classmethod
    def poll(cls, context):
        obj = context.object
        if obj is None or obj.get("meshsplats_base") is None:
            return False
        if obj.library:
            cls.poll_message_set("Linked splats stay as they are: Object > Library Override > Make")
        return not obj.library

    def execute(self, context):
        from meshsplats.blender.inside import priors

        obj = context.object
        priors.tie(obj)
        if not priors.follow([obj], context.evaluated_depsgraph_get()):
            self.report(
                {"ERROR"}, obj[priors.PROBLEM] or f"Blender does not evaluate {obj.name}, or its base"
            )
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


register, unregister = bpy.utils.register_classes_factory(
    (ConvertAgain, ConvertSplats, FollowBase, ShowLevel, FitLevel)
)
