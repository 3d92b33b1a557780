# ruff: noqa: E402
"""The extension's operators on an object, and its panel, in this process."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats
from mathutils import Matrix

from meshsplats import bind, convert, load_gaussians, load_mesh, look_at, save_gaussians, save_mesh
from meshsplats.blender import subject
from meshsplats.blender.inside import (
    adjusting,
    baking,
    far_to_near,
    materials,
    meshes,
    notes,
    objects,
    rendering,
    setting,
    sorted_copies,
    stage,
    stand_ins,
    views,
)
from meshsplats.conversion import merging_views
from meshsplats.conversion.cleaning import find
from meshsplats.errors import DataWarning
from meshsplats.evaluation.metrics import psnr
from meshsplats.images.reading import load_image
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.gaussians import GaussianCloud


@pytest.fixture
def ball(extension, tmp_path):
    """Splats in the start scene, with a stray one above them."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stray = GaussianCloud([[0.0, -5, 0]], [[1.0, 0, 0, 0]], [[0.05] * 3], [0.5], np.zeros((1, 1, 3)))
    save_gaussians(GaussianCloud.joined([ball_splats(200)[0], stray]), tmp_path / "ball.ply")
    bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "ball.ply"), at_origin=True)
    bpy.ops.ed.undo_push(message="before")
    return bpy.context.object


def test_a_place_is_imported_with_a_view_from_within(extension, tmp_path, monkeypatch):
    """The first click shows what was photographed, unless nothing is to be framed."""
    save_gaussians(ball_splats(200)[0], tmp_path / "place.ply")
    asked = []

    def default_views(scene, source, count, side):
        asked.append((len(scene), source, count))
        return [look_at((0.1, 0.2, 0.3), (1, 0.4, 0.3), fov=60, width=400, height=400)], "a place"

    monkeypatch.setattr("meshsplats.viewpoints.showing.default_views", default_views)
    for frame_view in (True, False):
        bpy.ops.wm.read_factory_settings()
        before = np.array(bpy.context.scene.camera.matrix_world)
        bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "place.ply"), frame_view=frame_view)
        bpy.context.view_layer.update()
        obj, after = bpy.context.object, np.array(bpy.context.scene.camera.matrix_world)
        assert asked == [(200, tmp_path / "place.ply", 24)]
        if not frame_view:
            np.testing.assert_array_equal(after, before)
            assert views.VIEWS not in obj
            continue
        np.testing.assert_allclose(after, views.opening([obj]).pose, atol=1e-5)
        # Where the file has the camera, the object's own vertices being relative to its foot.
        foot = objects.prepare(convert(load_gaussians(tmp_path / "place.ply")), False)["origin"]
        local = np.array(obj.matrix_world.inverted()) @ after[:, 3]
        np.testing.assert_allclose(local[:3] + foot, [0.1, 0.2, 0.3], atol=1e-4)


def test_a_place_with_a_limit_is_merged_as_it_is_seen_from_within(extension, tmp_path, monkeypatch):
    path, asked = tmp_path / "place.ply", []
    save_gaussians(ball_splats(200)[0], path)
    given = [look_at((0.1, y, 0.3), (1, 0.4, 0.3), fov=60, width=800, height=800) for y in (0.1, 0.2)]

    def default_views(scene, source, count, **_):
        asked.append((len(scene), source, count))
        return given, "a place"

    monkeypatch.setattr(merging_views, "default_views", default_views)
    monkeypatch.setattr("meshsplats.viewpoints.showing.default_views", default_views)
    bpy.ops.wm.read_factory_settings()
    bpy.ops.import_scene.meshsplats(filepath=str(path), max_triangles=300, at_origin=True)
    assert asked == [(200, path, 32), (200, path, 24)], (
        "the larger search is first, so that it is the only one"
    )
    assert len(bpy.context.object.data.polygons) <= 300 < len(convert(load_gaussians(path)).faces)


def test_a_place_is_searched_for_views_once(extension, tmp_path, monkeypatch):
    """Whether it is imported lit, or lit later; not where it was changed so much that they are not of it."""
    save_gaussians(ball_splats(300)[0], tmp_path / "place.ply")
    given = [look_at((0.1, y, 0.3), (1, 0.4, 0.3), fov=60, width=400, height=400) for y in (0.1, 0.2, 0.3)]
    asked, seen = [], []

    def default_views(cloud, *arguments, **options):
        asked.append(len(cloud))
        return given, "a place"

    def shape_for_light(mesh, cameras, *options):
        seen.append([camera.world_to_camera for camera in cameras])
        return made(mesh, cameras, *options)

    made = subject.shape_for_light
    monkeypatch.setattr("meshsplats.viewpoints.showing.default_views", default_views)
    monkeypatch.setattr(subject, "default_views", default_views)
    monkeypatch.setattr(subject, "shape_for_light", shape_for_light)
    bpy.ops.wm.read_factory_settings()
    bpy.context.scene.meshsplats_fast = True
    for shading in ("lit", "unlit"):
        bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "place.ply"), shading=shading, at_origin=True)
    assert len(asked) == 2
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert len(asked) == 2
    assert len(seen) == 2
    for views_of_one in seen:
        np.testing.assert_allclose(views_of_one, [c.world_to_camera for c in given], atol=1e-5)
    obj = bpy.context.object
    obj.data.transform(Matrix.Scale(3, 4))
    bpy.ops.scene.meshsplats_bake_light(fast=True, only_active=True)
    assert len(asked) == 3
    assert views.opening([obj]) is None, "it is not known where they are"


def test_a_mesh_prior_stands_on_the_grid_with_its_base(extension, tmp_path):
    corners = np.add([[-1.0, -2, 0], [1, -2, 0], [1, 0, 0], [-1, 0, 0]], [5, 6, 7])
    base = BaseMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), up=np.array([0, -1, 0]))
    save_mesh(bind(base, triangles=200).mesh, tmp_path / "prior.npz")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "prior.npz"), at_origin=True)
    bpy.context.view_layer.update()
    obj = bpy.context.object
    points = meshes.world_points(obj)
    np.testing.assert_allclose([points[:, 2].min(), np.median(points[:, 0])], 0, atol=0.1)
    assert np.ptp(points[:, 2]) > 1.8
    np.testing.assert_allclose(meshes.local_points(obj).mean(axis=0), corners.mean(axis=0), atol=0.1)


def splat_count(obj) -> int:
    return len(objects.as_splat_mesh(obj).splats)


def test_edits_of_splats_and_the_way_back(ball, tmp_path):
    name = ball.name
    assert bpy.ops.object.meshsplats_clean() == {"FINISHED"}
    ball = bpy.data.objects[name]
    assert splat_count(ball) == 200
    assert bpy.ops.object.meshsplats_adjust(saturation=0.0, opacity=0.5) == {"FINISHED"}
    grey = objects.as_splat_mesh(ball).colors
    np.testing.assert_allclose(grey[:, 0], grey[:, 2], atol=1e-5)
    bpy.ops.object.meshsplats_cut(action="select", shape="all", by_color=True, color=(0.7, 0.7, 0.7))
    assert ball.mode == "EDIT"
    bpy.ops.export_scene.meshsplats_splats(filepath=str(tmp_path / "out"))
    assert ball.mode == "OBJECT"
    found, before = load_gaussians(tmp_path / "out.ply"), load_gaussians(tmp_path / "ball.ply")
    assert len(found) == 200
    away = found.means - before.means[:200]
    np.testing.assert_allclose(away - away[0], 0, atol=1e-4, err_msg="moved to the grid as a whole")
    red = np.flatnonzero(before.colors[:200, 1] < 0.4)
    assert np.ptp(found.colors[red], axis=1).max() < 1e-3
    np.testing.assert_allclose(found.opacities / before.opacities[:200], 0.5, atol=0.05)


def test_cleaning_by_default_asks_what_surrounds_a_place(ball, monkeypatch):
    """Numbers of operators have single precision: their defaults must still be those of the rules."""
    asked = []

    def floaters(mesh):
        asked.append(len(mesh.splats))
        return find(mesh)

    monkeypatch.setattr("meshsplats.conversion.surroundings.floaters", floaters)
    bpy.ops.object.meshsplats_clean(sparse=0.06)
    assert asked == []
    bpy.ops.object.meshsplats_clean()
    assert asked == [200]


def test_undo_takes_edits_back(ball):
    name, count = ball.name, splat_count(ball)
    for operator, arguments in (
        (bpy.ops.object.meshsplats_clean, {}),
        (bpy.ops.object.meshsplats_adjust, {"brightness": 0.5}),
        (bpy.ops.object.meshsplats_cut, {"shape": "all", "by_color": True, "color": (0.8, 0.2, 0.1)}),
    ):
        before = objects.as_splat_mesh(bpy.data.objects[name]).colors.copy()
        assert operator("EXEC_DEFAULT", True, **arguments) == {"FINISHED"}
        after = objects.as_splat_mesh(bpy.data.objects[name]).colors
        assert after.shape != before.shape or (after != before).any()
        bpy.ops.ed.undo()
        back = bpy.data.objects[name]
        bpy.context.view_layer.objects.active = back
        assert splat_count(back) == count
        np.testing.assert_array_equal(objects.as_splat_mesh(back).colors, before)


def test_an_import_is_one_step_that_can_be_undone(ball, extension, tmp_path, monkeypatch):
    """Blender itself adds a step to what its file dialog starts, before anything has changed."""
    operator = sys.modules["blender_extension.import_operator"]
    assert "UNDO" not in operator.ImportMeshSplats.bl_options
    monkeypatch.setattr(operator, "bpy_background", lambda: False)
    bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "ball.ply"))
    after = sorted(bpy.data.objects.keys())
    bpy.ops.ed.undo()
    assert sorted(bpy.data.objects.keys()) == ["ball"]
    bpy.ops.ed.redo()
    assert sorted(bpy.data.objects.keys()) == after == ["ball", "ball.001"]


def test_undo_and_redo_show_splats_far_to_near_at_once(ball, extension, monkeypatch):
    """Sorted for the view as it is now before it is drawn again, not for that of another state, and once."""
    sorting, name = sys.modules["blender_extension.sorting"], ball.name
    region_data = SimpleNamespace(view_perspective="PERSP", view_matrix=None)
    space, looked = SimpleNamespace(shading=SimpleNamespace(type="MATERIAL")), []
    look = far_to_near.look
    monkeypatch.setattr(far_to_near, "look", lambda one, view: looked.append(view) or look(one, view))

    def drawn_from(direction):
        """Draws a viewport, and sorts if it asks for that."""
        region_data.view_matrix = [None, None, direction]
        region = SimpleNamespace(as_pointer=lambda: 1)
        context = SimpleNamespace(
            scene=bpy.context.scene, region=region, space_data=space, region_data=region_data
        )
        with monkeypatch.context() as patch:
            patch.setattr(sorting, "bpy", SimpleNamespace(context=context, app=bpy.app))
            sorting.before_drawing()
        sorting.sort()

    def assert_far_to_near(direction):
        bpy.context.view_layer.update()
        obj = bpy.data.objects[name]
        data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        faces, own = meshes.triangles(data)[0], meshes.triangles(obj.data)[0]
        splat_of = np.empty(len(obj.data.vertices), int)
        splat_of[own] = meshes.owners(obj.data)[:, None]
        local = np.array(direction) @ np.array(obj.matrix_world)[:3, :3]
        owner, heights = splat_of[faces[:, 0]], meshes.face_middles(data) @ local
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        means = np.add.reduceat(heights, starts) / np.diff(starts, append=len(owner))
        assert (np.diff(means) >= -1e-5).all()

    drawn_from((0, 0, 1))
    bpy.ops.object.meshsplats_adjust("EXEC_DEFAULT", True, brightness=0.5)
    drawn_from((0, 0.6, 0.8))
    for step in (bpy.ops.ed.undo, bpy.ops.ed.redo, bpy.ops.ed.undo):
        looked.clear()
        step()
        assert looked == [(0, 0.6, 0.8)]
        assert_far_to_near((0, 0.6, 0.8))
        assert sorted_copies.of(far_to_near.modifier_of(bpy.data.objects[name])) is not None, "nodes need not"
        drawn_from((0, 0.6, 0.8))
        assert len(looked) == 1
    extension.unregister()
    extension.register()
    handlers = [h for hs in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post) for h in hs]
    assert [h.__name__ for h in handlers if h.__module__ == sorting.__name__] == ["after_undo"] * 2


@pytest.mark.parametrize("lit", [False, True])
def test_sliders_show_colours_before_they_are_accepted(ball, extension, lit):
    """And leave nothing behind where they are not: no colour, no attribute, no stale light."""
    if lit:
        objects.replace_mesh(ball, objects.prepare(objects.as_splat_mesh(ball), True, fast=True))
        for name in (meshes.MADE, meshes.DISPLAY):
            ball.data.attributes.remove(ball.data.attributes[name])
    ours = vars(sys.modules["blender_extension.cut_operator"].AdjustSplats)
    described = bpy.ops.object.meshsplats_adjust.get_rna_type().properties
    assert all(described[name].is_skip_save for name in ("hue", "opacity")), "it begins with what is shown"
    dialog = type("Dialog", (), {name: value for name, value in ours.items() if callable(value)})()
    dialog.hue, dialog.saturation, dialog.brightness, dialog.contrast, dialog.opacity = 0, 1, 1, 1, 1
    window = SimpleNamespace(invoke_props_dialog=lambda operator: {"RUNNING_MODAL"})
    context = SimpleNamespace(object=ball, selected_objects=[ball], window_manager=window)

    def now():
        stored = {name: colors.tolist() for name, colors in adjusting.kept_colors(ball.data).items()}
        return stored | {"light": stand_ins.is_current(ball)}

    before, shown = now(), objects.as_splat_mesh(ball).colors
    assert dialog.invoke(context, None) == {"RUNNING_MODAL"}
    for dialog.brightness in (0.2, 0.5):  # each from where it began
        dialog.check(context)
    np.testing.assert_allclose(objects.as_splat_mesh(ball).colors[:, :3], shown[:, :3] / 2, atol=1e-4)
    dialog.cancel(context)
    assert now() == before
    dialog.check(context)
    assert dialog.execute(context) == {"FINISHED"}
    np.testing.assert_allclose(objects.as_splat_mesh(ball).colors[:, :3], shown[:, :3] / 2, atol=1e-4)
    assert not stand_ins.is_current(ball)


@pytest.mark.slow
def test_linear_shows_the_same_colours_in_any_light_under_the_view_transform(ball, extension, tmp_path):
    """Of a saved file with other objects, whose import says so; and what keeps them so."""
    name, scene = ball.name, bpy.context.scene
    bpy.ops.object.meshsplats_clean()
    scene.meshsplats_fast, scene.render.engine = True, "CYCLES"
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.camera.location, scene.camera.rotation_euler = (0, -4, 1), (np.pi / 2, 0, 0)
    scene.collection.objects.link(scene.camera)
    scene.render.resolution_x = scene.render.resolution_y = 40
    stage.even_world((0, 0, 0))

    def image(file):
        rendering.render_to(scene, tmp_path / f"{file}.png")
        return load_image(tmp_path / f"{file}.png") / np.float32(255)

    exact = image("exact")
    scene.view_settings.view_transform, scene.cycles.samples = "Standard", 16
    pale = image("pale")
    bpy.ops.object.meshsplats_shading(shading="linear")
    ball = bpy.data.objects[name]
    assert scene.view_settings.view_transform == "Standard"
    panel = sys.modules["blender_extension.panel"]
    assert (panel.shading_of(ball), panel.light_warning(scene, ball)) == ("linear", "")
    dark = image("dark")
    assert psnr(dark, exact) > psnr(pale, exact) + 6
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy = 9
    scene.collection.objects.link(sun)
    np.testing.assert_allclose(image("sunny"), dark, atol=0.02)
    with pytest.raises(RuntimeError, match="no splats are lit"):
        bpy.ops.scene.meshsplats_bake_light(fast=True)
    bpy.context.view_layer.objects.active = ball
    bpy.ops.object.meshsplats_cut(action="separate", shape="all", by_color=True, color=(0.8, 0.2, 0.1))
    parts = objects.splat_objects(scene)
    assert [panel.shading_of(part) for part in parts] == ["linear"] * 2
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert [panel.shading_of(part) for part in parts].count("lit") == 1


@pytest.mark.parametrize("view", ["AgX", "Raw"])
def test_an_import_says_that_unlit_splats_look_pale(extension, tmp_path, view):
    bpy.ops.wm.read_factory_settings()
    bpy.context.scene.view_settings.view_transform = view
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    obj = objects.add(objects.prepare(convert(ball_splats(50)[0]), False), "ball", bpy.context.collection)
    notes.take()
    setting.set_up_render(bpy.context.scene, [obj], False)
    said = any("pale under the view transform AgX: Linear" in note for note in notes.take())
    assert said == (view == "AgX")


@pytest.mark.slow
def test_fast_light_is_made_carefully_when_asked(ball, extension):
    """Light of one object, baked or live; what was made for a preview does not pass for the rest."""
    name = ball.name
    bpy.ops.object.meshsplats_clean()
    assert bpy.ops.scene.meshsplats_stage(lights="studio", fast=True) == {"FINISHED"}
    ball = bpy.data.objects[name]
    bpy.context.view_layer.objects.active = ball
    panel = sys.modules["blender_extension.panel"]
    (material,) = ball.data.materials
    assert materials.shows_baked(material)
    assert (ball[objects.ROUGH], panel.light_warning(bpy.context.scene, ball)) == (True, "")
    assert objects.needs_light(ball)
    assert not objects.needs_light(ball, fast=True)
    assert bpy.context.scene.cycles.denoising_input_passes == "RGB"
    rough = len(baking.places_of(ball)[0])
    bpy.ops.scene.meshsplats_bake_light(live=True, only_active=True)
    assert not materials.shows_baked(material)
    bpy.ops.scene.meshsplats_bake_light(fast=True, only_active=True)
    assert materials.shows_baked(material)
    assert len(baking.places_of(ball)[0]) == rough
    bpy.context.view_layer.objects.active = bpy.context.scene.camera
    with pytest.raises(RuntimeError, match="the active object is not lit"):
        bpy.ops.scene.meshsplats_bake_light(only_active=True)
    # A part that is cut off a baked object shows baked light, too.
    bpy.context.view_layer.objects.active = ball
    bpy.ops.object.meshsplats_cut(
        action="hide", shape="all", by_color=True, color=(0.8, 0.2, 0.1), color_distance=0.05
    )
    assert stand_ins.is_current(ball)
    assert materials.shows_baked(ball.data.materials[0])
    (home,) = [c for c in bpy.data.collections if c.name.endswith("hidden")]
    assert len(home.objects) == 3, "the splats, what stands in for them, their points of light"
    assert home.hide_render
    assert panel.light_warning(bpy.context.scene, ball) == ""
    bpy.ops.object.meshsplats_adjust(hue=1.0)
    assert panel.light_warning(bpy.context.scene, ball).startswith("Baked light belongs to other splats")


def test_a_modifier_that_tears_splats_is_named(ball, extension):
    warning = sys.modules["blender_extension.panel"].modifier_warning
    assert warning(ball) == ""
    ball.modifiers.new("Bend", "SIMPLE_DEFORM")
    assert warning(ball) == ""
    ball.modifiers.new("Hole", "BOOLEAN")
    assert warning(ball) == "Hole cuts through splats and leaves strips: use Cut Splats"


def recording_layout():
    """A layout, and the operators whose buttons are drawn in it, each with its context."""
    drawn = []

    class Layout(SimpleNamespace):
        def __getattr__(self, name):
            if name.startswith("__"):
                raise AttributeError(name)

            def draw(*arguments, **_):
                if name == "operator":
                    drawn.append((arguments[0], top.operator_context))
                return Layout()

            return draw

    top = Layout(operator_context="INVOKE_REGION_WIN")  # all layouts of a panel share it
    return top, drawn


def test_the_panel_has_a_button_for_each(ball, extension):
    top, drawn = recording_layout()
    panel = sys.modules["blender_extension.panel"].MeshSplatsPanel
    panel._object(None, top, ball)
    names = [name for name, _ in drawn]
    assert {"object.meshsplats_cut", "object.meshsplats_clean", "object.meshsplats_adjust"} <= set(names)
    assert names.count("object.meshsplats_cut") == 2, "any, and all outside of a box"
    at_once = [name for name, context in drawn if context == "EXEC_DEFAULT"]
    assert at_once == ["object.meshsplats_cut"], "the others ask in a dialog, if they have one"


def test_a_warning_is_shown_whole_in_the_usual_side_bar(extension):
    lines = []
    column = SimpleNamespace(label=lambda text, icon: lines.append((text, icon)))
    text = "Baked light belongs to other splats: Bake Light again"
    sys.modules["blender_extension.panel"].draw_warning(SimpleNamespace(column=lambda align: column), text)
    assert " ".join(line for line, _ in lines) == text
    assert max(len(line) for line, _ in lines) <= 32
    assert [icon for _, icon in lines] == ["ERROR", "BLANK1"]


def test_tooltips_say_why_a_button_is_grey(ball, extension):
    can_edit, said = sys.modules["blender_extension.cut_operator"].can_edit, []
    operator = SimpleNamespace(poll_message_set=said.append)
    assert can_edit(operator, bpy.context)
    bpy.ops.object.mode_set(mode="EDIT")
    assert not can_edit(operator, bpy.context)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not can_edit(operator, SimpleNamespace(object=bpy.data.objects.new("empty", None)))
    assert said == ["Only in Object Mode", "The active object is no splat mesh"]


def test_each_light_has_a_tooltip_of_its_own(extension):
    stage = sys.modules["blender_extension.light_operators"].SetUpStage
    texts = [
        stage.description(None, SimpleNamespace(lights=n)) for n in ("sun", "noon", "overcast", "studio")
    ]
    assert len(set(texts)) == 4
    assert texts[3].startswith("A large lamp on the left, a weaker one on the right. Set up light")


def test_a_new_camera_is_made_only_where_it_is_chosen(ball, monkeypatch):
    asked = []
    monkeypatch.setattr(setting, "set_up", lambda *_, camera, fast: asked.append(camera))
    for chosen in ({}, {"camera": True}, {"camera": False}, {}):
        bpy.ops.scene.meshsplats_stage(make_lit=False, **chosen)
    assert asked == [None, True, False, None]


@pytest.fixture
def instances(ball):
    """Two instances of a collection, one of them within another instance; it is in the scene only so."""
    scene, ball.data[objects.LAYERS] = bpy.context.scene, 100
    asset, group = bpy.data.collections.new("asset"), bpy.data.collections.new("group")
    asset.objects.link(ball)
    scene.collection.objects.unlink(ball)
    found = []
    for shown, home in ((asset, scene.collection), (asset, group), (group, scene.collection)):
        obj = bpy.data.objects.new("instance", None)
        obj.instance_type, obj.instance_collection = "COLLECTION", shown
        home.objects.link(obj)
        found.append(obj)
    bpy.context.view_layer.update()
    return found


def test_linked_splats_say_that_rays_pass_too_few_layers(instances, extension, capsys):
    """In the panel, and in the console where images are rendered in the background; nothing changes until it
    is asked for."""
    scene, ours = bpy.context.scene, sys.modules["blender_extension.bounces"]
    panel = sys.modules["blender_extension.panel"].MeshSplatsPanel

    def buttons():
        layout, drawn = recording_layout()
        panel.draw(SimpleNamespace(layout=layout), SimpleNamespace(scene=scene, object=None))
        return [name for name, _ in drawn]

    scene.render.engine, scene.cycles.transparent_max_bounces = "CYCLES", 8
    ours.before_render(scene)
    said = capsys.readouterr().out
    assert "Rays pass 8 transparent layers and splats need 250: deeper ones are black" in said
    assert "bpy.ops.scene.meshsplats_bounces()" in said
    assert ours.SetBounces.bl_idname in buttons()
    assert scene.cycles.transparent_max_bounces == 8
    bpy.ops.scene.meshsplats_set_up(shading="lit")
    assert scene.cycles.transparent_max_bounces == 250
    scene.cycles.transparent_max_bounces = 99
    instances[0].hide_render = True
    bpy.ops.scene.meshsplats_bounces()
    assert scene.cycles.transparent_max_bounces == 125, "of what images show"
    assert ours.SetBounces.bl_idname not in buttons()
    ours.before_render(scene)
    assert capsys.readouterr().out.count("Rays pass") == 0
    scene.cycles.transparent_max_bounces = 8
    scene.render.engine = "BLENDER_WORKBENCH"
    assert ours.missing(scene) == 0, "Cycles alone has such a limit"


def test_instances_are_exported_where_they_are(instances, ball, tmp_path):
    instances[0].location, instances[0].rotation_euler = (5, 0, 0), (0, 0, 1)
    count = splat_count(ball)
    bpy.ops.export_scene.meshsplats(filepath=str(tmp_path / "all.npz"))
    both = load_mesh(tmp_path / "all.npz")
    assert len(both.splats) == 2 * count
    half = len(both.vertices) // 2
    here, away = both.vertices[:half], both.vertices[half:]
    if here[:, 0].mean() > away[:, 0].mean():
        here, away = away, here
    turned = here @ np.array(instances[0].matrix_world)[:3, :3].T + [5, 0, 0]
    np.testing.assert_allclose(away, turned, atol=1e-4)
    instances[0].select_set(True)
    bpy.ops.export_scene.meshsplats_splats(filepath=str(tmp_path / "one.ply"), use_selection=True)
    assert len(load_gaussians(tmp_path / "one.ply")) == count


def test_name_and_format_of_an_export_follow_each_other(extension):
    export = sys.modules["blender_extension.export_operator"]
    dialog = SimpleNamespace(filepath="/a/b.ply", format=".ply", _shown=".ply")
    dialog.suffix_of = export.ExportSplats.suffix_of
    for changes, path, suffix in (
        ({}, "/a/b.ply", ".ply"),
        ({"format": ".spz"}, "/a/b.spz", ".spz"),
        ({"filepath": "/a/c.compressed.ply"}, "/a/c.compressed.ply", ".compressed.ply"),
        ({"filepath": "/a/D.PLY"}, "/a/D.PLY", ".ply"),
        ({"filepath": "/a/E"}, "/a/E.ply", ".ply"),
        ({"format": ".compressed.ply"}, "/a/E.compressed.ply", ".compressed.ply"),
        ({"format": ".ply"}, "/a/E.ply", ".ply"),
    ):
        vars(dialog).update(changes)
        before = (dialog.filepath, dialog.format)
        assert export.Export.check(dialog, None) == (before != (path, suffix))
        assert (dialog.filepath, dialog.format) == (path, suffix)


@pytest.mark.slow
def test_lit_and_unlit_set_up_the_render_where_all_splats_are(ball):
    view = bpy.context.scene
    view.meshsplats_fast = True
    other = ball.copy()
    other.data = ball.data.copy()
    assert view.view_settings.view_transform == "Raw"
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert view.view_settings.view_transform == "Standard"
    view.view_settings.view_transform = "AgX"
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert view.view_settings.view_transform == "AgX", "nothing changed, so that the user's choice stays"
    view.collection.objects.link(other)  # unlit
    bpy.ops.object.meshsplats_shading(shading="unlit")
    assert view.view_settings.view_transform == "Raw"
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert view.view_settings.view_transform == "Raw", "one of them is unlit"


@pytest.mark.parametrize("how", ["is_repeat", "is_repeat_last"])
def test_what_is_repeated_is_done_at_once(extension, monkeypatch, how):
    """From Adjust Last Operation or by Shift R: what becomes modal there, Blender lists twice and frees."""
    ours, done = sys.modules["blender_extension.work"], []
    monkeypatch.setattr(ours, "bpy_background", lambda: False)
    window = SimpleNamespace(cursor_modal_set=lambda name: None, cursor_modal_restore=lambda: None)
    work = SimpleNamespace(run=lambda: done.append("run"), paths=["a"], results=["a"], problems=[])
    operator = ours.Modal()
    operator.options = SimpleNamespace(**({"is_repeat": False, "is_repeat_last": False} | {how: True}))
    operator.done = lambda context, work: done.append("done")
    assert operator.begin(SimpleNamespace(window=window), work) == {"FINISHED"}
    assert done == ["run", "done"]


def test_splats_that_were_edited_meanwhile_are_named(ball, extension):
    ours, said = sys.modules["blender_extension.work"], []
    works = [ours.LightWork({ball.name: objects.light_source(ball)}, "unlit") for _ in range(2)]
    for work in works:
        work.run()
    operator = SimpleNamespace(report=lambda kind, text: said.append(text))
    assert ours.take_over(operator, works[0]) == [ball.name]
    assert said == []
    ball.data.vertices[0].co.z += 1
    assert ours.take_over(operator, works[1]) == []
    assert said == ["MeshSplats: ball: was edited, renamed or deleted meanwhile, and left out"]


def test_sun_says_what_it_hides(extension, monkeypatch, capfd):
    bpy.ops.wm.read_factory_settings()
    monkeypatch.setattr(setting, "set_up", lambda *_, camera, fast: None)
    bpy.ops.scene.meshsplats_stage()
    assert "hid what Blender starts with: Cube, Light" in capfd.readouterr().out


def test_exact_and_lit_say_what_they_change(extension, capfd):
    bpy.ops.wm.read_factory_settings()
    bpy.ops.scene.meshsplats_set_up(shading="lit")
    said = capfd.readouterr().out
    assert "MeshSplats: render settings changed: view AgX to Standard" in said
    assert "light tree on to off" in said


def test_it_is_dark_only_where_nothing_lights(extension):
    is_dark = sys.modules["blender_extension.light_operators"].is_dark
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    sky = stage.even_world((0.01, 0.01, 0.01), (0, 0, 0)).node_tree
    assert is_dark(scene)
    out = next(node for node in sky.nodes if node.type == "OUTPUT_WORLD")
    before = out.inputs["Surface"].links[0].from_socket
    for kind in ("ShaderNodeTexSky", "ShaderNodeEmission"):
        sky.links.new(sky.nodes.new(kind).outputs[0], out.inputs["Surface"])
        assert not is_dark(scene), kind
    sky.links.new(before, out.inputs["Surface"])
    assert is_dark(scene)
    lamps = bpy.data.collections.new("lamps")
    lamps.objects.link(bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT")))
    shown = bpy.data.objects.new("shown", None)
    scene.collection.objects.link(shown)
    shown.instance_type, shown.instance_collection = "COLLECTION", lamps
    bpy.context.view_layer.update()
    assert not is_dark(scene)


def test_a_blender_without_numpy_is_told_so(extension, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "numpy" else found(name))
    with pytest.raises(RuntimeError, match=r"needs NumPy.*\n.*python3-numpy") as caught:
        extension.register()
    assert max(map(len, str(caught.value).splitlines())) < 90, "the window cuts longer lines"


def test_warnings_of_other_add_ons_are_not_reported(extension):
    with sys.modules["blender_extension.work"].own_warnings() as caught:
        warnings.warn("unclosed file", ResourceWarning, stacklevel=1)
        warnings.warn("deprecated", UserWarning, stacklevel=1)
        warnings.warn("3 splats were left out", DataWarning, stacklevel=1)
    assert [str(warning.message) for warning in caught] == ["3 splats were left out"]
