"""The plain colours of a result: what programs without harmonics show of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.views import Dataset
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step
from meshsplats.rendering.plain_colors import plain_means
from meshsplats.scene.mesh import SplatMesh

MOST_VIEWS = 16
"""Largest number of views that the colours are means over, before they are optimised."""
MOST_STEPS = 60
"""Largest number of steps of the colours alone."""
VIEWS_SHARE = 1 / 3
"""Share of the images that are for the means."""


def most_images(steps: int) -> int:
    """Number of images that are worth while after a run of ``steps`` steps."""
    return min(MOST_VIEWS + MOST_STEPS, 1 + steps // 5)


def with_plain_means(
    mesh: SplatMesh, dataset: Dataset, views: int = MOST_VIEWS, *, threads: int | None = None
) -> SplatMesh:
    """``mesh`` with ``plain_colors`` that are means over so many training ``views`` of ``dataset``."""
    cameras = [view.camera for view in subsample(dataset.train, views)]
    return replace(mesh, plain_colors=plain_means(mesh, cameras, threads=threads)[0])


def with_plain_colors(
    mesh: SplatMesh, dataset: Dataset, config: FinetuneConfig, images: int, *, threads: int | None = None
) -> SplatMesh:
    """``mesh``, which has harmonics, with ``plain_colors`` for the training views of ``dataset``: means over
    some of them, and then steps of the colours alone.

    ``images``: how many may be drawn in all, at least 1; each takes about as long as a step.
    """
    views = min(max(1, round(VIEWS_SHARE * images)), MOST_VIEWS)
    mesh = with_plain_means(mesh, dataset, views, threads=threads)
    steps = min(images - views, MOST_STEPS)
    if steps <= 0:
        return mesh
    # Constant light on the mesh as it is: no exposures, and only colours move.
    colors_only = FinetuneConfig(
        steps=steps,
        position_rate=0.0,
        prune_epochs=0.0,
        color_rate=config.color_rate,
        ssim_weight=config.ssim_weight,
        l2_weight=config.l2_weight,
        background=config.background,
        samples=config.samples,
        point_share=0.0,
        seed=config.seed,
    )
    plain = replace(mesh.plain, binding=None)
    state = State.begin(plain, len(dataset.train), colors_only, threads)
    state.solid = np.ones(len(plain.vertices), bool)  # opacities stay
    phase = Blended(colors_only)
    for step in range(steps):
        make_step(state, dataset.train, step, step / steps, phase)
    return replace(mesh, plain_colors=np.clip(state.colors[:, :3], 0, 1))
