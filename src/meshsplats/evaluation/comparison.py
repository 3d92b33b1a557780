"""compare: the picture of the splats against the picture of the mesh, from the same cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from meshsplats.camera import Camera
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.rendering.looks import Look


@dataclass(frozen=True)
class ViewScore:
    """How close the two pictures of one view are."""

    name: str
    psnr: float
    """dB; inf for equal pictures."""
    ssim: float
    """In [-1, 1], in the convention of 3DGS (``metrics.ssim``)."""


@dataclass(frozen=True, eq=False)
class ComparedView:
    """The two pictures of one view, and how close they are."""

    camera: Camera
    splats: np.ndarray
    """(h, w, 3) float32 in [0, 1]: the splats, in the look that was asked for."""
    mesh: np.ndarray
    """(h, w, 3) float32 in [0, 1]."""
    score: ViewScore


@dataclass(frozen=True)
class Comparison:
    """Scores of all views. The mean PSNR is the mean of the views' PSNR, as papers give it."""

    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        return float(np.mean([view.psnr for view in self.views]))

    @property
    def ssim(self) -> float:
        return float(np.mean([view.ssim for view in self.views]))

    def to_dict(self) -> dict:
        """For JSON, which knows no infinity: the PSNR of equal pictures is null."""
        rows = [asdict(view) for view in self.views] + [{"psnr": self.psnr, "ssim": self.ssim}]
        for row in rows:
            row["psnr"] = row["psnr"] if math.isfinite(row["psnr"]) else None
        return {"views": rows[:-1], "mean": rows[-1]}


def compare_views(
    cloud: GaussianCloud,
    mesh: SplatMesh,
    cameras: Sequence[Camera],
    *,
    look: Look = "area",
    sh_degree: int | None = None,
    background: Sequence[float] = (1, 1, 1),
    samples: int | None = None,
    max_layers: int | None = None,
    threads: int | None = None,
) -> Iterator[ComparedView]:
    """The views one by one, so that only one pair of pictures is in memory.

    Parameters
    ----------
    look: what the mesh is compared with. 'area': the mean over each pixel's area, which programs that take
        several samples a pixel show. 'splats': what a 3DGS viewer shows at this size of the image.
    sh_degree: spherical harmonics of the splats up to this degree; all by default. A mesh has one colour a
        vertex: 0 leaves the change of colour with the view out of the comparison.
    background, threads: as in ``render``, display RGB; pictures are clipped to [0, 1] as they are when saved.
        A mesh made for blending in linear light is drawn so, and encoded for display after.
    samples, max_layers: as in ``render``, for the mesh; samples: by default as many as it needs for 'area',
        1 for 'splats'.
    """
    from meshsplats.evaluation.metrics import psnr, ssim
    from meshsplats.evaluation.report import image_of
    from meshsplats.rendering.looks import check_look, draw_splats, mesh_samples

    check_look(look)
    samples = mesh_samples(look, mesh, cameras) if samples is None else samples
    options: dict[str, Any] = {"samples": samples, "max_layers": max_layers, "threads": threads}
    for i, camera in enumerate(cameras):
        drawn = draw_splats(cloud, camera, look, sh_degree=sh_degree, background=background, threads=threads)
        a = np.clip(drawn.color, 0, 1)
        b = np.clip(image_of(mesh, camera, background, **options)[0], 0, 1)
        yield ComparedView(camera, a, b, ViewScore(camera.name or f"view_{i:04d}", psnr(a, b), ssim(a, b)))


def compare(
    cloud: GaussianCloud,
    mesh: SplatMesh,
    cameras: Sequence[Camera],
    *,
    look: Look = "area",
    sh_degree: int | None = None,
    background: Sequence[float] = (1, 1, 1),
    samples: int | None = None,
    max_layers: int | None = None,
    threads: int | None = None,
) -> Comparison:
    """PSNR and SSIM of the mesh's pictures against the splats', view by view. Options are those of
    ``compare_views``.

    Raises ValueError without cameras.
    """
    if not cameras:
        raise ValueError("cameras must hold at least one camera")
    views = compare_views(
        cloud,
        mesh,
        cameras,
        look=look,
        sh_degree=sh_degree,
        background=background,
        samples=samples,
        max_layers=max_layers,
        threads=threads,
    )
    return Comparison(tuple(view.score for view in views))
