"""Time and quality of lit images, and the command's estimate of the time.

    blender-env/bin/python benchmarks/blender_waiting.py [--width 240]

The demo scene, as it is, of a tenth as many splats, and of faint large ones, is drawn by Cycles under the
default light, flat ellipses as ``meshsplats blender --lit`` has them. Two tables: processor time per image
and the command's estimate; and, of the first scene, PSNR (8 bits) of fewer samples, with and without
denoising, against many.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from _common import Report, arguments

from meshsplats import convert, orbit, psnr
from meshsplats.blender import LightOptions, SceneOptions, draw
from meshsplats.blender.plan import estimated_seconds
from meshsplats.demo_scene import make_scene
from meshsplats.images.reading import load_image


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--reference", type=int, default=400, help="samples of the reference image")
    asked = parser.parse_args()
    whole, faint = make_scene(20_000), make_scene(20_000)
    faint = replace(faint, opacities=0.15 * faint.opacities, scales=2 * faint.scales)
    scenes = {"still life": whole, "2,000 splats": make_scene(2000), "faint, large splats": faint}
    meshes = {name: convert(cloud, mode="flat") for name, cloud in scenes.items()}
    lens: dict[str, Any] = {"elevation": 15, "azimuth": 20}
    lens |= {"width": asked.width, "height": asked.width * 9 // 16}
    with Report(asked) as report, tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.png"

        def image(mesh, options):
            ahead: list[dict] = []
            camera = orbit(mesh, 1, **lens)
            result = draw(mesh, camera, images=[path], options=options, announce=ahead.append)
            return load_image(path) / 255, result["image_processor_seconds"][0], ahead[0]

        report.table("scene", "light", "layers, mean", "samples", "processor time", "estimate")
        for name, mesh in meshes.items():
            for light in (None, LightOptions()):
                options = SceneOptions(light=light, samples=2 if light is None else 4, threads=1)
                _, seconds, ahead = image(mesh, options)
                guess = estimated_seconds(ahead, options)
                kind = "unlit" if light is None else "lit"
                work = (f"{ahead['mean_layers']:.1f}", ahead["samples"])
                report.row(name, kind, *work, f"{seconds:.1f} s", f"{guess:.1f} s")
        mesh, light = meshes["still life"], LightOptions()
        many, _, _ = image(mesh, SceneOptions(light=light, samples=asked.reference))
        report.table("samples", "denoised", "PSNR", "processor time")
        for samples in (8, 16, 64):
            for denoise in (False, True):
                options = SceneOptions(light=light, samples=samples, denoise=denoise)
                shown, seconds, _ = image(mesh, options)
                likeness = f"{psnr(shown, many):.1f} dB"
                report.row(samples, "yes" if denoise else "no", likeness, f"{seconds:.1f} s")


if __name__ == "__main__":
    main()
