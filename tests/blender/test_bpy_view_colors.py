# ruff: noqa: E402
"""Colours that depend on the view in Blender: unlit images are those of ``render``; they are read back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _eevee import draw_by_eevee
from _local import shared_data

from meshsplats import convert, load_gaussians, orbit, render, save_mesh
from meshsplats.blender import SceneOptions, draw
from meshsplats.blender.inside import foreign, frame, meshes, objects, versions
from meshsplats.blender.inside.rendering import read_pixels
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.metrics import psnr
from meshsplats.spherical_harmonics import moved_harmonics


def colorful(degree: int):
    """The still life with strong harmonics, and colours up to above white. Its triangles are small: Blender
    shades fragments, not vertices."""
    scene = make_scene(1500)
    rng = np.random.default_rng(degree)
    sh = rng.normal(0, 0.4, (len(scene), (degree + 1) ** 2, 3))
    sh[:, 0] = 3 * scene.sh[:, 0]
    return convert(replace(scene, sh=sh))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_cycles_draws_what_the_renderer_draws(degree, tmp_path):
    mesh = colorful(degree)
    views = orbit(mesh, 2, azimuth=20, width=120, height=100)
    paths = [tmp_path / f"{i}.exr" for i in range(len(views))]
    draw(mesh, views, images=paths, options=SceneOptions())
    for view, path in zip(views, paths, strict=True):
        drawn = read_pixels(path)[..., :3]
        assert psnr(drawn, render(mesh, view).color) > 50, view.name
        assert psnr(drawn, render(mesh.of_degree(0), view).color) < 30


@pytest.mark.nightly(keep=1)
@pytest.mark.parametrize("degree", [3, 2])
def test_eevee_takes_as_many_attributes(degree, tmp_path):
    """It draws wrong colours, or nothing, where a material reads more than 14."""
    mesh = colorful(degree)
    view = orbit(mesh, 1, azimuth=20, width=120, height=100)[0]
    draw_by_eevee(mesh, [view], images=[tmp_path / "a.exr"], options=SceneOptions(engine="eevee"))
    drawn = read_pixels(tmp_path / "a.exr")[..., :3].clip(0, 1)
    image = render(mesh, view, samples=4, order="splat").color.clip(0, 1)
    plain = render(mesh.of_degree(0), view, samples=4, order="splat").color
    assert psnr(drawn, image) > psnr(drawn, plain.clip(0, 1)) + 6


def test_a_capture_in_cycles(tmp_path):
    cloud = load_gaussians(shared_data("splats/playbot_lod5_3k_sh2.ply"))
    mesh = convert(cloud)
    view = orbit(mesh, 1, azimuth=40, width=200, height=200)[0]
    draw(mesh, [view], images=[tmp_path / "a.exr"], options=SceneOptions())
    drawn, expected = read_pixels(tmp_path / "a.exr")[..., :3], render(mesh, view).color
    assert psnr(drawn.clip(0, 1), expected.clip(0, 1)) > 60


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_an_object_gives_its_harmonics_back(degree):
    mesh = colorful(degree)
    obj = objects.add(objects.prepare(mesh, False), "splats", bpy.context.scene.collection)
    found = objects.as_splat_mesh(obj)
    assert np.array_equal(found.harmonics, mesh.harmonics)
    assert np.array_equal(found.colors, mesh.colors)
    assert len([a for a in obj.data.attributes if a.name.startswith("splat_sh_")]) <= 12
    lit = objects.prepare(mesh, True, fast=True, views=())
    assert lit["harmonics"] is None
    assert lit["colors"].max() <= 1
    assert meshes.read_harmonics(obj.data).shape == (len(mesh.vertices), mesh.harmonics.shape[1], 3)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_glb_with_texture_coordinates_has_its_harmonics_after_a_click(degree, tmp_path):
    mesh = replace(colorful(degree), up=np.array([0, 0, 1], np.float32))
    save_mesh(mesh, tmp_path / "m.glb", harmonics="texcoords")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "m.glb"))
    bpy.context.view_layer.update()
    obj = next(obj for obj in bpy.data.objects if obj.type == "MESH")
    found = foreign.splat_mesh(obj)
    assert len(found.harmonics) == mesh.splat_count
    turn = np.array(obj.matrix_world.to_3x3(), np.float64)
    world = frame.to_blender(np.array(mesh.up, np.float64))
    expected = moved_harmonics(mesh.harmonics, turn.T @ world)
    largest = np.abs(mesh.harmonics).max()
    np.testing.assert_allclose(found.harmonics, expected, atol=0.02 * largest)
    np.testing.assert_allclose(found.colors, mesh.colors, atol=0.01)
    objects.dress(obj, lit=False)
    assert meshes.read_harmonics(obj.data) is not None
