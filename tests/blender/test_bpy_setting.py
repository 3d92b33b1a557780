# ruff: noqa: E402
"""Light, ground and camera around objects of an open file, and the origin of imported objects."""

from __future__ import annotations

import errno
import shutil

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector

from meshsplats import SplatMesh, convert
from meshsplats.blender import LightOptions, SceneOptions, draw
from meshsplats.blender.inside import notes, objects, rendering, setting, versions, views, written
from meshsplats.blender.options import LIGHTS
from meshsplats.cameras.trajectories import look_at
from meshsplats.images.reading import load_image


@pytest.fixture
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    return bpy.context.scene


def ball():
    mesh = convert(ball_splats(600)[0], mode="flat")
    return objects.add(objects.prepare(mesh, True, fast=True), "ball", bpy.context.collection)


def corners(obj):
    places = np.array([vertex.co for vertex in obj.data.vertices])
    world = np.array(obj.matrix_world)
    return places @ world[:3, :3].T + world[:3, 3]


def test_the_origin_lies_under_the_subject(empty):
    """And the object where its file has it, upright, also after another shading and another conversion."""
    cloud, _ = ball_splats(600)
    mesh = convert(cloud, mode="flat")
    obj = objects.add(objects.prepare(mesh, False), "ball", bpy.context.collection)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(obj.location, (0, 0, -1), atol=0.12)
    before = corners(obj)
    # y down and z forward in the file are z up and y back here.
    np.testing.assert_allclose(before, mesh.vertices[:, [0, 2, 1]] * [1, 1, -1], atol=1e-5)
    again = objects.as_splat_mesh(obj)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-5)
    obj.location = (5, 6, 7)
    objects.replace_mesh(obj, objects.prepare(again, True, fast=True))
    bpy.context.view_layer.update()
    assert tuple(obj.location) == (5, 6, 7)
    np.testing.assert_allclose(corners(obj)[:, 2].min(), 7, atol=0.12)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("lights", LIGHTS)
def test_one_click_sets_everything_up(empty, lights):
    obj = ball()
    obj.location = (10, -3, 2)
    bpy.context.view_layer.update()
    for _ in range(2):  # a second click replaces what the first made
        setting.set_up(empty, [obj], lights, fast=True)
    names = sorted(o.name for o in empty.objects)
    lamps = {"sun": ["Sun"], "noon": ["Sun"], "overcast": [], "studio": ["Fill", "Sun"]}[lights]
    assert names == sorted(["ball", "ball light points", "ball stand-in", "Camera", "Ground", *lamps])
    ground = empty.objects["Ground"]
    assert ground.data.materials[0].use_backface_culling, "EEVEE's viewports look through it from below"
    assert empty.objects["ball stand-in"].display_type == "BOUNDS", "no wires over the splats"
    np.testing.assert_allclose(ground.location, (10, -3, 2), atol=0.12)
    assert empty.camera is empty.objects["Camera"]
    from bpy_extras.object_utils import world_to_camera_view

    bpy.context.view_layer.update()
    places = [obj.matrix_world @ vertex.co for vertex in list(obj.data.vertices)[::20]]
    seen = np.array([world_to_camera_view(empty, empty.camera, place) for place in places])
    assert (seen[:, :2] > 0).all()
    assert (seen[:, :2] < 1).all()
    assert np.ptp(seen[:, 1]) > 0.6, "it fills the image"
    assert empty.cycles.use_denoising
    assert empty.view_settings.exposure == pytest.approx(LIGHTS[lights].exposure)


def test_the_camera_of_a_shot_stays_the_active_one(tmp_path):
    """Unless another one is asked for, which sees the splats at the pixel aspect of the file."""
    bpy.ops.wm.read_factory_settings()
    scene, obj = bpy.context.scene, ball()
    camera, render = scene.camera, scene.render
    camera.keyframe_insert("location", frame=1)
    render.pixel_aspect_x = 2
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    notes.take()
    setting.set_up(scene, [obj], fast=True)
    assert scene.camera == camera
    assert [o.name for o in scene.objects if o.type == "CAMERA"] == ["Camera"]
    assert "Camera stays the active camera: New Camera in the panel makes another" in notes.take()
    setting.set_up(scene, [obj], camera=True, fast=True)
    assert "the active camera is Camera.001, in place of Camera" in notes.take()
    assert (render.resolution_x, render.resolution_y) == (1920, 1080)
    assert (render.pixel_aspect_x, render.pixel_aspect_y) == (2, 1)
    bpy.context.view_layer.update()
    places = [obj.matrix_world @ vertex.co for vertex in list(obj.data.vertices)[::20]]
    across, up, _ = np.array([world_to_camera_view(scene, scene.camera, place) for place in places]).T
    assert 0 < up.min() < up.max() < 1
    assert np.ptp(up) > 0.6
    assert np.ptp(across) / np.ptp(up) == pytest.approx(9 / 32, rel=0.1), "as wide as high where it is shown"


@pytest.mark.parametrize("change", ["nothing", "save", "save moved", "prop", "keys"])
def test_whose_camera_it_is(tmp_path, change):
    bpy.ops.wm.read_factory_settings()
    scene = bpy.context.scene
    if change == "prop":
        bpy.ops.mesh.primitive_cone_add()
    elif change == "keys":
        scene.camera.keyframe_insert("location", frame=1)
    elif change == "save moved":
        scene.camera.location.x += 1
    if change.startswith("save"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    assert setting.has_own_camera(scene) == (change in ("save moved", "prop", "keys"))


def test_without_splats_it_says_so(empty):
    with pytest.raises(ValueError, match="no splat mesh in the scene"):
        setting.set_up(empty, [])


def plate(value: float) -> tuple[SplatMesh, object]:
    """An upright white plate that faces the viewer, and a camera before it."""
    square = np.array([[-1.0, -2, 0], [1, -2, 0], [1, 0, 0], [-1, 0, 0]])
    colors = np.array([[value, value, value, 1.0]] * 4)
    normals = np.tile([0.0, 0, -1], (4, 1))
    mesh = SplatMesh(square, np.array([[0, 1, 2], [0, 2, 3]]), colors, normals=normals)
    return mesh, look_at((0, -1.4, -5), (0, -0.9, 0), width=48, height=36)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("lights", LIGHTS)
def test_white_looks_white(tmp_path, lights):
    """A white plate (display value 0.95) under each named light, shown by the default exposure."""
    mesh, camera = plate(0.95)
    options = SceneOptions(light=LIGHTS[lights], samples=32, denoise=True, fast=lights != "sun")
    draw(mesh, [camera], images=[tmp_path / "a.png"], options=options)
    image = load_image(tmp_path / "a.png")
    middle = image[14:22, 20:28].mean()
    assert 0.88 * 255 < middle < 254, middle


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.2, 0.3, 0.5)])
def test_the_ground_fades_into_the_background(tmp_path, background):
    """No hard horizon: from the ground's colour to the background's it takes many rows, in small steps."""
    mesh, _ = plate(0.5)
    small = SplatMesh(mesh.vertices * 0.3, mesh.faces, mesh.colors, normals=mesh.normals)
    camera = look_at((0, -0.5, -3), (-0.7, -0.3, 0), width=24, height=240, fov=6.6)  # 60 degrees high
    options = SceneOptions(light=LightOptions(), samples=32, background=background, denoise=True, fast=True)
    draw(small, [camera], images=[tmp_path / "a.png"], options=options)
    column = load_image(tmp_path / "a.png").mean(axis=(1, 2))
    np.testing.assert_allclose(column[0], 255 * np.mean(background), atol=2)
    change = column[-1] - column[0]
    assert abs(change) > 20, "there is a ground"
    share = (column - column[0]) / change
    assert ((share > 0.1) & (share < 0.9)).sum() >= 5
    assert abs(np.diff(share)).max() < 0.35


def test_values_of_light_do_not_change_with_exposure(tmp_path):
    mesh, camera = plate(0.5)
    values = []
    for exposure in (0.0, 2.0):
        options = SceneOptions(light=LightOptions(exposure=exposure), samples=4, fast=True)
        draw(mesh, [camera], images=[tmp_path / "a.exr"], options=options)
        values.append(rendering.read_pixels(tmp_path / "a.exr"))
    np.testing.assert_array_equal(*values)


@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_a_truncated_image_is_an_error(tmp_path, monkeypatch, suffix):
    """Blender does not report a full disk, and leaves a truncated file."""
    mesh, camera = plate(0.5)
    path = tmp_path / f"a.{suffix}"
    draw(mesh, [camera], images=[path])
    written.check_image(path, 48 * 36)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(OSError, match="wrote no image"):
        written.check_image(path, 48 * 36)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 0))
    with pytest.raises(OSError) as caught:
        written.check_image(path, 48 * 36)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))


def test_a_truncated_blend_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "a.blend"
    draw(convert(ball_splats(200)[0]), [], blend=path)
    written.check_blend(path)
    data = path.read_bytes()
    for broken in (data[:-1], data[: len(data) // 2], data[:5000] + data[5100:], b""):
        path.write_bytes(broken)
        with pytest.raises(OSError, match=r"a\.blend: Blender wrote no complete file"):
            written.check_blend(path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 0))
    with pytest.raises(OSError) as caught:
        written.check_blend(path)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))


def test_the_start_scene_is_hidden_once_and_only_as_it_was(tmp_path):
    bpy.ops.wm.read_factory_settings()
    view = bpy.context.scene
    cube, lamp = view.objects["Cube"], view.objects["Light"]
    cube.location.x = lamp.location.x = 1
    assert setting.hide_start_scene(view) == [], "what was moved is the user's"
    cube.location.x, lamp.location.x = 0, 4.07625
    cube.modifiers.new("Bevel", "BEVEL")
    assert setting.hide_start_scene(view) == ["Light"], "and what was modelled"
    cube.modifiers.clear()
    assert setting.hide_start_scene(view) == ["Cube"]
    assert [o.hide_render and o.hide_get() for o in (cube, lamp)] == [True, True]
    assert setting.hide_start_scene(view) == []
    lamp.hide_render = False
    assert setting.hide_start_scene(view) == [], "who shows it again wants it"
    cube.hide_render = False
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    assert setting.hide_start_scene(view) == [], "a saved file is the user's"


def test_what_is_excluded_at_the_start_needs_no_hiding():
    bpy.ops.wm.read_factory_settings()
    bpy.context.view_layer.layer_collection.children["Collection"].exclude = True
    assert setting.hide_start_scene(bpy.context.scene) == []


def test_viewports_show_what_was_imported():
    bpy.ops.wm.read_factory_settings()
    obj = ball()
    obj.location = (100, 20, 3)
    bpy.context.view_layer.update()
    setting.frame_in_viewports(bpy.context.window_manager.windows, [obj])
    areas = [a for w in bpy.context.window_manager.windows for a in w.screen.areas if a.type == "VIEW_3D"]
    assert areas
    space = areas[0].spaces.active
    middle = np.mean([tuple(obj.matrix_world @ v.co) for v in obj.data.vertices], axis=0)
    np.testing.assert_allclose(space.region_3d.view_location, middle, atol=0.2)
    # The ball of radius 1 fills half to all of the view's height at 16 : 9; viewports take a sensor of 72 mm.
    half = space.region_3d.view_distance * 36 / space.lens * 9 / 16
    assert 1 < half < 2


def test_the_camera_of_the_start_scene_sees_what_was_imported(tmp_path):
    bpy.ops.wm.read_factory_settings()
    view, obj = bpy.context.scene, ball()
    obj.location, obj.scale = (100, 20, 3), (9, 9, 9)
    bpy.context.view_layer.update()
    before = np.array(view.camera.matrix_world)
    setting.frame_in_start_camera(view, [obj])
    bpy.context.view_layer.update()
    camera = view.camera
    np.testing.assert_allclose(np.array(camera.matrix_world)[:3, :3], before[:3, :3], atol=1e-6)
    places = [world_to_camera_view(view, camera, obj.matrix_world @ v.co) for v in obj.data.vertices]
    across, up, away = np.array(places).T
    assert 0 < up.min() < 0.2, "nearly as high as the image"
    assert 0.8 < up.max() < 1
    assert 0 < across.min() < across.max() < 1
    assert away.min() > camera.data.clip_start
    assert away.max() < camera.data.clip_end
    moved = camera.location.copy()
    obj.location.x = 0
    bpy.context.view_layer.update()
    setting.frame_in_start_camera(view, [obj])
    assert camera.location == moved, "a camera that was moved is the user's"
    camera.matrix_world = Matrix(before)
    bpy.context.view_layer.update()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    setting.frame_in_start_camera(view, [obj])
    np.testing.assert_allclose(
        camera.location, before[:3, 3], atol=1e-6, err_msg="a saved file is the user's"
    )


def test_a_place_is_seen_from_within(tmp_path):
    """By viewports and by the start camera, wherever the object has been moved; and Studio's camera."""
    bpy.ops.wm.read_factory_settings()
    scene, obj = bpy.context.scene, ball()
    inside = look_at((0.2, -0.3, 0.1), (1, 0.4, 0.3), up=(0, 1, 0), fov=60, width=400, height=300)
    views.remember(obj, [inside])
    obj.location, obj.scale, obj.rotation_euler = (5, 2, 3), (3, 3, 3), (0.3, 0, 1)
    bpy.context.view_layer.update()
    view = views.opening([obj])
    setting.look_from(view, bpy.context.window_manager.windows, scene)
    bpy.context.view_layer.update()
    x, y = np.meshgrid([-200.0, 0, 200], [-150.0, 0, 150])
    rays = np.stack([x / inside.fx, y / inside.fy, np.ones_like(x)], axis=-1).reshape(-1, 3)
    points = inside.center + rays @ inside.world_to_camera[:3, :3]
    world = points @ np.array(obj.matrix_world)[:3, :3].T + np.array(obj.location)
    shown = np.array([world_to_camera_view(scene, scene.camera, Vector(p)) for p in world])
    np.testing.assert_allclose(shown[4, :2], 0.5, atol=1e-5)
    # Its image, 4 : 3, lies within that of 16 : 9, and is as wide as it can be.
    assert (shown[:, :2] >= -1e-6).all()
    assert (shown[:, :2] <= 1 + 1e-6).all()
    np.testing.assert_allclose(shown[[0, 8], 0], [0.5 - 9 / 32, 0.5 + 9 / 32], atol=1e-5)
    assert shown[0, 1] > shown[8, 1], "y goes down in images"
    space = next(a for a in bpy.context.screen.areas if a.type == "VIEW_3D").spaces.active
    seen = space.region_3d
    ahead = np.array(seen.view_rotation.to_matrix())[:, 2]
    eye = np.array(seen.view_location) + seen.view_distance * ahead
    np.testing.assert_allclose(eye, np.array(scene.camera.matrix_world)[:3, 3], atol=1e-4)
    np.testing.assert_allclose(ahead, np.array(scene.camera.matrix_world)[:3, 2], atol=1e-5)
    assert space.lens == pytest.approx(36 * 9 / 16 / view.half)
    camera = view.camera(400, 300)
    np.testing.assert_allclose(camera.center, eye, atol=1e-4)
    np.testing.assert_allclose(camera.fx, 300 / 2 / view.half)
    assert views.opening([]) is None
    for broken in ([1.0] * 5, [float("nan")] * 18, [0.0] * 18, [1.0] * 20, "view", {"a": 1}, [{"a": 1}], obj):
        obj[views.VIEWS] = broken
        assert views.opening([obj]) is None
        assert views.within(obj, np.zeros(3)) is None


@pytest.mark.parametrize("scale", [(-1, 1, 1), (1, 1, 1.3)])
def test_a_mirrored_or_stretched_place_is_seen_from_within(scale):
    bpy.ops.wm.read_factory_settings()
    obj = ball()
    inside = look_at((0.2, -0.3, 0.1), (1, 0.4, 0.3), up=(0, 1, 0), fov=60, width=400, height=300)
    views.remember(obj, [inside])
    obj.scale, obj.rotation_euler = scale, (0.3, 0, 1)
    bpy.context.view_layer.update()
    camera = views.opening([obj]).camera(400, 300)
    world = np.array(obj.matrix_world)
    eye, ahead = inside.center, inside.center + inside.world_to_camera[2, :3]
    np.testing.assert_allclose(camera.center, world[:3, :3] @ eye + world[:3, 3], atol=1e-5)
    x, y, depth = camera.world_to_camera[:3, :3] @ world[:3, :3] @ (ahead - eye)
    np.testing.assert_allclose([x, y], 0, atol=1e-5)
    assert depth > 0


def test_what_is_seen_from_around_stays_so_until_it_changes():
    bpy.ops.wm.read_factory_settings()
    obj = ball()
    assert views.within(obj, np.zeros(3)) is None
    views.remember(obj, [])
    assert views.within(obj, np.zeros(3)) == []
    assert views.opening([obj]) is None
    obj.data.transform(Matrix.Scale(3, 4))
    assert views.within(obj, np.zeros(3)) is None, "other things may be in it now"


def test_studio_looks_at_a_place_from_within(empty):
    obj = ball()
    views.remember(obj, [look_at((0.2, -0.3, 0.1), (1, 0.4, 0.3), fov=60, width=400, height=300)])
    bpy.context.view_layer.update()
    setting.set_up(empty, [obj], fast=True)
    bpy.context.view_layer.update()
    pose = views.opening([obj]).pose
    np.testing.assert_allclose(np.array(empty.camera.matrix_world), pose, atol=1e-5)


def test_viewports_show_colors_and_then_light():
    bpy.ops.wm.read_factory_settings()
    windows = bpy.context.window_manager.windows
    views = [a.spaces.active for w in windows for a in w.screen.areas if a.type == "VIEW_3D"]
    assert views
    for before, wanted, after in (
        ("SOLID", "MATERIAL", "MATERIAL"),
        ("WIREFRAME", "MATERIAL", "WIREFRAME"),
        ("RENDERED", "MATERIAL", "RENDERED"),
        ("SOLID", "RENDERED", "RENDERED"),
        ("MATERIAL", "RENDERED", "RENDERED"),
        ("WIREFRAME", "RENDERED", "WIREFRAME"),
    ):
        views[0].shading.type = before
        setting.show_colors(windows, wanted)
        assert views[0].shading.type == after, (before, wanted)
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    views[0].shading.type = "SOLID"
    setting.show_colors(windows, "MATERIAL")
    assert views[0].shading.type == "SOLID", "that engine has no Material Preview"


def test_a_blender_that_cannot_denoise_takes_more_samples(empty, monkeypatch):
    for can, samples in ((True, 16), (False, 64)):
        monkeypatch.setattr(versions, "can_denoise", lambda can=can: can)
        rendering.lit_settings(empty, "cycles", samples=16, denoise=True)
        assert (empty.cycles.use_denoising, empty.cycles.samples) == (can, samples)
        rendering.lit_settings(empty, "cycles", samples=16, denoise=False)
        assert (empty.cycles.use_denoising, empty.cycles.samples) == (False, 16)


def test_previews_are_denoised_in_less_time(empty):
    """And careful images after them as before."""
    if not hasattr(empty.cycles, "denoising_quality"):
        pytest.skip("this Blender has one quality")
    found = []
    for preview in (False, True, False):
        rendering.lit_settings(empty, "cycles", samples=4, limit=100, denoise=True)
        if preview:
            rendering.preview_settings(empty)
        cycles = empty.cycles
        found.append(
            (cycles.denoising_input_passes, cycles.denoising_quality, cycles.min_transparent_bounces)
        )
    careful = ("RGB_ALBEDO_NORMAL", "HIGH", 16)
    assert found == [careful, ("RGB", "FAST", 8), careful]
