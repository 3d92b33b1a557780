"""The Blender examples run at a smaller size and show what they claim."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from meshsplats import demo_scene, save_gaussians
from meshsplats.images.reading import load_image

EXAMPLES = Path(__file__).parents[2] / "examples" / "blender"


def run(name, folder, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout, folder / "example-output"


@pytest.mark.nightly
def test_three_lights_give_three_images(tmp_path):
    save_gaussians(demo_scene.make_scene(600), tmp_path / "scene.ply")
    _, out = run("three_lights.py", tmp_path, "scene.ply", "--width", 48, "--samples", 2)
    images = [load_image(out / f"{name}.png") / 255 for name in ("low_sun", "overcast_sky", "studio")]
    assert (out / "three_lights.png").exists()
    red, _, blue = images[0].mean(axis=(0, 1))
    assert red > blue, "the low sun is warm"
    for k in range(3):
        assert np.abs(images[k] - images[k - 1]).mean() > 0.05, "lights differ"


@pytest.mark.nightly
def test_the_vase_falls(tmp_path):
    printed, out = run("falling.py", tmp_path, "--width", 40, "--samples", 1, "--splats", 800)
    tilt = re.search(r"the vase lies at (\d+) degrees", printed)
    assert tilt
    assert 60 < int(tilt[1]) <= 180
    assert (out / "falling.blend").stat().st_size > 10_000
    first, last = (load_image(out / f"falling_{frame:02d}.png") for frame in (1, 50))
    assert first.shape == (33, 40, 3) or first.shape == (33, 40, 4)
    assert np.abs(first[..., :3] / 255 - last[..., :3] / 255).mean() > 0.01
