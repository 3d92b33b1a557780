"""An ordinary textured mesh of splats, as other programs want it. The image of docs/surfaces.md.

python examples/10_surface.py [size]      Needs the extra base. Writes into example-output/.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import meshsplats as ms
from meshsplats.demo_scene import make_scene
from meshsplats.images.writing import save_image, strip

out = Path("example-output")
out.mkdir(exist_ok=True)
size = int(sys.argv[1]) if len(sys.argv) > 1 else 400

cloud = make_scene()
surface = ms.make_surface(cloud, faces=8_000, texture=1024, size=size, views=48, resolution=192)
ms.save_base(surface, out / "surface.glb")
print(f"{out / 'surface.glb'}: {len(surface.faces):,} triangles")

# Its shape alone, in the light of the camera.
corners = surface.vertices[surface.faces]
normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
camera = ms.orbit(cloud, 8, elevation=20, width=400, height=400)[0]
forward = camera.world_to_camera[2, :3]
light = np.repeat(0.15 + 0.8 * np.abs(normals @ forward), 3)[:, None]
clay = replace(
    surface,
    vertices=corners.reshape(-1, 3),
    faces=np.arange(corners[..., 0].size).reshape(-1, 3),
    colors=np.concatenate([np.repeat(light, 3, axis=1), np.ones_like(light)], axis=1),
    uv=None,
    normal_map=None,
    face_texture=None,
    textures=(),
)

splats = ms.draw_splats(cloud, camera).color
drawn = ms.draw_surface(surface, camera)
print(f"{ms.psnr(drawn, splats):.1f} dB")
save_image(out / "surface.png", strip([splats, drawn, ms.draw_surface(clay, camera)]))
print(f"{out / 'surface.png'}: splats, surface, its triangles")
