# ruff: noqa: E402
"""What is the artist's stays: objects, camera, world and render settings of a file with other content."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_extension import registered
from _blender_scenes import ball_splats

from meshsplats import look_at, save_gaussians
from meshsplats.blender.inside import notes, rendering, stage, versions


@pytest.fixture
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    notes.take()
    return bpy.context.scene


def sun(home):
    return stage.add_sun(np.array([0.0, 0, 1]), 3.0, 1.0, 0.01, home)


def test_what_the_artist_adds_to_our_collections_is_kept(empty):
    home = stage.collection("Lights")
    own = sun(home)
    copy = own.copy()  # as Shift D does
    mine = bpy.data.objects.new("bust", bpy.data.meshes.new("bust"))
    group = bpy.data.collections.new("props")
    for obj in (copy, mine):
        home.objects.link(obj)
    home.children.link(group)
    stage.clear()
    assert sorted(obj.name for obj in empty.objects) == ["Sun.001", "bust"]
    assert [c.name for c in empty.collection.children] == ["props"]
    (note,) = notes.take()
    assert "bust" in note
    assert "Sun.001" in note


@pytest.mark.parametrize("change", ["nothing", "moved", "animated", "named", "lens", "focus", "clipping"])
def test_a_camera_that_was_changed_is_kept(empty, change):
    view = look_at((0, -1, -5), (0, 0, 0), width=48, height=36)
    obj = stage.add_camera(view, "Camera", np.eye(3), 100.0, stage.collection("Cameras"))
    if change == "moved":
        obj.location.x += 0.1
    elif change == "animated":
        obj.keyframe_insert("location", frame=1)
    elif change == "named":
        obj.name = "Close-up"
    elif change == "lens":
        obj.data.lens = 85
    elif change == "focus":
        obj.data.dof.use_dof = True
    elif change == "clipping":
        obj.data.clip_end *= 2
    stage.clear()
    stage.clear()
    assert len(empty.objects) == (change != "nothing")


def test_the_world_of_the_artist_stays_in_the_file(empty):
    mine = bpy.data.worlds.new("Dusk")
    empty.world = mine
    for _ in range(3):
        stage.clear()
        stage.even_world((0.5, 0.5, 0.5))
    assert mine.use_fake_user
    assert "Dusk" in notes.take()[0]
    assert sorted(world.name for world in bpy.data.worlds) == ["Dusk", "World"], "one of ours"
    empty.world.node_tree.nodes.new("ShaderNodeTexSky")  # now it is the artist's, too
    stage.clear()
    stage.even_world((0.5, 0.5, 0.5))
    assert len(bpy.data.worlds) == 3


def test_the_world_of_the_start_file_is_nothing_to_tell():
    bpy.ops.wm.read_factory_settings()
    notes.take()
    stage.clear()
    stage.even_world((0.5, 0.5, 0.5))
    assert notes.take() == []


@pytest.mark.parametrize("settings", [rendering.exact_settings, rendering.lit_settings])
def test_compositing_and_render_region_are_left_alone(empty, settings):
    names = ("use_compositing", "use_sequencer", "use_border")
    for name in names:
        setattr(empty.render, name, True)
    empty.cycles.samples = 777
    settings(empty, "cycles")
    assert all(getattr(empty.render, name) for name in names)
    (note,) = notes.take()
    assert f"Cycles samples 777 to {empty.cycles.samples}" in note


OWNERS = ("cycles", "render", "eevee", "view_settings", "display_settings")


def settings_of(scene):
    found = {}
    for owner in OWNERS:
        block = getattr(scene, owner)
        for prop in block.bl_rna.properties:
            kept = prop.type in ("BOOLEAN", "INT", "FLOAT", "ENUM") and not prop.is_readonly
            if kept and not getattr(prop, "is_array", False):
                found[f"{owner}.{prop.identifier}"] = getattr(block, prop.identifier)
    return found


def test_every_setting_that_is_changed_is_told(empty):
    """And none is that splats do not need: what an artist has chosen stays."""
    cycles = empty.cycles
    empty.eevee.use_raytracing = cycles.caustics_reflective = cycles.caustics_refractive = True
    cycles.transparent_max_bounces, cycles.diffuse_bounces, cycles.seed = 512, 9, 7
    empty.render.dither_intensity, empty.view_settings.gamma, cycles.film_exposure = 0.75, 1.5, 2.0
    empty.view_settings.use_curve_mapping = True
    versions.set_if_there(empty.view_settings, use_white_balance=True)
    before = settings_of(empty)
    rendering.lit_settings(empty, "cycles", limit=64, denoise=True)
    after = settings_of(empty)
    changed = {name for name in before if before[name] != after[name]}
    assert changed <= set(rendering._TOLD.values())
    assert {"cycles.use_light_tree", "view_settings.gamma", "cycles.pixel_filter_type"} <= changed
    stays = {"eevee.use_raytracing", "cycles.caustics_reflective", "cycles.transparent_max_bounces"}
    stays |= {"cycles.diffuse_bounces", "cycles.seed", "render.dither_intensity", "cycles.film_exposure"}
    assert not stays & changed
    (note,) = notes.take()
    assert all(part in note for part in ("gamma 1.5 to 1", "light tree on to off", "pixel filter "))
    rendering.exact_settings(empty, "cycles")
    last = settings_of(empty)
    assert {name for name in after if after[name] != last[name]} <= set(rendering._TOLD.values())
    (note,) = notes.take()
    assert all(part in note for part in ("dither 0.75 to 0", "curves on to off", "film exposure 2 to 1"))


def test_a_view_that_a_studio_lacks_is_told(empty):
    before = empty.view_settings.view_transform
    rendering._choose(empty.view_settings, "view_transform", "Plain", "view transform")
    assert empty.view_settings.view_transform == before
    assert notes.take() == [
        f"the colour management of this Blender has no view transform Plain, so that {before} stays: colours"
        " may differ"
    ]


@pytest.mark.parametrize("chosen", [False, True])
def test_a_file_with_other_objects_keeps_its_render_settings(tmp_path, chosen):
    save_gaussians(ball_splats(50)[0], tmp_path / "ball.ply")
    bpy.ops.wm.read_factory_settings()
    versions.enable_cycles()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    view = bpy.context.scene
    before = (view.view_settings.view_transform, view.cycles.samples, view.cycles.max_bounces)
    with registered():
        asked = {"set_up_scene": True} if chosen else {}
        bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "ball.ply"), frame_view=False, **asked)
    after = (view.view_settings.view_transform, view.cycles.samples, view.cycles.max_bounces)
    assert (after == before) != chosen
    assert view.cycles.transparent_max_bounces == 1024


def test_a_file_says_what_points_up_in_it(tmp_path):
    """Z too, as in maps; the axes are those of the file."""
    save_gaussians(ball_splats(50)[0], tmp_path / "ball.ply")
    with registered():
        for axes, up in {"y-down": (0, -1, 0), "z-up": (0, 0, 1), "z-down": (0, 0, -1)}.items():
            bpy.ops.wm.read_factory_settings(use_empty=True)
            path = str(tmp_path / "ball.ply")
            bpy.ops.import_scene.meshsplats(filepath=path, axes=axes, frame_view=False)
            world = np.array(bpy.context.object.matrix_world)[:3, :3]
            np.testing.assert_allclose(world @ up, (0, 0, 1), atol=1e-6)


def test_no_file_and_an_image_of_a_sog_are_refused_with_advice(tmp_path):
    (tmp_path / "meta.json").write_text("{}")
    folder = tmp_path / "photos"
    folder.mkdir()
    for place in (tmp_path, folder):
        (place / "means_l.webp").write_bytes(b"RIFF")
    cases = {
        "": "choose a file: no name was given",
        str(folder): "choose a file: .*photos is a folder without a model",
        str(tmp_path / "means_l.webp"): "means_l.webp is one of the images of a SOG: choose meta.json",
    }
    with registered():
        for path, message in cases.items():
            with pytest.raises(RuntimeError, match=message):
                bpy.ops.import_scene.meshsplats(filepath=path)


def test_unknown_formats_are_not_exported(tmp_path):
    save_gaussians(ball_splats(50)[0], tmp_path / "ball.ply")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with registered():
        bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "ball.ply"), frame_view=False)
        with pytest.raises(RuntimeError, match=r"\.xyz is none of the formats of this export: \.glb, \.npz"):
            bpy.ops.export_scene.meshsplats(filepath=str(tmp_path / "q.xyz"))
        with pytest.raises(RuntimeError, match=r"\.ksplat is none .*\.spz"):
            bpy.ops.export_scene.meshsplats_splats(filepath=str(tmp_path / "q.ksplat"))
        for name in ("ball.001", "room.final"):
            bpy.ops.export_scene.meshsplats(filepath=str(tmp_path / name))
    assert {path.name for path in tmp_path.iterdir()} == {"ball.001.glb", "ball.ply", "room.final.glb"}
