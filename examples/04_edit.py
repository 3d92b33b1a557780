"""A splat mesh is ordinary triangles: cut it, move it, colour it, and render depth and vertex attributes.

python examples/04_edit.py        Writes into example-output/.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

import meshsplats as ms
from meshsplats.demo_scene import BALL, make_scene

out = Path("example-output")
out.mkdir(exist_ok=True)

cloud = make_scene()
mesh = ms.convert(cloud)

# The splats of the ball, hence their triangles: face_splat is the index of each triangle's splat.
center, radius = BALL
in_ball = np.abs(np.linalg.norm(cloud.means - center, axis=1) - radius) < 1e-4
ball_faces = in_ball[mesh.face_splat]
without_ball = mesh.take(~ball_faces)
print(f"{ball_faces.sum():,} of {len(mesh.faces):,} triangles belong to the ball")

# Lift the ball and dye it: vertices and colours are arrays.
vertices, colors = mesh.vertices.copy(), mesh.colors.copy()
ball_vertices = mesh.vertices_of(ball_faces)
vertices[ball_vertices] -= [0, 0.7, 0]  # y points down
colors[ball_vertices, :3] = colors[ball_vertices, :3][:, [2, 1, 0]]

# Height above the table as a vertex attribute, interpolated and blended as colour is.
lifted = replace(mesh.moved(vertices), colors=colors, attributes={"height": -vertices[:, 1]})
camera = ms.orbit(mesh, 1, elevation=20, width=320, height=320)[0]
drawn = ms.render(lifted, camera, depth=True, attributes=["height"], samples=2)

images = [
    ms.render(without_ball, camera, samples=2).color,
    drawn.color,
    np.repeat(1 - drawn.attributes["height"][:, :, None] / 2, 3, axis=2),
]
strip = np.concatenate(images, axis=1).clip(0, 1)
ms.save_image(out / "edit.png", strip)
print(f"{out / 'edit.png'}: without the ball | lifted and dyed | height")
nearest = drawn.mean_depth(min_alpha=0.5).min()
print(f"nearest point: {nearest:.2f} scene units away")
