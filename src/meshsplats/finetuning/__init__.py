"""Fine-tuning meshes on pictures: ``finetune``, its configuration, losses, optimiser and checkpoints.

Nothing but the package itself is needed; ``meshsplats.finetuning.losses`` has the losses for torch.
"""

from meshsplats.finetuning.config import (
    FEWEST_VIEWS,
    PRESETS,
    FinetuneConfig,
    make_config,
    worthwhile_views,
)
from meshsplats.finetuning.initial import starting_mesh
from meshsplats.finetuning.interruption import Interrupted
from meshsplats.finetuning.run import Progress, RunOptions, finetune

__all__ = [
    "FEWEST_VIEWS",
    "PRESETS",
    "FinetuneConfig",
    "Interrupted",
    "Progress",
    "RunOptions",
    "finetune",
    "make_config",
    "starting_mesh",
    "worthwhile_views",
]
