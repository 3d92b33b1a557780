# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be done to objects: convert again, another shading, a material for other imports, render
settings."""

import bpy
from bpy.props import BoolProperty, EnumProperty

from .settings import CHOICES
from .work import Modal, Work

SHADINGS = [("unlit", "Unlit", "Colours as they are"), ("lit", "Lit", "Light and shadow act on them")]


class ConvertAgain(Modal, bpy.types.Operator):
    """Convert the file of the active object again, with the settings shown"""

    bl_idname = "object.meshsplats_convert_again"
    bl_label = "Convert Again"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    @classmethod
    def poll(cls, context):
        obj = context.object
        return obj is not None and bool(obj.meshsplats.path) and not obj.meshsplats.busy

    def execute(self, context):
        source = context.object.meshsplats
        self._name = context.object.name
        source.busy = not bpy.app.background
        path = bpy.path.abspath(source.path)
        return self.begin(context, Work([path], {name: getattr(source, name) for name in CHOICES}))

    def given_up(self):
        obj = bpy.data.objects.get(self._name)
        if obj is not None:
            obj.meshsplats.busy = False

    def done(self, context, work):
        from meshsplats.blender.inside import objects

        self.given_up()
        obj = bpy.data.objects.get(self._name)
        if obj is None:
            self.report({"WARNING"}, "MeshSplats: the object is gone")
            return
        objects.replace_mesh(obj, work.results[0][1])
        self.report({"INFO"}, f"MeshSplats: {len(obj.data.polygons):,} triangles")


class SetShading(bpy.types.Operator):
    """Change between unlit and lit, with what was edited since the import kept"""

    bl_idname = "object.meshsplats_shading"
    bl_label = "Change Shading"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    shading: EnumProperty(items=SHADINGS)

    @classmethod
    def poll(cls, context):
        return context.object is not None and context.object.type == "MESH"

    def execute(self, context):
        from meshsplats.blender.inside import objects

        obj = context.object
        lit = self.shading == "lit"
        try:
            if objects.LIT in obj.data:
                objects.replace_mesh(obj, objects.prepare(objects.as_splat_mesh(obj), lit))
                obj.meshsplats.shading = self.shading
            else:
                objects.dress(obj, lit)
                # One click: the colours of imports are shown right with these settings only.
                every = [o for o in context.scene.objects if o.type == "MESH" and objects.LAYERS in o.data]
                objects.render_settings(context.scene, every, lit)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class SetUpRender(bpy.types.Operator):
    """Set bounce limits and colour management for the splat meshes of the scene"""

    bl_idname = "scene.meshsplats_set_up"
    bl_label = "Set up Render"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    shading: EnumProperty(items=SHADINGS)

    def execute(self, context):
        from meshsplats.blender.inside import objects

        every = [o for o in context.scene.objects if o.type == "MESH" and objects.LAYERS in o.data]
        lit = self.shading == "lit"
        limit = objects.render_settings(context.scene, every, lit)
        clash = objects.clash(every, lit)
        if clash:
            self.report({"WARNING"}, f"MeshSplats: {clash}")
        layers = sum(int(obj.data[objects.LAYERS]) for obj in every)
        if layers > limit:
            self.report(
                {"WARNING"}, f"Up to {layers} layers, and Cycles follows {limit}: beyond, pixels turn black"
            )
        return {"FINISHED"}


class SetUpStage(bpy.types.Operator):
    """Sun, sky, ground and a camera round the splat meshes; what an earlier click made is replaced"""

    bl_idname = "scene.meshsplats_stage"
    bl_label = "Set up Light and Camera"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's own form

    lights: EnumProperty(
        name="Light",
        items=[
            ("sun", "Sun", "An afternoon's sun and an even sky"),
            ("noon", "Noon", "The sun high in a clear sky"),
            ("overcast", "Overcast", "Clouds: no shadows with edges"),
            ("studio", "Studio", "A large lamp on the left, a weaker one on the right"),
        ],
        default="sun",
    )
    camera: BoolProperty(name="Camera", description="A camera that sees all of it", default=True)
    make_lit: BoolProperty(
        name="Make Lit",
        description="Give unlit splat meshes the lit material, which light acts on",
        default=True,
    )

    def execute(self, context):
        from meshsplats.blender.inside import objects, setting

        every = [o for o in context.scene.objects if o.type == "MESH" and objects.LAYERS in o.data]
        try:
            for obj in every if self.make_lit else []:
                if not obj.data[objects.LIT]:
                    objects.replace_mesh(obj, objects.prepare(objects.as_splat_mesh(obj), True))
                    obj.meshsplats.shading = "lit"
            setting.set_up(context.scene, every, self.lights, camera=self.camera)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class FollowBase(bpy.types.Operator):
    """Move the splats to where their base is now; after edits and on each frame this happens by itself"""

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


CLASSES = (ConvertAgain, SetShading, SetUpRender, SetUpStage, FollowBase)


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister():
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
