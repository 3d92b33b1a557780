# ruff: noqa: E402
"""Light on the splats that Blender draws itself (5.3): that of a mesh of them; and what stays of them."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")
if bpy.app.version < (5, 3, 0):
    pytest.skip("Blender draws splats since 5.3", allow_module_level=True)

from _blender_scenes import ball_splats
from _splat_points import splat_points

from meshsplats import DataWarning, GaussianCloud, convert, orbit, psnr, render_splats
from meshsplats.blender.inside import (
    baking,
    lit_points,
    materials,
    meshes,
    objects,
    rendering,
    stage,
    stand_ins,
    versions,
)
from meshsplats.blender.inside import splat_points as reader
from meshsplats.scene.colors import linear_to_srgb


@pytest.fixture
def scene():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    return bpy.context.scene


def ball(count: int = 400) -> GaussianCloud:
    """The ball of ``ball_splats`` standing upright in Blender, with one splat that cannot be seen."""
    found = ball_splats(count)[0]
    opacities = found.opacities.copy()
    opacities[7] = 0.001
    return replace(found, opacities=opacities)


def attributes(obj) -> dict[str, bytes]:
    return {
        name: reader.values(obj.data, name).tobytes()
        for name in (*reader.WIDTHS, *(a.name for a in obj.data.attributes if "sh_" in a.name))
    }


def lit(obj, **options):
    lit_points.light(obj, lit_points.prepare(objects.light_source(obj), **options))
    return obj


def light_of(data) -> np.ndarray:
    points = data.attributes[materials.LIGHT].data
    values = np.empty(4 * len(points), np.float32)
    points.foreach_get("color", values)
    return values.reshape(-1, 4)[:, :3]


def even_world(strength: float = 1.0) -> None:
    stage.even_world((strength,) * 3)


def test_unlit_splats_are_those_that_were_imported(scene):
    obj = splat_points(ball(), "ball", scene.collection)
    own = [bpy.data.materials.new("the user's"), bpy.data.materials.new("another")]
    for material in own:
        obj.data.materials.append(material)
    obj.data.attributes.new("Color", "FLOAT_COLOR", "POINT")
    before, names = attributes(obj), sorted(a.name for a in obj.data.attributes)
    cloud = reader.cloud_of(obj, bpy.context.evaluated_depsgraph_get())
    lit(obj, fast=True)
    assert attributes(obj)["radiance:base"] != before["radiance:base"], "opacities for linear light"
    assert [m.name for m in obj.data.materials] == ["Splats, lit", "another"]
    assert len(obj.children) >= 2
    assert not obj.visible_shadow
    again = reader.cloud_of(obj, bpy.context.evaluated_depsgraph_get())
    assert np.array_equal(again.opacities, cloud.opacities), "light does not add to light"
    for _ in range(2):  # once more changes nothing
        lit_points.unlight(obj)
    assert attributes(obj) == before
    assert sorted(a.name for a in obj.data.attributes) == names
    assert list(obj.data.materials) == own
    assert not obj.children
    assert obj.visible_shadow
    assert not objects.is_lit(obj)
    assert not [key for key in (*obj.keys(), *obj.data.keys()) if key.startswith("meshsplats")]


def test_splats_that_were_joined_to_lit_ones_keep_their_opacity(scene):
    """They lack the attributes of lit ones, which Blender fills with zeros."""
    obj = lit(splat_points(ball(100), "lit", scene.collection), fast=True)
    other = splat_points(ball(50), "other", scene.collection)
    for each in (obj, other):
        each.select_set(True)
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.join()
    wanted = np.concatenate([ball(100).opacities, ball(50).opacities])
    found = reader.cloud_of(obj, bpy.context.evaluated_depsgraph_get()).opacities
    np.testing.assert_array_equal(found, wanted)
    lit_points.unlight(obj)
    np.testing.assert_array_equal(reader.values(obj.data, "radiance:base")[:, 3], wanted)


def test_what_cannot_be_drawn_comes_back_too(scene):
    obj = splat_points(ball(100), "ball", scene.collection)
    broken = reader.values(obj.data, "radiance:base")
    broken[3], broken[5, 3] = (np.nan, 0, 0, 0.5), 1.5
    obj.data.attributes["radiance:base"].data.foreach_set("vector", broken.ravel())
    obj.data.update_tag()
    before = attributes(obj)
    with pytest.warns(DataWarning, match="1 of 100 splats"):
        lit(obj, fast=True)
    lit_points.unlight(obj)
    assert attributes(obj) == before


@pytest.mark.nightly
def test_light_is_that_of_a_mesh_of_the_splats(scene):
    """The same sun on both, one after the other: each splat takes what its fan takes."""
    cloud = ball()
    obj = splat_points(cloud, "ball", scene.collection)
    even_world(0.2)
    stage.add_sun(np.array([0.0, -0.6, 0.8]), 3.0, 1.0, 0.1, scene.collection)
    baking.bake(scene, [lit(obj)], samples=64)
    taken = light_of(obj.data)
    assert not baking.is_older(scene, obj)
    bpy.data.objects.remove(obj)
    stand_ins.remove_strays(scene)
    mesh = convert(cloud, mode="flat", up=(0, 0, 1))
    fans = objects.add(objects.prepare(mesh, True), "mesh", scene.collection)
    baking.bake(scene, [fans], samples=64)
    first, rows = mesh.faces[mesh.splats.starts, 0], mesh.face_splat[mesh.splats.starts]
    expected = light_of(fans.data)[first]
    assert len(rows) == len(cloud) - 1
    assert np.abs(taken[rows] - expected).mean() < 0.03 * expected.mean()
    toward = np.asarray(cloud.means) @ [0, -0.6, 0.8]
    assert taken[toward > 0.8].mean() > 4 * taken[toward < -0.8].mean(), "the sun's side"


def test_an_even_light_shows_the_image_of_the_splats(scene):
    """Nearer to it than Blender's own drawing, which blends display values in linear light."""
    rng = np.random.default_rng(0)
    cloud = ball_splats(800)[0]
    shades = rng.uniform(-1.5, 1.5, (len(cloud), 1, 1)).astype(np.float32)
    cloud = replace(cloud, sh=np.repeat(shades, 3, axis=2), opacities=np.full(len(cloud), 0.5))
    obj = splat_points(cloud, "ball", scene.collection)
    view = orbit(cloud, 1, up=(0, 0, 1), width=120, height=120)[0]
    home = stage.collection("Cameras")
    stage.aim(scene, view, stage.add_camera(view, "camera", np.eye(3), 100.0, home))
    even_world()
    rendering.lit_settings(scene, "cycles", limit=64, denoise=False, exposure=0.0)
    scene.cycles.samples = 48
    truth = render_splats(cloud, view, samples=3, dilation=0.0).color

    def error() -> float:
        return psnr(linear_to_srgb(np.clip(shot(scene), 0, 1)), truth)

    before = error()
    lit(obj)
    assert error() > before + 2


def shot(scene) -> np.ndarray:
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        rendering.render_to(scene, Path(folder) / "image.exr")
        return rendering.read_pixels(Path(folder) / "image.exr")[..., :3]


def test_linked_duplicates_have_light_of_their_own(scene):
    obj = splat_points(ball(), "ball", scene.collection)
    before = attributes(obj)
    twin = obj.copy()
    scene.collection.objects.link(twin)
    lit(obj, fast=True)
    assert not objects.is_lit(twin)
    assert attributes(twin) == before
    third = obj.copy()  # of lit splats
    scene.collection.objects.link(third)
    assert objects.needs_light(third, fast=True)
    lit_points.unlight(third)
    assert attributes(third) == before
    assert objects.is_lit(obj)
    assert stand_ins.is_current(obj)
    obj.data = twin.data  # as an earlier release has left them: unlit together, with a stand-in
    lit_points.unlight(obj)
    assert not obj.children
    assert obj.visible_shadow


def test_edited_splats_need_light_anew(scene):
    obj = lit(splat_points(ball(), "ball", scene.collection), fast=True)
    assert stand_ins.is_current(obj)
    assert stand_ins.is_current(obj, counts_only=True)
    assert not objects.needs_light(obj, fast=True)
    assert objects.needs_light(obj), "made for a preview"
    scales = reader.values(obj.data, "scale") * 2
    obj.data.attributes["scale"].data.foreach_set("vector", scales.ravel())
    assert objects.needs_light(obj, fast=True)
    objects.renew_light(scene, [obj], fast=True)
    assert not objects.needs_light(obj, fast=True)
    assert len([child for child in obj.children if child.get(stand_ins.STAND_IN)]) >= 2


def test_what_takes_no_light_says_so(scene):
    few = GaussianCloud(np.zeros((1, 3)), [[1.0, 0, 0, 0]], [[0.01] * 3], [0.02], np.zeros((1, 1, 3)))
    dust = GaussianCloud.joined([replace(few, means=few.means + np.array([i, 2 * i, 0])) for i in range(3)])
    obj = splat_points(dust, "dust", scene.collection)
    with pytest.raises(ValueError, match="take no light: Convert Splats to Mesh"):
        lit(obj, fast=True)
    assert not objects.is_lit(obj)
    obj = splat_points(ball(50), "ball", scene.collection)
    tree = bpy.data.node_groups.new("none", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    join = tree.nodes.new("GeometryNodeJoinGeometry")
    for _ in range(2):
        tree.links.new(start.outputs[0], join.inputs[0])
    move = tree.nodes.new("GeometryNodeTransform")
    tree.links.new(start.outputs[0], move.inputs[0])
    tree.links.new(move.outputs[0], join.inputs[0])
    tree.links.new(join.outputs[0], end.inputs[0])
    obj.modifiers.new("twice", "NODES").node_group = tree
    with pytest.raises(ValueError, match="its modifiers make other splats"):
        objects.light_source(obj)


def test_one_click_lights_what_blender_has_imported(extension, scene):
    obj = splat_points(ball(), "ball", scene.collection)
    scene.meshsplats_fast = True
    assert bpy.ops.scene.meshsplats_stage(lights="studio", fast=True) == {"FINISHED"}
    assert objects.is_lit(obj)
    assert np.ptp(light_of(obj.data)) > 0.2
    assert scene.camera is not None
    assert scene.objects["Ground"].location.z < -0.9
    panel = sys.modules["blender_extension.panel"]
    assert panel.light_warning(scene, obj) == ""
    for lamp in bpy.data.lights:
        lamp.energy *= 3
    assert panel.light_warning(scene, obj) == "Baked light is out of date: Bake Light again"
    before = light_of(obj.data)
    assert bpy.ops.scene.meshsplats_bake_light(fast=True) == {"FINISHED"}
    assert light_of(obj.data).mean() > 1.2 * before.mean()
    with pytest.raises(RuntimeError, match="take baked light alone"):
        bpy.ops.scene.meshsplats_bake_light(live=True)
    assert bpy.ops.object.meshsplats_shading(shading="unlit") == {"FINISHED"}
    assert not objects.is_lit(obj)
    assert bpy.ops.object.meshsplats_shading(shading="lit") == {"FINISHED"}
    assert np.ptp(light_of(obj.data)) > 0.2, "lit at once"


def test_a_hidden_original_is_left_alone(extension, scene):
    """*Convert Splats to Mesh* hides them, and the mesh takes the light."""
    obj = lit(splat_points(ball(), "ball", scene.collection), fast=True)
    assert bpy.ops.object.meshsplats_from_splats() == {"FINISHED"}
    assert not obj.children, "no stand-in casts the shadow of what is hidden"
    assert bpy.ops.scene.meshsplats_stage(fast=True) == {"FINISHED"}
    assert not objects.is_lit(obj)
    assert [objects.is_lit(mesh) for mesh in objects.splat_objects(scene)] == [True]
    assert meshes.size(obj.data) == len(ball())
