"""Mesh priors: splats bound to the faces of a classical mesh, trained on it and edited with it.

Needs NumPy alone.
"""

from __future__ import annotations

from meshsplats.base_mesh import BaseMesh, Texture
from meshsplats.prior.bind import bind
from meshsplats.prior.model import LIFT, MeshPrior, load_prior
from meshsplats.prior.training import prior_config, train_prior

__all__ = [
    "LIFT",
    "BaseMesh",
    "MeshPrior",
    "Texture",
    "bind",
    "load_prior",
    "prior_config",
    "train_prior",
]
