# ruff: noqa: E402
"""The Mitsuba example draws what Cycles draws: any ray tracer shows a splat mesh."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")
pytest.importorskip("mitsuba", reason="mitsuba is not here: pip install mitsuba")

from _blender_scenes import ball_splats

from meshsplats import convert, orbit, render, save_cameras, save_mesh
from meshsplats.blender import LightOptions, SceneOptions, subject
from meshsplats.blender.inside import materials, rendering, scene, stage, stand_ins
from meshsplats.scene.colors import srgb_to_linear

EXAMPLE = Path(__file__).parents[2] / "examples" / "mitsuba" / "render.py"
SAMPLES = 48

SESSION = """
import runpy, sys
import mitsuba as mi
import numpy as np
import meshsplats as ms
mi.set_variant("scalar_rgb")
example = runpy.run_path(sys.argv[1], run_name="example")
mesh, camera = ms.load_mesh("mesh.npz"), ms.load_cameras("camera.json")[0]
made = example["make_scene_of"](mesh, camera, int(sys.argv[3]), float(sys.argv[2]))
np.save("image.npy", np.array(mi.render(made)))
"""


def coarse(image):
    """Means of 4 x 4 pixels: noise and the pixel filters, which differ, go away."""
    height, width = image.shape[0] // 4, image.shape[1] // 4
    return image[: 4 * height, : 4 * width].reshape(height, 4, width, 4, -1).mean(axis=(1, 3))


@pytest.mark.nightly
def test_mitsuba_and_cycles_agree(tmp_path):
    """Same light, same ground, triangles shaded by their own normals: the same linear light."""
    mesh = convert(ball_splats(300)[0], mode="flat")
    view = orbit(mesh, 1, elevation=30, width=64, height=48, distance=1.6)[0]
    options = SceneOptions(light=LightOptions(bounces=2), samples=SAMPLES)
    layers, limit = subject.count(mesh, [view], options)
    arrays, facts = subject.prepare(mesh, [view], options, layers)
    facts["self_shadow"] = 0.0
    # Without a stand-in, lamps light the layers in every image.
    for name in ("normals", *stand_ins.ARRAYS):
        del arrays[name]
    arrays["colors"] = np.column_stack([srgb_to_linear(mesh.colors[:, :3]), mesh.colors[:, 3]])
    built = scene.build(scene.Subject(**arrays, **facts), [view], options, limit, edges=False)
    stage.even_world((0.35, 0.35, 0.35))  # seen as it shines
    # Mitsuba's ground does not fade into the background.
    (ground,) = (obj for obj in built.scene.objects if obj.name.startswith("Ground"))
    ground.data.materials[0] = materials.plain("Plain ground", stage.GREY)
    built.scene.cycles.pixel_filter_type = "BOX"
    built.scene.cycles.filter_width = 1.0
    rendering.render_to(built.scene, tmp_path / "cycles.exr")
    cycles = coarse(rendering.read_pixels(tmp_path / "cycles.exr")[..., :3])

    save_mesh(mesh, tmp_path / "mesh.npz")
    save_cameras([view], tmp_path / "camera.json")
    command = [sys.executable, "-c", SESSION, str(EXAMPLE), str(facts["floor"]), str(SAMPLES)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    mitsuba = coarse(np.load(tmp_path / "image.npy"))

    assert mitsuba.mean() == pytest.approx(cycles.mean(), rel=0.02)
    covered = coarse(render(mesh, view).alpha[..., None])[..., 0]
    for part in (covered > 0.98, covered < 0.02):
        assert part.sum() > 10
        assert mitsuba[part].mean() == pytest.approx(cycles[part].mean(), rel=0.03)
    assert np.sqrt(np.mean((mitsuba - cycles) ** 2)) < 0.03
