"""What a file of several parts holds."""

from __future__ import annotations

from dataclasses import dataclass

from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


@dataclass(frozen=True)
class SceneParts:
    """What a file holds, relative to any origins of one world, with one ``up``."""

    splats: GaussianCloud | None
    mesh: SplatMesh | None
    surface: BaseMesh | None
    collider: BaseMesh | None
