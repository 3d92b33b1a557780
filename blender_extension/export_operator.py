# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Export > Splat Mesh and Gaussian Splats, and help for Blender's own glTF exporter, which by itself
loses our colours."""

import os
import warnings

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from meshsplats.formats.splat_formats import written_suffixes

from .settings import is_splat_mesh
from .work import own_warnings, waiting

FORMATS = [
    (".glb", "glTF (.glb)", "For viewers and engines: colours in linear light, blended"),
    (".npz", "MeshSplats (.npz)", "Everything exactly, for meshsplats' own commands"),
    (".ply", "Stanford (.ply)", "Triangles with float colours and opacities, as they are shown"),
    (".usdc", "USD (.usdc)", "Colour and opacity as primvars; needs the Python module pxr"),
]
SPLAT_FORMATS = [(suffix, f"*{suffix}", "A format of splat files") for suffix in written_suffixes()]


OTHERS = (
    *(".3mf", ".abc", ".blend", ".dae", ".fbx", ".glb", ".gltf", ".npz", ".obj", ".ply", ".stl", ".x3d"),
    *(".usd", ".usda", ".usdc", ".usdz", ".xyz", ".ksplat", ".sog", ".splat", ".spz"),
    *(".exr", ".jpeg", ".jpg", ".png", ".webp", ".txt", ".zip"),
)
"""Endings of files that a name may ask for; any other end, as in room.final, is part of the name."""


def other_suffix(path):
    """The ending of ``path`` if it is one of ``OTHERS``, else ''."""
    suffix = os.path.splitext(path)[1]
    return suffix if suffix.lower() in OTHERS else ""


class Export(ExportHelper):
    """Mix-in for operators that export splat meshes: ``save`` writes some objects and instances of others,
    and says what it wrote. The name's suffix and ``format``, chosen in the dialog, follow each other."""

    _shown = None
    """The format that the dialog showed last."""

    use_selection: BoolProperty(
        name="Selected Only", description="Otherwise all visible splat meshes", default=False
    )

    @classmethod
    def suffix_of(cls, path):
        """The longest of the formats' suffixes that ``path`` ends with, or ''."""
        return max((s for s in cls.suffixes if path.lower().endswith(s)), key=len, default="")

    def invoke(self, context, event):
        self._shown = self.format
        return super().invoke(context, event)

    def check(self, context):
        before = (self.filepath, self.format)
        suffix = self.suffix_of(self.filepath)
        if not suffix and other_suffix(self.filepath):
            pass  # ``execute`` says so
        elif suffix and self.format == self._shown:  # the name was typed
            self.format = suffix
        else:
            self.filepath = self.filepath[: len(self.filepath) - len(suffix)] + self.format
        self._shown = self.format
        return before != (self.filepath, self.format)

    def execute(self, context):
        from meshsplats.blender.inside import exporting

        path = self.filepath
        if not self.suffix_of(path):
            if other := other_suffix(path):
                what = f"{other} is none of the formats of this export: {', '.join(self.suffixes)}"
                self.report({"ERROR"}, what)
                return {"CANCELLED"}
            path += self.format
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        try:
            with waiting(context), own_warnings() as caught:
                objs = exporting.chosen(context.view_layer, selected=self.use_selection)
                depsgraph = context.evaluated_depsgraph_get()
                instances = exporting.instances(depsgraph, selected=self.use_selection)
                written = self.save(objs, instances, path)
        except (ValueError, OSError, ImportError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for warning in caught:
            self.report({"WARNING"}, str(warning.message))
        self.report({"INFO"}, f"MeshSplats: {path}, {written}")
        return {"FINISHED"}


class ExportMeshSplats(Export, bpy.types.Operator):
    """Export splat meshes with colours and opacities, where they are and as their modifiers make them"""

    bl_idname = "export_scene.meshsplats"
    bl_label = "Export Splat Mesh"
    bl_options = {"PRESET"}  # noqa: RUF012 - Blender's own form

    filename_ext = ".glb"
    suffixes = tuple(suffix for suffix, *_ in FORMATS)
    filter_glob: StringProperty(default=";".join(f"*{suffix}" for suffix, *_ in FORMATS), options={"HIDDEN"})
    format: EnumProperty(name="Format", description="Of a name without suffix", items=FORMATS)

    def save(self, objs, instances, path):
        from meshsplats.blender.inside import exporting
        from meshsplats.formats.meshes import save_mesh

        mesh = exporting.exported(objs, instances)
        save_mesh(mesh, path)
        return f"{len(objs)} objects, {len(instances)} instances, {len(mesh.faces):,} triangles"


class ExportSplats(Export, bpy.types.Operator):
    """Export splat meshes as the Gaussian splats that they were made from, with the edits since: those that
    have all their triangles"""

    bl_idname = "export_scene.meshsplats_splats"
    bl_label = "Export Splats"
    bl_options = {"PRESET"}  # noqa: RUF012 - Blender's own form

    filename_ext = ".ply"
    suffixes = tuple(suffix for suffix, *_ in SPLAT_FORMATS)
    filter_glob: StringProperty(
        default=";".join(f"*{suffix}" for suffix, *_ in SPLAT_FORMATS), options={"HIDDEN"}
    )
    format: EnumProperty(name="Format", description="Of a name without suffix", items=SPLAT_FORMATS)

    def save(self, objs, instances, path):
        from meshsplats.blender.inside import exporting
        from meshsplats.errors import DataWarning
        from meshsplats.formats.gaussians import save_gaussians

        cloud, cut = exporting.exported_splats(objs, instances)
        save_gaussians(cloud, path)
        if cut:
            left_out = f"MeshSplats: left out {cut:,} splats that lack some of their triangles"
            warnings.warn(left_out, DataWarning, stacklevel=1)
        return f"{len(cloud):,} splats"


_stock = None
"""The splat meshes of an export by Blender's exporter, which is not done yet."""


def glTF2_pre_export_callback(export_settings):
    """Gives splat meshes the names and nodes that Blender's glTF exporter knows."""
    global _stock
    _restore()
    objs = [obj for obj in bpy.context.scene.objects if is_splat_mesh(obj)]
    if objs:
        from meshsplats.blender.inside import exporting

        _stock = exporting.Stock(objs)
        # An exporter that fails does not call back. The timer runs after it, where there is a window.
        if not bpy.app.background and not bpy.app.timers.is_registered(_restore):
            bpy.app.timers.register(_restore, first_interval=0.1)


def glTF2_post_export_callback(export_settings):
    _restore()


def _restore():
    global _stock
    if _stock is not None:
        stock, _stock = _stock, None
        stock.restore()


class glTF2ExportUserExtension:
    """Leaves out what only serves images in Blender: stand-ins, points of light, the ground."""

    def gather_tree_filter_tag_hook(self, tree, export_settings):
        from meshsplats.blender.inside import exporting

        for node in tree.nodes.values():
            obj = getattr(node, "blender_object", None)
            if obj is not None and exporting.is_helper(obj):
                node.keep_tag = False


def menu(self, context):
    self.layout.operator(ExportMeshSplats.bl_idname, text="Splat Mesh (.glb, .npz, .ply, .usdc)")
    self.layout.operator(ExportSplats.bl_idname, text="Gaussian Splats (.ply, .spz, .sog, ...)")


def register():
    bpy.utils.register_class(ExportMeshSplats)
    bpy.utils.register_class(ExportSplats)
    bpy.types.TOPBAR_MT_file_export.append(menu)


def unregister():
    _restore()
    bpy.types.TOPBAR_MT_file_export.remove(menu)
    bpy.utils.unregister_class(ExportSplats)
    bpy.utils.unregister_class(ExportMeshSplats)
