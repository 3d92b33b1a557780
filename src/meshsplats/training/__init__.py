"""Training: photographs with cameras to a mesh, without splats to start from."""

from meshsplats.training.config import TrainConfig, train_config
from meshsplats.training.run import starting_fans, train

__all__ = ["TrainConfig", "starting_fans", "train", "train_config"]
