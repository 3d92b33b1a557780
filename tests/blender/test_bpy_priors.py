# ruff: noqa: E402
"""Mesh priors in Blender: the splats follow their base when it is edited, posed and simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

import bmesh

from meshsplats.blender.inside import objects, priors
from meshsplats.prior import MeshPrior, bind
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.mesh import SplatMesh


def sheet(n: int = 6) -> BaseMesh:
    """A square of 2 n^2 triangles in the x-y plane, y down as in splat files."""
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return BaseMesh(np.stack([x, y, 0.1 * x * y], -1).reshape(-1, 3), faces, up=np.array([0, -1, 0]))


def prior_mesh(layers: int = 2) -> SplatMesh:
    rng = np.random.default_rng(0)
    mesh = bind(sheet(), triangles=4, layers=layers, spacing=0).mesh
    binding = replace(mesh.binding, weights=rng.dirichlet((1, 1, 1), len(mesh.vertices)))
    return MeshPrior(replace(mesh, colors=rng.random(mesh.colors.shape), binding=binding)).pose()


@pytest.fixture(params=[False, True], ids=["unlit", "lit"])
def placed(request):
    """The splats' object, that of its base, and the prior they were made from."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = prior_mesh()
    obj = objects.add(
        objects.prepare(mesh, request.param, fast=request.param), "prior", bpy.context.collection
    )
    return obj, priors.base_of(obj), MeshPrior(mesh)


def places(obj) -> np.ndarray:
    found = np.empty(3 * len(obj.data.vertices), np.float32)
    obj.data.vertices.foreach_get("co", found)
    return found.reshape(-1, 3)


def in_blender(prior: MeshPrior) -> MeshPrior:
    """``prior`` with its layers set apart, as splats are placed."""
    return MeshPrior(prior.pose(lift=prior.export_lift))


def wanted(prior: MeshPrior, vertices) -> np.ndarray:
    return in_blender(prior).pose(vertices).vertices


def assert_follows(obj, prior, vertices) -> None:
    np.testing.assert_allclose(places(obj), wanted(prior, vertices), atol=2e-6)
    assert obj[priors.PROBLEM] == ""


def test_base_and_splats_stand_together(placed):
    obj, base, prior = placed
    assert obj.parent is base
    assert (base.display_type, base.hide_render) == ("WIRE", True)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(np.array(obj.matrix_world), np.array(base.matrix_world), atol=1e-6)
    assert len(base.data.vertices) == len(prior.base_vertices)
    assert_follows(obj, prior, prior.base_vertices)
    found = priors.binding_of(obj)
    for name in ("base_vertices", "base_faces", "vertex_face", "weights", "layers"):
        np.testing.assert_array_equal(getattr(found, name), getattr(prior.mesh.binding, name))


def test_an_edited_base(placed):
    obj, base, prior = placed
    moved = prior.base_vertices * np.float32(1.5) + np.float32([0.1, 0, 0.3])
    base.data.vertices.foreach_set("co", moved.ravel())
    base.data.update()
    assert priors.follow([obj], bpy.context.evaluated_depsgraph_get()) == 1
    assert_follows(obj, prior, moved)


def test_shells_follow_the_stretch_around_them():
    """Also while the base is edited, and in the file afterwards."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    prior = bind(sheet(), triangles=4, layers=3, spacing=-0.05)
    obj = objects.add(objects.prepare(prior.mesh, False), "prior", bpy.context.collection)
    base = priors.base_of(obj)
    moved = prior.base_vertices.copy()
    moved[moved[:, 0] > 0.5] *= np.float32([2, 3, 1])
    wanted = prior.pose(moved)
    bpy.context.view_layer.objects.active = base
    bpy.ops.object.mode_set(mode="EDIT")
    edited = bmesh.from_edit_mesh(base.data)
    for vertex, place in zip(edited.verts, moved.tolist(), strict=True):
        vertex.co = place
    for mode in ("EDIT", "OBJECT"):
        bpy.ops.object.mode_set(mode=mode)
        assert priors.follow([obj], bpy.context.evaluated_depsgraph_get()) == 1
        np.testing.assert_allclose(places(obj), wanted.vertices, atol=1e-6)
    np.testing.assert_allclose(priors.binding_of(obj).stretch, wanted.binding.stretch, atol=1e-6)
    again = objects.add(objects.prepare(wanted, False), "again", bpy.context.collection)
    priors.follow([again], bpy.context.evaluated_depsgraph_get())
    np.testing.assert_allclose(places(again), wanted.vertices, atol=1e-6)


def test_handlers_follow_shape_keys_and_armatures(placed):
    obj, base, prior = placed
    scene = bpy.context.scene
    handlers = (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.frame_change_post)
    functions = (priors.after_update, priors.after_frame)
    for group, function in zip(handlers, functions, strict=True):
        group.append(function)
    try:
        base.shape_key_add(name="rest")
        key = base.shape_key_add(name="up")
        raised = prior.base_vertices + np.float32([0, 0, 0.5])
        key.data.foreach_set("co", raised.ravel())
        key.value = 1.0
        bpy.context.view_layer.update()
        assert_follows(obj, prior, raised)
        # From frame to frame, between the two.
        key.value = 0.0
        key.keyframe_insert("value", frame=1)
        key.value = 1.0
        key.keyframe_insert("value", frame=11)
        scene.frame_set(6)
        heights = places(obj)[:, 2] - wanted(prior, prior.base_vertices)[:, 2]
        assert 0.1 < heights.mean() < 0.4
        scene.frame_set(1)
        assert_follows(obj, prior, prior.base_vertices)
        # A hook, one of the modifiers that move vertices; an armature is another.
        bone = bpy.data.objects.new("rig", bpy.data.armatures.new("rig"))
        scene.collection.objects.link(bone)
        bpy.context.view_layer.objects.active = bone
        bpy.ops.object.mode_set(mode="EDIT")
        made = bone.data.edit_bones.new("bone")
        made.head, made.tail = (0, 0, 0), (0, 0, 1)
        bpy.ops.object.mode_set(mode="OBJECT")
        group = base.vertex_groups.new(name="bone")
        group.add(list(range(len(base.data.vertices))), 1.0, "REPLACE")
        modifier = base.modifiers.new("rig", "ARMATURE")
        modifier.object = bone
        before = places(obj)
        bone.pose.bones["bone"].location = (0, 2, 0)
        bpy.context.view_layer.update()
        shift = places(obj) - before
        np.testing.assert_allclose(np.linalg.norm(shift, axis=1), 2, atol=1e-4)
    finally:
        for group, function in zip(handlers, functions, strict=True):
            group.remove(function)


def test_splats_are_at_rest_again_where_the_modifiers_of_the_base_do_nothing(placed):
    obj, base, prior = placed
    lift = base.modifiers.new("lift", "DISPLACE")
    lift.direction, lift.mid_level = "Z", 0
    for strength in (1, 0):
        lift.strength = strength
        bpy.context.view_layer.update()
        assert priors.follow([obj], bpy.context.evaluated_depsgraph_get()) == 1
        assert_follows(obj, prior, prior.base_vertices + np.float32([0, 0, strength]))


def test_a_muted_tie_is_mended_by_itself(placed):
    obj, _, _ = placed
    obj.constraints[priors.TIE].mute = True
    assert not priors.is_tied(obj)
    priors.tie(obj)
    assert priors.is_tied(obj)
    assert len(obj.constraints) == 1


def rendered(scene, path) -> list[np.ndarray]:
    """Frames 1 and 3, with the handler of the extension."""
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0, -4, 0), (np.pi / 2, 0, 0)
    scene.camera, scene.render.engine = camera, "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = 16
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 3, 2
    scene.render.film_transparent = True  # alpha shows also what no lamp lights
    scene.render.filepath = f"{path}/"
    bpy.app.handlers.frame_change_post.append(priors.after_frame)
    try:
        bpy.ops.render.render(animation=True)
    finally:
        bpy.app.handlers.frame_change_post.remove(priors.after_frame)
    return [np.array(bpy.data.images.load(str(path / f"000{i}.png")).pixels) for i in (1, 3)]


def rise(base) -> None:
    """Hooks ``base``, which has risen by its height at frame 3, to an empty."""
    rig = bpy.data.objects.new("rig", None)
    bpy.context.scene.collection.objects.link(rig)
    modifier = base.modifiers.new("rig", "HOOK")
    modifier.object = rig
    modifier.vertex_indices_set(range(len(base.data.vertices)))
    for at, height in ((1, 0), (3, 1)):
        rig.location.z = height
        rig.keyframe_insert("location", frame=at)


@pytest.mark.parametrize("tied", [True, False])
def test_a_rendered_animation_shows_the_base_move(placed, tmp_path, tied):
    """Blender leaves hidden objects as they are at rest. A file of an earlier release, which has no tie, is
    tied when it is loaded; else the splats stay where they are, and the panel says so."""
    obj, base, _ = placed
    scene = bpy.context.scene
    objects.render_settings(scene, [obj], False)
    rise(base)
    base.hide_set(True)
    if not tied:
        obj.constraints.clear()
        scene.frame_set(3)
        priors.follow([obj], bpy.context.evaluated_depsgraph_get())
        before = places(obj)
        first, last = rendered(scene, tmp_path)
        np.testing.assert_array_equal(first, last)
        np.testing.assert_array_equal(places(obj), before)
        assert "Follow Base Now" in obj[priors.PROBLEM]
        priors.tie_all()
    first, last = rendered(scene, tmp_path)
    assert first.std() > 0.05
    assert np.abs(first - last).mean() > 0.02
    assert obj[priors.PROBLEM] == ""


def test_linked_splats_follow_by_an_override_with_a_mesh_of_its_own(placed, tmp_path):
    obj, base, _ = placed
    rise(base)
    home = bpy.data.collections.new("home")
    for part in (obj, base, bpy.data.objects["rig"]):
        home.objects.link(part)
    path = tmp_path / "library.blend"
    bpy.data.libraries.write(str(path), {home})
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    with bpy.data.libraries.load(str(path), link=True) as (_, wanted):
        wanted.collections = ["home"]
    scene.collection.children.link(bpy.data.collections["home"])
    assert priors.followers(scene) == [], "what is linked cannot be changed"
    bpy.data.collections["home"].override_hierarchy_create(scene, bpy.context.view_layer)
    own = next(o for o in scene.objects if o.override_library and priors.base_of(o))
    for reloaded in (False, True):
        if reloaded:  # where the property of the base is that of the library again
            bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
            bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shot.blend"))
            scene = bpy.context.scene
            own = next(o for o in scene.objects if o.override_library and priors.base_of(o))
        else:
            assert priors.follow([own], bpy.context.evaluated_depsgraph_get()) == 0
            assert "linked from library.blend" in own[priors.PROBLEM]
            priors.tie(own)
        heights = []
        for frame in (1, 3):
            scene.frame_set(frame)
            assert priors.follow([own], bpy.context.evaluated_depsgraph_get()) == 1
            heights.append(places(own)[:, 2].mean() - places(own)[:, 1].mean())
        assert abs(heights[1] - heights[0]) > 0.5


def test_splats_of_instances_follow(placed):
    obj, base, _ = placed
    scene = bpy.context.scene
    rise(base)
    home = bpy.data.collections.new("home")
    for part in (obj, base):
        scene.collection.objects.unlink(part)
        home.objects.link(part)
    shown = bpy.data.objects.new("instance", None)
    shown.instance_type, shown.instance_collection = "COLLECTION", home
    scene.collection.objects.link(shown)
    before = places(obj)
    scene.frame_set(3)
    priors.after_frame(scene, bpy.context.evaluated_depsgraph_get())
    np.testing.assert_allclose(np.linalg.norm(places(obj) - before, axis=1), 1, atol=1e-4)


@pytest.mark.parametrize("kind", ["CLOTH", "SOFT_BODY"])
def test_a_simulated_base(placed, kind):
    """A cloth or soft body pinned nowhere falls, and takes its splats along."""
    obj, base, prior = placed
    modifier = base.modifiers.new("simulation", kind)
    if kind == "SOFT_BODY":
        modifier.settings.use_goal = False
    scene = bpy.context.scene
    bpy.app.handlers.frame_change_post.append(priors.after_frame)
    try:
        heights = []
        for frame in range(1, 9):
            scene.frame_set(frame)
            world = np.array(obj.matrix_world)
            heights.append(float((places(obj) @ world[:3, :3].T + world[:3, 3])[:, 2].mean()))
        assert heights[-1] < heights[0] - 0.05
        evaluated = base.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
        fallen = np.array([vertex.co[:] for vertex in evaluated.vertices], np.float32)
        np.testing.assert_allclose(places(obj), wanted(prior, fallen), atol=1e-5)
    finally:
        bpy.app.handlers.frame_change_post.remove(priors.after_frame)


def test_edit_mode_is_followed(placed):
    obj, base, prior = placed
    bpy.context.view_layer.objects.active = base
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        import bmesh

        edited = bmesh.from_edit_mesh(base.data)
        for vertex in edited.verts:
            vertex.co.z += 1
        bmesh.update_edit_mesh(base.data)
        priors.follow([obj], bpy.context.evaluated_depsgraph_get())
        assert_follows(obj, prior, prior.base_vertices + np.float32([0, 0, 1]))
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def test_a_base_that_cannot_be_followed_is_reported(placed):
    obj, base, prior = placed
    before = places(obj)
    base.modifiers.new("more", "SUBSURF").levels = 1
    assert priors.follow([obj], bpy.context.evaluated_depsgraph_get()) == 0
    assert "follow modifiers that move vertices" in obj[priors.PROBLEM]
    np.testing.assert_array_equal(places(obj), before)
    base.modifiers.clear()
    priors.follow([obj], bpy.context.evaluated_depsgraph_get())
    assert_follows(obj, prior, prior.base_vertices)
    bpy.data.objects.remove(base)
    assert priors.base_of(obj) is None
    priors.after_frame(bpy.context.scene, bpy.context.evaluated_depsgraph_get())


def test_shading_can_be_changed_and_it_still_follows(placed):
    obj, base, prior = placed
    for lit in (True, False):
        objects.replace_mesh(obj, objects.prepare(objects.as_splat_mesh(obj), lit))
        assert obj.data[objects.LIT] == lit
        moved = prior.base_vertices + np.float32([0, 0, 0.25])
        base.data.vertices.foreach_set("co", moved.ravel())
        base.data.update()
        priors.follow([obj], bpy.context.evaluated_depsgraph_get())
        assert_follows(obj, prior, moved)


def test_a_stretch_ends_with_the_splats_that_had_it():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    prior = bind(sheet(), triangles=4, layers=2, spacing=-0.05)
    moved = prior.base_vertices.copy()
    moved[moved[:, 0] > 0.5] *= np.float32([2, 3, 1])
    stretched = objects.prepare(prior.pose(moved), False)
    obj = objects.add(stretched, "prior", bpy.context.collection)
    priors.base_of(obj).data.vertices.foreach_set("co", prior.base_vertices.ravel())
    objects.replace_mesh(obj, objects.prepare(prior.mesh, False))
    assert priors.binding_of(obj).stretch is None
    priors.follow([obj], bpy.context.evaluated_depsgraph_get())
    np.testing.assert_allclose(places(obj), prior.mesh.vertices, atol=1e-6)


def test_images_are_those_of_the_posed_mesh(tmp_path, placed):
    """Cycles draws the followed splats as it draws the mesh that ``pose`` makes."""
    obj, base, prior = placed
    if obj.data[objects.LIT]:
        pytest.skip("unlit images are the exact ones")
    moved = prior.base_vertices * np.float32([1, 1, 3])
    base.data.vertices.foreach_set("co", moved.ravel())
    base.data.update()
    priors.follow([obj], bpy.context.evaluated_depsgraph_get())
    lifted = replace(in_blender(prior).pose(moved), binding=None)
    # With its origin where the base has it: rays that meet edges exactly must be rounded the same way.
    prepared = objects.prepare(lifted, False) | {"origin": np.zeros(3)}
    other = objects.add(prepared, "posed", bpy.context.collection)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0, -4, 0), (np.pi / 2, 0, 0)
    scene = bpy.context.scene
    scene.camera = camera
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.render.engine = "CYCLES"
    objects.render_settings(scene, [obj], False)
    images = []
    for shown, hidden in ((obj, other), (other, obj)):
        shown.hide_render, hidden.hide_render = False, True
        scene.render.filepath = str(tmp_path / f"{shown.name}.png")
        bpy.ops.render.render(write_still=True)
        images.append(np.array(bpy.data.images.load(scene.render.filepath).pixels))
    assert images[0].std() > 0.05
    assert (np.abs(images[0] - images[1]) < 0.01).mean() > 0.99
