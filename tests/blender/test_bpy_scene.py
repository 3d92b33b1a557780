# ruff: noqa: E402
"""Saved .blend files open ready to use, and the command line makes them."""

from __future__ import annotations

import json
import stat
import sys

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats, cameras, random_mesh

from meshsplats import (
    TileOptions,
    build_tiles,
    convert,
    psnr,
    save_cameras,
    save_gaussians,
    save_mesh,
    stream_gaussians,
)
from meshsplats.blender import LightOptions, SceneOptions, draw
from meshsplats.blender.inside import materials, meshes, rendering
from meshsplats.blender.plan import PHASES
from meshsplats.cli import main
from meshsplats.demo_scene.city import city_blocks
from meshsplats.images.reading import load_image
from meshsplats.scene.gaussians import GaussianCloud


def environment(path):
    """A small environment image, brighter above."""
    image = bpy.data.images.new("sky", 8, 4, float_buffer=True)
    values = np.ones((4, 8, 4), np.float32)
    values[2:] = 3
    image.pixels.foreach_set(values.ravel())
    image.file_format = "HDR"
    image.filepath_raw = str(path)
    image.save()
    return path


def test_unlit_file_renders_the_image_again(tmp_path):
    mesh = random_mesh()
    views = cameras()[1:3]
    targets = [tmp_path / "a.png", tmp_path / "b.png"]
    draw(mesh, views, images=targets, blend=tmp_path / "s.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "s.blend"))
    scene = bpy.context.scene
    assert [c.name for c in scene.collection.children] == ["Splats", "Cameras"]
    assert scene.camera.name == "wide"
    assert [marker.camera.name for marker in scene.timeline_markers] == ["wide", "tall"]
    assert (scene.frame_start, scene.frame_end) == (0, 1)
    rendering.render_to(scene, tmp_path / "again.png")
    assert (load_image(tmp_path / "again.png") == load_image(targets[0])).all()


def test_lit_file_has_everything_in_named_collections(tmp_path):
    cloud, _ = ball_splats(300)
    light = LightOptions(mirror=True, glass=True, hdri=environment(tmp_path / "sky.hdr"), hdri_rotation=90)
    draw(
        convert(cloud),
        cameras()[:1],
        blend=tmp_path / "s.blend",
        options=SceneOptions(light=light, samples=5, fast=True),
    )
    (tmp_path / "sky.hdr").unlink()  # it is in the file
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "s.blend"))
    scene = bpy.context.scene
    named = {c.name: sorted(o.name for o in c.objects) for c in scene.collection.children}
    assert named == {
        "Splats": ["Splats", "Splats light points", "Splats stand-in"],
        "Cameras": ["view_0000"],
        "Lights": ["Sun"],
        "Surroundings": ["Glass ball", "Ground", "Mirror"],
    }
    image = next(node.image for node in scene.world.node_tree.nodes if node.type == "TEX_ENVIRONMENT")
    assert image.packed_file is not None
    assert tuple(image.size) == (8, 4)
    assert scene.cycles.samples == 5
    assert scene.cycles.denoising_input_passes == "RGB", "it is a preview"
    assert 64 <= scene.cycles.transparent_max_bounces < 1024
    assert (scene.cycles.max_bounces, scene.cycles.diffuse_bounces) == (8, 4)
    assert scene.render.dither_intensity == 0
    assert scene.render.use_compositing, "nodes that are added later have an effect"
    assert scene.render.use_sequencer
    data = bpy.data.objects["Splats"].data
    assert data.materials[0].name == "Splats, lit"
    assert {meshes.COLOR, meshes.NORMAL, meshes.SPLAT} <= set(data.attributes.keys())
    assert data.validate(verbose=True) is False, "Blender finds nothing to mend"


def test_what_takes_long_before_a_lit_image_is_named(tmp_path):
    told = []
    draw(
        convert(ball_splats(200)[0]),
        cameras()[:1],
        blend=tmp_path / "s.blend",
        options=SceneOptions(light=LightOptions(), samples=1, fast=True),
        progress=lambda at: told.append((at.phase, at.left)),
    )
    assert [phase for phase, _ in told] == list(PHASES)
    assert all(left.endswith((" s", " min")) for _, left in told)


def test_mesh_arrays_arrive_as_they_are():
    mesh = random_mesh(50)
    normals = np.tile(np.float32([0, 0.6, 0.8]), (len(mesh.vertices), 1))
    data = meshes.make_mesh(
        "m", mesh.vertices, mesh.faces, mesh.colors, normals=normals, face_splat=mesh.face_splat
    )
    assert data.validate(verbose=True) is False
    assert len(data.edges) == 150
    found = np.empty(4 * len(mesh.vertices), np.float32)
    data.attributes[meshes.COLOR].data.foreach_get("color", found)
    assert (found.reshape(-1, 4) == mesh.colors).all()
    assert [tuple(p.vertices) for p in data.polygons] == [tuple(face) for face in mesh.faces]
    owners = [value.value for value in data.attributes[meshes.SPLAT].data]
    assert owners == mesh.face_splat.tolist()


def test_scene_stands_upright():
    from meshsplats.blender.inside import frame

    for up in ([0, -1, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8]):
        rotation = frame.to_blender(np.array(up, float))
        assert np.allclose(rotation @ up, [0, 0, 1])
        assert np.isclose(np.linalg.det(rotation), 1)


@pytest.mark.slow
def test_command_line_draws_the_tiles_of_a_tileset_that_the_camera_needs(tmp_path, capsys, monkeypatch):
    source = tmp_path / "city.ply"
    save_gaussians(GaussianCloud.joined(list(city_blocks(4000, degree=0))), source)
    build_tiles(stream_gaussians(source), tmp_path / "tiles", TileOptions(max_triangles=4000))
    view = ["--width", "60", "--azimuth", "30", "--elevation", "20", "--json"]
    images = {}
    for distance in ("0.4", "3"):
        given = [str(tmp_path / "tiles"), "--distance", distance, *view]
        assert main(["blender", *given, "-o", str(tmp_path / f"b{distance}.png")]) == 0
        images[distance] = json.loads(capsys.readouterr().out)["triangles"]
        assert main(["render", *given, "-o", str(tmp_path / f"r{distance}.png"), "--samples", "2"]) == 0
        capsys.readouterr()
        ours, theirs = (load_image(tmp_path / f"{kind}{distance}.png") / 255.0 for kind in "rb")
        assert psnr(ours, theirs) > 45
    assert images["3"] < 0.5 * images["0.4"]
    monkeypatch.setattr("meshsplats.blender.files.TILE_TRIANGLES", 6000)
    given = [str(tmp_path / "tiles"), "--distance", "0.4", *view]
    assert main(["blender", *given, "-o", str(tmp_path / "limited.png")]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["triangles"] <= 6000
    assert "need more than 6,000 triangles" in told.err
    assert main(["blender", str(source), "-o", str(tmp_path / "x.png"), "--max-error", "2"]) == 2
    assert "--max-error is for tilesets" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".npz", ".glb", ".ply"])
def test_command_line_draws_meshes_and_splats(tmp_path, suffix, capsys):
    source = tmp_path / f"in{suffix}"
    if suffix == ".ply":
        save_gaussians(ball_splats(200)[0], source)
    else:
        save_mesh(random_mesh(40), source)
    save_cameras(cameras()[:2], tmp_path / "c.json")
    arguments = [
        "blender",
        str(source),
        "-o",
        str(tmp_path / "out"),
        "--cameras",
        str(tmp_path / "c.json"),
        "--json",
    ]
    assert main(arguments) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(result["images"]) == len(result["image_seconds"]) == 2
    assert result["blender"] == bpy.app.version_string
    assert load_image(result["images"][1]).shape == (40, 72, 3)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "cameras.json",
        "config.toml",
        "view_0000.png",
        "view_0001.png",
    ]
    assert main(arguments) == 3
    assert "exists already" in capsys.readouterr().err


def test_executable_runs_the_worker_by_itself(tmp_path):
    """A stand-in for Blender's program: bpy run as Blender runs scripts, without this package installed."""
    program = tmp_path / "blender"
    program.write_text(
        f"#!{sys.executable} -I\n"
        "import sys\n"
        "if sys.argv[1] == '--version':\n"
        "    print('Blender 4.2.0')\n"
        "    sys.exit()\n"
        "sys.meta_path = [f for f in sys.meta_path if 'meshsplats' not in repr(f).lower()]\n"
        "sys.path = [p for p in sys.path if 'meshsplats' not in p]\n"
        "script = sys.argv[sys.argv.index('--python') + 1]\n"
        "exec(compile(open(script).read(), script, 'exec'), {'__name__': '__main__', '__file__': script,"
        " '__package__': ''})\n"
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    result = draw(
        random_mesh(20),
        cameras()[:1],
        images=[tmp_path / "a.png"],
        blend=tmp_path / "a.blend",
        executable=program,
    )
    assert result["blender"] == bpy.app.version_string
    assert load_image(tmp_path / "a.png").shape == (48, 64, 3)
    assert (tmp_path / "a.blend").stat().st_size > 10_000


def test_errors_inside_blender_come_out_in_words(tmp_path):
    from meshsplats.blender import BlenderError

    broken = tmp_path / "sky.hdr"
    broken.write_bytes(b"#?RADIANCE\nbroken")
    options = SceneOptions(light=LightOptions(hdri=broken), samples=1)
    with pytest.raises(BlenderError, match=r"sky\.hdr: Blender cannot read this environment image"):
        draw(random_mesh(5), cameras()[:1], images=[tmp_path / "a.png"], options=options)
    assert [path.name for path in tmp_path.iterdir()] == ["sky.hdr"]


def test_view_layers_may_ask_for_the_smoothed_normals():
    """By a shader AOV: each layer gives its normal, by its opacity."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    nodes = materials.lit(self_shadow=0.0).node_tree.nodes
    (shown,) = (node for node in nodes if node.bl_idname == "ShaderNodeOutputAOV")
    assert shown.aov_name == "Splat normal"
    scale = shown.inputs["Color"].links[0].from_node
    assert (scale.operation, scale.inputs["Scale"].links[0].from_socket.name) == ("SCALE", "Alpha")
    turned = scale.inputs[0].links[0].from_node
    assert turned.inputs["Vector"].links[0].from_node.attribute_name == meshes.NORMAL
