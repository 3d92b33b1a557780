"""How evenly splats are lit with one, two or three ellipses per splat: the conversion's modes.

    blender-env/bin/python benchmarks/blender_modes.py [--size 96] [--samples 32]

A grey ball of 3000 splats, twice as long as wide and half as thick, tilted and moved at random, is lit by sun
and sky. The table has the radiance of the ball's centre, and how far it deviates from a smooth image (a
polynomial of degree 4), which is what looks mottled or speckled.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from _common import Report, arguments

from meshsplats import GaussianCloud, convert
from meshsplats.blender import LightOptions, SceneOptions, draw
from meshsplats.cameras.trajectories import look_at

COUNT = 3000
NOISE = 0.3
"""Tilt in radians, and distance along the normal in spacings: standard deviations."""


def ball() -> GaussianCloud:
    rng = np.random.default_rng(0)
    heights = 1 - 2 * (np.arange(COUNT) + 0.5) / COUNT
    angles = np.pi * (3 - 5**0.5) * np.arange(COUNT)
    rings = np.sqrt(1 - heights**2)
    normals = np.stack([rings * np.cos(angles), heights, rings * np.sin(angles)], axis=1)
    spacing = np.sqrt(4 * np.pi / COUNT)
    axes = normals + rng.normal(0, NOISE, normals.shape)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    # The rotation from +z to the axis, as a quaternion: (1 + z, z x axis), normalised.
    turns = np.stack([1 + axes[:, 2], -axes[:, 1], axes[:, 0], np.zeros(COUNT)], axis=1)
    turns[axes[:, 2] < -0.999999] = [0, 1, 0, 0]
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return GaussianCloud(
        normals * (1 + NOISE * spacing * rng.normal(0, 1, (COUNT, 1))),
        turns,
        np.tile(np.array([1.04, 0.48, 0.24]) * spacing, (COUNT, 1)),
        np.full(COUNT, 0.9),
        np.full((COUNT, 1, 3), (0.7 - 0.5) / 0.28209479177387814),
    )


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--samples", type=int, default=32)
    asked = parser.parse_args()
    view = look_at((0, -1.2, -3.2), (0, 0, 0), width=asked.size, height=asked.size, fov=45)
    options = SceneOptions(light=LightOptions(ground="none"), samples=asked.samples)
    rows, columns = (np.mgrid[: asked.size, : asked.size] + 0.5) / (asked.size / 2) - 1
    middle = rows**2 + columns**2 < 0.45**2
    terms = [columns[middle] ** i * rows[middle] ** j for i in range(5) for j in range(5 - i)]
    smooth = np.stack(terms, axis=1)
    from meshsplats.blender.inside.host import bpy
    from meshsplats.blender.inside.rendering import read_pixels

    with Report(asked) as report:
        report.say(f"Blender {bpy.app.version_string}")
        report.table("mode", "triangles", "light", "deviation")
        for mode in ("flat", "crossed", "3d"):
            mesh = convert(ball(), mode=mode)
            with tempfile.TemporaryDirectory() as folder:
                draw(mesh, [view], images=[Path(folder) / "ball.exr"], options=options)
                light = read_pixels(Path(folder) / "ball.exr")[..., 1][middle]
            rest = light - smooth @ np.linalg.lstsq(smooth, light, rcond=None)[0]
            share = rest.std() / light.mean()
            report.row(mode, f"{len(mesh.faces):,}", f"{light.mean():.3f}", f"{share:.1%}")


if __name__ == "__main__":
    main()
