# ruff: noqa: E402
"""Lit images against a known surface lit the same way."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats
from _eevee import draw_by_eevee

from meshsplats import convert, orbit, render
from meshsplats.blender import LightOptions, SceneOptions, subject
from meshsplats.blender.inside import materials, meshes, rendering, scene, stage, versions
from meshsplats.cameras.trajectories import look_at
from meshsplats.evaluation.metrics import psnr
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear


def built(mesh, view, options):
    layers, limit = subject.count(mesh, [view], options)
    arrays, facts = subject.prepare(mesh, [view], options, layers)
    return scene.build(scene.Subject(**arrays, **facts), [view], options, limit, edges=False)


def shot(made, view, path):
    stage.aim(made.scene, view, made.cameras[0])
    rendering.render_to(made.scene, path)
    return rendering.read_pixels(path)[..., :3]


def display(values):
    return linear_to_srgb(np.clip(values, 0, 1))


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """Linear images of splats on a ball, of the ball itself, and of the ground alone."""
    folder = tmp_path_factory.mktemp("ball")
    cloud, _ = ball_splats(3000)
    mesh = convert(cloud, mode="flat")
    view = orbit(mesh, 1, elevation=35, azimuth=20, width=96, height=72, distance=2.2)[0]
    # A ball is no place: no views from within are looked for.
    options = SceneOptions(light=LightOptions(sun=(100, 40), bounces=1), samples=16, within=())
    made = built(mesh, view, options)
    splats = shot(made, view, folder / "splats.exr")
    for obj in (made.obj, *made.obj.children):
        obj.hide_render = True
    ground = shot(made, view, folder / "ground.exr")
    bpy.ops.mesh.primitive_uv_sphere_add(segments=128, ring_count=64, radius=1)
    true = bpy.context.object
    true.data.shade_smooth()
    grey, red = (srgb_to_linear(np.array(c)).tolist() for c in ([0.7, 0.7, 0.7], [0.8, 0.2, 0.1]))
    true.data.materials.append(materials.plain("Grey", grey))
    true.data.materials.append(materials.plain("Red", red))
    for polygon in true.data.polygons:
        polygon.material_index = int(polygon.center.z > 0.5)  # y down in the file is up here
    solid = shot(made, view, folder / "solid.exr")
    covered = render(mesh, view).alpha
    return splats, solid, ground, covered


def test_splats_look_like_the_surface_they_were_taken_from(ball):
    splats, solid, _, covered = ball
    assert psnr(display(splats), display(solid)) > 29
    inside = covered > 0.99
    assert 0.94 < splats[inside].mean() / solid[inside].mean() < 1.03


@pytest.mark.slow
def test_layers_do_not_speckle_or_mottle(ball):
    """Away from edges, neighbouring pixels differ as little as on the smooth surface, but for the noise."""
    splats, solid, _, covered = ball
    inside = (
        np.minimum.reduce([covered[1:-1, 1:-1], covered[:-2, 1:-1], covered[2:, 1:-1], covered[1:-1, 2:]])
        > 0.995
    )

    def roughness(image):
        grey = display(image).mean(axis=2)
        middle = grey[1:-1, 1:-1]
        around = (grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]) / 4
        return np.median(np.abs(middle - around)[inside])

    assert roughness(splats) < roughness(solid) + 0.025


def test_shadow_falls_where_the_surface_throws_it(ball):
    splats, solid, ground, covered = ball
    floor = (covered < 0.02) & (ground.mean(axis=2) > 0.05)
    dark = [image.mean(axis=2)[floor] < 0.75 * ground.mean(axis=2)[floor] for image in (splats, solid)]
    assert dark[1].sum() > 200
    assert (dark[0] & dark[1]).sum() / (dark[0] | dark[1]).sum() > 0.9


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("tilt", [10, 60, 85])
@pytest.mark.parametrize("side", [-60, 60])
def test_light_follows_the_smoothed_normal_only(tmp_path, tilt, side):
    """A triangle askew in a surface is as bright as the surface, from both sides and for every light."""
    t, a = np.radians(tilt), np.radians(side)
    square = 3 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners = np.stack([square[:, 0] * np.cos(t), square[:, 1], square[:, 0] * np.sin(t)], axis=1)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    home = stage.collection("all")
    normals = np.tile([0.0, 0, 1], (4, 1))
    faces, grey = np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.5, 0.5, 0.5, 1], (4, 1))
    data = meshes.make_mesh("m", corners, faces, grey, normals=normals)
    data.materials.append(materials.lit(self_shadow=0.1))
    meshes.make_object(data, "m", np.eye(3), home)
    stage.even_world((0, 0, 0))
    view = look_at((5 * np.sin(a), 0, 5 * np.cos(a)), (0, 0, 0), up=(0, 1, 0), width=8, height=8, fov=2)
    camera = stage.add_camera(view, "c", np.eye(3), 100, home)
    for height in (20, 70):
        for way in (-1, 1):
            direction = np.array([way * np.cos(np.radians(height)), 0, np.sin(np.radians(height))])
            sun = stage.add_sun(direction, np.pi, 0, 0.01, home)
            rendering.lit_settings(bpy.context.scene, "cycles", samples=1, limit=64, bounces=0)
            stage.aim(bpy.context.scene, view, camera)
            rendering.render_to(bpy.context.scene, tmp_path / "a.exr")
            found = rendering.read_pixels(tmp_path / "a.exr")[4, 4, 0]
            assert np.isclose(found, 0.5 * direction[2], atol=2e-3)
            bpy.data.objects.remove(sun)


def test_a_small_object_throws_its_shadow_on_what_is_near(tmp_path):
    """Rays ignore layers within a distance that shrinks with the object."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    home = stage.collection("all")
    square = 3 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces, grey = np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.5, 0.5, 0.5, 1], (4, 1))
    data = meshes.make_mesh("m", square, faces, grey, normals=np.tile([0.0, 0, 1], (4, 1)))
    data.materials.append(materials.lit(self_shadow=0.1))
    meshes.make_object(data, "m", np.eye(3), home).scale = (0.01, 0.01, 0.01)
    floor = meshes.make_mesh("floor", square, faces, grey)
    floor.materials.append(materials.plain("Grey", (0.5, 0.5, 0.5)))
    meshes.make_object(floor, "floor", np.eye(3), home).location.z = -0.02
    stage.even_world((0, 0, 0))
    stage.add_sun(np.array([0.0, 0, 1]), np.pi, 0, 0.01, home)
    rendering.lit_settings(bpy.context.scene, "cycles", samples=1, limit=64, bounces=0)
    found = []
    for middle in (0.0, 0.2):
        view = look_at((0.5, 0, 0.1), (middle, 0, -0.02), up=(0, 0, 1), width=8, height=8, fov=1)
        camera = stage.add_camera(view, "c", np.eye(3), 100, home)
        stage.aim(bpy.context.scene, view, camera)
        rendering.render_to(bpy.context.scene, tmp_path / "a.exr")
        found.append(rendering.read_pixels(tmp_path / "a.exr")[..., 0].mean())
    assert found[0] < 0.5 * found[1]


@pytest.mark.nightly
def test_eevee_draws_in_order_and_casts_a_shadow(tmp_path):
    """Slow without a graphics card: one small scene for both. All light on the ground is the sun's."""
    cloud, _ = ball_splats(400)
    mesh = convert(cloud, mode="flat")
    view = orbit(mesh, 1, elevation=35, azimuth=20, width=64, height=48, distance=2.2)[0]
    draw_by_eevee(mesh, [view], images=[tmp_path / "plain.exr"], options=SceneOptions(engine="eevee"))
    plain = rendering.read_pixels(tmp_path / "plain.exr")[..., :3]
    assert psnr(np.clip(plain, 0, 1), render(mesh, view).color) > 30
    options = SceneOptions(
        light=LightOptions(sun=(100, 40), sky=0), engine="eevee", samples=2, background=(0, 0, 0), fast=True
    )
    draw_by_eevee(mesh, [view], images=[tmp_path / "lit.exr"], options=options)
    lit = rendering.read_pixels(tmp_path / "lit.exr")[..., :3].mean(axis=2)
    floor = (render(mesh, view).alpha < 0.01) & (np.arange(48) > 30)[:, None]
    sun = lit[floor]
    assert sun.max() > 0.2, "the sun shines on the ground"
    assert (sun < 0.1 * sun.max()).sum() > 20, "but not in the shadow"
