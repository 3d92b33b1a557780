"""Photographs of a still life to a mesh: the folder, the training, scores on held-out photographs.

python examples/08_photographs.py [count] [pixels] [steps]      Writes into example-output/.
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import meshsplats as ms
from meshsplats.demo_scene import make_scene

count, side, steps = (int(sys.argv[i]) if len(sys.argv) > i else n for i, n in ((1, 24), (2, 96), (3, 60)))
folder = Path("example-output") / "photos"
(folder / "images").mkdir(parents=True, exist_ok=True)

# Photographs from all around, transparent around the table. They shine as real ones do: at spherical
# harmonics of degree 3.
cloud = make_scene()
frames = []
for i, camera in enumerate(ms.dome(cloud, count, width=side, height=side)):
    drawn = ms.draw_splats(cloud, camera, "area", background=(0, 0, 0))
    alpha = drawn.alpha[..., None]
    color = drawn.color / np.maximum(alpha, 1e-6)  # files have it without the background
    pixels = np.concatenate([color, alpha], axis=2).clip(0, 1)
    name = f"images/{i:03d}.png"
    Image.fromarray((pixels * 255 + 0.5).astype(np.uint8)).save(folder / name)
    pose = np.linalg.inv(camera.world_to_camera)
    pose[:, 1:3] *= -1  # nerfstudio's axes: y up, z backward
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": side, "h": side}
    frames.append({"file_path": name, "transform_matrix": pose.tolist(), **lens})
(folder / "transforms.json").write_text(json.dumps({"frames": frames}))

# The same as: meshsplats train example-output/photos -o example-output/trained.npz --steps 60
# --start-splats 3000 --max-splats 8000
data = ms.load_dataset(folder)
mesh = ms.train(data, steps=steps, start_splats=3000, max_splats=8000)
ms.save_mesh(mesh, folder.parent / "trained.npz")
scores = ms.evaluate(mesh, data).method("mesh")
print(f"{len(data.train)} photographs: {scores.mean('psnr'):.1f} dB on {len(data.test)} others")
print(folder, folder.parent / "trained.npz")
