"""Fine-tuning meshes on pictures: ``finetune``, its configuration, losses, optimiser and checkpoints.

Running needs the extra ``finetune``; importing this package does not.
"""

from meshsplats.finetuning.config import PRESETS, FinetuneConfig, make_config
from meshsplats.finetuning.interruption import Interrupted
from meshsplats.finetuning.run import Progress, RunOptions, finetune
from meshsplats.finetuning.start import starting_mesh

__all__ = [
    "PRESETS",
    "FinetuneConfig",
    "Interrupted",
    "Progress",
    "RunOptions",
    "finetune",
    "make_config",
    "starting_mesh",
]
