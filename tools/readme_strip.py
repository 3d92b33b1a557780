"""The strip of the README: a capture as splats, as a mesh, lit in Blender, opaque in three.js, and as a
textured surface.

    npm install three puppeteer-core    (in some folder; Chromium installed)
    python tools/readme_strip.py PLAYBOT --blender-python blender-env/bin/python \\
        --node-folder FOLDER -o docs/images/playbot.jpg

PLAYBOT is Stephane Agullo's capture, CC-BY-4.0: https://superspl.at/view?id=ee6d8bc4, level 1 of its levels
of detail (250,000 splats). Another file takes --azimuth, --distance and --look-at. --blender-python is in the
environment with the extra blender (docs/blender.md). What a step made is kept in --work and used again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "viewers"))
from _node import draw_jobs, drawn_images, job

import meshsplats as ms
from meshsplats.images.reading import load_image

LABELS = ("splats", "mesh", "the mesh lit, in Blender", "opaque, in three.js", "textured surface")
WIDTH, HEIGHT, GAP, TOP = 400, 400, 8, 44
"""Of a panel, between panels, and of the line of labels, in pixels; the README shows half of them."""
LIGHT = ("--sun", "-75", "16", "--sun-strength", "5", "--sky", "0.12", "--glass", "--samples", "32")


def lit(splats: Path, cameras: Path, image: Path, python: Path) -> np.ndarray:
    """The image of `meshsplats blender --lit`, on a grey-blue background."""
    if not image.exists():
        command = [python, "-m", "meshsplats", "blender", splats, "-o", image, "--lit", *LIGHT]
        subprocess.run([*command, "--cameras", cameras, "--background", "#c3d0de"], check=True)
    return load_image(image) / np.float32(255)


def opaque(splats: Path, camera: ms.Camera, folder: Path, node_folder: Path, minutes: float) -> np.ndarray:
    """The image that three.js draws, at twice the size and averaged, of a mesh for depth buffers."""
    glb, views = folder / "opaque.glb", folder / "views_2.json"
    if not glb.exists():
        command = [sys.executable, "-m", "meshsplats", "finetune", splats, "-o", glb]
        subprocess.run(
            [*command, "--opacity", "cutoff", "--soft-share", "0.05", "--minutes", str(minutes)], check=True
        )
    ms.save_cameras([camera.scaled(2)], views)
    draw_jobs([job("three", glb, views, folder / "three", 100.0, antialias=True)], folder, node_folder)
    large = drawn_images(folder / "three", 1)[0]
    return large.reshape(HEIGHT, 2, WIDTH, 2, 3).mean(axis=(1, 3))


def textured(splats: Path, camera: ms.Camera, folder: Path) -> np.ndarray:
    """The image of the surface of `meshsplats surface`."""
    glb = folder / "surface.glb"
    if not glb.exists():
        subprocess.run([sys.executable, "-m", "meshsplats", "surface", splats, "-o", glb], check=True)
    return ms.draw_surface(ms.load_base(glb), camera)


def labelled(panels: list[np.ndarray]) -> np.ndarray:
    """(h, w, 3): the panels side by side, each below its label."""
    sheet = np.ones((TOP + HEIGHT, len(panels) * (WIDTH + GAP) - GAP, 3), np.float32)
    line = Image.new("RGB", (sheet.shape[1], TOP), "white")
    draw, font = ImageDraw.Draw(line), ImageFont.load_default(size=27)
    for i, (panel, label) in enumerate(zip(panels, LABELS, strict=True)):
        left = i * (WIDTH + GAP)
        sheet[TOP:, left : left + WIDTH] = panel
        draw.text((left + WIDTH / 2, TOP / 2), label, fill=(50, 50, 50), font=font, anchor="mm")
    sheet[:TOP] = np.asarray(line, np.float32) / 255
    return sheet


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("splats", type=Path)
    parser.add_argument("--blender-python", type=Path, required=True)
    parser.add_argument("--node-folder", type=Path, required=True, help="where node_modules lies")
    parser.add_argument("--azimuth", type=float, default=-30)
    parser.add_argument("--distance", type=float, default=0.5)
    parser.add_argument("--look-at", type=float, nargs=3, default=(0, -0.62, 0), metavar=("X", "Y", "Z"))
    parser.add_argument("--minutes", type=float, default=6, help="of fine-tuning to opaque triangles")
    parser.add_argument("--work", type=Path, default=Path("build/readme-strip"), help="folder of the steps")
    parser.add_argument("-o", "--output", type=Path, required=True)
    asked = parser.parse_args()

    asked.work.mkdir(parents=True, exist_ok=True)
    cloud = ms.load_gaussians(asked.splats)
    size = {"width": WIDTH, "height": HEIGHT, "elevation": 5}
    view = {"azimuth": asked.azimuth, "distance": asked.distance, "target": asked.look_at}
    camera = ms.orbit(cloud, 1, **size, **view)[0]
    cameras = asked.work / "views.json"
    ms.save_cameras([camera], cameras)
    mesh = ms.convert(cloud, cameras=[camera])
    panels = [
        ms.draw_splats(cloud, camera, look="area").color,
        ms.render(mesh, camera, samples=2).color,
        lit(asked.splats, cameras, asked.work / "lit.png", asked.blender_python),
        opaque(asked.splats, camera, asked.work, asked.node_folder, asked.minutes),
        textured(asked.splats, camera, asked.work),
    ]
    ms.save_image(asked.output, labelled(panels).clip(0, 1))
    opaque_count = len(ms.load_mesh(asked.work / "opaque.glb").faces)
    print(f"{len(cloud):,} splats, {len(mesh.faces):,} triangles, {opaque_count:,} for depth buffers")
    print(f"{asked.output}: {asked.output.stat().st_size // 1024} KB")


if __name__ == "__main__":
    main()
