"""Run by test_bpy_extension: installs the extension, uses it, removes it, and records what happened."""

import contextlib
import json
import os
import sys
import time
from importlib.machinery import PathFinder
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

package, folder = sys.argv[1], Path(sys.argv[2])


class OnlyFromTheWheel:
    """The tests' own environment has these packages too: here they must come from where Blender unpacked the
    wheels."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        if name not in ("meshsplats", "PIL"):
            return None
        found = PathFinder.find_spec(name, [place for place in sys.path if place.startswith(str(folder))])
        if found is None:
            raise ModuleNotFoundError(f"the extension's wheel with {name} is not there", name=name)
        return found


sys.meta_path.insert(0, OnlyFromTheWheel)

import bpy  # noqa: E402

report = {}
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True)
(addon,) = [name for name in list(bpy.context.preferences.addons.keys()) if name.endswith("meshsplats")]

bpy.context.scene.meshsplats_fast = True  # what is lit here may be rough
report["imported"] = sorted(bpy.ops.import_scene.meshsplats(filepath=str(folder / "ball.ply"), shading="lit"))
import meshsplats  # noqa: E402

report["package"] = meshsplats.__file__
obj = bpy.context.object
report["origin"] = list(obj.location)
obj.location = (1, 2, 2)  # of the foot of the ball
report["triangles"] = {"default": len(obj.data.polygons)}
report["bounces"] = bpy.context.scene.cycles.transparent_max_bounces
report["materials"] = [obj.data.materials[0].name]

obj.meshsplats.max_triangles = 400
obj.meshsplats.shading = "unlit"
bpy.ops.object.meshsplats_convert_again()
report["triangles"]["fewer"] = len(obj.data.polygons)
report["materials"].append(obj.data.materials[0].name)
report["moved"] = list(obj.location)
bpy.ops.object.meshsplats_shading(shading="lit")
bpy.ops.object.meshsplats_shading(shading="unlit")
assert obj.data.materials[0].name.startswith("Splats, unlit")
bpy.ops.scene.meshsplats_set_up(shading="unlit")

# Its images are decoded by the other wheel, Pillow.
bpy.ops.import_scene.meshsplats(filepath=str(folder / "small.sog"), max_triangles=800)
report["sog"] = len(bpy.context.object.data.polygons)
bpy.data.objects.remove(bpy.context.object)

directory = str(folder) + "/"
bpy.ops.import_scene.meshsplats(directory=directory, files=[{"name": "mesh.npz"}, {"name": "ball.ply"}])
assert {"mesh", "ball.001"} <= set(bpy.data.objects.keys())
# Blender asks these of a file that is dropped on a window, and then calls the operator as above.
handler = bpy.types.IMPORT_FH_meshsplats
report["dropped"] = {
    "operator": handler.bl_import_operator,
    "suffixes": handler.bl_file_extensions.split(";"),
    "places": [
        kind
        for kind in ("VIEW_3D", "OUTLINER", "TEXT_EDITOR")
        if handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type=kind)))
    ],
}

# Alone in the scene, a mesh for linear blending is shown encoded; beside others, a warning says so.
report["linear"] = []
hidden = [obj for obj in bpy.context.scene.objects if obj.type == "MESH"]
for other in hidden:
    bpy.context.scene.collection.objects.unlink(other)
bpy.ops.import_scene.meshsplats(filepath=str(folder / "linear.npz"))
report["linear"].append(bpy.context.scene.view_settings.view_transform)
for other in hidden:
    bpy.context.scene.collection.objects.link(other)
bpy.ops.scene.meshsplats_set_up(shading="unlit")
report["linear"].append(bpy.context.scene.view_settings.view_transform)
bpy.data.objects.remove(bpy.data.objects["linear"])
bpy.context.view_layer.objects.active = obj

try:
    bpy.ops.import_scene.meshsplats(filepath=str(folder / "broken.ply"))
    report["broken"] = "nothing was said"
except RuntimeError as error:
    report["broken"] = str(error)

# A mesh prior comes with its base, and its splats follow that.
bpy.ops.import_scene.meshsplats(filepath=str(folder / "prior.npz"))
splats = bpy.context.object
base = splats.parent
heights = [vertex.co.z for vertex in splats.data.vertices]
for vertex in base.data.vertices:
    vertex.co.z += 1
base.data.update()
bpy.context.view_layer.update()
report["followed"] = [vertex.co.z - z for vertex, z in zip(splats.data.vertices, heights, strict=True)]
report["base"] = base.name
bpy.context.view_layer.objects.active = splats
report["follow"] = sorted(bpy.ops.object.meshsplats_follow())
bpy.data.objects.remove(splats)
bpy.data.objects.remove(base)

# All splats again, for an image of the ball: it stands at (1, 2, 3) and has radius 1.
bpy.context.view_layer.objects.active = obj
obj.meshsplats.max_triangles = 0
bpy.ops.object.meshsplats_convert_again()
report["triangles"]["again"] = len(obj.data.polygons)
from meshsplats.blender.inside import stage  # noqa: E402

scene = bpy.context.scene
scene.render.engine = "CYCLES"
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
camera.location = (1, -4, 3)
camera.rotation_euler = (1.5708, 0, 0)
scene.camera = camera
stage.even_world((1, 1, 1))
scene.render.resolution_x = scene.render.resolution_y = 32
scene.render.filepath = str(folder / "image.png")
bpy.ops.render.render(write_still=True)
image = bpy.data.images.load(scene.render.filepath)
values = image.pixels[:]
row = [values[4 * (16 * 32 + column)] for column in range(32)]
report["edge"], report["middle"] = row[1], row[16]

# Named after its folder, and moved to the world's origin; then light, ground and camera in one click.
model = folder / "chair" / "point_cloud" / "iteration_7"
model.mkdir(parents=True)
(model / "point_cloud.ply").write_bytes((folder / "ball.ply").read_bytes())
bpy.ops.import_scene.meshsplats(filepath=str(model / "point_cloud.ply"), at_origin=True)
chair = bpy.context.object
report["named"] = [chair.name, list(chair.location)]
report["stage"] = sorted(bpy.ops.scene.meshsplats_stage(lights="studio", camera=True, fast=True))
bpy.ops.scene.meshsplats_stage(lights="studio", camera=True, fast=True)
report["staged"] = sorted(c.name for c in scene.collection.children)
report["camera"] = scene.camera.name
report["dressed"] = chair.data.materials[0].name.startswith("Splats, lit")
bpy.data.objects.remove(chair)

# Splats that Blender imported itself.
from _splat_points import splat_points  # noqa: E402

report["own_splats"] = None
points = splat_points(meshsplats.load_gaussians(folder / "ball.ply"), "points", scene.collection)
if points is not None:
    points.location = (7, 0, 0)
    bpy.context.view_layer.update()
    drawn = []

    def button(name, **_):
        drawn.append(name)
        return SimpleNamespace()

    # What follows the buttons of the active object is of no interest here.
    layout = SimpleNamespace(operator=button, label=lambda text: None, separator=lambda: 1 / 0)
    layout.row = lambda align: layout
    with contextlib.suppress(ZeroDivisionError):
        sys.modules[addon + ".panel"].MeshSplatsPanel.draw(SimpleNamespace(layout=layout), bpy.context)
    answer = sorted(bpy.ops.object.meshsplats_from_splats(shading="lit", max_triangles=800))
    converted = bpy.context.object
    report["own_splats"] = {
        "buttons": drawn,
        "answer": answer,
        "name": converted.name,
        "triangles": len(converted.data.polygons),
        "material": converted.data.materials[0].name,
        "middle": converted.matrix_world.translation.x,
        "hidden": [points.hide_viewport, points.hide_render, converted.hide_render],
        "poll": bpy.ops.object.meshsplats_from_splats.poll(),
    }
    bpy.data.objects.remove(converted)
    bpy.data.objects.remove(points)

# Levels of detail, from the folder and from its table dropped on the window.
chain = folder / "chain"
bpy.ops.import_scene.meshsplats(filepath=str(chain) + "/")
report["levels"] = [c.name for c in scene.collection.children if c.name.startswith("chain")]
bpy.ops.import_scene.meshsplats(directory=str(chain) + "/", files=[{"name": "levels.json"}], shading="lit")
(collection,) = [c for c in scene.collection.children if c.name == "chain.001"]
report["levels"] += [(c.name, [o.name for o in c.objects], c.hide_render) for c in collection.children]
report["level_triangles"] = [len(c.objects[0].data.polygons) for c in collection.children]
report["shown"] = []


def shown():
    """Indices of the visible levels of the second chain, and the active object."""
    bpy.context.view_layer.update()
    seen = [i for i, c in enumerate(collection.children) if c.objects[0].visible_get() and not c.hide_render]
    report["shown"].append([seen, bpy.context.object.name])


shown()
bpy.ops.scene.meshsplats_level(level=1)  # of the chain of the active object
shown()
bpy.ops.object.meshsplats_shading(shading="unlit")  # of all its levels
report["level_materials"] = [c.objects[0].data.materials[0].name[:13] for c in collection.children]
bpy.context.object.meshsplats.shading = "lit"
bpy.ops.object.meshsplats_convert_again()
report["level_materials"] += [c.objects[0].data.materials[0].name[:11] for c in collection.children]
bpy.ops.scene.meshsplats_stage(lights="sun", camera=True, fast=True)  # which just sees the ball and all else
scene.render.resolution_x = scene.render.resolution_y = 2000
bpy.ops.scene.meshsplats_fit_level(chain="chain.001")
shown()
scene.render.resolution_x = scene.render.resolution_y = 20
bpy.ops.scene.meshsplats_fit_level(chain="chain.001")
shown()
report["level_errors"] = []
for operator, arguments in [
    (bpy.ops.scene.meshsplats_level, {"chain": "chain.001", "level": 7}),
    (bpy.ops.scene.meshsplats_level, {"chain": "nothing"}),
    (bpy.ops.import_scene.meshsplats, {"filepath": str(folder / "cameras.json")}),
]:
    try:
        report["level_errors"].append(str(operator(**arguments)))
    except RuntimeError as error:
        report["level_errors"].append(str(error))


class Layout:
    """What the panel asks of Blender's layout: remembers labels and buttons."""

    def __init__(self, drawn):
        self.drawn = drawn

    def __getattr__(self, name):
        def draw(*arguments, text=None, depress=None, **_):
            if name in ("label", "operator"):
                self.drawn.append([text or arguments[0], depress])
            return Layout(self.drawn) if name in ("box", "row", "column") else SimpleNamespace()

        return draw


drawn = []
sys.modules[addon + ".panel"].MeshSplatsPanel._chain(None, Layout(drawn), collection)
report["panel"] = drawn

# As in a window, where Blender calls the operator again and again while a thread does the work.
work = sys.modules[addon + ".work"]
work.bpy_background = lambda: False


class Window:
    """What the operator asks of Blender's window."""

    def __init__(self):
        self.shown, self.handlers, self.timers, self.text = [], 0, 0, None
        self.window_manager = self.window = self.workspace = self

    def event_timer_add(self, seconds, window):
        self.timers += 1
        return self

    def event_timer_remove(self, timer):
        self.timers -= 1

    def progress_begin(self, low, high):
        self.shown.append(low)

    def progress_update(self, value):
        self.shown.append(value)

    def progress_end(self):
        self.shown.append("end")

    def modal_handler_add(self, operator):
        self.handlers += 1

    def status_text_set(self, text):
        self.text = text


class Operator(work.Modal):
    options = SimpleNamespace(is_repeat=False, is_repeat_last=False)

    def __init__(self):
        self.said, self.results, self.was_cancelled = [], None, False

    def report(self, kind, text):
        self.said.append(text)

    def done(self, context, work):
        self.results = len(work.results)

    def cancelled(self):
        self.was_cancelled = True


def event(kind):
    return SimpleNamespace(type=kind, value="PRESS")


choices = {name: getattr(obj.meshsplats, name) for name in sys.modules[addon + ".settings"].CHOICES}
choices["fast"] = True
window, operator = Window(), Operator()
answers = [operator.begin(window, work.Work([str(folder / "ball.ply")], choices))]
answers.append(operator.modal(window, event("MOUSEMOVE")))
while answers[-1] != {"FINISHED"} and len(answers) < 20_000:
    time.sleep(0.02)
    answers.append(operator.modal(window, event("TIMER")))
report["waited"] = {
    "answers": [sorted(answers[0]), sorted(answers[1]), sorted(answers[-1])],
    "progress": [value for value in window.shown if value != "end"],
    "results": operator.results,
    "timers": window.timers,
    "text": window.text,
}

window, operator = Window(), Operator()
job = work.Work([str(folder / "ball.ply")] * 50, choices)
operator.begin(window, job)
report["escape"] = {"answer": sorted(operator.modal(window, event("ESC"))), "said": operator.said}
job._thread.join(60)
report["escape"] |= {
    "alive": job._thread.is_alive(),
    "converted": len(job.results),
    "results": operator.results,
    "was_cancelled": operator.was_cancelled,
    "timers": window.timers,
}

work.bpy_background = lambda: True

# Out again: by our exporter, and by Blender's, which leaves out stand-ins and the ground.
bpy.context.view_layer.active_layer_collection = bpy.context.view_layer.layer_collection
for other in [o for o in scene.objects if o.type == "MESH"]:
    other.hide_set(True)
bpy.ops.import_scene.meshsplats(filepath=str(folder / "ball.ply"), shading="lit")
ball = bpy.context.object
bpy.ops.import_scene.meshsplats(filepath=str(folder / "mesh.npz"))
other = bpy.context.object
ball.rotation_euler, ball.location, ball.scale = (0.4, 0, 1), (3, 0, 0), (1, 1, -2)
bpy.context.view_layer.update()
for name, arguments in (("out.glb", {}), ("out.npz", {"use_selection": True}), ("out.ply", {})):
    bpy.ops.export_scene.meshsplats(filepath=str(folder / name), **arguments)
with contextlib.suppress(RuntimeError):
    bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
materials = [o.data.materials[0].name for o in (ball, other)]
bpy.ops.export_scene.gltf(filepath=str(folder / "theirs.glb"), use_visible=True)
report["exported"] = {
    "restored": [o.data.materials[0].name for o in (ball, other)] == materials,
    "colors": [[a.name for a in o.data.color_attributes if "linear" in a.name] for o in (ball, other)],
    "active": [o.data.color_attributes.active_color.name for o in (ball, other)],
    "places": [[v for row in o.matrix_world for v in row] for o in (ball, other)],
}
try:
    bpy.ops.export_scene.meshsplats(filepath=str(folder / "nowhere" / "out.glb"))
except RuntimeError as error:
    report["exported"]["error"] = str(error)
bpy.data.objects.remove(other)

# Several files at once move together; the engine is that of the user, or Cycles if asked for.
files = [{"name": "ball.ply"}, {"name": "mesh.npz"}]
report["imports"] = []
for arguments in ({}, {"at_origin": True, "use_cycles": True}):
    scene.render.engine = "BLENDER_WORKBENCH"
    before = set(bpy.data.objects)
    bpy.ops.import_scene.meshsplats(directory=directory, files=files, set_up_scene=False, **arguments)
    first, second = sorted((o for o in bpy.data.objects if o not in before), key=lambda o: o.name)
    apart = [round(b - a, 5) for a, b in zip(first.location, second.location, strict=True)]
    report["imports"].append([scene.render.engine, apart, list(first.location)])
    for obj_ in (first, second):
        bpy.data.objects.remove(obj_)

# Edits of lit splats: the panel says so, and baking makes stand-in and light points anew.
warning = sys.modules[addon + ".panel"].light_warning
sys.modules["meshsplats.blender.inside.pacing"]._LONG = float("inf")  # even on busy machines


def only(*objs):
    for selected in bpy.context.selected_objects:
        selected.select_set(False)
    for chosen in objs:
        chosen.select_set(True)
    bpy.context.view_layer.objects.active = objs[0]


ball.rotation_euler, ball.scale = (0, 0, 0), (1, 1, 1)
bpy.ops.scene.meshsplats_bake_light(fast=True)
report["light"] = {"baked": warning(scene, ball)}
lamp = next(o for o in scene.objects if o.type == "LIGHT")
lamp.data.energy *= 2
report["light"]["lamp"] = warning(scene, ball)
lamp.data.energy /= 2
only(ball)
bpy.ops.object.duplicate()
copy = bpy.context.object
report["light"]["duplicated"] = warning(scene, copy)
bpy.ops.scene.meshsplats_bake_light(fast=True)
report["light"]["own"] = [sorted(c.name for c in o.children) for o in (ball, copy)]
report["light"]["again"] = warning(scene, copy)
only(ball, copy)
bpy.ops.object.join()
report["light"]["joined"] = warning(scene, ball)
bpy.ops.scene.meshsplats_bake_light(fast=True)
report["light"]["left"] = [name for name in report["light"]["own"][1] if name in scene.objects]
report["light"]["shadows"] = ball.visible_shadow
made = [child.name for child in ball.children]
bpy.data.objects.remove(ball)
sys.modules[addon + ".following"].sweep()
report["light"]["strays"] = [len(made), [name for name in made if name in scene.objects]]

# Viewports of EEVEE: what Blender calls when it draws them, and then from a timer.
sorting = sys.modules[addon + ".sorting"]
bpy.ops.import_scene.meshsplats(filepath=str(folder / "ball.ply"))
turned, registered = bpy.context.object, []
space = SimpleNamespace(shading=SimpleNamespace(type="SOLID"))
region_data = SimpleNamespace(view_perspective="PERSP", view_matrix=None)
region = SimpleNamespace(as_pointer=lambda: 1)
sorting.bpy = SimpleNamespace(
    context=SimpleNamespace(
        scene=scene,
        region=region,
        space_data=space,
        region_data=region_data,
        view_layer=bpy.context.view_layer,
    ),
    data=bpy.data,
    app=SimpleNamespace(
        is_job_running=lambda _: False,
        timers=SimpleNamespace(
            is_registered=lambda function: function in registered,
            register=lambda function, first_interval: registered.append(function),
        ),
    ),
)


def drawn_from(direction, kind="MATERIAL"):
    """Whether a drawn viewport asks for sorting, and whether the splats then lie far to near."""
    space.shading.type, region_data.view_matrix = kind, [None, None, direction]
    registered.clear()
    sorting.before_drawing()
    asked = len(registered)
    while registered and sorting.sort() is not None:
        pass
    bpy.context.view_layer.update()
    data = turned.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    owner = {}
    for face, splat in zip(turned.data.polygons, turned.data.attributes["splat"].data, strict=True):
        owner.update((vertex, splat.value) for vertex in face.vertices)
    middles = {}
    for face in turned.data.polygons:
        middles.setdefault(owner[face.vertices[0]], []).append(face.center)
    middles = {splat: sum(found, middles[splat][0] * 0) / len(found) for splat, found in middles.items()}
    centers = [middles[owner[face.vertices[0]]] for face in data.polygons]
    heights = [sum(a * b for a, b in zip(center, direction, strict=True)) for center in centers]
    return [asked, all(a <= b + 1e-5 for a, b in pairwise(heights))]


turned.matrix_world.identity()
report["sorted"] = [
    drawn_from((0, 0, 1), "SOLID"),
    drawn_from((0, 0, 1)),
    drawn_from((0, 0, 1)),
    drawn_from((0, 0.6, 0.8)),
    drawn_from((0, 0.6, 0.8), "SOLID"),
]
sorting.bpy = bpy
bpy.data.objects.remove(turned)

bpy.ops.preferences.addon_disable(module=addon)
report["left"] = [
    name
    for group, name in [
        ("import_scene", "meshsplats"),
        ("object", "meshsplats_shading"),
        ("scene", "meshsplats_set_up"),
        ("scene", "meshsplats_stage"),
        ("scene", "meshsplats_level"),
    ]
    if name in dir(getattr(bpy.ops, group))
]
report["left"] += [name for name in dir(bpy.types) if "meshsplats" in name.lower()]
handlers = bpy.app.handlers.depsgraph_update_post[:] + bpy.app.handlers.frame_change_post[:]
handlers += bpy.app.handlers.load_post[:]
report["left"] += [h.__name__ for h in handlers if h.__module__.startswith(addon)]
report["left"] += [name for name in dir(bpy.types.Object) if name == "meshsplats"]
(folder / "report.json").write_text(json.dumps(report))
# As a module, Blender 4.2 may crash while Python ends, when nothing is left to be checked.
sys.stdout.flush()
os._exit(0)
