# SPDX-License-Identifier: GPL-3.0-or-later
"""Conversion settings, as properties of the import operator and of each imported object."""

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

LIT = "meshsplats_lit"
"""Property of the data of splat meshes; ``meshsplats.blender.inside.objects`` sets it."""


def is_splat_mesh(obj):
    """Whether the object is a splat mesh; it may be None."""
    return obj is not None and obj.type == "MESH" and LIT in obj.data


def is_blenders(obj):
    """Whether the object is splats that Blender draws itself, since 5.3; it may be None. Loads no library of
    ours: the panel asks whenever it is drawn."""
    return (
        obj is not None
        and obj.type == "POINTCLOUD"
        and getattr(obj.data, "type", "") == "GAUSSIAN_SPLAT"
        and "radiance:base" in obj.data.attributes
    )


class Choices:
    """Properties shared by the import operator and by the objects it made."""

    preset: EnumProperty(
        name="Conversion",
        description="How splats become triangles",
        items=[
            ("default", "Calibrated", "Looks like the splats: crossed ellipses, fitted falloff"),
            ("paper", "Paper", "The conversion of the MeshSplats paper: flat ellipses of 8 triangles"),
        ],
        default="default",
    )
    max_triangles: IntProperty(
        name="Max. Triangles",
        description="Merge splats that are alike until the mesh has at most this many triangles; 0: all",
        default=0,
        min=0,
        soft_max=10_000_000,
    )
    min_opacity: FloatProperty(
        name="Min. Opacity",
        description="Leave out splats fainter than this",
        default=1 / 255,
        min=0.0,
        max=1.0,
        precision=4,
    )
    axes: EnumProperty(
        name="Up in File",
        description="What points up in a splat file",
        items=[
            ("auto", "Automatic", "As the format prescribes"),
            ("y-down", "-Y", "The y axis points down, as in trained .ply files"),
            ("y-up", "Y", "The y axis points up"),
            ("z-up", "Z", "The z axis points up, as in maps and survey data"),
            ("z-down", "-Z", "The z axis points down"),
        ],
        default="auto",
    )
    shading: EnumProperty(
        name="Shading",
        description="How the mesh reacts to light",
        items=[
            ("unlit", "Unlit", "Colours unchanged: the exact image of the splats"),
            ("lit", "Lit", "Light and shadow act on the splats, by smoothed normals"),
        ],
        default="unlit",
    )


SCENE_CHOICES = ("set_up_scene", "use_cycles", "hide_start_scene", "frame_view", "show_colors")


class SceneChoice:
    """Properties of the operators that make splat meshes, for ``work.settle``."""

    set_up_scene: BoolProperty(
        name="Set up Render",
        description="Set bounce limits and colour management for these meshes. In a saved file with other"
        " objects, only the transparent bounces, unless this is ticked again",
        default=True,
    )
    use_cycles: BoolProperty(
        name="Render with Cycles",
        description="Triangles that cross are then right, too, and lit splats have shadows of every lamp."
        " EEVEE, Blender's default, is faster and draws whole splats far to near",
        default=False,
    )
    hide_start_scene: BoolProperty(
        name="Hide Start Cube and Lamp",
        description="In a file that was not saved yet: the cube would stand in the middle of the subject",
        default=True,
    )
    frame_view: BoolProperty(
        name="Frame in View",
        description="Turn the 3D views to what was imported and, in a file that was not saved yet, the camera"
        " that Blender starts with",
        default=True,
    )
    show_colors: BoolProperty(
        name="Show Colours",
        description="Switch 3D views from Solid, which is grey, to Material Preview",
        default=True,
    )


CHOICES = ("preset", "max_triangles", "min_opacity", "axes", "shading")


def draw_choices(owner, layout, names=CHOICES):
    """Shows the properties of ``owner``, an operator or an object's."""
    for name in names:
        layout.prop(owner, name)


def copy_choices(owner, other):
    """Gives ``owner`` the values of ``other``."""
    for name in CHOICES:
        setattr(owner, name, getattr(other, name))


class MeshSplatsSource(Choices, bpy.types.PropertyGroup):
    """The source of an object and how it was converted."""

    path: StringProperty(name="File", description="The file this object was made from", subtype="FILE_PATH")
    busy: BoolProperty(options={"SKIP_SAVE", "HIDDEN"})


def register():
    bpy.types.Scene.meshsplats_fast = BoolProperty(
        name="Fast Light",
        description="Prepare light for a preview: rougher, in less time",
        default=False,
    )
    bpy.types.Scene.meshsplats_new_camera = BoolProperty(
        name="New Camera",
        description="Sun to Studio make a camera that sees the splats, also where there is one of your own",
        default=False,
    )
    bpy.utils.register_class(MeshSplatsSource)
    bpy.types.Object.meshsplats = PointerProperty(type=MeshSplatsSource)


def unregister():
    del bpy.types.Object.meshsplats
    bpy.utils.unregister_class(MeshSplatsSource)
    del bpy.types.Scene.meshsplats_new_camera
    del bpy.types.Scene.meshsplats_fast
