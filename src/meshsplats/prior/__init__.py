"""Mesh priors: splats bound to the faces of a classical mesh, trained on it and edited with it.

Needs NumPy alone.
"""

from typing import TYPE_CHECKING

from meshsplats._common.lazy import lazy_names

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

if TYPE_CHECKING:
    from meshsplats.prior.laying import bind
    from meshsplats.prior.model import LIFT, MeshPrior, load_prior
    from meshsplats.prior.options import prior_config
    from meshsplats.prior.training import train_prior
    from meshsplats.scene.base_mesh import BaseMesh, Texture
else:
    _HOME = {
        "meshsplats.scene.base_mesh": ("BaseMesh", "Texture"),
        "meshsplats.prior.laying": ("bind",),
        "meshsplats.prior.model": ("LIFT", "MeshPrior", "load_prior"),
        "meshsplats.prior.options": ("prior_config",),
        "meshsplats.prior.training": ("train_prior",),
    }
    __getattr__ = lazy_names(__name__, _HOME)
