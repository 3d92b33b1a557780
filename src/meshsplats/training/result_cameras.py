"""What ``train`` saves after the mesh: its splats, and the cameras from which both are shown by default."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from meshsplats.formats.outputs import CAMERAS, WantedOrigin, beside

if TYPE_CHECKING:
    import numpy as np

    from meshsplats.datasets.views import Dataset
    from meshsplats.scene.gaussians import GaussianCloud

MOST = 60
"""Cameras, at most, in such a file."""
FEW = 10
"""Photographs below which views between them are poor: three of bonsai score 16 dB."""


def camera_files(mesh: Path, splats: Path | None = None) -> list[Path]:
    """The names of the camera files of these results: ``mesh.npz.cameras.json``."""
    return [beside(result, CAMERAS) for result in (mesh, splats) if result is not None]


def files_after_mesh(mesh: Path, splats: Path | None = None) -> list[Path]:
    """All that ``train`` writes besides the ``mesh`` and its records: these splats and the camera files."""
    return [*camera_files(mesh, splats), *filter(None, [splats])]


def save_splats(splats: GaussianCloud, path: Path, dataset: Dataset, origin: WantedOrigin) -> None:
    """Saves ``splats``, which were fitted to ``dataset`` and ``placed`` by ``origin``, and their cameras."""
    from meshsplats.formats.gaussians import save_gaussians

    save_gaussians(splats, path)
    save_result_cameras(dataset, path, origin)


def save_result_cameras(dataset: Dataset, result: Path, origin: WantedOrigin = "keep") -> None:
    """Saves up to ``MOST`` of the training cameras, evenly spread, as they were held, in the world of the
    file ``result``, which was ``placed`` by ``origin``. Replaces a file of that name."""
    from meshsplats._common.arrays import subsample
    from meshsplats.cameras.files import save_cameras

    cameras = [view.upright for view in subsample(dataset.train, MOST)]
    save_cameras(cameras, beside(result, CAMERAS), origin=_in_file(dataset.origin, origin))


def _in_file(own: np.ndarray, origin: WantedOrigin) -> Sequence[float] | np.ndarray:
    """Where the ``own`` origin (3,) of a scene is in the world of a file that is ``placed`` by ``origin``."""
    if isinstance(origin, str):
        return own if origin == "keep" else (0.0, 0.0, 0.0)
    return own - origin
