# ruff: noqa: E402
"""EEVEE blends splats far to near: in images of any camera, and in viewports as they turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats, random_mesh
from _eevee import draw_animation, draw_by_eevee

from meshsplats import convert, orbit, psnr, render
from meshsplats.blender import SceneOptions
from meshsplats.blender.inside import (
    far_to_near,
    frame,
    meshes,
    objects,
    rendering,
    sorted_copies,
    stage,
    versions,
)


@pytest.fixture
def scene():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def evaluated_faces(obj) -> np.ndarray:
    """(f, 3) vertices of the triangles in the order in which they are drawn."""
    bpy.context.view_layer.update()
    return meshes.triangles(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data)[0]


def evaluated_centers(obj) -> np.ndarray:
    """(f, 3) centres of splats in the order in which they are drawn, Blender's world."""
    drawn = evaluated_faces(obj)
    middles, own = meshes.face_middles(obj.data), meshes.triangles(obj.data)[0]
    _, owner = np.unique(meshes.owners(obj.data), return_inverse=True)
    means = np.stack([np.bincount(owner, middles[:, k]) for k in range(3)], axis=1)
    means /= np.bincount(owner)[:, None]
    of_vertex = np.zeros(len(obj.data.vertices), int)
    of_vertex[own] = owner[:, None]
    world = np.array(obj.matrix_world)
    return means[of_vertex[drawn[:, 0]]] @ world[:3, :3].T + world[:3, 3]


def assert_far_to_near(obj, direction) -> None:
    heights = evaluated_centers(obj) @ np.array(direction, float)
    assert len(heights) == len(obj.data.polygons)
    assert (np.diff(heights) >= -1e-5).all()


def test_a_viewport_is_sorted_for_its_viewer_and_the_mesh_keeps_its_order(scene):
    mesh = convert(ball_splats(300)[0])
    obj = objects.add(objects.prepare(mesh, False), "ball", scene.collection)
    obj.scale = (1, 3, 0.5)
    obj.rotation_euler = (0.3, 0.2, 1)
    bpy.context.view_layer.update()
    modifier = far_to_near.modifier_of(obj)
    for direction in ((1, 0, 0), (0.3, -0.8, 0.5), (0, 0, -1)):
        far_to_near.look(modifier, direction)
        assert_far_to_near(obj, direction)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.rotation_euler = (1.2, 0, 2.5)
    far_to_near.look(modifier, (0, 0, 0))
    bpy.context.view_layer.update()
    assert_far_to_near(obj, np.array(camera.matrix_world)[:3, 2])
    np.testing.assert_array_equal(objects.as_splat_mesh(obj).faces, mesh.faces)
    far_to_near.look(modifier, None)
    centers = evaluated_centers(obj)
    first = np.flatnonzero(np.diff(mesh.face_splat, prepend=-1))
    assert (np.diff(centers[:, 2]) < -1e-3).any(), "its own order"
    assert len(np.unique(centers.round(5), axis=0)) == len(first)


@pytest.mark.parametrize("copied", [True, False])
def test_triangles_of_a_splat_keep_their_order(scene, copied):
    mesh = convert(ball_splats(60)[0])
    obj = objects.add(objects.prepare(mesh, False), "ball", scene.collection)
    if not copied:  # with another modifier before it, nodes sort
        earlier = obj.modifiers.new("earlier", "WEIGHTED_NORMAL")
        obj.modifiers.move(len(obj.modifiers) - 1, 0)
        assert obj.modifiers[0] == earlier
    modifier = far_to_near.modifier_of(obj)
    far_to_near.look(modifier, (0.2, -1, 0.1))
    assert (sorted_copies.of(modifier) is not None) == copied
    faces = evaluated_faces(obj)
    order = np.array([np.flatnonzero((mesh.faces == face).all(axis=1))[0] for face in faces])
    assert (order != np.arange(len(order))).any()
    owner = mesh.face_splat[order]
    inside = np.diff(owner) == 0
    assert inside.sum() == len(order) - len(np.unique(owner)), "splats stay together"
    assert (np.diff(order)[inside] == 1).all()


def test_a_copy_shows_what_nodes_would_and_leaves_nothing(scene):
    cloud, _ = ball_splats(200)
    stray = replace(cloud, means=np.vstack([cloud.means[:-1], [3e5, 0, 0]]))
    for points in (cloud, stray):
        mesh = convert(points)
        obj = objects.add(objects.prepare(mesh, False), "ball", scene.collection)
        modifier = far_to_near.modifier_of(obj)
        far_to_near.look(modifier, (0.2, -1, 0.1))
        shown = evaluated_faces(obj)
        assert sorted_copies.of(modifier) is not None
        far_to_near.drop_copies()
        assert not [other for other in bpy.data.objects if sorted_copies.OWNER in other]
        assert not [data for data in bpy.data.meshes if sorted_copies.OWNER in data]
        np.testing.assert_array_equal(evaluated_faces(obj), shown)
        bpy.data.objects.remove(obj)


def test_an_object_that_turns_is_sorted_again(scene):
    obj = objects.add(objects.prepare(convert(ball_splats(100)[0]), False), "ball", scene.collection)
    modifier = far_to_near.modifier_of(obj)
    bpy.context.view_layer.update()
    handlers = bpy.app.handlers.depsgraph_update_post
    handlers.append(lambda _, depsgraph: far_to_near.after_update(depsgraph))
    try:
        for direction in ((0, 0, 1), (0, 1, 0)):
            far_to_near.look(modifier, direction)
            assert_far_to_near(obj, direction)
            assert sorted_copies.of(modifier) is not None, "only turning the object drops it"
        obj.location.x += 1
        assert_far_to_near(obj, (0, 1, 0))
        assert sorted_copies.of(modifier) is not None
        obj.rotation_euler.x += 1
        bpy.context.view_layer.update()
        assert_far_to_near(obj, (0, 1, 0))
    finally:
        handlers.clear()


def test_a_duplicate_has_a_copy_of_its_own(scene):
    obj = objects.add(objects.prepare(convert(ball_splats(100)[0]), False), "ball", scene.collection)
    far_to_near.look(far_to_near.modifier_of(obj), (0, 0, 1))
    other = obj.copy()
    other.rotation_euler = (2, 0, 0)
    scene.collection.objects.link(other)
    bpy.context.view_layer.update()
    for turned in (other, obj):
        far_to_near.look(far_to_near.modifier_of(turned), (0, 0, 1))
    for turned in (other, obj):
        assert_far_to_near(turned, (0, 0, 1))
    bpy.data.objects.remove(other)
    far_to_near.drop_copies()
    assert not [data for data in bpy.data.meshes if sorted_copies.OWNER in data]


def test_whole_numbers_are_sorted_as_numpy_sorts_them():
    values = np.random.default_rng(0).normal(0, 1e5, 3000).astype(np.float32) // 7
    values[:3] = (2.0**30, -(2.0**30), 2.0**30)
    expected = np.argsort(np.rint(values), kind="stable")
    np.testing.assert_array_equal(sorted_copies.far_to_near(values), expected)


def test_centres_follow_edits(scene):
    obj = objects.add(objects.prepare(convert(ball_splats(100)[0]), False), "ball", scene.collection)
    modifier = far_to_near.modifier_of(obj)
    handlers = bpy.app.handlers.depsgraph_update_post
    handlers.append(lambda _, depsgraph: far_to_near.after_update(depsgraph))
    try:
        far_to_near.look(modifier, (0, 1, 0))
        before = evaluated_centers(obj)
        for vertex in obj.data.vertices:
            vertex.co.x += 5
        obj.data.update()
        bpy.context.view_layer.update()
    finally:
        handlers.clear()
    assert sorted_copies.of(modifier) is None, "it would show the mesh as it was"
    for _ in ("nodes", "a copy"):
        assert_far_to_near(obj, (0, 1, 0))
        far_to_near.look(modifier, (0, 1, 0))
    after = evaluated_centers(obj)
    assert after[:, 0].mean() == pytest.approx(before[:, 0].mean() + 5, abs=1e-3)


@pytest.mark.parametrize("numbered", [True, False])
def test_splats_that_modifiers_or_shape_keys_have_moved_are_sorted_where_they_are(scene, numbered):
    """A rig that was added last, and turns them by half a turn. Numbers of splats may occur twice, as in
    joined meshes."""
    obj = objects.add(objects.prepare(convert(ball_splats(100)[0]), False), "ball", scene.collection)
    owner = meshes.owners(obj.data)
    if not numbered:
        obj.data.attributes[meshes.SPLAT].data.foreach_set("value", owner % 7)
    modifier = far_to_near.modifier_of(obj)
    rig = bpy.data.objects.new("rig", None)
    scene.collection.objects.link(rig)
    hook = obj.modifiers.new("rig", "HOOK")
    assert obj.modifiers[-1] == modifier
    hook.object = rig
    hook.vertex_indices_set(range(len(obj.data.vertices)))
    obj.data.attributes.new("own", "INT", "FACE").data.foreach_set("value", owner)
    rig.rotation_euler = (0, 0, np.pi)
    far_to_near.look(modifier, (0, 1, 0))
    for keyed in (False, True):
        if keyed:
            hook.show_viewport = False
            obj.shape_key_add(name="rest")
            moved = versions.positions(obj.data) * np.float32([-1, -1, 1])
            obj.shape_key_add(name="turned").data.foreach_set("co", moved.ravel())
            obj.data.shape_keys.key_blocks["turned"].value = 1
        bpy.context.view_layer.update()
        data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        number = np.empty(len(data.polygons), np.int32)
        data.attributes["own"].data.foreach_get("value", number)
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        assert len(starts) == len(np.unique(owner)), "splats stay together"
        middles = np.add.reduceat(meshes.face_middles(data), starts)
        middles /= np.diff(starts, append=len(number))[:, None]
        drawn = middles @ np.array(obj.matrix_world)[:3, :3].T
        assert (np.diff(drawn[:, 1]) >= -1e-5).all()


def test_files_of_earlier_releases_are_sorted_so_too(scene):
    obj = objects.add(objects.prepare(convert(ball_splats(20)[0]), False), "ball", scene.collection)
    modifier = far_to_near.modifier_of(obj)
    modifier.use_pin_to_last = False
    for node in [n for n in modifier.node_group.nodes if n.bl_idname == "GeometryNodeAccumulateField"]:
        modifier.node_group.nodes.remove(node)
    obj.modifiers.new("later", "WEIGHTED_NORMAL")
    old = modifier.node_group
    far_to_near.renew()
    assert obj.modifiers[-1] == far_to_near.modifier_of(obj)
    assert far_to_near.modifier_of(obj).node_group != old
    far_to_near.look(far_to_near.modifier_of(obj), (1, 0, 0))
    assert_far_to_near(obj, (1, 0, 0))
    again = objects.add(objects.prepare(convert(ball_splats(20)[0]), False), "again", scene.collection)
    assert far_to_near.modifier_of(again).node_group == far_to_near.modifier_of(obj).node_group


def test_meshes_without_splats_are_sorted_by_the_triangle(scene):
    mesh = replace(random_mesh(50), face_splat=None)
    obj = objects.add(objects.prepare(mesh, False), "mesh", scene.collection)
    far_to_near.look(far_to_near.modifier_of(obj), (0, 0, 1))
    bpy.context.view_layer.update()
    data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    world = np.array(obj.matrix_world)[:3, :3]
    assert (np.diff((meshes.face_middles(data) @ world.T)[:, 2]) >= -1e-5).all()


def test_eevee_draws_by_the_splat_from_all_sides(tmp_path):
    """The command line, and the saved file, whose cameras are markers of the timeline: more than 60 dB.
    Without a graphics card each image takes seconds, however small it is."""
    mesh = convert(ball_splats(200)[0])
    views = [view.with_near_plane(mesh.vertices) for view in orbit(mesh, 3, width=40, height=40)]
    paths, saved = [tmp_path / f"{i}.exr" for i in range(2)], tmp_path / "s.blend"
    draw_by_eevee(mesh, views[:2], images=paths, blend=saved, options=SceneOptions(engine="eevee"))
    expected = [render(mesh, view, order="splat").color for view in views]
    for path, image in zip(paths, expected[:2], strict=True):
        assert psnr(rendering.read_pixels(path)[..., :3], image) > 60
    bpy.ops.wm.open_mainfile(filepath=str(saved))
    scene = bpy.context.scene
    scene.eevee.use_shadows = False  # no lamp throws any, and each image takes a third of the time
    # The second camera moves, too.
    camera = scene.timeline_markers[1].camera
    scene.frame_end = 2
    for at in (1, 2):
        from mathutils import Matrix

        rotation = frame.to_blender(mesh.up)
        camera.matrix_world = Matrix(frame.camera_pose(views[at], rotation).tolist())
        camera.keyframe_insert("location", frame=at)
        camera.keyframe_insert("rotation_euler", frame=at)
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = str(tmp_path / "again_")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "moves.blend"))
    draw_animation(tmp_path / "moves.blend")
    for i, image in enumerate(expected):
        assert psnr(rendering.read_pixels(tmp_path / f"again_{i:04d}.exr")[..., :3], image) > 60
    stage.clear()
