"""The triangles of a mesh: splats, mesh, and the mesh with its triangles opaque. The image of docs/method.md.

python examples/05_triangles.py [scene.ply]      Without a file: the demo scene. Writes into example-output/.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import meshsplats as ms
from meshsplats.demo_scene import make_scene

out = Path("example-output")
out.mkdir(exist_ok=True)

cloud = ms.load_gaussians(sys.argv[1]) if len(sys.argv) > 1 else make_scene()
camera = ms.orbit(cloud, 1, elevation=22, azimuth=-10, width=340, height=380)[0]
mesh = ms.convert(cloud, cameras=[camera])

# One vertex per corner, so that each triangle has its own shade; smaller fans, so that gaps show.
corners = mesh.vertices[mesh.faces]
centers = cloud.means[mesh.face_splat][:, None]
shade = np.random.default_rng(0).uniform(0.55, 1.1, (len(mesh.faces), 1, 1))
colors = mesh.colors[mesh.faces]
opaque = np.concatenate([colors[:, :, :3] * shade, np.ones_like(colors[:, :, :1])], axis=2).clip(0, 1)
keep = colors[:, :, 3].max(axis=1) > 0.3
triangles = replace(
    mesh.of_degree(0),
    vertices=(centers + 0.4 * (corners - centers))[keep].reshape(-1, 3),
    faces=np.arange(3 * keep.sum()).reshape(-1, 3),
    colors=opaque[keep].reshape(-1, 4),
    face_splat=None,
)

images = [
    ms.render_splats(cloud, camera).color,
    ms.render(mesh, camera, samples=3).color,
    ms.render(triangles, camera, samples=3).color,
]
strip = np.concatenate(images, axis=1).clip(0, 1)
ms.save_image(out / "triangles.png", strip)
print(f"{out / 'triangles.png'}: {len(cloud):,} splats | {len(mesh.faces):,} triangles | the same, opaque")
