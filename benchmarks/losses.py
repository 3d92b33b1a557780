"""Cost of the loss and of the optimiser's step, beside torch's.

    python benchmarks/losses.py                     both tables
    python benchmarks/losses.py --size 800 --rows 1000000 --repeat 9

The loss is 0.6 L1 + 0.4 (1 - SSIM) of images (size, size, 3), with its gradient. The step is Adam on
positions (v, 3) and colours (v, 4), where a view reached a share of the splats of nine vertices each. Rows
take turns; processor time is that of all threads together. Needs torch.
"""

from __future__ import annotations

import statistics
import warnings
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from _common import Report, arguments, in_turns

from meshsplats.finetuning.adam import RowAdam

if TYPE_CHECKING:
    import torch

VERTICES = 9  # of a splat
SHARES = (1, 0.3, 0.03)


def medians(rows: dict[str, Callable[[], object]], repeat: int) -> dict[str, tuple[float, float]]:
    """Milliseconds by the clock and of the processors, the rows taking turns."""
    found = in_turns(list(rows.values()), repeat)
    return {
        name: (1e3 * statistics.median(times.wall), 1e3 * statistics.median(times.processor))
        for name, times in zip(rows, found, strict=True)
    }


def gaussian() -> torch.Tensor:
    import torch

    line = torch.exp(-0.5 * (torch.arange(-5, 6, dtype=torch.float32) / 1.5) ** 2)
    return line / line.sum()


def torch_loss(image: torch.Tensor, target: torch.Tensor, separable: bool) -> torch.Tensor:
    """The same loss in torch alone: five means under the window, each with one or with two convolutions."""
    import torch
    from torch.nn import functional

    line = gaussian()
    x, y = (p.permute(2, 0, 1)[None] for p in (image, target))

    def mean(z: torch.Tensor) -> torch.Tensor:
        if separable:
            z = functional.conv2d(z, line.view(1, 1, 11, 1).expand(3, 1, 11, 1), padding=(5, 0), groups=3)
            return functional.conv2d(z, line.view(1, 1, 1, 11).expand(3, 1, 1, 11), padding=(0, 5), groups=3)
        return functional.conv2d(z, torch.outer(line, line).expand(3, 1, 11, 11), padding=5, groups=3)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    values = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return 0.6 * (x - y).abs().mean() + 0.4 * (1 - values.mean())


def losses(report: Report, size: int, repeat: int) -> None:
    import torch

    from meshsplats.finetuning.losses import photometric_loss

    generator = torch.Generator().manual_seed(0)
    target = torch.rand(size, size, 3, generator=generator)
    image = (target + 0.05 * torch.randn(target.shape, generator=generator)).clamp(0, 1)

    def step(loss: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[], torch.Tensor]:
        def work() -> torch.Tensor:
            x = image.clone().requires_grad_()
            loss(x).backward()
            assert x.grad is not None
            return x.grad

        return work

    rows = {
        "meshsplats, 1 thread": step(lambda x: photometric_loss(x, target, threads=1)),
        "meshsplats": step(lambda x: photometric_loss(x, target)),
        "torch, separable": step(lambda x: torch_loss(x, target, separable=True)),
        "torch, 11 x 11 windows": step(lambda x: torch_loss(x, target, separable=False)),
    }
    expected = rows["torch, separable"]()
    found = rows["meshsplats"]()
    assert float((found - expected).norm() / expected.norm()) < 1e-3
    times = medians(rows, repeat)
    report.table(f"loss and gradient, {size} x {size} x 3", "ms", "processor ms")
    for name, (clock, processor) in times.items():
        report.row(name, f"{clock:.0f}", f"{processor:.0f}")


def steps(report: Report, rows: int, repeat: int) -> None:
    import torch

    splats = rows // VERTICES
    rows = splats * VERTICES
    table: dict[str, list[tuple[float, float]]] = {}
    for share in SHARES:
        generator = np.random.default_rng(0)
        mask = np.repeat(generator.random(splats) < share, VERTICES) if share < 1 else np.ones(rows, bool)
        chosen = np.flatnonzero(mask).astype(np.int32)
        index = torch.from_numpy(chosen).long()
        work: dict[str, list[Callable[[], object]]] = {}
        for columns in (3, 4):
            start = torch.from_numpy(generator.random((rows, columns), np.float32))
            gradient = torch.from_numpy(generator.normal(size=(rows, columns)).astype(np.float32))
            gradient *= torch.from_numpy(mask)[:, None]
            ours = RowAdam(start.clone(), lr=1e-3)
            for name, reached in {"by mask": mask, "by index": chosen}.items():
                step = partial(ours.step, gradient, reached)
                work.setdefault(f"meshsplats, rows {name}", []).append(step)
            for name, make in {
                "torch Adam": lambda p: torch.optim.Adam([p], lr=1e-3),
                "torch Adam, fused": lambda p: torch.optim.Adam([p], lr=1e-3, fused=True),
            }.items():
                leaf = start.clone().requires_grad_()
                leaf.grad = gradient
                work.setdefault(name, []).append(make(leaf).step)
            leaf = start.clone().requires_grad_()
            model = torch.optim.SparseAdam([leaf], lr=1e-3)

            def sparse(leaf=leaf, model=model, gradient=gradient, index=index) -> None:
                leaf.grad = torch.sparse_coo_tensor(
                    index[None], gradient[index], gradient.shape, is_coalesced=True
                )
                model.step()

            work.setdefault("torch SparseAdam", []).append(sparse)
        together = {name: lambda both=both: [step() for step in both] for name, both in work.items()}
        for name, value in medians(together, repeat).items():
            table.setdefault(name, []).append(value)
    report.table("Adam, ms / processor ms", *(f"{share:.0%} reached" for share in SHARES))
    for name, values in table.items():
        report.row(name, *(f"{a:.1f} / {b:.1f}" for a, b in values))


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=9)
    asked = parser.parse_args()
    import torch

    warnings.filterwarnings("ignore", message="Sparse invariant checks")
    with Report(asked) as report:
        report.say(f"torch {torch.__version__} with {torch.get_num_threads()} threads")
        losses(report, asked.size, asked.repeat)
        steps(report, asked.rows, asked.repeat)


if __name__ == "__main__":
    main()
