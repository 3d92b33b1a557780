"""Cost of one step of fine-tuning, its growth, and the cost of others' steps.

    python benchmarks/training_step.py                        steps at 160k, 1 M and 4 M triangles
    python benchmarks/training_step.py --order fragment splat the same, exact and by whole splats, in turns
    python benchmarks/training_step.py --growth               with triangles, pixels and layers, one at a time
    python benchmarks/training_step.py --beside               beside torch and, where installed, Mitsuba 3

A step draws an image, takes 0.6 L1 + 0.4 (1 - SSIM) and its gradient back to positions and colours, and
moves all vertices by Adam; scenes are the random fans of _common.py. Medians of wall time in milliseconds;
parts are timed within the same steps. --beside takes an image and the gradients of its colours of one small
scene: by this program, by the float64 reference in torch, and by Mitsuba's path integrator with automatic
differentiation (llvm_ad_rgb, which needs an LLVM library), one sample per pixel. Mitsuba draws the same
triangles as diffuse surfaces with an opacity under a white sky, not the same image: it has no unlit
blending. --beside needs torch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
from _common import FANS, Report, Stopwatch, arguments, median_ms, random_fans

from meshsplats._core.kernels import compare_images
from meshsplats.finetuning.adam import RowAdam
from meshsplats.rendering import render
from meshsplats.rendering.backward import TapedRendering
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.order import Order


class Step:
    """One step of fine-tuning on one view, timed in parts."""

    parts = ("draw", "loss", "back", "Adam")

    def __init__(self, mesh: SplatMesh, camera: Camera, threads: int) -> None:
        self.mesh, self.camera, self.threads = mesh, camera, threads
        self.vertices, self.colors = mesh.vertices.copy(), mesh.colors.copy()
        size = (1, camera.height, camera.width, 3)
        self.target = np.random.default_rng(0).random(size, np.float32)
        # Rates so small that every step draws the same scene.
        self.optimizers = [RowAdam(self.vertices, lr=1e-9), RowAdam(self.colors, lr=1e-9, bounds=(0, 1))]

    def draw(self) -> TapedRendering:
        triangles = self.mesh.triangles._replace(vertices=self.vertices, colors=self.colors)
        return TapedRendering(triangles, self.camera, threads=self.threads)

    def __call__(self) -> list[float]:
        watch, times = Stopwatch(), [0.0]
        image = self.draw()
        times.append(watch.wall)
        rates = dict(l1_rate=0.6 / self.target.size, ssim_rate=-0.4 / self.target.size)
        compared = compare_images(
            image.color[None], self.target, gradient=True, threads=self.threads, **rates
        )
        assert compared.gradient is not None
        times.append(watch.wall)
        gradients = [np.zeros_like(values) for values in (self.vertices, self.colors)]
        image.backward(compared.gradient[0], None, None, vertices=gradients[0], colors=gradients[1])
        times.append(watch.wall)
        for optimizer, gradient in zip(self.optimizers, gradients, strict=True):
            optimizer.step(gradient)
        times.append(watch.wall)
        return list(np.diff(times))


def timed(step: Step, repeat: int) -> list[float]:
    step()
    return list(1e3 * np.median([step() for _ in range(repeat)], axis=0))


def in_turns(steps: dict[Order, Step], repeat: int) -> dict[Order, list[float]]:
    """The median times of steps that take turns, so that other work disturbs all alike."""
    for step in steps.values():
        step()
    found = [{name: step() for name, step in steps.items()} for _ in range(repeat)]
    return {name: list(1e3 * np.median([turn[name] for turn in found], axis=0)) for name in steps}


def steps(report: Report, scenes: list[str], orders: list[Order], threads: list[int], repeat: int) -> None:
    report.table("triangles", "image", "order", "threads", *Step.parts, "step")
    for name in scenes:
        mesh, camera = random_fans(*FANS[name])
        for count in threads:
            found = {order: Step(replace(mesh, order=order), camera, count) for order in orders}
            for order, times in in_turns(found, repeat).items():
                size = f"{camera.width} x {camera.height}"
                parts = (f"{t:.0f}" for t in (*times, sum(times)))
                report.row(f"{len(mesh.faces):,}", size, order, count, *parts)


def growth(report: Report, repeat: int) -> None:
    """From a scene of 160k triangles, each of triangles, pixels and layers grows by itself."""
    report.table(
        *("what grows", "triangles", "image", "fragments a pixel", "forward", "backward", "ns a fragment")
    )
    fans, radius, opacity, side = FANS["160k"]
    cases = []
    for by in (0.25, 1, 4):
        # The same number of fragments, of smaller triangles.
        cases.append(("triangles", int(fans * by), radius / by**0.5, opacity, side))
    for by in (0.5, 1, 2):
        cases.append(("pixels", fans, radius, opacity, int(side * by)))
    for by in (0.25, 1, 4):
        # Fainter where there are more, so that the transmittance stays the same.
        cases.append(("layers", int(fans * by), radius, opacity / by, side))
    for what, *scene in cases:
        mesh, camera = random_fans(*scene)
        draw, _, back, _ = timed(Step(mesh, camera, 2), repeat)
        fragments = render(mesh, camera).fragments
        report.row(
            what,
            f"{len(mesh.faces):,}",
            f"{camera.width} x {camera.height}",
            f"{fragments / camera.width / camera.height:.1f}",
            f"{draw:.0f}",
            f"{back:.0f}",
            f"{1e6 * (draw + back) / fragments:.1f}",
        )


def mitsuba_image(mesh: SplatMesh, camera: Camera) -> tuple[str, Callable[[], object]] | None:
    """Drawing with gradients of the colours by Mitsuba 3, and its variant; None where it is missing."""
    try:
        import mitsuba as mi
    except ImportError:
        return None
    try:
        mi.set_variant("llvm_ad_rgb")
        import drjit as dr

        dr.eval(mi.Float(1))
    except Exception:
        return None
    settings = mi.Properties()
    surface = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    settings["bsdf"] = mi.load_dict(
        {
            "type": "mask",
            "opacity": {"type": "mesh_attribute", "name": "vertex_opacity"},
            "bsdf": {"type": "twosided", "bsdf": surface},
        }
    )
    shape = mi.Mesh("fans", len(mesh.vertices), len(mesh.faces), props=settings)
    shape.add_attribute("vertex_color", 3, mesh.colors[:, :3].ravel())
    shape.add_attribute("vertex_opacity", 1, mesh.colors[:, 3].copy())
    params = mi.traverse(shape)
    params["vertex_positions"] = mesh.vertices.ravel()
    params["faces"] = mesh.faces.astype(np.uint32).ravel()
    params.update()
    fov = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx)))
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 256, "rr_depth": 256},
            "light": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "fov": fov,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
                "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height},
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "fans": shape,
        }
    )
    params = mi.traverse(scene)
    key = next(name for name, _ in params if name.endswith("vertex_color"))

    def work() -> object:
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, spp=1)
        dr.backward(dr.mean(image))
        return np.array(dr.grad(params[key]))

    return mi.variant(), work


def beside(report: Report, fans: int, repeat: int) -> None:
    import torch

    from meshsplats.rendering import reference_autograd
    from meshsplats.rendering.autograd import rasterize

    side = 100
    mesh, camera = random_fans(fans, 0.12, 0.05, side)
    torch.set_num_threads(2)
    vertices = torch.from_numpy(mesh.vertices.copy())
    colors = torch.from_numpy(mesh.colors.copy()).requires_grad_()
    given = {"face_splat": mesh.face_splat, "threads": 2}
    draw = lambda: rasterize(vertices, mesh.faces, colors, camera, **given)  # noqa: E731
    layers = render(mesh, camera).fragments / side**2
    report.say(
        f"{len(mesh.faces):,} triangles, {side} x {side}, {layers:.1f} fragments a pixel, 2 threads,"
        f" torch {torch.__version__}."
    )
    ours = median_ms(lambda: draw().color.mean().backward(), 20 * repeat)
    found = {"meshsplats": ours}
    reference = reference_autograd.rasterize(vertices, mesh.faces, colors, camera).color.mean()
    order = median_ms(lambda: reference_autograd.rasterize(vertices, mesh.faces, colors, camera), 1)
    found["torch, float64 reference"] = median_ms(lambda: reference.backward(retain_graph=True), 1) + order
    other = mitsuba_image(mesh, camera)
    if other:
        found[f"Mitsuba 3, {other[0]}"] = median_ms(other[1], repeat)
    report.table("image and gradients of colours", "ms", "of ours")
    for name, taken in found.items():
        report.row(name, f"{taken:.1f}", f"{taken / ours:.1f}")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--scenes", nargs="+", choices=FANS, default=list(FANS))
    parser.add_argument("--order", nargs="+", choices=get_args(Order), default=["fragment"])
    parser.add_argument("--growth", action="store_true")
    parser.add_argument("--beside", action="store_true")
    parser.add_argument("--fans", type=int, default=1250, help="of the scene of --beside")
    asked = parser.parse_args()
    with Report(asked) as report:
        if asked.growth:
            growth(report, asked.repeat)
        elif asked.beside:
            beside(report, asked.fans, asked.repeat)
        else:
            steps(report, asked.scenes, asked.order, asked.threads, asked.repeat)


if __name__ == "__main__":
    main()
