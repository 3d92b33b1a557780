# SPDX-License-Identifier: GPL-3.0-or-later
"""Cutting splats: whole ones, by another object, by opacity, by size and by colour, and floaters; changing
their colours."""

import math

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty

from .checks import can_edit, report_lost
from .settings import copy_choices, is_splat_mesh
from .work import waiting

DONE = {"delete": "deleted", "separate": "separated", "hide": "hid", "select": "selected"}
"""What each action of ``CutSplats`` did."""


def cut(operator, context, obj, mesh, faces, *, action="delete"):
    """As ``cutting.cut``, for the ``action`` delete, separate or hide; what showed baked light does so again,
    and ``operator`` reports what was lost."""
    from meshsplats.blender.inside import baking, cutting, homes, materials, objects

    baked = any(materials.shows_baked(material) for material in obj.data.materials)
    even = objects.is_even(obj)
    separate = action != "delete"
    home = homes.shown_by(context.view_layer, obj)
    made, lost = cutting.cut(obj, mesh, faces, separate=separate, collection=home)
    report_lost(operator, {obj.name: lost})
    parts = [obj]
    if made is not None:
        copy_choices(made.meshsplats, obj.meshsplats)
        if even:
            objects.show_even(made)
    if action == "hide":  # before light is baked: it casts no shadow
        cutting.hide(made)
    elif made is not None:
        parts.append(made)
    if baked:
        baking.bake(context.scene, parts)
    context.view_layer.objects.active = obj


class CutSplats(bpy.types.Operator):
    """Delete, separate, hide or select whole splats of the active object: those in the bounds of the other
    selected object, faint ones, large ones or those of a colour"""

    bl_idname = "object.meshsplats_cut"
    bl_label = "Cut Splats"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    action: EnumProperty(
        name="Action",
        items=[
            ("delete", "Delete", "Remove the chosen splats"),
            ("separate", "Separate", "Move the chosen splats to an object of their own"),
            ("hide", "Hide", "Move them to an object in a collection of its own, which is hidden"),
            ("select", "Select", "Go to edit mode, where they are selected"),
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
        name="Max. Opacity",
        description="Only splats of at most this opacity; 1: all",
        default=1.0,
        min=0.0,
        max=1.0,
    )
    above_size: FloatProperty(
        name="Min. Size",
        description="Only splats with at least this radius; 0: all",
        default=0.0,
        min=0.0,
        unit="LENGTH",
    )
    by_color: BoolProperty(name="By Colour", description="Only splats of a colour", default=False)
    color: FloatVectorProperty(
        name="Colour", subtype="COLOR_GAMMA", size=3, default=(1.0, 1.0, 1.0), min=0.0, max=1.0
    )
    color_distance: FloatProperty(
        name="Tolerance",
        description="Greatest difference from that colour: the distance of red, green and blue, each 0 to 1",
        default=0.15,
        min=0.0,
        max=1.75,
    )

    @classmethod
    def poll(cls, context):
        return can_edit(cls, context)

    def invoke(self, context, event):
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "action")
        layout.prop(self, "shape")
        if self.shape != "all":
            others = [other for other in context.selected_objects if other != context.object]
            if len(others) == 1:
                layout.label(text=f"Of {others[0].name}", icon="OBJECT_DATA")
            else:
                layout.label(text="Select the region's object, then the splats", icon="ERROR")
            layout.prop(self, "outside")
        layout.prop(self, "below_opacity")
        layout.prop(self, "above_size")
        layout.prop(self, "by_color")
        if self.by_color:
            layout.prop(self, "color")
            layout.prop(self, "color_distance")

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
                    color=tuple(self.color) if self.by_color else None,
                    color_distance=self.color_distance,
                )
                if self.action == "select":
                    cutting.select(obj, faces)
                else:
                    cut(self, context, obj, mesh, faces, action=self.action)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"MeshSplats: {DONE[self.action]} {faces.sum():,} of {len(faces):,} triangles")
        return {"FINISHED"}


class CleanSplats(bpy.types.Operator):
    """Delete floaters of the active object, as the command meshsplats clean does"""

    bl_idname = "object.meshsplats_clean"
    bl_label = "Clean Splats"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    sparse: FloatProperty(
        name="Min. Neighbours",
        description="Delete splats with fewer neighbours than this share of the median; 0: none",
        default=0.05,
        min=0.0,
        max=1.0,
    )
    min_part: FloatProperty(
        name="Min. Part",
        description="Delete parts that touch nothing else with less than this share of all opacity; 0: none",
        default=0.01,
        min=0.0,
        max=1.0,
    )
    max_size: FloatProperty(
        name="Max. Size",
        description="Delete splats longer than this many radii of the subject",
        default=1000,
        min=0.1,
    )

    @classmethod
    def poll(cls, context):
        return can_edit(cls, context)

    def execute(self, context):
        from meshsplats.blender.inside import cutting
        from meshsplats.conversion.cleaning_rules import CleaningRules

        obj = context.object
        # Blender's numbers have single precision, and its defaults are to be those of the rules.
        values = {name: round(getattr(self, name), 6) for name in ("sparse", "min_part", "max_size")}
        rules = CleaningRules(**{name: value or None for name, value in values.items()})
        try:
            with waiting(context):
                mesh, faces = cutting.floaters(obj, rules)
                if faces.any():
                    cut(self, context, obj, mesh, faces)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        found = f"deleted {faces.sum():,} of {len(faces):,} triangles" if faces.any() else "found no floaters"
        self.report({"INFO"}, f"MeshSplats: {found}")
        return {"FINISHED"}


_AFRESH = {"SKIP_SAVE"}
"""Options of a property that begins with its default each time."""


class AdjustSplats(bpy.types.Operator):
    """Change hue, saturation, brightness, contrast and opacity of the selected splat meshes"""

    bl_idname = "object.meshsplats_adjust"
    bl_label = "Adjust Colours"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    hue: FloatProperty(name="Hue", default=0.0, min=-math.pi, max=math.pi, subtype="ANGLE", options=_AFRESH)
    saturation: FloatProperty(name="Saturation", default=1.0, min=0.0, soft_max=2.0, max=4.0, options=_AFRESH)
    brightness: FloatProperty(name="Brightness", default=1.0, min=0.0, soft_max=2.0, max=4.0, options=_AFRESH)
    contrast: FloatProperty(name="Contrast", default=1.0, min=0.0, soft_max=2.0, max=4.0, options=_AFRESH)
    opacity: FloatProperty(name="Opacity", default=1.0, min=0.0, soft_max=2.0, max=4.0, options=_AFRESH)

    @classmethod
    def poll(cls, context):
        return can_edit(cls, context)

    def invoke(self, context, event):  # by themselves, its defaults change nothing
        from meshsplats.blender.inside import adjusting

        every = {obj.data for obj in self._every(context)}
        self._kept = [(data, adjusting.kept_colors(data)) for data in every]
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        for name in ("hue", "saturation", "brightness", "contrast", "opacity"):
            # As a mere number, a hue would turn by a degree in 200 pixels.
            layout.prop(self, name, slider=True)

    def check(self, context):
        """Called by Blender's dialog after each move of a slider: shows the colours at once. Only OK is a
        step that can be undone."""
        self._put_back()
        self._adjust(context)
        return False

    def cancel(self, context):
        self._put_back()

    def execute(self, context):
        from meshsplats.blender.inside import stand_ins

        self._put_back()
        with waiting(context):
            self._adjust(context)
        for obj in self._every(context):
            if stand_ins.SHAPE in obj:  # light bounces off the old colours
                obj[stand_ins.SHAPE] = ""
        return {"FINISHED"}

    def _every(self, context):
        """The selected splat meshes and the active one, with all levels of their chains."""
        from meshsplats.blender.inside import levels

        chosen = {context.object, *(obj for obj in context.selected_objects if is_splat_mesh(obj))}
        return {level for obj in chosen for level in levels.with_levels(obj)}

    def _adjust(self, context):
        from meshsplats.blender.inside import adjusting

        values = {name: getattr(self, name) for name in ("saturation", "brightness", "contrast", "opacity")}
        change = adjusting.Adjustment(hue=math.degrees(self.hue), **values)
        for data in {obj.data for obj in self._every(context)}:
            adjusting.adjust(data, change)

    def _put_back(self):
        """Takes back what the dialog has shown."""
        from meshsplats.blender.inside import adjusting

        for data, kept in getattr(self, "_kept", ()):
            adjusting.put_back(data, kept)


register, unregister = bpy.utils.register_classes_factory((CutSplats, CleanSplats, AdjustSplats))
