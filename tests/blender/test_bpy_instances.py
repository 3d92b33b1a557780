# ruff: noqa: E402
"""What the extension does with instances of splats and with linked ones."""

from __future__ import annotations

import sys

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import convert
from meshsplats.blender.inside import objects, priors, versions
from meshsplats.prior import bind
from meshsplats.scene.base_mesh import BaseMesh


@pytest.fixture
def scene(extension):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def home_in(scene):
    home = bpy.data.collections.new("home")
    scene.collection.children.link(home)
    return home


def warnings_of(scene) -> list[str]:
    bpy.context.view_layer.update()
    return sys.modules["blender_extension.instances"].instance_warnings(scene)


def test_turned_instances_are_named_where_eevee_draws_them(scene):
    home = home_in(scene)
    objects.add(objects.prepare(convert(ball_splats(20)[0]), False), "ball", home)
    scene.collection.children.unlink(home)
    shown = bpy.data.objects.new("shown", None)
    shown.instance_type, shown.instance_collection = "COLLECTION", home
    scene.collection.objects.link(shown)
    scene.render.engine = versions.engine_name("eevee")
    shown.scale, shown.location = (2, 2, 2), (1, 2, 3)
    assert warnings_of(scene) == []
    for turned in ({"rotation_euler": (0, 0, 0.1)}, {"scale": (1, 2, 1)}, {"scale": (-1, -1, -1)}):
        for name, value in ({"rotation_euler": (0, 0, 0), "scale": (1, 1, 1)} | turned).items():
            setattr(shown, name, value)
        (said,) = warnings_of(scene)
        assert "EEVEE draws shown, a turned instance" in said
    versions.enable_cycles()
    scene.render.engine = "CYCLES"
    assert warnings_of(scene) == []


def test_linked_splats_of_a_mesh_prior_are_named_until_they_can_follow(scene, tmp_path):
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = bind(BaseMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), triangles=20).mesh
    home = home_in(scene)
    obj = objects.add(objects.prepare(mesh, False), "prior", home)
    library, shot = tmp_path / "library.blend", tmp_path / "shot.blend"
    bpy.data.libraries.write(str(library), {home})
    # As an earlier release has left it.
    obj.constraints.clear()
    bpy.ops.wm.save_as_mainfile(filepath=str(shot))
    bpy.ops.wm.open_mainfile(filepath=str(shot))
    assert priors.is_tied(bpy.data.objects["prior"])

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.collections = ["home"]
    linked = bpy.data.collections["home"]
    scene.collection.children.link(linked)
    (said,) = warnings_of(scene)
    assert "prior, linked from library.blend, does not follow" in said
    linked.override_hierarchy_create(scene, bpy.context.view_layer)
    scene.collection.children.unlink(linked)
    own = next(o for o in scene.objects if o.override_library and priors.base_of(o))
    assert warnings_of(scene) == []
    bpy.context.view_layer.objects.active = own
    scene.frame_set(2)
    assert "Follow Base Now makes it local" in own[priors.PROBLEM]
    assert bpy.ops.object.meshsplats_follow() == {"FINISHED"}
    assert (own[priors.PROBLEM], own.data.library) == ("", None)
