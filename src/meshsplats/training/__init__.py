"""Training: photographs with cameras to a mesh, without splats to start from."""

from typing import TYPE_CHECKING

from meshsplats._common.lazy import lazy_names

__all__ = ["TrainConfig", "starting_fans", "train", "train_config"]

if TYPE_CHECKING:
    from meshsplats.training.config import TrainConfig, train_config
    from meshsplats.training.run import starting_fans, train
else:
    _HOME = {
        "meshsplats.training.config": ("TrainConfig", "train_config"),
        "meshsplats.training.run": ("starting_fans", "train"),
    }
    __getattr__ = lazy_names(__name__, _HOME)
