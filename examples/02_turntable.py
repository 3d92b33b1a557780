"""Images from all around, as an animation.

python examples/02_turntable.py [scene.ply]      Without a file: the demo scene. Writes into example-output/.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import meshsplats as ms
from meshsplats.demo_scene import make_scene

out = Path("example-output")
out.mkdir(exist_ok=True)

cloud = ms.load_gaussians(sys.argv[1]) if len(sys.argv) > 1 else make_scene()
mesh = ms.convert(cloud)

frames = []
for camera in ms.orbit(mesh, 12, elevation=20, width=320, height=320):
    rendering = ms.render(mesh, camera, background=(0.95, 0.95, 0.97), samples=2)
    frames.append(Image.fromarray(np.rint(255 * rendering.color.clip(0, 1)).astype(np.uint8)))
frames[0].save(out / "turntable.webp", save_all=True, append_images=frames[1:], duration=80, loop=0)
print(f"{out / 'turntable.webp'}: {len(frames)} images")
