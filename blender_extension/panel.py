# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel in the side bar of the 3D view."""

import textwrap

import bpy

from .bounces import SetBounces, described, missing
from .cut_operator import AdjustSplats, CleanSplats, CutSplats
from .import_operator import ImportMeshSplats
from .instances import instance_warnings
from .light_operators import LINEAR, SHADINGS, BakeLight, SetShading, SetUpRender, SetUpStage
from .object_operators import ConvertAgain, ConvertSplats, FitLevel, FollowBase, ShowLevel
from .settings import LIT, draw_choices, is_blenders

CHAIN, LEVEL = "meshsplats_levels", "meshsplats_level"
"""Properties of the collections of levels of detail; ``meshsplats.blender.inside.levels`` sets them."""


BREAK_SPLATS = {"BOOLEAN", "DECIMATE", "REMESH", "SUBSURF", "MULTIRES", "SOLIDIFY", "BEVEL", "WELD"}
"""Modifiers that make other triangles."""


def shading_of(obj):
    """The shading of ``obj``, as ``SetShading`` names it; None where it has none."""
    if LIT not in obj.data:
        return "unlit" if is_blenders(obj) else None
    if not obj.data[LIT]:
        return "unlit"
    from meshsplats.blender.inside import objects

    return "linear" if objects.is_even(obj) else "lit"


def light_warning(scene, obj):
    """What is wrong with the baked light of ``obj``, or ''."""
    if shading_of(obj) != "lit" or obj.get("meshsplats_base") is not None:
        return ""
    from meshsplats.blender.inside import baking, stand_ins

    if not stand_ins.is_current(obj, counts_only=True):
        return "Baked light belongs to other splats: Bake Light again"
    if baking.is_older(scene, obj):
        return "Baked light is out of date: Bake Light again"
    return ""


def modifier_warning(obj):
    """Which modifier of the splats ``obj`` leaves no whole ones, or ''."""
    if LIT not in obj.data:
        return ""
    broken = next((m for m in obj.modifiers if m.type in BREAK_SPLATS and m.show_render), None)
    return "" if broken is None else f"{broken.name} cuts through splats and leaves strips: use Cut Splats"


def draw_warning(layout, text):
    """Shows ``text`` whole, in as many lines as the side bar's usual width takes."""
    column = layout.column(align=True)
    for i, line in enumerate(textwrap.wrap(text, 32)):
        column.label(text=line, icon="BLANK1" if i else "ERROR")


def draw_blenders(layout, scene, obj):
    """Shows what can be done with splats that Blender draws itself."""
    warning = light_warning(scene, obj)
    if warning:
        draw_warning(layout, warning)
    layout.label(text="Light of these splats")
    draw_shadings(layout, shading_of(obj))


def draw_shadings(layout, now):
    """Buttons for the shadings, of which ``now`` is that of the object, or None."""
    row = layout.row(align=True)
    for shading, text, _ in (*SHADINGS, LINEAR):
        row.operator(SetShading.bl_idname, text=text, depress=shading == now).shading = shading


class MeshSplatsPanel(bpy.types.Panel):
    bl_idname = "VIEW3D_PT_meshsplats"
    bl_label = "MeshSplats"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "MeshSplats"

    def draw(self, context):
        layout = self.layout
        layout.operator(ImportMeshSplats.bl_idname, icon="IMPORT")
        obj = context.object
        if obj is not None and obj.type == "MESH":
            self._object(layout, obj)
        if ConvertSplats.poll(context):
            layout.operator(ConvertSplats.bl_idname, icon="MESH_DATA")
        if is_blenders(obj):
            draw_blenders(layout, context.scene, obj)
        for collection in context.scene.collection.children_recursive:
            if CHAIN in collection:
                self._chain(layout, collection)
        for warning in instance_warnings(context.scene, now=False):
            draw_warning(layout, warning)
        layout.separator()
        layout.label(text="Light, ground and camera")
        layout.prop(context.scene, "meshsplats_fast")
        layout.prop(context.scene, "meshsplats_new_camera")
        row = layout.row(align=True)
        fast = context.scene.meshsplats_fast
        for lights in ("sun", "noon", "overcast", "studio"):
            button = row.operator(SetUpStage.bl_idname, text=lights.capitalize())
            button.lights, button.fast = lights, fast
            if context.scene.meshsplats_new_camera:
                button.camera = True
        row = layout.row(align=True)
        button = row.operator(BakeLight.bl_idname, text="Bake Light")
        button.live, button.fast = False, fast
        row.operator(BakeLight.bl_idname, text="Live Light").live = True
        layout.label(text="Render settings")
        limit = missing(context.scene, now=False)
        if limit:
            draw_warning(layout, described(context.scene, limit))
            layout.operator(SetBounces.bl_idname, text=f"Set Bounces to {limit}")
        row = layout.row(align=True)
        row.operator(SetUpRender.bl_idname, text="Exact").shading = "unlit"
        row.operator(SetUpRender.bl_idname, text="Lit").shading = "lit"

    def _chain(self, layout, chain):
        box = layout.box()
        box.label(text=f"{chain.name}: level in", icon="OUTLINER_COLLECTION")
        children = sorted((c for c in chain.children if LEVEL in c), key=lambda c: c[LEVEL])
        for where, text, hidden in (
            ("view", "Viewport", "hide_viewport"),
            ("render", "Render", "hide_render"),  # the side bar cuts longer labels
        ):
            row = box.row(align=True)
            row.label(text=text)
            for child in children:
                shown = not getattr(child, hidden)
                button = row.operator(ShowLevel.bl_idname, text=str(child[LEVEL]), depress=shown)
                button.chain, button.level, button.where = chain.name, child[LEVEL], where
        box.operator(FitLevel.bl_idname, icon="CAMERA_DATA").chain = chain.name

    def _object(self, layout, obj):
        if obj.meshsplats.path:
            box = layout.box()
            box.use_property_split = True
            box.prop(obj.meshsplats, "path")
            draw_choices(obj.meshsplats, box)
            box.label(text=f"{len(obj.data.polygons):,} triangles")
            box.operator(ConvertAgain.bl_idname, icon="FILE_REFRESH")
        base = obj.get("meshsplats_base")
        if base is not None:
            box = layout.box()
            box.label(text=f"Follows {base.name}", icon="MOD_MESHDEFORM")
            if obj.get("meshsplats_problem"):
                draw_warning(box, obj["meshsplats_problem"])
            box.operator(FollowBase.bl_idname, icon="FILE_REFRESH")
        if LIT in obj.data:
            row = layout.row(align=True)
            row.operator(CutSplats.bl_idname, icon="SCULPTMODE_HLT", text="Cut Splats ...")
            usual = layout.operator_context
            layout.operator_context = "EXEC_DEFAULT"  # without its dialog; all of the panel shares it
            crop = row.operator(CutSplats.bl_idname, text="Crop to Box")
            crop.action, crop.shape, crop.outside = "delete", "box", True
            layout.operator_context = usual
            row = layout.row(align=True)
            row.operator(CleanSplats.bl_idname, text="Clean")
            row.operator(AdjustSplats.bl_idname, text="Adjust Colours")
        for warning in (light_warning(bpy.context.scene, obj), modifier_warning(obj)):
            if warning:
                draw_warning(layout, warning)
        if LIT not in obj.data and not obj.data.color_attributes:
            return
        layout.label(text="Material and light of this object")
        now = shading_of(obj)
        draw_shadings(layout, now)
        if now == "lit":
            from meshsplats.blender.inside import materials

            baked = any(materials.shows_baked(material) for material in obj.data.materials)
            row = layout.row(align=True)
            for live, text in ((False, "Baked"), (True, "Live")):
                button = row.operator(BakeLight.bl_idname, text=text, depress=baked != live)
                button.live, button.only_active, button.fast = live, True, bpy.context.scene.meshsplats_fast


def register():
    bpy.utils.register_class(MeshSplatsPanel)


def unregister():
    bpy.utils.unregister_class(MeshSplatsPanel)
