# ruff: noqa: E402
"""Levels of detail in Blender: a collection for each, one visible, chosen by hand or by the camera."""

from __future__ import annotations

import json

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import convert, save_mesh
from meshsplats.blender import LevelMeshes, LightOptions, SceneOptions, draw, subject
from meshsplats.blender.inside import levels, materials, meshes, objects, rendering, stage, versions
from meshsplats.blender.inside import scene as build_scene
from meshsplats.cameras.trajectories import dome, orbit
from meshsplats.cli import main
from meshsplats.images.reading import load_image

SIZES = (128, 64, 32)


@pytest.fixture(scope="module")
def chain():
    return LevelMeshes("ball", [convert(ball_splats(n)[0], mode="flat") for n in (640, 160, 40)], SIZES)


@pytest.fixture
def scene():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    return bpy.context.scene


def imported(chain, scene, *, lit=False):
    """The chain's collection and its objects, as the extension makes them."""
    prepared = [objects.prepare(mesh, lit, fast=True) for mesh in chain.meshes]
    objs = objects.add_chain(prepared, chain.name, chain.screen_sizes, scene.collection)
    return levels.chain_of(objs[0]), objs


def visible(scene):
    """Names of the splat meshes that the viewport shows, and of those that renders show."""
    bpy.context.view_layer.update()
    objs = [obj for obj in scene.objects if obj.type == "MESH" and levels.LEVEL in obj]
    shown = [obj.name for obj in objs if obj.visible_get()]
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = {item.object.name for item in depsgraph.object_instances if levels.LEVEL in item.object}
    assert set(shown) == evaluated
    return shown, [obj.name for obj in objs if not any(c.hide_render for c in obj.users_collection)]


def world(obj):
    places = np.array([vertex.co for vertex in obj.data.vertices])
    matrix = np.array(obj.matrix_world)
    return places @ matrix[:3, :3].T + matrix[:3, 3]


def fitting(found, scene):
    return levels.fitting_level(found, levels.screen_size(found, scene))


def watch(scene, camera):
    """Makes ``camera``, in Blender's frame, the active one."""
    obj = stage.add_camera(camera, "camera", np.eye(3), 1000, scene.collection)
    stage.aim(scene, camera, obj)
    return obj


@pytest.mark.nightly(keep=1)
@pytest.mark.parametrize("light", [None, LightOptions(bounces=0, ground="none")], ids=["unlit", "lit"])
def test_a_saved_file_shows_the_finest_and_switches_to_the_others(tmp_path, chain, light):
    """Whatever level is shown, the file renders as if it were alone."""
    views = orbit(chain.meshes[0], 1, width=40, height=30)
    options = SceneOptions(light=light, fast=light is not None)
    alone = []
    for i, mesh in enumerate(chain.meshes):
        draw(mesh, views, blend=tmp_path / f"{i}.blend", options=options)
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / f"{i}.blend"))
        rendering.render_to(bpy.context.scene, tmp_path / "a.png")
        alone.append(load_image(tmp_path / "a.png"))
    result = draw(chain, views, blend=tmp_path / "chain.blend", options=options)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "chain.blend"))
    scene = bpy.context.scene
    (found,) = levels.chains(scene)
    assert found.name == "ball"
    names = [f"ball level {i}" for i in range(3)]
    assert [child.name for child in found.children] == names
    added = ["", " stand-in", " light points"] if light else [""]
    of_levels = [[obj.name for obj in child.objects] for child in found.children]
    assert of_levels == [[name + suffix for suffix in added] for name in names]
    assert visible(scene) == ([names[0]], [names[0]])
    assert result["layers"] == max(obj.data[objects.LAYERS] for obj in levels.objects_of(found))
    for i in (0, 2, 1):
        levels.show(found, i)
        assert levels.visible_level(found) == i
        assert visible(scene) == ([names[i]], [names[i]])
        rendering.render_to(scene, tmp_path / "b.png")
        off = np.abs(load_image(tmp_path / "b.png").astype(int) - alone[i])
        # Where Cycles has AVX-512, one value of an unlit image may be rounded otherwise.
        assert off.max() <= (1 if light is None else 2)
        assert np.count_nonzero(off) <= (3 if light is None else off.size)
    assert any(np.abs(alone[i].astype(int) - alone[i - 1]).max() > 20 for i in (1, 2)), "levels differ"


@pytest.mark.slow
def test_the_command_line_saves_a_chain(tmp_path, chain, capsys):
    folder = tmp_path / "owl"
    folder.mkdir()
    rows = []
    for i, (mesh, size) in enumerate(zip(chain.meshes, SIZES, strict=True)):
        save_mesh(mesh, folder / f"level_{i}.npz")
        rows.append({"file": f"level_{i}.npz", "screen_size": size})
    (folder / "levels.json").write_text(json.dumps({"levels": rows}))
    for i, source in enumerate((folder, folder / "levels.json")):
        command = ["blender", str(source), "-o", str(tmp_path / f"{i}.blend"), "--json"]
        assert main([*command, "--fast"] if i else command) == 0
        assert json.loads(capsys.readouterr().out)["triangles"] == len(chain.meshes[0].faces)
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / f"{i}.blend"))
        scene = bpy.context.scene
        (found,) = levels.chains(scene)
        assert found.name == "owl"
        assert [len(obj.data.polygons) for obj in levels.objects_of(found)] == [
            len(mesh.faces) for mesh in chain.meshes
        ]
        assert fitting(found, scene) == 0, "the default camera is for 800 pixels"
        # As in a file that the extension made, colours and materials can be changed.
        for obj, mesh in zip(levels.objects_of(found), chain.meshes, strict=True):
            assert obj.data.materials[0].name.startswith("Splats, lit" if i else "Splats, unlit")
            np.testing.assert_allclose(objects.as_splat_mesh(obj).colors, mesh.colors, atol=1e-5)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("lit", [False, True], ids=["unlit", "lit"])
def test_imported_levels_stand_in_one_place(chain, scene, lit):
    found, objs = imported(chain, scene, lit=lit)
    assert levels.objects_of(found) == objs
    assert visible(scene) == (["ball level 0"], ["ball level 0"])
    assert bpy.context.view_layer.objects.active == objs[0]
    objs[0].location = (5, 6, 7)
    for i in (1, 2, 0):
        levels.show(found, i)
        np.testing.assert_allclose(np.median(world(objs[i]), axis=0), (5, 6, 8), atol=0.2)
        assert bpy.context.view_layer.objects.active == objs[i]
    again, _ = imported(chain, scene)
    assert [child.name for child in again.children] == [f"ball.001 level {i}" for i in range(3)]
    assert len(levels.chains(scene)) == 2


@pytest.mark.slow
def test_stand_ins_hide_with_their_level_and_each_level_is_baked(chain):
    options = SceneOptions(light=LightOptions(), fast=True)
    subjects = []
    for mesh, size in zip(chain.meshes, SIZES, strict=True):
        arrays, facts = subject.prepare(mesh, [], options, 10)
        subjects.append(build_scene.Subject(**arrays, **facts, name="ball", screen_size=size))
    built = build_scene.build(subjects[0], [], options, 64, edges=True, coarser=subjects[1:])
    (found,) = levels.chains(built.scene)
    for i in (0, 1, 2):
        levels.show(found, i)
        bpy.context.view_layer.update()
        shown = {obj.name for obj in built.scene.objects if obj.name.startswith("ball") and obj.visible_get()}
        assert shown == {f"ball level {i}", f"ball level {i} stand-in"}
        light = built.scene.objects[f"ball level {i}"].data.attributes[materials.LIGHT]
        values = np.empty(4 * len(light.data), np.float32)
        light.data.foreach_get("color", values)
        assert 0.2 < values.reshape(-1, 4)[:, :3].mean() < 0.9


def test_a_chain_of_one_level_is_a_chain(tmp_path, chain):
    one = LevelMeshes("one", chain.meshes[:1], SIZES[:1])
    draw(one, orbit(chain.meshes[0], 1, width=20, height=20), blend=tmp_path / "one.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "one.blend"))
    (found,) = levels.chains(bpy.context.scene)
    assert [child.name for child in found.children] == ["one level 0"]
    assert fitting(found, bpy.context.scene) == 0


def test_a_level_moved_by_hand_takes_the_others_along(chain, scene):
    found, objs = imported(chain, scene)
    levels.show(found, 2)
    bpy.context.view_layer.update()
    before = world(objs[2])
    objs[2].location.x += 3
    objs[2].scale = (2, 2, 2)
    bpy.context.view_layer.update()
    moved = world(objs[2])
    assert np.abs(moved - before).max() > 3
    levels.show(found, 1)
    np.testing.assert_allclose(np.ptp(world(objs[1]), axis=0), 2 * 2 * np.ones(3), atol=0.6)
    levels.show(found, 2)
    np.testing.assert_allclose(world(objs[2]), moved, atol=1e-5)


def test_selection_passes_to_the_level_that_is_shown(chain, scene):
    found, objs = imported(chain, scene)
    bpy.context.view_layer.update()
    objs[0].select_set(True)
    levels.show(found, 1)
    assert [obj.name for obj in bpy.context.view_layer.objects if obj.select_get()] == [objs[1].name]
    with pytest.raises(ValueError, match="has the levels 0 to 2, got 3"):
        levels.show(found, 3)
    assert levels.visible_level(found) == 1


def test_view_and_images_may_show_different_levels(chain, scene):
    found, objs = imported(chain, scene)
    levels.show(found, 2, "view")
    assert visible(scene) == ([objs[2].name], [objs[0].name])
    levels.show(found, 1, "render")
    assert visible(scene) == ([objs[2].name], [objs[1].name])
    assert [levels.visible_level(found, where) for where in ("view", "render")] == [2, 1]
    levels.show(found, 0)
    assert visible(scene) == ([objs[0].name], [objs[0].name])


def test_layers_of_levels_do_not_add_up(chain, scene):
    _, objs = imported(chain, scene)
    most = max(obj.data[objects.LAYERS] for obj in objs)
    assert objects.count_layers(objects.splat_objects(scene)) == most
    other = objects.add(objects.prepare(chain.meshes[2], False), "other", scene.collection)
    assert objects.count_layers([*objs, other]) == most + other.data[objects.LAYERS]
    assert levels.with_levels(other) == [other]
    assert levels.with_levels(objs[1]) == objs


def test_a_level_fits_the_camera_for_whose_size_it_was_made(chain, scene):
    found, objs = imported(chain, scene)
    bpy.context.view_layer.update()
    for shown in (0, 2):  # whatever is visible
        levels.show(found, shown)
        for level, width in enumerate(SIZES):
            camera = dome(meshes.world_points(objs[0]), 3, up=(0, 0, 1), width=width, height=width)[1]
            watch(scene, camera)
            assert levels.screen_size(found, scene) == pytest.approx(width, rel=0.03)
            assert fitting(found, scene) == level


def test_the_size_follows_distance_lens_and_resolution(chain, scene):
    found, objs = imported(chain, scene)
    bpy.context.view_layer.update()
    points = meshes.world_points(objs[0])

    def size(**lens):
        watch(scene, orbit(points, 1, up=(0, 0, 1), **{"width": 100, "height": 100} | lens)[0])
        return levels.screen_size(found, scene)

    assert size() == pytest.approx(100, rel=0.03)
    assert size(distance=4) == pytest.approx(25, rel=0.03)
    assert size(width=200) == pytest.approx(100, rel=0.03), "the shorter side decides"
    assert size(width=200, height=200) == pytest.approx(200, rel=0.03)
    scene.render.resolution_percentage = 50
    assert levels.screen_size(found, scene) == pytest.approx(100, rel=0.03)
    scene.render.resolution_percentage = 100
    # Where the camera looks does not matter: levels must not change as it pans.
    scene.camera.rotation_euler = (1, 2, 3)
    assert levels.screen_size(found, scene) == pytest.approx(200, rel=0.03)
    scene.camera.data.lens *= 2
    assert levels.screen_size(found, scene) == pytest.approx(400, rel=0.03)
    # The subject twice as large, seen from the same distance.
    scene.camera.data.lens /= 2
    scene.camera.location = (0, 0, 1000)
    far = levels.screen_size(found, scene)
    objs[0].scale = (2, 2, 2)
    assert levels.screen_size(found, scene) == pytest.approx(2 * far, rel=0.01)
    objs[0].scale = (1, 1, 1)
    # A ball of radius 1, 1.08 of which images leave room for, on an orthographic image 10 units wide.
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", 10
    assert levels.screen_size(found, scene) == pytest.approx(200 * 2.16 / 10, rel=0.15)
    levels.show(found, fitting(found, scene))
    assert levels.visible_level(found) == 1


def test_without_a_camera_nothing_fits(chain, scene):
    found, objs = imported(chain, scene)
    with pytest.raises(ValueError, match="no active camera"):
        fitting(found, scene)
    bpy.context.view_layer.update()
    watch(scene, orbit(meshes.world_points(objs[0]), 1, up=(0, 0, 1))[0]).data.type = "PANO"
    with pytest.raises(ValueError, match="camera is panoramic"):
        fitting(found, scene)
    bpy.data.objects.remove(objs[0])
    scene.camera.data.type = "PERSP"
    for obj in objs[1:]:
        bpy.data.objects.remove(obj)
    with pytest.raises(ValueError, match="no visible vertices"):
        fitting(found, scene)


def test_light_and_camera_leave_saved_splats_in_place(tmp_path, chain):
    """Setting up the stage replaces lights and cameras, never the splats."""
    from meshsplats.blender.inside import setting

    for mesh in (chain, chain.meshes[0]):
        draw(mesh, orbit(chain.meshes[0], 1, width=20, height=20), blend=tmp_path / "s.blend")
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "s.blend"))
        scene = bpy.context.scene
        every = objects.splat_objects(scene)
        setting.set_up(scene, every, "sun")
        assert objects.splat_objects(scene) == every
