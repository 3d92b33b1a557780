"""Run by test_bpy_extension: installs the extension, uses it, removes it, and writes down what happened."""

import json
import sys
from importlib.machinery import PathFinder
from pathlib import Path

package, folder = sys.argv[1], Path(sys.argv[2])


class OnlyFromTheWheel:
    """The tests' own environment has the package too: here it must come from where Blender unpacked the
    wheel."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        if name != "meshsplats":
            return None
        found = PathFinder.find_spec(name, [place for place in sys.path if place.startswith(str(folder))])
        if found is None:
            raise ModuleNotFoundError("the extension's wheel is not there", name=name)
        return found


sys.meta_path.insert(0, OnlyFromTheWheel)

import bpy  # noqa: E402

told = {}
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True)
(addon,) = [name for name in list(bpy.context.preferences.addons.keys()) if name.endswith("meshsplats")]

told["imported"] = sorted(bpy.ops.import_scene.meshsplats(filepath=str(folder / "ball.ply"), shading="lit"))
import meshsplats  # noqa: E402

told["package"] = meshsplats.__file__
thing = bpy.context.object
thing.location = (1, 2, 3)
told["triangles"] = {"default": len(thing.data.polygons)}
told["bounces"] = bpy.context.scene.cycles.transparent_max_bounces
told["materials"] = [thing.data.materials[0].name]

thing.meshsplats.max_triangles = 400
thing.meshsplats.shading = "unlit"
bpy.ops.object.meshsplats_convert_again()
told["triangles"]["fewer"] = len(thing.data.polygons)
told["materials"].append(thing.data.materials[0].name)
told["moved"] = list(thing.location)
bpy.ops.object.meshsplats_shading(shading="lit")
bpy.ops.object.meshsplats_shading(shading="unlit")
assert thing.data.materials[0].name.startswith("Splats, unlit")
bpy.ops.scene.meshsplats_set_up(shading="unlit")

directory = str(folder) + "/"
bpy.ops.import_scene.meshsplats(directory=directory, files=[{"name": "mesh.npz"}, {"name": "ball.ply"}])
assert {"mesh", "ball.001"} <= set(bpy.data.objects.keys())
try:
    bpy.ops.import_scene.meshsplats(filepath=str(folder / "broken.ply"))
    told["broken"] = "nothing was said"
except RuntimeError as error:
    told["broken"] = str(error)

scene = bpy.context.scene
scene.render.engine = "CYCLES"
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
camera.location = (1, -4, 3)
camera.rotation_euler = (1.5708, 0, 0)
scene.camera = camera
scene.world = bpy.data.worlds.new("w")
scene.world.color = (1, 1, 1)
scene.render.resolution_x = scene.render.resolution_y = 32
scene.render.filepath = str(folder / "picture.png")
bpy.ops.render.render(write_still=True)
picture = bpy.data.images.load(scene.render.filepath)
values = picture.pixels[:]
told["mean"] = sum(values[0::4]) / len(values[0::4])

bpy.ops.preferences.addon_disable(module=addon)
told["left"] = [
    name
    for group, name in [
        ("import_scene", "meshsplats"),
        ("object", "meshsplats_shading"),
        ("scene", "meshsplats_set_up"),
    ]
    if name in dir(getattr(bpy.ops, group))
]
told["left"] += [name for name in dir(bpy.types.Object) if name == "meshsplats"]
(folder / "told.json").write_text(json.dumps(told))
