"""Fine-tuning of meshes on images: ``finetune``, its configuration, losses, optimiser and checkpoints.

Needs NumPy alone. ``meshsplats.finetuning.losses`` has the same losses as torch functions.
"""

from typing import TYPE_CHECKING

from meshsplats._common.lazy import lazy_names

__all__ = [
    "FEWEST_VIEWS",
    "PRESETS",
    "FinetuneConfig",
    "Interrupted",
    "OrderedMesh",
    "Progress",
    "RunOptions",
    "finetune",
    "finetune_ordered",
    "make_config",
    "starting_mesh",
    "worthwhile_views",
]

if TYPE_CHECKING:
    from meshsplats.finetuning.config import (
        FEWEST_VIEWS,
        PRESETS,
        FinetuneConfig,
        make_config,
        worthwhile_views,
    )
    from meshsplats.finetuning.initial import starting_mesh
    from meshsplats.finetuning.interruption import Interrupted
    from meshsplats.finetuning.ordered import OrderedMesh, finetune_ordered
    from meshsplats.finetuning.run import Progress, finetune
    from meshsplats.finetuning.run_options import RunOptions
else:
    _HOME = {
        "meshsplats.finetuning.config": (
            *("FEWEST_VIEWS", "PRESETS", "FinetuneConfig", "make_config", "worthwhile_views"),
        ),
        "meshsplats.finetuning.initial": ("starting_mesh",),
        "meshsplats.finetuning.interruption": ("Interrupted",),
        "meshsplats.finetuning.ordered": ("OrderedMesh", "finetune_ordered"),
        "meshsplats.finetuning.run": ("Progress", "finetune"),
        "meshsplats.finetuning.run_options": ("RunOptions",),
    }
    __getattr__ = lazy_names(__name__, _HOME)
