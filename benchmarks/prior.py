"""The gain of a mesh prior: PSNR on held-out views, against the same base opaque and against fan mode.

    python benchmarks/prior.py --data ../shared/data --steps 200
    python benchmarks/prior.py --data ../shared/data --steps 500 --only layers=6

The base is a visual hull (`meshes/lego_visual_hull_40k_vertexcolor.ply`), the images `photos/lego`, with
its own 40 test views. Rows: the base opaque with the vertex colours it came with; the same with its vertex
colours optimised by the same losses, rates and number of steps (positions and opacity fixed); priors of
several forms; and the fans of splats that were trained on the same photographs, fine-tuned. Seconds are
processor time of the steps alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from _common import PHOTOGRAPHED, Report, Stopwatch, arguments, take_steps

import meshsplats as ms
from meshsplats.finetuning import make_config, starting_mesh
from meshsplats.finetuning.config import FinetuneConfig, learning_rates
from meshsplats.finetuning.loss import DefaultLoss
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import target_of, view_of_step
from meshsplats.formats.base_meshes import load_base
from meshsplats.prior import bind
from meshsplats.prior.options import prior_config

FORMS = (
    "layers=1",
    "triangles=4 layers=1",
    "triangles=9 layers=1",
    "layers=2 spacing=0",
    "triangles=4 layers=2 spacing=0",
    "layers=2",
    "layers=4",
    "layers=6",
    "triangles=4 layers=4",
)
"""Of ``bind``; layers=6 is the default."""


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--test-every", type=int, default=1, help="judge by every n-th test view only")
    parser.add_argument("--only", nargs="+", help="forms such as 'triangles=4 layers=2'; baseline; fans")
    options = parser.parse_args()
    lego = PHOTOGRAPHED["lego"]
    data = ms.load_dataset(options.data / lego.photographs)
    judged = ms.Dataset((), data.test[:: options.test_every])
    base = load_base(options.data / "meshes/lego_visual_hull_40k_vertexcolor.ply")
    config = prior_config(steps=options.steps)

    wanted = options.only or ["baseline", *FORMS, "fans"]
    with Report(options) as report:
        report.table("form", "triangles", "steps", "processor s", "PSNR", "SSIM")

        def row(name: str, mesh: ms.SplatMesh, steps: int, seconds: float) -> None:
            scores = ms.evaluate(mesh, judged, threads=options.threads).methods[0]
            psnr, ssim = f"{scores.mean('psnr'):.2f}", f"{scores.mean('ssim'):.4f}"
            report.row(name, f"{len(mesh.faces):,}", steps, f"{seconds:.0f}", psnr, ssim)

        if "baseline" in wanted:
            opaque = ms.SplatMesh(base.vertices, base.faces, base.colors)
            row("base, opaque, its own colours", opaque, 0, 0)
            for name, loss in (
                ("", config),
                (", loss of 3DGS", make_config(steps=options.steps, color_rate=0.05)),
            ):
                tuned, seconds = opaque_colors(opaque, data, loss, options.threads)
                row(f"base, opaque, vertex colours optimised{name}", tuned, options.steps, seconds)
        for form in wanted:
            if "=" in form:
                parts = (part.split("=") for part in form.split())
                laid = {name: float(value) if "." in value else int(value) for name, value in parts}
                mesh = bind(base, views=data.train, threads=options.threads, **laid).mesh
                row(f"prior, {form}", *trained(mesh, data, config, options.threads))
        if "fans" in wanted:
            mesh = starting_mesh(lego.cloud(options.data), [view.camera for view in data.train])
            plain = make_config(steps=options.steps)
            row("fans of 60,000 splats", *trained(mesh, data, plain, options.threads))


def trained(
    mesh: ms.SplatMesh, data: ms.Dataset, config: FinetuneConfig, threads: int
) -> tuple[ms.SplatMesh, int, float]:
    """``mesh`` after all steps, their count, and their processor time."""
    state = State.begin(mesh, len(data.train), config, threads)
    total = config.total_steps(len(data.train)) or 0
    watch = Stopwatch()
    return *take_steps(state, data.train, config, lambda step: step / total), watch.processor


def opaque_colors(
    mesh: ms.SplatMesh, data: ms.Dataset, config: FinetuneConfig, threads: int
) -> tuple[ms.SplatMesh, float]:
    """``mesh`` with its vertex colours optimised, all of it opaque and where it was."""
    import torch

    from meshsplats.rendering.autograd import rasterize

    torch.set_num_threads(1)
    vertices = torch.from_numpy(mesh.vertices.copy())
    colors = torch.from_numpy(mesh.colors[:, :3].copy()).requires_grad_(True)
    ones = torch.ones(len(colors), 1)
    adam = torch.optim.Adam([colors], betas=(config.beta1, config.beta2), eps=config.epsilon)
    steps = config.total_steps(len(data.train)) or 0
    watch = Stopwatch()
    for step in range(steps):
        view = data.train[view_of_step(config, step, len(data.train))]
        target = target_of(view, config, step)
        rgba = torch.cat([colors, ones], 1)
        drawn = rasterize(
            vertices, mesh.faces, rgba, view.camera, background=target.background, threads=threads
        )
        adam.param_groups[0]["lr"] = learning_rates(config, step, step / steps)[0]
        adam.zero_grad()
        gradient = DefaultLoss.of(config, threads)(drawn.color.detach().numpy(), target)[1]
        drawn.color.backward(torch.from_numpy(gradient))
        adam.step()
        with torch.no_grad():
            colors.clamp_(0, 1)
    seconds = watch.processor
    rgba = np.concatenate([colors.detach().numpy(), np.ones((len(colors), 1), np.float32)], axis=1)
    return replace(mesh, colors=rgba), seconds


if __name__ == "__main__":
    main()
