"""How close the mesh comes to the splats it was made from, for both presets.

python examples/03_compare.py [scene.ply]        Without a file: the demo scene.
"""

import sys

import numpy as np

import meshsplats as ms
from meshsplats.demo_scene import make_scene

cloud = ms.load_gaussians(sys.argv[1]) if len(sys.argv) > 1 else make_scene()
cameras = ms.dome(cloud, 6, width=240, height=240)
# Degree 0 compares like with like: a mesh has one colour a vertex, whatever the view.
splats = [ms.render_splats(cloud, camera, sh_degree=0).color.clip(0, 1) for camera in cameras]

for preset in ("paper", "default"):
    mesh = ms.convert(cloud, preset=preset, cameras=cameras if preset == "default" else None)
    pictures = [ms.render(mesh, camera, samples=2).color.clip(0, 1) for camera in cameras]
    psnr = np.mean([ms.psnr(a, b) for a, b in zip(pictures, splats, strict=True)])
    ssim = np.mean([ms.ssim(a, b) for a, b in zip(pictures, splats, strict=True)])
    print(f"{preset:8}  {len(mesh.faces):8,} triangles  PSNR {psnr:.2f} dB  SSIM {ssim:.4f}")
