"""One splat object under three lights, with a mirror behind it and a glass ball beside it, in Blender.

Needs the environment with Blender's module (docs/blender.md):

blender-env/bin/python examples/blender/three_lights.py [scene.ply]
    [--width 400] [--samples 64]

Without a file: vase and fruit of the demo scene. Writes into example-output/.
"""

import argparse
from pathlib import Path

import numpy as np

import meshsplats as ms
from meshsplats.blender import LightOptions, SceneOptions, draw
from meshsplats.demo_scene import make_scene
from meshsplats.images.reading import load_image
from meshsplats.images.writing import save_image, strip

parser = argparse.ArgumentParser()
parser.add_argument("scene", nargs="?")
parser.add_argument("--width", type=int, default=400)
parser.add_argument("--samples", type=int, default=64)
asked = parser.parse_args()
out = Path("example-output")
out.mkdir(exist_ok=True)


def studio(path: Path) -> Path:
    """An environment image of a dark room with a warm window on one side and a cool one on the other."""
    rows, columns = np.mgrid[0:128, 0:256] / np.array([128, 256])[:, None, None]
    light = np.full((128, 256, 3), 0.06) * (1.5 - rows)[..., None]
    for middle, color in [(0.42, (16, 9, 4)), (0.88, (3, 6, 13))]:
        window = (np.abs(columns - middle) < 0.055) & (np.abs(rows - 0.33) < 0.14)
        light[window] = color
    # Radiance's format: three mantissas and a shared exponent of two.
    exponent = np.ceil(np.log2(light.max(axis=2)))
    rgbe = np.dstack([light / 2 ** exponent[..., None] * 255, exponent + 128]).astype(np.uint8)
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 128 +X 256\n" + rgbe.tobytes())
    return path


LIGHTS = {
    "low sun": LightOptions(
        sun=(-65, 18), sun_strength=4, sun_color=(1, 0.72, 0.42), sky=0.16, mirror=True, glass=True
    ),
    "overcast sky": LightOptions(sun_strength=0, sky=0.9, mirror=True, glass=True),
    "studio": LightOptions(
        sun_strength=0, hdri=studio(out / "studio.hdr"), hdri_strength=0.6, mirror=True, glass=True
    ),
}

if asked.scene:
    cloud = ms.load_gaussians(asked.scene)
else:
    cloud = make_scene()
    cloud = cloud.take(cloud.means[:, 1] < -0.003)  # without the table: there will be a ground
mesh = ms.convert(cloud, mode="flat")  # one flat ellipse a splat takes light best
height = round(asked.width * 3 / 4)
camera = ms.orbit(mesh, 1, elevation=14, azimuth=8, width=asked.width, height=height, distance=1.75)[0]

images = []
for name, light in LIGHTS.items():
    path = out / f"{name.replace(' ', '_')}.png"
    options = SceneOptions(light=light, samples=asked.samples, denoise=True, background=(0.75, 0.8, 0.88))
    result = draw(mesh, [camera], images=[path], options=options)
    images.append(load_image(path) / 255)
    print(f"{path}: {result['image_seconds'][0]:.0f} s, up to {result['layers']} layers")
save_image(out / "three_lights.png", strip(images, list(LIGHTS)))
print(f"{out / 'three_lights.png'}: all three; lit by {out / 'studio.hdr'}, too")
