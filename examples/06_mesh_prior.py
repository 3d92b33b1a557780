"""A mesh prior: splats on a base mesh, trained, bent and lit anew. The image of docs/mesh-prior.md.

python examples/06_mesh_prior.py [steps]      Needs the extra base. Writes into example-output/.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import meshsplats as ms
from meshsplats.demo_scene import make_scene
from meshsplats.images.writing import save_image, strip
from meshsplats.prior import bind, prior_config, train_prior
from meshsplats.surfaces import make_surface

out = Path("example-output")
out.mkdir(exist_ok=True)
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 20

# Train: a base of the surface, splats on it and on shells inside, and images of the splats as targets.
cloud = make_scene()
base = make_surface(cloud, faces=10_000, texture=0, resolution=64, views=32, size=192)
data = ms.splat_dataset(cloud, train=30, test=4, width=160, sh_degree=0)
start = bind(base, views=data.train)
prior = train_prior(start, data, prior_config(steps=steps))
before, after = (ms.evaluate(p.mesh, data).methods[0].mean("psnr") for p in (start, prior))
ms.save_mesh(prior.mesh, out / "prior.npz")
print(f"{out / 'prior.npz'}: {len(base.faces):,} faces, {len(prior.mesh.faces):,} triangles")
print(f"held out: {before:.1f} -> {after:.1f} dB after {steps} steps")

# Bend: the base is twisted about the up direction and leans over; the splats follow.
vertices = prior.base_vertices
height = vertices @ base.up
angle = 0.9 * (height - height.min())
axis = np.array(base.up, np.float64)
across = vertices - height[:, None] * axis
turned = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
sideways = np.cross(axis, [0, 0, 1])
lean = 0.15 * (height - height.min())[:, None] ** 2 * sideways
bent = prior.pose(turned + height[:, None] * axis + lean)

# Relight: the base's normals give the light of a lamp at each vertex.
camera = ms.orbit(cloud, 1, elevation=22, azimuth=-10, width=300, height=340)[0]
right, _, forward = camera.world_to_camera[:3, :3]
lamp = 1.2 * right + 0.8 * axis - 0.6 * forward
facing = np.sign(((camera.center - bent.vertices) * bent.normals).sum(axis=1, keepdims=True))  # two-sided
shade = 0.25 + 0.95 * np.clip(facing * bent.normals @ (lamp / np.linalg.norm(lamp)), 0, 1)
warm = bent.colors.copy()
warm[:, :3] = np.clip(warm[:, :3] * shade[:, None] * [1.1, 1.0, 0.8], 0, 1)

images = [
    ms.render_splats(cloud, camera, sh_degree=0).color,
    ms.render(prior.mesh, camera, samples=2).color,
    ms.render(bent, camera, samples=2).color,
    ms.render(replace(bent, colors=warm), camera, samples=2).color,
]
captions = ("splats", "mesh prior", "its base bent", "lit by a lamp")
save_image(out / "mesh_prior.png", strip(np.clip(images, 0, 1), captions))
print(f"{out / 'mesh_prior.png'}: {' | '.join(captions)}")
