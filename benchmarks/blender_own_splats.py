"""The splats that Blender draws itself, since 5.3, as they are and lit by the extension, in Cycles.

    blender-env/bin/python benchmarks/blender_own_splats.py --data ../shared/data [--splats FILE ...]

*Unlit*: for each file, images of four sides against the splats' own image (``render_splats``, without its
widening, which Blender has not; 3 x 3 samples), all harmonics and degree 0: as Blender draws them; with the
colours and opacities of lit ones before even light (1 everywhere); and the mesh that ``convert`` makes of
them, as ``render(order="splat")`` draws it.

*Lit*: splats sampled on a textured cow, as in ``blender_known_truth.py``, under sun and sky on a ground,
against the textured mesh: as imported; with a diffuse material in their own colours, shaded by Blender; lit.
Shadow overlap is intersection over union of the pixels of the ground darker than 0.8 of the bare ground.
``-o`` writes a strip of these images.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import blender_known_truth as cow
import numpy as np
from _common import SCENES, Report, Stopwatch, arguments
from PIL import Image

import meshsplats as ms
from meshsplats.images.writing import save_image, strip
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear

SIDES = 4
KINDS = ("clean", "noisy", "faulty")


def imported(path: Path, rotation: np.ndarray):
    """The object that Blender makes of the splats of a file, turned by ``rotation`` (3, 3)."""
    from meshsplats.blender.inside.host import bpy

    read = bpy.ops.wm.spz_import if path.suffix == ".spz" else bpy.ops.wm.ply_import
    read(filepath=str(path))
    obj = bpy.context.object
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    obj.matrix_world = matrix.T.tolist()
    bpy.context.view_layer.update()
    return obj


def light(obj) -> None:
    from meshsplats.blender.inside import lit_points, objects

    lit_points.light(obj, lit_points.prepare(objects.light_source(obj)))


def images(views, rotation: np.ndarray, samples: int) -> list[np.ndarray]:
    """Linear images of the scene, by Cycles."""
    from meshsplats.blender.inside import rendering, stage
    from meshsplats.blender.inside.host import bpy

    scene = bpy.context.scene
    rendering.lit_settings(scene, "cycles", samples=samples, limit=64, denoise=False, exposure=0.0)
    found = []
    for view in views:
        home = stage.collection("Cameras")
        stage.aim(scene, view, stage.add_camera(view, "camera", rotation, 1e4, home))
        found.append(cow.shot(scene))
    return found


def unlit(report: Report, paths: list[Path], width: int, samples: int) -> None:
    from meshsplats.blender.inside import frame, stage, versions
    from meshsplats.blender.inside.host import bpy

    report.say(
        f"Unlit, {SIDES} sides, {width} x {width}, {samples} samples, PSNR in dB, all harmonics / degree 0"
    )
    report.table(
        "splats", "as Blender draws them", "with colours for linear light", "mesh, `render`", "seconds"
    )
    for path in paths:
        cloud = ms.load_gaussians(path)
        mesh = ms.convert(cloud)
        rotation = frame.to_blender(mesh.up)
        views = ms.orbit(cloud, SIDES, up=mesh.up, width=width, height=width)
        truths = [
            [ms.render_splats(cloud, v, samples=3, dilation=0.0, sh_degree=degree).color for v in views]
            for degree in (None, 0)
        ]
        bpy.ops.wm.read_factory_settings(use_empty=True)
        versions.enable_cycles()
        stage.even_world((1.0, 1.0, 1.0))
        obj = imported(path, rotation)
        rows, watch = [], Stopwatch()
        for lit in (False, True):
            if lit:
                watch = Stopwatch()
                light(obj)
                seconds = watch.processor
            drawn = [linear_to_srgb(np.clip(image, 0, 1)) for image in images(views, rotation, samples)]
            rows.append(" / ".join(f"{np.mean(list(map(ms.psnr, drawn, truth))):.1f}" for truth in truths))
        found = []
        for shown, truth in zip((mesh, mesh.of_degree(0)), truths, strict=True):
            drawn = [ms.render(shown, view, samples=3, order="splat").color for view in views]
            found.append(f"{np.mean(list(map(ms.psnr, drawn, truth))):.1f}")
        report.row(path.stem, *rows, " / ".join(found), f"{seconds:.0f}")


def known_truth(report: Report, data: Path, width: int, samples: int, output: Path | None) -> None:
    from meshsplats.blender import LightOptions
    from meshsplats.blender.inside import frame, materials, meshes, scene, setting, versions
    from meshsplats.blender.inside.baking import bake
    from meshsplats.blender.inside.host import bpy
    from meshsplats.cameras.framing import scene_bounds

    folder = data / "meshes" / "spot_textured" / "spot"
    surface = cow.read_obj(folder / "spot_triangulated.obj")
    texture = np.asarray(Image.open(folder / "spot_texture.png").convert("RGB"))
    rotation, shown, captions = frame.to_blender(cow.UP), [], []
    options = LightOptions(sun=(130, 40))
    report.say(f"Lit, {width} x {width * 3 // 4}, {samples} samples")
    report.table("splats", "material", "PSNR, image", "cow alone", "shadow overlap", "light, of the mesh's")
    for kind in KINDS:
        cloud = cow.sample(surface, texture, kind)
        size = {"width": width, "height": width * 3 // 4, "distance": 1.3}
        view = ms.orbit(cloud, 1, elevation=25, azimuth=215, up=cow.UP, **size)[0]
        covered = ms.render_splats(cloud, view).alpha
        bpy.ops.wm.read_factory_settings(use_empty=True)
        versions.enable_cycles()
        with tempfile.TemporaryDirectory() as scratch:
            ms.save_gaussians(cloud, Path(scratch) / "cow.ply")
            obj = imported(Path(scratch) / "cow.ply", rotation)
        bounds = scene_bounds(meshes.world_points(obj))
        floor = np.array([*bounds.center[:2], setting.lowest(bounds, np.array(setting.UP))])
        scene.surround(floor, bounds.radius, options, rotation @ view.center, (1.0, 1.0, 1.0))

        def draw(view=view) -> np.ndarray:
            return images([view], rotation, samples)[0]

        obj.hide_render = True
        ground = draw()
        cow.add_truth(surface, folder / "spot_texture.png", obj)
        truth = bpy.data.objects["Ground truth"]
        target = draw()
        truth.hide_render, obj.hide_render = True, False
        if not shown:
            shown, captions = [cow.display(target)], ["textured mesh"]
        solid = covered > 0.98
        below = (covered < 0.02) & (ground.mean(axis=2) > 0.05)
        shade = (target.mean(axis=2) < 0.8 * ground.mean(axis=2)) & below
        for material in ("as imported", "plain diffuse", "lit"):
            if material == "plain diffuse":
                rgba = np.ones((len(obj.data.points), 4), np.float32)
                rgba[:, :3] = srgb_to_linear(cloud.colors)
                own = obj.data.attributes.new(meshes.COLOR, "FLOAT_COLOR", "POINT")
                own.data.foreach_set("color", rgba.ravel())
                plain = materials.plain("Diffuse", (1.0, 1.0, 1.0))
                nodes = plain.node_tree
                read = nodes.nodes.new("ShaderNodeAttribute")
                read.attribute_name = meshes.COLOR
                (diffuse,) = (node for node in nodes.nodes if node.type == "BSDF_DIFFUSE")
                nodes.links.new(read.outputs["Color"], diffuse.inputs["Color"])
                obj.data.materials.append(plain)
            elif material == "lit":
                obj.data.materials.clear()
                light(obj)
                bake(bpy.context.scene, [obj])
            drawn = draw()
            dark = (drawn.mean(axis=2) < 0.8 * ground.mean(axis=2)) & below
            report.row(
                kind,
                material,
                f"{ms.psnr(cow.display(drawn), cow.display(target)):.1f} dB",
                f"{ms.psnr(cow.display(drawn), cow.display(target), mask=solid):.1f} dB",
                f"{(dark & shade).sum() / max((dark | shade).sum(), 1):.2f}",
                f"{drawn[solid].mean() / target[solid].mean():.2f}",
            )
            shown.append(cow.display(drawn))
            captions.append(f"{kind}, {material}")
    if output is not None:
        save_image(output, strip(shown, captions))


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--splats", type=Path, nargs="+", help="files for the unlit images")
    parser.add_argument("--width", type=int, default=300)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("-o", "--output", type=Path, help="image of the lit ones: a .png")
    asked = parser.parse_args()
    from meshsplats.blender.inside.host import bpy

    if bpy.app.version < (5, 3, 0):
        parser.error(f"Blender draws splats since 5.3, this is {bpy.app.version_string}")
    paths = asked.splats or [asked.data / "splats" / SCENES[name].splats for name in ("playbot", "guitar")]
    with Report(asked) as report:
        report.say(f"Blender {bpy.app.version_string}")
        unlit(report, paths, asked.width, asked.samples)
        known_truth(report, asked.data, asked.width, asked.samples, asked.output)


if __name__ == "__main__":
    main()
