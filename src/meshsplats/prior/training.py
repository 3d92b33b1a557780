"""train_prior: optimises a mesh prior on images."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from meshsplats._common.kinds import need
from meshsplats.prior.options import prior_config

if TYPE_CHECKING:
    from meshsplats.datasets.views import Dataset
    from meshsplats.finetuning import FinetuneConfig, Progress, RunOptions
    from meshsplats.prior.model import MeshPrior


def train_prior(
    prior: MeshPrior,
    dataset: Dataset,
    config: FinetuneConfig | None = None,
    *,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> MeshPrior:
    """Optimises barycentric weights, colours and opacities of ``prior`` on the training views of ``dataset``.

    The targets are photographs or images of splats. The loop is that of ``finetune``, with its losses,
    optimiser, pruning and checkpoints. In place of positions it optimises their barycentric weights on the
    base's faces, which are projected onto the simplex after every step. The learning rate of positions is in
    units of the triangles' size (``position_unit`` 'splat') or of the scene.

    Args:
        prior: the initial mesh prior, from ``bind``.
        dataset: the training views, and held-out views to score.
        config: the configuration; ``prior_config()`` by default.
        run: output folder, logging and resources, as for ``finetune``.
        on_progress: called after every step.

    Returns:
        The trained prior on the same base.

    Raises:
        The errors of ``finetune``.
    """
    from meshsplats.datasets.views import Dataset
    from meshsplats.prior.model import MeshPrior

    need(MeshPrior, prior=prior)
    need(Dataset, dataset=dataset)
    from meshsplats.finetuning import finetune

    trained = finetune(prior.mesh, dataset, config or prior_config(), run=run, on_progress=on_progress)
    return MeshPrior(MeshPrior(trained).pose())  # posed, with shading normals
