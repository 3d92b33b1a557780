"""Splat objects as rigid bodies: a ball made of splats knocks over a vase made of splats.

blender-env/bin/python examples/blender/falling.py [--width 320] [--samples 24] [--splats 20000]

Each object of the demo scene becomes a mesh of its own; the hull of its solid splats collides, and the splats
follow. Blender's rigid bodies move them, and shadows move along. Writes example-output/falling.png (four
moments) and falling.blend, to play in Blender. Needs Blender's module bpy (docs/blender.md).
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

import meshsplats as ms
from meshsplats.blender import LightOptions, SceneOptions, draw
from meshsplats.demo_scene import SHARES, make_scene

arguments = argparse.ArgumentParser()
arguments.add_argument("--width", type=int, default=320)
arguments.add_argument("--samples", type=int, default=24)
arguments.add_argument("--splats", type=int, default=20_000)
asked = arguments.parse_args()
out = Path("example-output")
out.mkdir(exist_ok=True)

cloud = make_scene(asked.splats)
mesh = ms.convert(cloud, mode="flat")

# The splats of the still life are stored part by part.
size = {name: int(share * len(cloud)) for name, share in SHARES.items()}
order = [("vase", size["vase"]), ("ball", size["ball"])]
order += [("orange", size["orange"]), ("orange.001", size["orange"])]
order += [("flowers", size["leaves"] + size["flowers"])]
ends = np.cumsum([count for _, count in order])
part_of_splat = np.searchsorted(ends, np.arange(len(cloud)), side="right")
part_of_splat[part_of_splat == 4] = 0  # the flowers stand in the vase and fall with it
part_of_face = part_of_splat[mesh.face_splat]
table = mesh.take(part_of_face == 5)

# The table with ground, sun, sky and camera is a .blend of its own; the bodies are added to it.
width, height = asked.width, asked.width * 5 // 6
camera = ms.orbit(mesh, 1, elevation=16, azimuth=15, width=width, height=height, distance=1.15)[0]
light = LightOptions(sun=(-60, 38), sun_strength=3.0)
options = SceneOptions(light=light, samples=asked.samples, denoise=True)
draw(table, [camera], blend=out / "falling.blend", options=options)

import bpy  # noqa: E402 - from here on, Blender's own Python
import mathutils  # noqa: E402

from meshsplats.blender.inside import objects  # noqa: E402

bpy.ops.wm.open_mainfile(filepath=str((out / "falling.blend").resolve()))
scene = bpy.context.scene
bpy.ops.rigidbody.world_add()
scene.rigidbody_world.substeps_per_frame = 20
scene.frame_start, scene.frame_end = 1, 60
scene.rigidbody_world.point_cache.frame_end = scene.frame_end
home = bpy.data.collections.new("Bodies")
scene.collection.children.link(home)


def make_body(obj, kind, shape, **settings):
    bpy.context.view_layer.objects.active = obj
    bpy.ops.rigidbody.object_add(type=kind)
    obj.rigid_body.collision_shape = shape
    for name, value in {"friction": 0.6, "restitution": 0.2, "collision_margin": 0.0, **settings}.items():
        setattr(obj.rigid_body, name, value)


def hull(points, name):
    """An object at the middle of ``points`` (n, 3), Blender's frame, that holds them and is not rendered."""
    middle = points.mean(axis=0)
    data = bpy.data.meshes.new(name)
    data.from_pydata((points - middle).tolist(), [], [])
    obj = bpy.data.objects.new(name, data)
    obj.location = middle
    obj.hide_render = True
    home.objects.link(obj)
    return obj


bodies = {}
for index, (name, _) in enumerate(order[:4]):
    part = mesh.take(part_of_face == index)
    splats = objects.add(objects.prepare(part, lit=True), name, home)
    # The vase collides with its own splats only: leaves would make it as wide as they reach.
    solid = cloud.means[ends[index] - order[index][1] : ends[index]]
    turn = np.array(splats.matrix_world.to_3x3())
    body = hull(solid[:: max(1, len(solid) // 400)] @ turn.T, f"{name} body")
    bpy.context.view_layer.update()
    splats.parent = body
    splats.matrix_parent_inverse = mathutils.Matrix.Translation(-body.location)
    make_body(body, "ACTIVE", "CONVEX_HULL", mass=0.6 if name == "ball" else 0.4)
    bodies[name] = body
make_body(bpy.data.objects["Ground"], "PASSIVE", "MESH")

# The ball is thrown: moved for six frames, then let go.
ball, target = bodies["ball"], bodies["vase"].location
way = (target - ball.location) * mathutils.Vector((1, 1, 0))
goal = ball.location.copy()
bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
for frame, share in [(1, -0.55), (7, 0.0)]:
    ball.location = goal + share * way + mathutils.Vector((0, 0, 0.45))
    ball.keyframe_insert("location", frame=frame)
for frame, held in [(1, True), (7, False)]:
    ball.rigid_body.kinematic = held
    ball.rigid_body.keyframe_insert("kinematic", frame=frame)

objs = [obj for obj in scene.objects if obj.type == "MESH" and not obj.hide_render]
objects.render_settings(scene, [obj for obj in objs if objects.LAYERS in obj.data], lit=True)
scene.cycles.samples, scene.cycles.use_denoising = asked.samples, True
moments = [1, 12, 24, 50]
strip = []
for frame in range(1, moments[-1] + 1):  # rigid bodies go from frame to frame
    scene.frame_set(frame)
    if frame in moments:
        scene.render.filepath = str((out / f"falling_{frame:02d}.png").resolve())
        bpy.ops.render.render(write_still=True)
        strip.append(np.asarray(Image.open(scene.render.filepath).convert("RGB")))
        print(f"{out / f'falling_{frame:02d}.png'}")
bpy.ops.wm.save_as_mainfile(filepath=str((out / "falling.blend").resolve()), compress=True)
Image.fromarray(np.concatenate(strip, axis=1)).save(out / "falling.png", optimize=True)
tilt = np.degrees(bodies["vase"].matrix_world.to_quaternion().angle)
print(f"{out / 'falling.png'}, {out / 'falling.blend'}: {len(mesh.faces):,} triangles")
print(f"the vase lies at {tilt:.0f} degrees")
