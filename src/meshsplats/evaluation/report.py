"""evaluate: how good the pictures of a mesh are, against held-out photographs or the splats' own pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from meshsplats.camera import Camera
from meshsplats.datasets.splat_targets import RenderedSplats
from meshsplats.datasets.views import Dataset, View
from meshsplats.evaluation.metrics import psnr
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.looks import Look, draw_splats, image_of, mesh_samples

if TYPE_CHECKING:
    from meshsplats.evaluation.lpips import Lpips

SSIM_CONVENTION = "3dgs"
"""11 x 11 Gaussian window, zeros outside the picture: what splatting papers report."""
FLOATER_ALPHA = 0.05
"""A pixel that should be empty is a floater's if the picture has more opacity there than this."""
FLOATER_MARGIN = 2
"""Pixels round what the truth shows that are not looked at: edges are soft."""
COLUMNS = ("psnr", "ssim", "lpips", "psnr_exposure", "floaters")

ImageAt = Callable[[Camera, Sequence[float]], tuple[np.ndarray, np.ndarray | None]]
"""(h, w, 3) display RGB over a background, and (h, w) alpha or None."""


@dataclass(frozen=True)
class ViewScores:
    """How close a picture of one view is to the truth."""

    name: str
    psnr: float
    """dB; inf for equal pictures."""
    ssim: float
    """In [-1, 1], in the convention ``SSIM_CONVENTION``."""
    lpips: float | None = None
    """LPIPS, smaller is closer; None without its weights."""
    psnr_exposure: float | None = None
    """dB after a gain and an offset a channel that fit this picture best; None if not asked for."""
    floaters: int | None = None
    """Pixels more opaque than ``FLOATER_ALPHA`` where the truth is empty; None where it has no alpha, or the
    picture none."""


@dataclass(frozen=True)
class MethodScores:
    """Scores of all views of one method."""

    method: str
    views: tuple[ViewScores, ...]

    def mean(self, column: str) -> float | None:
        """Mean of ``column`` (one of ``COLUMNS``) over the views; None if a view lacks it."""
        return self._over(column, np.mean)

    def median(self, column: str) -> float | None:
        """Median of ``column`` over the views; None if a view lacks it."""
        return self._over(column, np.median)

    def _over(self, column: str, statistic: Callable[[list], Any]) -> float | None:
        values = [getattr(view, column) for view in self.views]
        return None if None in values or not values else float(statistic(values))


@dataclass(frozen=True)
class Report:
    """Scores of several methods on the same views."""

    scene: str
    methods: tuple[MethodScores, ...]
    about: Mapping[str, Any] = field(default_factory=dict)
    """What was evaluated and how, for the record."""

    def method(self, name: str) -> MethodScores:
        """The scores of one method. KeyError for a name that is not there."""
        for scores in self.methods:
            if scores.method == name:
                return scores
        raise KeyError(
            f"the report has no method {name!r}; it has {', '.join(m.method for m in self.methods)}"
        )

    def results(self) -> dict[str, dict[str, float | None]]:
        """The shape of the ``results.json`` that INRIA's 3DGS code writes: method, then SSIM, PSNR and LPIPS,
        means over the views. None: not known, or infinite."""
        return {
            scores.method: {key: _finite(scores.mean(key.lower())) for key in ("SSIM", "PSNR", "LPIPS")}
            for scores in self.methods
        }

    def per_view(self) -> dict[str, dict[str, dict[str, float | None]]]:
        """The shape of INRIA's ``per_view.json``: method, metric, name of the view."""
        return {
            scores.method: {
                key: {view.name: _finite(getattr(view, key.lower())) for view in scores.views}
                for key in ("SSIM", "PSNR", "LPIPS")
            }
            for scores in self.methods
        }

    def to_dict(self) -> dict[str, Any]:
        """Everything, for JSON."""
        return {
            "scene": self.scene,
            "ssim_convention": SSIM_CONVENTION,
            **self.about,
            "methods": {
                scores.method: {
                    "mean": {c: _finite(scores.mean(c)) for c in COLUMNS},
                    "median": {c: _finite(scores.median(c)) for c in COLUMNS},
                    "views": [
                        {"name": view.name} | {c: _finite(getattr(view, c)) for c in COLUMNS}
                        for view in scores.views
                    ],
                }
                for scores in self.methods
            },
        }


@dataclass(frozen=True, eq=False)
class ScoredView:
    """One view with all its pictures, for those who want to save them."""

    view: View
    truth: np.ndarray
    """(h, w, 3) float32 in [0, 1]."""
    pictures: Mapping[str, np.ndarray]
    """(h, w, 3) float32 in [0, 1] by method."""
    scores: Mapping[str, ViewScores]


def evaluate(
    mesh: SplatMesh | Mapping[str, SplatMesh] | None,
    dataset: Dataset,
    *,
    before: SplatMesh | None = None,
    splats: GaussianCloud | None = None,
    pictures: ImageAt | None = None,
    samples: int | None = None,
    lpips: Lpips | None = None,
    fit_exposure: bool = False,
    threads: int | None = None,
    on_view: Callable[[ScoredView], None] | None = None,
) -> Report:
    """Scores on the test views of ``dataset`` (all of them where it holds none out).

    Pictures are clipped to [0, 1]; pixels outside a view's mask do not count. Views whose pictures have alpha
    are composited over ``View.background``, and so is everything drawn: beside photographs without alpha it
    has to be what the splats were trained over (``find_background``, ``Dataset.over``).

    Parameters
    ----------
    mesh: method ``'mesh'``; several by name, each the method of that name; None to score only the others.
    before: method ``'before'``, for instance the mesh before it was fine-tuned.
    splats: methods ``'splats_sh0'``, and ``'splats'`` with all their spherical harmonics where they have
    more. pictures: method ``'pictures'``, made elsewhere (``image_folder``).
    samples: side of the grid of samples in each pixel, for meshes. None: as many as the mesh needs at this
        size where the images are means over each pixel's area (``Dataset.look``), photographs among them;
        1 where they are a splat viewer's.
    lpips: the distance of ``load_lpips``; without it the column stays empty.
    fit_exposure: also give the PSNR after a gain and an offset a channel are fitted to each picture.
    on_view: called with each view when it is scored.

    Raises ValueError if there is nothing to score or no view, a view without a pixel that counts, or a mesh
    with the name of another method.
    """
    meshes = {} if mesh is None else {"mesh": mesh} if isinstance(mesh, SplatMesh) else dict(mesh)
    views = dataset.test or dataset.views
    if samples is None:
        drawn_by = [view.camera for view in views]
        beside = [] if before is None else [before]
        samples = max(
            (mesh_samples(dataset.look, m, drawn_by) for m in (*meshes.values(), *beside)), default=1
        )
    methods: dict[str, ImageAt] = {n: _of_mesh(m, samples, threads) for n, m in meshes.items()}
    others: dict[str, ImageAt] = {}
    if before is not None:
        others["before"] = _of_mesh(before, samples, threads)
    if splats is not None:
        # Beside photographs splats are drawn as they were trained, beside their own images as these are.
        look = dataset.look if _drawn(dataset) else "splats"
        others["splats_sh0"] = _of_splats(splats, look, 0, threads)
        if splats.sh_degree > 0:
            others["splats"] = _of_splats(splats, look, None, threads)
    if pictures is not None:
        others["pictures"] = pictures
    if taken := methods.keys() & others.keys():
        raise ValueError(f"a mesh cannot have the name {min(taken)!r}, which is that of another method")
    methods |= others
    if not methods:
        raise ValueError("there is nothing to evaluate: give a mesh, splats or pictures")
    if not views:
        raise ValueError("the data set has no view to evaluate with")
    found: dict[str, list[ViewScores]] = {name: [] for name in methods}
    for view in views:
        truth = np.clip(view.image, 0, 1)
        mask, empty = view.mask, _empty(view)
        if mask is not None and not mask.any():
            raise ValueError(f"view {view.name!r}: its mask leaves no pixel to score")
        drawn = {}
        for name, picture_at in methods.items():
            color, alpha = picture_at(view.camera, view.background)
            drawn[name] = np.clip(color, 0, 1)
            found[name].append(
                _scores(view.name, drawn[name], alpha, truth, mask, empty, lpips, fit_exposure, threads)
            )
        if on_view is not None:
            on_view(ScoredView(view, truth, drawn, {name: scores[-1] for name, scores in found.items()}))
    counts = {name: len(one.faces) for name, one in meshes.items()}
    about = {
        "views": len(views),
        "held_out": bool(dataset.test),
        "look": dataset.look,
        "samples": samples,
        "triangles": counts if len(counts) > 1 else next(iter(counts.values()), None),
        "splats": None if splats is None else len(splats),
    }
    return Report(dataset.name, tuple(MethodScores(n, tuple(s)) for n, s in found.items()), about)


def masked_ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None, threads: int | None = None) -> float:
    """``metrics.ssim`` in the convention of 3DGS where ``mask`` (h, w) is True; the rest counts as the
    outside of the picture. Pictures (h, w, 3) float32."""
    from meshsplats._core.kernels import compare_images

    x, y = (np.ascontiguousarray(p[None], np.float32) for p in (a, b))
    inside = None if mask is None else np.ascontiguousarray(mask[None])
    pixels = a.shape[0] * a.shape[1] if mask is None else int(mask.sum())
    return compare_images(x, y, inside, ssim_rate=1, threads=threads).ssim / (pixels * a.shape[2])


def fit_exposure_to(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """``picture`` (h, w, 3) with the gain and offset a channel that bring it closest to ``truth`` in the
    least squares over ``mask``, clipped to [0, 1]. A channel without contrast gets an offset only."""
    counted = np.ones(picture.shape[:2], bool) if mask is None else mask
    result = np.empty_like(picture)
    for channel in range(3):
        x, y = (p[..., channel][counted].astype(np.float64) for p in (picture, truth))
        spread = x.var()
        gain = float(np.mean((x - x.mean()) * (y - y.mean())) / spread) if spread > 1e-12 else 1.0
        result[..., channel] = picture[..., channel] * gain + (y.mean() - gain * x.mean())
    return np.clip(result, 0, 1)


def _scores(name, picture, alpha, truth, mask, empty, lpips, fit_exposure, threads) -> ViewScores:
    floaters = None
    if empty is not None and alpha is not None:
        floaters = int((alpha[empty] > FLOATER_ALPHA).sum())
    distance = None
    if lpips is not None:
        compared = picture if mask is None else np.where(mask[..., None], picture, truth)
        distance = lpips(compared, truth)
    fitted = None
    if fit_exposure:
        fitted = psnr(fit_exposure_to(picture, truth, mask), truth, mask=mask)
    score = psnr(picture, truth, mask=mask)
    return ViewScores(name, score, masked_ssim(picture, truth, mask, threads), distance, fitted, floaters)


def _empty(view: View) -> np.ndarray | None:
    """(h, w) bool: pixels that the truth leaves empty, and all round them."""
    alpha = view.alpha
    if alpha is None:
        return None
    shown: np.ndarray = np.asarray(alpha > 0)
    size = 2 * FLOATER_MARGIN + 1
    for axis in (0, 1):
        pads = [(0, 0), (0, 0)]
        pads[axis] = (FLOATER_MARGIN, FLOATER_MARGIN)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(shown, pads), size, axis=axis)
        shown = np.asarray(windows.any(axis=-1))
    return ~shown if view.mask is None else ~shown & view.mask


def _drawn(dataset: Dataset) -> bool:
    """Whether the images are those of splats."""
    return any(isinstance(view.source, RenderedSplats) for view in dataset.views[:1])


def _of_mesh(mesh: SplatMesh, samples: int, threads: int | None) -> ImageAt:
    def at(camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        return image_of(mesh, camera, background, samples=samples, threads=threads)

    return at


def _of_splats(cloud: GaussianCloud, look: Look, degree: int | None, threads: int | None) -> ImageAt:
    def at(camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        drawn = draw_splats(cloud, camera, look, background=background, sh_degree=degree, threads=threads)
        return drawn.color, drawn.alpha

    return at


def _finite(value: float | None) -> float | None:
    """JSON knows no infinity."""
    return value if value is not None and math.isfinite(value) else None
