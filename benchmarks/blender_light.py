"""Lit images under an even white light against the unlit ones, in Cycles.

    blender-env/bin/python benchmarks/blender_light.py ../shared/data/splats/guitar_sh0.ply [more files]

Under white light from everywhere, a lit image should be the unlit one, up to soft darkening in hollows. For
each file: PSNR of the display values on the object's pixels, after one gain that makes the means of linear
light equal; that gain; the share of blotches, solid pixels whose light (lit by unlit, means of 3 x 3 pixels)
differs by a fifth and more from its mean over 16 x 16 pixels; most layers behind each other; processor
seconds of all threads, from the mesh to the image. ``-o`` writes the unlit image beside those under even
light, sun and studio.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, arguments
from PIL import Image

from meshsplats import convert, load_gaussians, orbit, psnr, render
from meshsplats.blender import LightOptions, SceneOptions, draw
from meshsplats.blender.options import LIGHTS
from meshsplats.formats.splat_paths import subject_name
from meshsplats.images.writing import save_image, strip
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear

EVEN = LightOptions(sun_strength=0.0, sky=1.0, ground="none", exposure=0.0)
COVERED = 0.02
"""Opacity from which a pixel belongs to the object."""
SOLID = 0.95
"""Opacity from which a pixel is looked at for blotches: edges differ by their blending."""
BLOTCH = 0.2


def with_gain(lit: np.ndarray, unlit: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, float]:
    """Display values of ``lit`` times the gain in linear light that makes its mean on ``seen`` that of
    ``unlit``, and the gain."""
    light = srgb_to_linear(lit)
    gain = float(srgb_to_linear(unlit)[seen].mean() / light[seen].mean())
    return linear_to_srgb(np.clip(light * gain, 0, 1)), gain


def box_mean(values: np.ndarray, weights: np.ndarray, side: int) -> np.ndarray:
    """(h, w) means of ``values`` by ``weights`` over squares of ``side`` pixels."""

    def total(array: np.ndarray) -> np.ndarray:
        for axis in (0, 1):
            along = np.moveaxis(array, axis, 0)
            before, after = side // 2 + 1, side - 1 - side // 2
            sums = np.cumsum(np.pad(along, [(before, after), (0, 0)]), axis=0)
            array = np.moveaxis(sums[side:] - sums[:-side], 0, axis)
        return array

    return total(values * weights) / np.maximum(total(weights), 1e-12)


def blotches(lit: np.ndarray, unlit: np.ndarray, seen: np.ndarray) -> float:
    """Share of the pixels ``seen`` whose light deviates at scales below 16 pixels."""
    inside = seen.astype(np.float64)
    means = [box_mean(srgb_to_linear(image).mean(axis=2), inside, 3) + 0.02 for image in (lit, unlit)]
    ratio = np.log(means[0] / means[1])
    return float((np.abs(ratio - box_mean(ratio, inside, 16)) > BLOTCH)[seen].mean())


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="splats")
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--height", type=int, help="as wide by default")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--threads", type=int)
    parser.add_argument("-o", "--output", type=Path, help="folder for images")
    asked = parser.parse_args()
    with Report(asked) as report:
        report.table("splats", "PSNR", "gain", "blotches", "layers", "processor time")
        for file in asked.files:
            measure(report, file, asked)


def measure(report: Report, file: Path, asked: argparse.Namespace) -> None:
    mesh = convert(load_gaussians(file), mode="flat")
    height = asked.height or asked.width
    view = orbit(mesh, 1, elevation=15, azimuth=20, width=asked.width, height=height)[0]
    drawn = render(mesh, view, samples=2)
    unlit, seen = np.clip(drawn.color, 0, 1), drawn.alpha > COVERED
    images = [unlit]
    lights = {"even": EVEN}
    if asked.output is not None:
        lights |= {"sun": LIGHTS["sun"], "studio": LIGHTS["studio"]}
    for name, light in lights.items():
        options = SceneOptions(light=light, samples=asked.samples, denoise=True, threads=asked.threads)
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / "lit.png"
            watch = Stopwatch()
            made = draw(mesh, [view], images=[target], options=options)
            seconds = watch.processor
            seconds += made["build_processor_seconds"] + sum(made["image_processor_seconds"])
            images.append(np.asarray(Image.open(target).convert("RGB"), np.float32) / 255)
        if name == "even":
            fitted, gain = with_gain(images[-1], unlit, seen)
            error = psnr(fitted, unlit, mask=seen)
            share = blotches(fitted, unlit, drawn.alpha > SOLID)
            report.row(
                *(subject_name(file), f"{error:.1f} dB", f"{gain:.2f}", f"{share:.1%}"),
                *(made["layers"], f"{seconds:.0f} s"),
            )
    if asked.output is not None:
        asked.output.mkdir(exist_ok=True)
        save_image(asked.output / f"{subject_name(file)}.png", strip(images, ["unlit", *lights]))


if __name__ == "__main__":
    main()
