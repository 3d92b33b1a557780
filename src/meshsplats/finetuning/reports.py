"""Scores and previews of a run: its mesh in held-out views."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.choices import Device
from meshsplats.datasets.views import Dataset, View
from meshsplats.evaluation.comparison import images_of_view
from meshsplats.evaluation.metrics import psnr
from meshsplats.evaluation.report import masked_ssim
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.step import samples_of
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh

SCORED_VIEWS = 8
"""Maximum number of held-out views that are scored during a run."""

REPORT_SHARE = 0.02
"""Share of a run with a length in minutes that scoring them once may take; fewer are scored where it would be
more, but at least ``FEWEST_SCORED``."""

FEWEST_SCORED = 2


class Reports:
    """Scores the mesh of a run, and writes previews.

    Args:
        dataset: the views.
        config: of the run.
        threads, device: as in ``render``.
        scored: number of views that the run has scored before it was resumed; None: it has not.

    Attributes:
        views: the held-out views that are scored.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: FinetuneConfig,
        threads: int | None,
        device: Device,
        scored: int | None = None,
    ) -> None:
        self._dataset, self._config, self._threads, self._device = dataset, config, threads, device
        self._scored = scored
        self._limited = config.minutes is None
        self.views: tuple[View, ...] = subsample(dataset.test, SCORED_VIEWS)

    def scores(self, mesh: SplatMesh, listing: DrawOrder | None = None) -> tuple[float, float]:
        """Means of PSNR and SSIM over ``views``, of which there must be one; drawn as a file with the order
        ``listing``."""
        if not self._limited and len(self.views) > 1:
            self._limited = True
            self._limit(mesh, listing)
        return self._of_views(mesh, self.views, listing)

    def _limit(self, mesh: SplatMesh, listing: DrawOrder | None) -> None:
        """Leaves as many views as there is time for; all reports of a run have the same."""
        count, minutes = self._scored, self._config.minutes
        if count is None:
            assert minutes is not None
            start = time.perf_counter()
            self._of_views(mesh, self.views[:1], listing)
            cost = time.perf_counter() - start
            count = int(REPORT_SHARE * 60 * minutes / cost) if cost > 0 else SCORED_VIEWS
            count = min(max(count, FEWEST_SCORED), SCORED_VIEWS)
        self.views = subsample(self._dataset.test, count)

    def _of_views(
        self, mesh: SplatMesh, views: Sequence[View], listing: DrawOrder | None
    ) -> tuple[float, float]:
        return held_out_scores(mesh, views, self._config, self._threads, self._device, listing=listing)

    def save_preview(
        self, journal: Journal, step: int, mesh: SplatMesh, listing: DrawOrder | None = None
    ) -> None:
        view = (self.views or self._dataset.train)[0]
        samples = samples_of(view, self._config)
        image, target = images_of_view(
            mesh, view, samples=samples, threads=self._threads, device=self._device, listing=listing
        )
        journal.save_preview(step, target, image)


def scored_count(journal: Journal) -> int | None:
    """How many views the last scores in ``journal`` are means over; None if there are none."""
    lines = [line.get("views") for line in journal.metrics()]
    return lines[-1] if lines and isinstance(lines[-1], int) and lines[-1] > 0 else None


def held_out_scores(
    mesh: SplatMesh,
    views: Sequence[View],
    config: FinetuneConfig,
    threads: int | None,
    device: Device = "cpu",
    *,
    listing: DrawOrder | None = None,
) -> tuple[float, float]:
    """Means of PSNR, in dB and at most 200, and SSIM of ``mesh`` in ``views``, at least one; drawn as a file
    with the order ``listing``."""
    scores = []
    for view in views:
        samples = samples_of(view, config)
        image, target = images_of_view(
            mesh, view, samples=samples, threads=threads, device=device, listing=listing
        )
        decibels = min(psnr(image, target, mask=view.mask), 200.0)
        scores.append((decibels, masked_ssim(image, target, view.mask, threads)))
    mean_psnr, mean_ssim = (float(mean) for mean in np.mean(scores, axis=0))
    return mean_psnr, mean_ssim
