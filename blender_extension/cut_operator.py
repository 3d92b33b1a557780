# SPDX-License-Identifier: GPL-3.0-or-later
"""Cutting splats: whole ones, by another object, by opacity and by size."""

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty

from .settings import copy_choices
from .work import waiting


class CutSplats(bpy.types.Operator):
    """Delete or separate whole splats of the active object: those in the bounds of the other selected object,
    faint ones or large ones"""

    bl_idname = "object.meshsplats_cut"
    bl_label = "Cut Splats"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    action: EnumProperty(
        name="Action",
        items=[
            ("delete", "Delete", "Remove the chosen splats"),
            ("separate", "Separate", "Move the chosen splats to an object of their own"),
        ],
    )
    shape: EnumProperty(
        name="Region",
        items=[
            ("box", "Box", "The bounds of the other selected object, turned as it is"),
            ("sphere", "Sphere", "The ellipsoid in its bounds"),
            ("all", "Everywhere", "No region"),
        ],
    )
    outside: BoolProperty(name="Outside", description="Choose what lies outside of the region", default=False)
    below_opacity: FloatProperty(
        name="Up to Opacity", description="1: of any opacity", default=1.0, min=0.0, max=1.0
    )
    above_size: FloatProperty(
        name="Size from", description="Radius of a splat; 0: of any size", default=0.0, min=0.0, unit="LENGTH"
    )

    @classmethod
    def poll(cls, context):
        obj = context.object
        return (
            obj is not None and obj.type == "MESH" and "meshsplats_lit" in obj.data and obj.mode == "OBJECT"
        )

    def invoke(self, context, event):
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context):
        from meshsplats.blender.inside import cutting

        obj, region = context.object, None
        try:
            if self.shape != "all":
                others = [other for other in context.selected_objects if other != obj]
                if len(others) != 1:
                    raise ValueError(
                        "select the object that is the region, then the splats, so that these are active;"
                        f" {len(others)} others are selected. Or choose the region Everywhere"
                    )
                region = others[0]
            with waiting(context):
                mesh, faces = cutting.chosen_splats(
                    obj,
                    region,
                    shape=self.shape,
                    outside=self.outside,
                    below_opacity=self.below_opacity,
                    above_size=self.above_size,
                )
                made = cutting.cut(
                    obj, mesh, faces, separate=self.action == "separate", collection=obj.users_collection[0]
                )
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if made is not None:
            copy_choices(made.meshsplats, obj.meshsplats)
        context.view_layer.objects.active = obj
        self.report({"INFO"}, f"MeshSplats: {faces.sum():,} triangles of {len(faces):,} were chosen")
        return {"FINISHED"}


def register():
    bpy.utils.register_class(CutSplats)


def unregister():
    bpy.utils.unregister_class(CutSplats)
