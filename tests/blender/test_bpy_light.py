# ruff: noqa: E402
"""Light baked on a stand-in surface and shown by the splats."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import DataWarning, convert, orbit, render
from meshsplats.blender import LightOptions, SceneOptions, subject
from meshsplats.blender.inside import (
    baking,
    homes,
    materials,
    meshes,
    objects,
    rendering,
    scene,
    stage,
    stand_ins,
    versions,
)
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.mesh import SplatMesh

SIDE = 48


class Ball(NamedTuple):
    """What every test begins with. What no light changes is made once, which takes most of the time."""

    mesh: SplatMesh
    view: Camera
    subject: scene.Subject
    limit: int
    """That of transparent bounces."""
    prepared: dict[str, Any]
    """For a preview in a file of the user's."""


def built(ball, light):
    options = SceneOptions(light=light, samples=4)
    return scene.build(ball.subject, [ball.view], options, ball.limit, edges=False)


def shot(made, path):
    rendering.render_to(made.scene, path)
    return rendering.read_pixels(path)[..., :3]


@pytest.fixture(scope="module")
def ball():
    cloud, _ = ball_splats(1500, noise=0.1)
    mesh = convert(cloud, mode="flat")
    view = orbit(mesh, 1, elevation=20, azimuth=30, width=SIDE, height=SIDE)[0]
    options = SceneOptions(light=LightOptions(), within=())  # a ball is no place
    layers, limit = subject.count(mesh, [view], options)
    arrays, facts = subject.prepare(mesh, [view], options, layers)
    made = scene.Subject(**arrays, **facts)
    return Ball(mesh, view, made, limit, objects.prepare(mesh, True, fast=True, views=()))


def light_of(obj):
    attribute = obj.data.attributes[materials.LIGHT]
    values = np.empty(4 * len(attribute.data), np.float32)
    attribute.data.foreach_get("color", values)
    return values.reshape(-1, 4)[:, :3]


def test_even_light_shows_the_unlit_image(ball, tmp_path):
    mesh, view = ball.mesh, ball.view
    made = built(ball, LightOptions(sun_strength=0, sky=1, ground="none", exposure=0))
    lit = linear_to_srgb(np.clip(shot(made, tmp_path / "lit.exr"), 0, 1))
    unlit = render(mesh, view, samples=2)
    inside = unlit.alpha > 0.02
    assert np.sqrt(np.square(lit - unlit.color)[inside].mean()) < 0.04
    assert np.abs(light_of(made.obj) - 1).max() < 0.04, "nothing shades a ball"


@pytest.mark.slow
def test_the_image_of_the_splats_has_no_noise(ball, tmp_path):
    mesh, view = ball.mesh, ball.view
    made = built(ball, LightOptions(ground="none"))
    images = []
    for seed in (0, 1):
        made.scene.cycles.seed = seed
        images.append(shot(made, tmp_path / "a.exr"))
    # Deep inside the silhouette, where samples of a pixel differ in position only.
    solid = render(mesh, view).alpha > 0.995
    assert np.abs(images[0] - images[1])[solid].mean() < 0.01
    baking.forget([made.obj])
    live = []
    for seed in (0, 1):
        made.scene.cycles.seed = seed
        live.append(shot(made, tmp_path / "a.exr"))
    assert np.abs(live[0] - live[1])[solid].mean() > 0.03, "lamps in every image do make noise"
    # The same light, but for the noise.
    assert np.mean(live)[None] == pytest.approx(np.mean(images), rel=0.08)


@pytest.mark.slow
def test_lamps_and_other_objects_light_and_shade_the_splats(ball):
    mesh = ball.mesh
    made = built(ball, LightOptions(sun=(0, 89), sky=0, ground="none"))
    before = light_of(made.obj)
    top = -mesh.vertices[:, 1]  # y points down in the file
    cap = top > 0.9
    assert before[cap].mean() == pytest.approx(2.5 / np.pi * top[cap].mean(), rel=0.05)
    assert before[top < -0.3].max() < 0.02
    bpy.ops.mesh.primitive_cube_add(size=0.8, location=(0, 0, 2))
    samples = made.scene.cycles.samples
    assert baking.bake(made.scene, [made.obj]) == 1
    after = light_of(made.obj)
    across = np.abs(mesh.vertices[:, [0, 2]]).max(axis=1)
    assert after[(top > 0.5) & (across < 0.25)].max() < 0.05, "in the shadow of the cube"
    sunny = (top > 0.3) & (across > 0.6)
    np.testing.assert_allclose(after[sunny].mean(), before[sunny].mean(), rtol=0.05)
    assert made.scene.cycles.samples == samples
    assert not made.obj.hide_render
    assert baking.points_of(made.obj).hide_render


def test_the_unlit_mesh_comes_back_unchanged(ball):
    mesh = ball.mesh
    obj = lit_ball(ball)
    assert baking.points_of(obj) is not None
    assert not obj.visible_shadow
    again = objects.as_splat_mesh(obj)
    assert (again.colors == mesh.colors).all()
    objects.replace_mesh(obj, objects.prepare(again, False))
    assert obj.visible_shadow
    assert not obj.children
    assert baking.points_of(obj) is None
    assert baking.bake(bpy.context.scene, [obj]) == 0


def lit_ball(ball):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return objects.add(ball.prepared, "ball", bpy.context.collection)


def test_painted_colours_of_a_lit_mesh_are_kept(ball):
    mesh = ball.mesh
    obj = lit_ball(ball)
    painted = meshes.read_colors(obj.data, meshes.COLOR)
    painted[:10, :3] = (1.0, 0.5, 0.0)
    painted[5:20, 3] = 0.25
    obj.data.attributes[meshes.COLOR].data.foreach_set("color", painted.ravel())
    unlit = objects.as_splat_mesh(obj).colors
    expected = mesh.colors.copy()
    expected[:10, :3] = linear_to_srgb(np.float32([1, 0.5, 0]))
    expected[5:20, 3] = 0.25
    assert np.array_equal(unlit, expected)


def test_light_points_may_be_renamed_and_deleted(ball):
    obj = lit_ball(ball)
    points = baking.points_of(obj)
    points.name = "points"
    assert baking.points_of(obj) == points
    for collection in points.users_collection:  # as the window deletes what a property refers to
        collection.objects.unlink(points)
    assert baking.points_of(obj) is None
    assert baking.bake(bpy.context.scene, [obj]) == 0
    bpy.data.objects.remove(points)
    assert baking.points_of(obj) is None


def test_the_stand_in_is_seen_by_light_alone(ball, tmp_path):
    """A mirror shows the splats, the ground their shadow, and no camera the surface itself."""
    mesh, view = ball.mesh, ball.view
    made = built(ball, LightOptions(ground="none"))
    made.obj.visible_camera = False
    seen = shot(made, tmp_path / "a.exr")
    made.obj.visible_camera = True
    bare = shot(made, tmp_path / "b.exr")
    assert np.ptp(seen) < 1e-3, "the background alone"
    assert np.ptp(bare) > 0.2
    home = stage.collection("ground")
    stage.add_ground(np.array([0.0, 0, -1.2]), 1.0, False, home)
    made.obj.hide_render = True  # and with it the stand-in: it casts no shadow
    without = shot(made, tmp_path / "c.exr")
    made.obj.hide_render = False
    shadowed = shot(made, tmp_path / "d.exr")
    floor = render(mesh, view).alpha < 0.01
    assert (shadowed[floor] < 0.6 * without[floor]).mean() > 0.02, "the stand-in alone casts the shadow"


def test_the_stand_in_is_hidden_and_moved_with_its_splats(ball):
    obj = lit_ball(ball)
    view = bpy.context.scene
    points = baking.points_of(obj)
    (surface,) = (child for child in obj.children if child != points)
    obj.hide_render = True
    obj.keyframe_insert("hide_render", frame=1)
    obj.hide_render = False
    obj.keyframe_insert("hide_render", frame=2)
    for number in (1, 2, 1):  # also where the extension is missing
        view.frame_set(number)
        assert surface.hide_render == obj.hide_render == (number == 1)
        assert points.hide_render
    home = bpy.data.collections.new("home")
    view.collection.children.link(home)
    view.collection.objects.unlink(obj)
    home.objects.link(obj)
    obj.hide_viewport = True
    stand_ins.follow(view)
    assert [child.users_collection for child in obj.children] == [(home,)] * len(obj.children)
    assert surface.hide_viewport
    obj.hide_viewport = False
    stand_ins.follow(view)
    assert not surface.hide_viewport
    assert points.hide_viewport


def test_light_linking_takes_the_stand_in_for_its_splats(ball):
    """Where one receiver is included, a lamp lights no others: stand-ins of excluded splats must not be."""
    obj, view = lit_ball(ball), bpy.context.scene
    lamp = stage.add_sun(np.array([0.0, 0, 1]), 3.0, 1.0, 0.01, view.collection)
    receivers = bpy.data.collections.new("receivers")
    lamp.light_linking.receiver_collection = receivers
    receivers.objects.link(obj)
    for state in ("EXCLUDE", "INCLUDE", "EXCLUDE"):
        receivers.collection_objects[0].light_linking.link_state = state
        assert stand_ins.has_strays(view)
        stand_ins.remove_strays(view)
        assert not stand_ins.has_strays(view)
        states = [kept.light_linking.link_state for kept in receivers.collection_objects]
        assert states == [state] * (1 + len(obj.children))
    receivers.objects.unlink(obj)
    stand_ins.remove_strays(view)
    assert not len(receivers.objects)
    assert not stand_ins.has_strays(view)


def in_a_collection(obj, name):
    """A new one in the scene, to which ``obj`` and its parts have moved."""
    scene = bpy.context.scene.collection
    home = bpy.data.collections.new(name)
    scene.children.link(home)
    for part in (obj, *obj.children):
        homes.put(part, {scene: "INCLUDE"}, {home: "INCLUDE"})
    return home


def test_a_rigid_body_of_splats_is_one_body(ball):
    """And what is made for it is put where it is seen: by name, the collection of physics comes first."""
    obj, view = lit_ball(ball), bpy.context.scene
    home = in_a_collection(obj, "Splats")
    bpy.ops.rigidbody.world_add()
    bpy.context.view_layer.objects.active = obj
    bpy.ops.rigidbody.object_add(type="ACTIVE")
    assert obj.users_collection[0] == view.rigidbody_world.collection
    stand_ins.remove_strays(view)
    assert not stand_ins.has_strays(view)
    objects.replace_mesh(obj, ball.prepared)
    assert obj.rigid_body is not None
    assert len(obj.children) == 2
    assert all(child.rigid_body is None for child in obj.children)
    assert [child.users_collection for child in obj.children] == [(home,)] * 2
    assert homes.shown_by(bpy.context.view_layer, obj) == home


def test_a_collection_of_the_artist_may_be_that_of_physics(ball):
    obj, view = lit_ball(ball), bpy.context.scene
    bodies = in_a_collection(obj, "Bodies")
    bpy.ops.rigidbody.world_add()
    view.rigidbody_world.collection = bodies  # which makes bodies of all that is in it
    stand_ins.remove_strays(view)
    assert not stand_ins.has_strays(view)
    assert obj.users_collection == (bodies,)
    assert [child.users_collection for child in obj.children] == [(view.collection,)] * 2
    before = np.array(obj.matrix_world)
    for frame in range(1, 9):
        view.frame_set(frame)
    assert obj.matrix_world.translation.z < before[2, 3] - 0.01, "they fall"
    assert obj[stand_ins.SURFACE].matrix_world == obj.matrix_world, "with what is made for them"


@pytest.mark.parametrize("rays", [(False, True), (True, False)])
def test_rays_that_the_artist_has_chosen_see_unlit_splats_again(ball, rays):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    unlit = objects.prepare(ball.mesh, False)
    obj = objects.add(unlit, "ball", bpy.context.collection)
    obj.visible_shadow, obj.visible_diffuse = rays
    for prepared in (unlit, ball.prepared, ball.prepared, unlit):
        objects.replace_mesh(obj, prepared)
        lit = prepared is ball.prepared
        assert (obj.visible_shadow, obj.visible_diffuse) == ((False, False) if lit else rays)


def test_live_light_is_of_one_of_two_duplicates(ball):
    """Shift D copies the mesh, not its material."""
    obj = lit_ball(ball)
    materials.set_baked(obj.data.materials[0], True)
    other = obj.copy()
    other.data = obj.data.copy()
    bpy.context.collection.objects.link(other)
    for _ in range(2):
        baking.forget([other])
        assert [materials.shows_baked(o.data.materials[0]) for o in (obj, other)] == [True, False]
    assert len([m for m in bpy.data.materials if m.name.startswith("Splats")]) == 2


def test_hidden_splats_are_baked_as_if_they_were_visible(ball):
    obj = lit_ball(ball)
    versions.enable_cycles()
    stage.add_sun(np.array([0.0, 0, 1]), 3.0, 1.0, 0.01, bpy.context.collection)
    light = []
    for hidden in (False, True):
        obj.hide_render = hidden
        assert baking.bake(bpy.context.scene, [obj], samples=4) == 1
        assert obj.hide_render == hidden
        assert obj.visible_camera
        assert not obj.visible_shadow
        light.append(light_of(obj))
    np.testing.assert_array_equal(*light)
    assert light[0].min() < 0.02 < light[0].max(), "its stand-in shades it"


def sunny_ball(ball):
    """The lit ball in a collection of its own, under a sun and on a ground."""
    obj = lit_ball(ball)
    versions.enable_cycles()
    scene = bpy.context.scene
    stage.add_sun(np.array([0.0, 0, 1]), 3.0, 1.0, 0.01, scene.collection)
    stage.add_ground(np.array([0.0, 0, -1.2]), 1.0, False, scene.collection)
    home = bpy.data.collections.new("home")
    scene.collection.children.link(home)
    for part in (obj, *obj.children):
        scene.collection.objects.unlink(part)
        home.objects.link(part)
    return obj, home


def test_light_is_the_same_wherever_splats_are_hidden(ball):
    obj, home = sunny_ball(ball)
    view, layer = bpy.context.scene, bpy.context.view_layer
    place = layer.layer_collection.children["home"]
    ground = view.objects["Ground"]
    ground.select_set(True)
    layer.objects.active = ground
    baking.bake(view, [obj], samples=4)
    expected = light_of(obj)
    assert expected.min() < 0.5 < expected.max()
    for owner, switch in [
        *((home, name) for name in ("hide_viewport", "hide_render", "hide_select")),
        *((place, name) for name in ("hide_viewport", "holdout", "indirect_only", "exclude")),
        (obj, "hide_viewport"),
    ]:
        setattr(owner, switch, True)
        light = obj.data.attributes[materials.LIGHT]
        light.data.foreach_set("color", np.zeros(4 * len(light.data), np.float32))
        assert baking.bake(view, [obj], samples=4) == 1
        np.testing.assert_allclose(light_of(obj), expected, atol=1e-4, err_msg=switch)
        assert getattr(owner, switch)
        setattr(owner, switch, False)
    assert list(view.view_layers) == [layer]
    assert [child.users_collection for child in obj.children] == [(home,)] * len(obj.children)
    assert bpy.context.selected_objects == [ground] == [layer.objects.active]


def test_what_cannot_be_baked_is_left_out_and_the_others_are_lit(ball):
    obj, _ = sunny_ball(ball)
    view = bpy.context.scene
    broken = objects.add(ball.prepared, "broken", view.collection)
    points = baking.points_of(broken).data
    points.color_attributes.remove(points.color_attributes[materials.LIGHT])
    with pytest.warns(DataWarning, match="broken was left out, it cannot be baked: "):
        assert baking.bake(view, [broken, obj], samples=4) == 1
    assert np.ptp(light_of(obj)) > 0.3
    assert not baking.is_older(view, obj)
    assert len(view.view_layers) == 1
    assert broken.visible_camera
    assert baking.points_of(broken).hide_render


def test_light_does_not_depend_on_settings_of_images(ball):
    """Which apply the film's exposure to it once more, and after *Exact* have no bounces."""
    obj, _ = sunny_ball(ball)
    view = bpy.context.scene
    baking.bake(view, [obj], samples=4)
    expected = light_of(obj)
    view.cycles.film_exposure, view.cycles.max_bounces = 4.0, 0
    baking.bake(view, [obj], samples=4)
    np.testing.assert_allclose(light_of(obj), expected, atol=1e-4)
    assert (view.cycles.film_exposure, view.cycles.max_bounces) == (4.0, 0)


def test_an_appended_object_brings_its_stand_in(ball, tmp_path):
    lit_ball(ball)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "ball.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.append(directory=str(tmp_path / "ball.blend" / "Object"), filename="ball")
    obj = bpy.context.scene.objects["ball"]
    (surface,) = (child for child in obj.children if child != baking.points_of(obj))
    assert surface.name in bpy.context.scene.objects
    assert stand_ins.is_current(obj)
    bpy.data.objects.remove(surface)
    assert not stand_ins.is_current(obj, counts_only=True), "nothing casts its shadow"
