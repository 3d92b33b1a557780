"""How close the mesh comes to the splats it was made from, for both presets and under both looks.

python examples/03_compare.py [scene.ply]        Without a file: the demo scene.
"""

import sys

import numpy as np

import meshsplats as ms
from meshsplats._common.choices import Look
from meshsplats.demo_scene import make_scene

cloud = ms.load_gaussians(sys.argv[1]) if len(sys.argv) > 1 else make_scene()
cameras = ms.dome(cloud, 6, width=240, height=240)
# Degree 0 on both sides compares shapes alone: the paper's mesh has one colour for each splat.
meshes = {
    "paper": ms.convert(cloud, preset="paper"),
    "default": ms.convert(cloud, cameras=cameras, colors="base"),
    "look splats": ms.convert(cloud, cameras=cameras, look="splats", colors="base"),
    "filter": ms.convert(cloud, footprint="filter", colors="base"),
}

# area: the mean over each pixel's area, as programs show it that take several samples per pixel.
# splats: the image of a splat viewer.
looks: list[tuple[Look, int]] = [("area", 2), ("splats", 1)]
for look, samples in looks:
    splats = [ms.draw_splats(cloud, camera, look, sh_degree=0).color.clip(0, 1) for camera in cameras]
    for name, mesh in meshes.items():
        images = [ms.render(mesh, camera, samples=samples).color.clip(0, 1) for camera in cameras]
        psnr = np.mean([ms.psnr(a, b) for a, b in zip(images, splats, strict=True)])
        ssim = np.mean([ms.ssim(a, b) for a, b in zip(images, splats, strict=True)])
        print(f"{look:7} {name:11} {len(mesh.faces):8,} triangles  PSNR {psnr:.2f} dB  SSIM {ssim:.4f}")
