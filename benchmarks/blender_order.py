"""EEVEE's images of splats from eight sides, by the order in which it blends the triangles.

    blender-env/bin/python benchmarks/blender_order.py [--size 200] [--splats playbot_lod3_31k_sh2.ply ...]

PSNR against ``render(order="splat")``, unlit, one sample a pixel. *As converted*: the triangles in the order
of the mesh. *In the file*: each twice, with both windings, in the order that ``drawing_order`` solves for
views from all around, back faces culled. *Far to near*: the modifier of the extension and of saved files, in
one animation with a camera for each frame; and the processor time of all threads in which a viewport's
splats are sorted for another view.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import SCENES, Report, Stopwatch, arguments

import meshsplats as ms
from meshsplats.blender import SceneOptions
from meshsplats.blender.subject import prepare

SIDES = 8


def pictures(mesh: ms.SplatMesh, views: list[ms.Camera], *, sort: bool, cull: bool) -> list[np.ndarray]:
    from meshsplats.blender.inside import far_to_near, rendering, scene
    from meshsplats.blender.inside.host import bpy

    arrays, facts = prepare(mesh, views, SceneOptions(engine="eevee"), 1)
    subject = scene.Subject(**arrays, **facts)
    built = scene.build(subject, views, SceneOptions(engine="eevee"), 1024, edges=False)
    far_to_near.modifier_of(built.obj).show_render = sort
    built.obj.data.materials[0].use_backface_culling = cull
    settings = built.scene.render.image_settings
    settings.file_format, settings.color_depth = "OPEN_EXR", "32"
    bpy.app.handlers.frame_change_post.append(lambda scene, _: far_to_near.follow_camera(scene))
    with tempfile.TemporaryDirectory() as folder:
        built.scene.render.filepath = f"{folder}/"
        bpy.ops.render.render(animation=True)
        return [rendering.read_pixels(Path(folder) / f"{i:04d}.exr")[..., :3] for i in range(len(views))]


def sorting_ms(mesh: ms.SplatMesh) -> float:
    """Median over eight directions."""
    from meshsplats.blender.inside import far_to_near, scene
    from meshsplats.blender.inside.host import bpy

    arrays, facts = prepare(mesh, [], SceneOptions(engine="eevee"), 1)
    built = scene.build(scene.Subject(**arrays, **facts), [], SceneOptions(engine="eevee"), 1024, edges=True)
    modifier, found = far_to_near.modifier_of(built.obj), []
    for angle in np.linspace(0, 2 * np.pi, 9):
        watch = Stopwatch()
        far_to_near.look(modifier, (np.cos(angle), np.sin(angle), 0.2))
        bpy.context.view_layer.update()
        found.append(watch.processor)
    return 1e3 * float(np.median(found[1:]))


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--splats", nargs="+", default=[SCENES[n].splats for n in ("playbot", "guitar")])
    parser.add_argument("--solve", type=int, default=40_000, help="most splats whose order is solved")
    asked = parser.parse_args()
    from meshsplats.blender.inside.host import bpy

    with Report(asked) as report:
        report.say(f"Blender {bpy.app.version_string}; least and mean PSNR of {SIDES} sides, dB")
        report.table("splats", "triangles", "as converted", "in the file", "far to near", "sorting")
        for name in asked.splats:
            mesh = ms.convert(ms.load_gaussians(asked.data / "splats" / name))
            mesh = mesh.of_degree(0)  # the order is judged, not shading
            views = [
                view.with_near_plane(mesh.vertices)
                for view in ms.orbit(mesh, SIDES, width=asked.size, height=asked.size)
            ]
            truths = [ms.render(mesh, view, order="splat").color for view in views]

            def score(images: list[np.ndarray], truths: list[np.ndarray] = truths) -> str:
                values = [ms.psnr(image, truth) for image, truth in zip(images, truths, strict=True)]
                return f"{min(values):.1f}, {np.mean(values):.1f}"

            solved = "-"
            if mesh.splat_count <= asked.solve:
                listed = ms.drawing_order(mesh, nodes=1).listed(mesh.faces)
                twice = replace(mesh, faces=listed, face_splat=None)
                solved = score(pictures(twice, views, sort=False, cull=True))
            report.row(
                f"{name}, {mesh.splat_count:,}",
                f"{len(mesh.faces):,}",
                score(pictures(mesh, views, sort=False, cull=False)),
                solved,
                score(pictures(mesh, views, sort=True, cull=False)),
                f"{sorting_ms(mesh):.0f} ms",
            )


if __name__ == "__main__":
    main()
