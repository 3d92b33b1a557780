"""compare: images of the splats against images of the mesh, from the same cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.choices import Device, Look
from meshsplats._common.kinds import need, need_all
from meshsplats.cameras.trajectories import orbit
from meshsplats.datasets.views import View
from meshsplats.evaluation.metrics import psnr, ssim
from meshsplats.rendering.looks import check_look, draw_splats, image_of, mesh_samples
from meshsplats.rendering.sight import check_sight
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import need_one_origin


@dataclass(frozen=True)
class ViewSimilarity:
    """Similarity of the two images of one view."""

    name: str
    psnr: float
    """dB; inf for equal images."""
    ssim: float
    """In [-1, 1], in the convention of 3DGS (``metrics.ssim``)."""


@dataclass(frozen=True, eq=False)
class ComparedView:
    """The two images of one view, and their similarity."""

    camera: Camera
    splats: np.ndarray
    """(h, w, 3) float32 display RGB in [0, 1]: the splats, in the requested look."""
    mesh: np.ndarray
    """(h, w, 3) float32 display RGB in [0, 1]: the mesh."""
    score: ViewSimilarity


@dataclass(frozen=True)
class Comparison:
    """Scores of all views. The mean PSNR is the mean of the PSNR of the views, as in papers."""

    views: tuple[ViewSimilarity, ...]

    @property
    def psnr(self) -> float:
        return float(np.mean([view.psnr for view in self.views]))

    @property
    def ssim(self) -> float:
        return float(np.mean([view.ssim for view in self.views]))

    def to_dict(self) -> dict[str, Any]:
        """All scores, for JSON. JSON has no infinity: the PSNR of equal images is null."""
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
    device: Device = "cpu",
) -> Iterator[ComparedView]:
    """Compares ``cloud`` and ``mesh`` view by view; only one pair of images is in memory at a time.

    Images are clipped to [0, 1], as when they are saved. A mesh for blending in linear light is blended so
    and then encoded for display.

    Args:
        look: look of the splats. 'area': the mean over each pixel's area, as programs show that take several
            samples per pixel. 'splats': the image of a 3DGS viewer at this image size.
        sh_degree: spherical harmonics up to this degree, of the splats and of the mesh; all by default. 0
            excludes view-dependent colour from the comparison.
        background: display RGB in [0, 1].
        samples: samples along each side of a pixel, for the mesh. None: as many as it needs for 'area', 1 for
            'splats'.
        max_layers: as in ``render``, for the mesh.
        threads: maximum number of threads; all processors by default.
        device: as in ``render``, for the mesh. Splats are drawn on the CPU.

    Yields:
        A ``ComparedView`` for each camera, in their order.
    """
    check_look(look)
    mesh = mesh if sh_degree is None else mesh.of_degree(sh_degree)
    samples = mesh_samples(look, mesh, cameras) if samples is None else samples
    options: dict[str, Any] = {
        "samples": samples,
        "max_layers": max_layers,
        "threads": threads,
        "device": device,
    }
    for i, camera in enumerate(cameras):
        rendered = draw_splats(
            cloud, camera, look, sh_degree=sh_degree, background=background, threads=threads
        )
        a = np.clip(rendered.color, 0, 1)
        b = np.clip(image_of(mesh, camera, background, **options)[0], 0, 1)
        score = ViewSimilarity(camera.name or f"view_{i:04d}", psnr(a, b), ssim(a, b))
        yield ComparedView(camera, a, b, score)


def images_of_view(
    mesh: SplatMesh,
    view: View,
    *,
    samples: int,
    threads: int | None = None,
    device: Device = "cpu",
    listing: DrawOrder | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) display RGB: the image of ``mesh`` in ``view``, and the view's own, clipped to [0, 1].
    Options are those of ``image_of``."""
    image, _ = image_of(
        mesh,
        view.camera,
        view.background,
        samples=samples,
        threads=threads,
        device=device,
        listing=listing,
    )
    return np.clip(image, 0, 1), np.clip(view.image, 0, 1)


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
    device: Device = "cpu",
) -> Comparison:
    """PSNR and SSIM of the mesh's images against the splats', view by view. Options are those of
    ``compare_views``.

    Raises ValueError without cameras, and where none of them sees any of the splats; a DataWarning names
    those that see none where others do, whose PSNR would be inf.
    """
    need(GaussianCloud, cloud=cloud)
    need(SplatMesh, mesh=mesh)
    need_one_origin({"cloud": cloud, "mesh": mesh})
    need_all(Camera, cameras=cameras)
    if not cameras:
        raise ValueError("cameras must hold at least one camera")
    check_sight(cloud, cameras, threads=threads)
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
        device=device,
    )
    return Comparison(tuple(view.score for view in views))


def fidelity(
    cloud: GaussianCloud,
    mesh: SplatMesh,
    cameras: Sequence[Camera],
    count: int,
    look: Look = "area",
    *,
    threads: int | None = None,
) -> dict[str, Any]:
    """Mean scores of ``mesh`` against its splats in ``count`` views of at most 400 pixels, of the ``cameras``
    or, without any, around it; for JSON."""
    views = [camera.within(400) for camera in subsample(cameras, count)] or orbit(
        mesh, count, elevation=15, width=400, height=400
    )
    scores = tuple(view.score for view in compare_views(cloud, mesh, views, look=look, threads=threads))
    mean = Comparison(scores).to_dict()["mean"]
    return {"views": len(views), "look": look, "psnr": mean["psnr"], "ssim": mean["ssim"]}
