"""train: a mesh prior brought closer to pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from meshsplats.datasets.views import Dataset
from meshsplats.prior.model import MeshPrior

if TYPE_CHECKING:
    from meshsplats.finetuning import FinetuneConfig, Progress, RunOptions


CHOICES = {
    "color_rate": 0.05,
    "position_rate": 0.05,
    "rate_steps": 0,
    "ssim_weight": 0.0,
    "l2_weight": 5.0,
}
"""Where training a prior differs from the preset 'default' of fine-tuning."""


def prior_config(**changes: Any) -> FinetuneConfig:
    """The configuration that ``train`` has by default, with ``changes`` as in ``make_config``."""
    from meshsplats.finetuning import make_config

    return make_config("default", **{**CHOICES, **changes})


def train(
    prior: MeshPrior,
    dataset: Dataset,
    config: FinetuneConfig | None = None,
    *,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> MeshPrior:
    """``prior`` with weights, colours and opacities optimised on the training views of ``dataset``:
    photographs, or the splats' own pictures.

    The loop is that of ``finetune``, with its losses, optimiser, pruning and checkpoints; positions are moved
    by their weights on the base's faces, which after every step are not negative and have the sum 1. Rates of
    positions are in units of the triangles' size (``position_unit`` 'splat') or of the scene.

    Arguments and errors are those of ``finetune``, but ``config`` is ``prior_config()`` by default.
    """
    from meshsplats.finetuning import finetune

    return MeshPrior(
        MeshPrior(
            finetune(prior.mesh, dataset, config or prior_config(), run=run, on_progress=on_progress)
        ).pose()
    )
