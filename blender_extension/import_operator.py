# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Import > Gaussian Splats, and files dropped on the 3D view."""

import os

import bpy
from bpy.props import BoolProperty, CollectionProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from meshsplats.formats.splat_formats import folder_files, splat_suffixes

from .settings import CHOICES, SCENE_CHOICES, Choices, SceneChoice, copy_choices, draw_choices
from .work import Modal, Work, bpy_background, settle

SUFFIXES = (*splat_suffixes(), ".npz")
ENDS = tuple(dict.fromkeys(f".{suffix.rpartition('.')[2]}" for suffix in SUFFIXES))
"""Their last parts, by which Blender knows a dropped file."""
IMAGES = (".webp", ".png")
"""In the folders of unpacked SOG files, beside their meta.json."""
CHAIN = "levels.json"
"""Table of a chain of levels of detail, as ``meshsplats levels`` writes it."""


def refused(path):
    """Why ``path`` is no choice: nothing, a folder that holds no splats, or an image of a SOG. Else ''."""
    from pathlib import Path

    from meshsplats.blender.levels import is_chain
    from meshsplats.formats.splat_paths import splat_file

    place = Path(path)
    if not path:
        return "choose a file: no name was given"
    if place.is_dir() and not is_chain(place):
        try:
            splat_file(place)
        except ValueError:  # for commands, which take folders
            return f"choose a file: {place} is a folder without a model or a chain of levels of detail"
        except OSError:  # said when it is read
            return ""
    table = place.with_name("meta.json")
    if place.suffix.lower() in IMAGES and table.is_file():
        return f"{place.name} is one of the images of a SOG: choose {table.name} beside it"
    return ""


class ImportMeshSplats(Modal, Choices, SceneChoice, bpy.types.Operator, ImportHelper):
    """Import Gaussian splats as a mesh, or a mesh or levels of detail made by MeshSplats"""

    bl_idname = "import_scene.meshsplats"
    bl_label = "Import Splats"
    # Not UNDO: after its file dialog, Blender adds a step when such an operator begins, before there is
    # anything to undo, and another one when it ends.
    bl_options = {"PRESET"}  # noqa: RUF012 - Blender's own form

    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"})
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})
    filter_glob: StringProperty(
        default=";".join([*(f"*{s}" for s in SUFFIXES), CHAIN, *folder_files()]), options={"HIDDEN"}
    )
    at_origin: BoolProperty(
        name="Move to World Origin",
        description="Stand it on the centre of the grid. Otherwise it keeps the place that its file gives it,"
        " with others of the same capture, and beside earlier ones where coordinates are those of the world",
        default=False,
    )

    def invoke(self, context, event):
        if self.files and self.directory:  # dropped
            self._stand_on_grid(context)
            return context.window_manager.invoke_props_dialog(self)
        self._stand_on_grid(context)
        return ImportHelper.invoke(self, context, event)

    def _stand_on_grid(self, context):
        """The first splats of a scene stand on the centre of the grid, unless the user chose otherwise."""
        from meshsplats.blender.inside import objects

        if not self.properties.is_property_set("at_origin"):
            self.at_origin = not objects.splat_objects(context.scene)

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        draw_choices(self, layout)
        layout.use_property_split = False  # their names are longer than half of the dialog
        layout.prop(self, "at_origin")
        draw_choices(self, layout, SCENE_CHOICES)

    def execute(self, context):
        names = [file.name for file in self.files if file.name]
        # Without a file: the folder, of a model or of levels of detail.
        paths = [os.path.join(self.directory, name) for name in names] or [self.filepath or self.directory]
        refusal = refused(paths[0]) if len(paths) == 1 else ""  # Work names those of several files
        if refusal:
            self.report({"ERROR"}, refusal)
            return {"CANCELLED"}
        choices = {name: getattr(self, name) for name in (*CHOICES, "frame_view")}
        return self.begin(context, Work(paths, choices | {"fast": context.scene.meshsplats_fast}))

    def done(self, context, work):
        from meshsplats.blender.inside import objects, placing, sources

        objs = []
        for result in work.results:
            if result.screen_sizes:
                made = objects.add_chain(
                    result.prepared, result.name, result.screen_sizes, context.collection
                )
            else:
                made = [objects.add(result.prepared[0], result.name, context.collection)]
            for obj, path in zip(made, result.level_paths or (result.path,), strict=True):
                obj.meshsplats.path = path
                copy_choices(obj.meshsplats, self)
                sources.mark(obj)
            result.remember_views(made[0])
            objs.append(made[0])
        prepared = [result.prepared[0] for result in work.results]
        placing.place(context.scene, objs, prepared, centred=self.at_origin)
        settle(self, context, objs)
        if not bpy_background():
            bpy.ops.ed.undo_push(message=self.bl_label)
        count = sum(len(obj.data.polygons) for obj in objs)
        self.report({"INFO"}, f"MeshSplats: {len(objs)} imported, {count:,} triangles")


class MeshSplatsFileHandler(bpy.types.FileHandler):
    bl_idname = "IMPORT_FH_meshsplats"
    bl_label = "Gaussian Splats"
    bl_import_operator = ImportMeshSplats.bl_idname
    bl_file_extensions = ";".join([*ENDS, ".json"])

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


def menu(self, context):
    self.layout.operator(ImportMeshSplats.bl_idname, text="Gaussian Splats (.ply, .spz, .sog, ...)")


def register():
    bpy.utils.register_class(ImportMeshSplats)
    bpy.utils.register_class(MeshSplatsFileHandler)
    bpy.types.TOPBAR_MT_file_import.append(menu)


def unregister():
    bpy.types.TOPBAR_MT_file_import.remove(menu)
    bpy.utils.unregister_class(MeshSplatsFileHandler)
    bpy.utils.unregister_class(ImportMeshSplats)
