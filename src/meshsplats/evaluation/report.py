"""evaluate: scores of a mesh on held-out photographs, or on images of the splats themselves."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import TYPE_CHECKING, Any, NamedTuple, SupportsFloat

import numpy as np

from meshsplats._common.choices import Look
from meshsplats._common.kinds import need
from meshsplats.datasets.splat_targets import are_rendered
from meshsplats.datasets.views import Dataset, View
from meshsplats.errors import DataWarning
from meshsplats.evaluation.metrics import psnr
from meshsplats.rendering.looks import GROUND_TRUTHS, draw_splats, image_of, mesh_samples
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import need_one_origin

if TYPE_CHECKING:
    from meshsplats.evaluation.lpips import Lpips

SSIM_CONVENTION = "3dgs"
"""11 x 11 Gaussian window, zeros outside the image, as splatting papers report it."""
FLOATER_ALPHA = 0.05
"""A pixel that is empty in the target counts as a floater above this alpha."""
FLOATER_MARGIN = 2
"""Pixels around the subject that are not tested for floaters, since edges are soft."""
COLUMNS = ("psnr", "ssim", "lpips", "psnr_exposure", "floaters")
"""The scores of a view."""

ImageAt = Callable[[Camera, Sequence[float]], tuple[np.ndarray, np.ndarray | None]]
"""Renders a camera over a background: (h, w, 3) float32 display RGB, and (h, w) alpha or None."""


@dataclass(frozen=True)
class ViewScores:
    """Scores of an image of one view against the ground truth."""

    name: str
    psnr: float
    """dB; inf for equal images."""
    ssim: float
    """In [-1, 1], in the convention ``SSIM_CONVENTION``."""
    lpips: float | None = None
    """LPIPS, smaller is closer; None without its weights."""
    psnr_exposure: float | None = None
    """dB after a least-squares fit of a gain and an offset per channel; None if not requested."""
    floaters: int | None = None
    """Number of pixels more opaque than ``FLOATER_ALPHA`` where the ground truth is empty; None if it or the
    image has no alpha."""


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

    def _over(self, column: str, statistic: Callable[[list[float]], SupportsFloat]) -> float | None:
        values = [getattr(view, column) for view in self.views]
        return None if None in values or not values else float(statistic(values))


@dataclass(frozen=True)
class Report:
    """Scores of several methods on the same views."""

    scene: str
    methods: tuple[MethodScores, ...]
    about: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the evaluation, for the record."""

    def method(self, name: str) -> MethodScores:
        """The scores of the method ``name``. KeyError if the report does not have it."""
        for scores in self.methods:
            if scores.method == name:
                return scores
        raise KeyError(
            f"the report has no method {name!r}; it has {', '.join(m.method for m in self.methods)}"
        )

    def results(self) -> dict[str, dict[str, float | None]]:
        """Means over the views in the layout of the ``results.json`` of INRIA's 3DGS code: by method, then
        SSIM, PSNR and LPIPS. None: unknown, or infinite."""
        return {
            scores.method: {key: _finite(scores.mean(key.lower())) for key in ("SSIM", "PSNR", "LPIPS")}
            for scores in self.methods
        }

    def per_view(self) -> dict[str, dict[str, dict[str, float | None]]]:
        """Scores in the layout of INRIA's ``per_view.json``: by method, metric, and name of the view. A view
        without a name is ``view_0000`` by its number; the second of one name, ``a.png``, is ``a.png 2``."""
        return {
            scores.method: {
                key: {
                    name: _finite(getattr(view, key.lower()))
                    for name, view in zip(_distinct_names(scores.views), scores.views, strict=True)
                }
                for key in ("SSIM", "PSNR", "LPIPS")
            }
            for scores in self.methods
        }

    def to_dict(self) -> dict[str, Any]:
        """All scores and settings, for JSON."""
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


def _distinct_names(views: Sequence[ViewScores]) -> list[str]:
    """A name for each of ``views`` that no other has."""
    wanted = [view.name or f"view_{i:04d}" for i, view in enumerate(views)]
    found: dict[str, None] = {}
    for name in wanted:
        free = (one for n in count(2) if (one := f"{name} {n}") not in found and one not in wanted)
        found[next(free) if name in found else name] = None
    return list(found)


@dataclass(frozen=True, eq=False)
class ScoredView:
    """One view with its images, for instance to save them."""

    view: View
    target: np.ndarray
    """(h, w, 3) float32 display RGB in [0, 1]: the ground truth."""
    images: Mapping[str, np.ndarray]
    """The same of each method, by its name."""
    scores: Mapping[str, ViewScores]
    """Scores of each method, by its name."""


def evaluate(
    mesh: SplatMesh | Mapping[str, SplatMesh] | None,
    dataset: Dataset,
    *,
    before: SplatMesh | None = None,
    splats: GaussianCloud | None = None,
    images: ImageAt | None = None,
    samples: int | None = None,
    lpips: Lpips | None = None,
    fit_exposure: bool = False,
    threads: int | None = None,
    on_view: Callable[[ScoredView], None] | None = None,
) -> Report:
    """Scores meshes, splats and images on the held-out views of ``dataset``, or on all views if it has none:
    with a DataWarning if they are photographs.

    Images are clipped to [0, 1], and masked pixels do not count; fully masked held-out views are left out
    (``Dataset.scorable``). Ground truth with alpha is composited over ``View.background``, and everything is
    rendered over it. For photographs without alpha it has to be the background that the splats were trained
    with (``find_background``, ``Dataset.over``).

    Args:
        mesh: method ``'mesh'``, or several meshes by the names of their methods; None: only the others.
        dataset: views with their ground truth.
        before: method ``'before'``, for instance the mesh before fine-tuning.
        splats: methods ``'splats_sh0'``, and ``'splats'`` with all spherical harmonics if they have more than
            degree 0.
        images: method ``'images'``: images from elsewhere (``image_folder``).
        samples: samples along each side of a pixel, for meshes. None: as many as the mesh needs at this size
            if the ground truth is the mean over each pixel's area (``Dataset.look``), as photographs are; 1
            if it is that of a splat viewer.
        lpips: the distance from ``load_lpips``; without it the column stays empty.
        fit_exposure: also compute the PSNR after fitting a gain and an offset per channel to each image.
        threads: maximum number of threads; all processors by default.
        on_view: called with each view after it is scored.

    Returns:
        The scores of all methods on all views.

    Raises:
        ValueError: nothing to score, no view, views whose masks exclude all pixels, a mesh with the name of
            another method, records of different origins.
    """
    if not (isinstance(mesh, Mapping) and all(isinstance(one, SplatMesh) for one in mesh.values())):
        need(SplatMesh, mesh=mesh, optional=True, instead={"dict": "one by the name of each method"})
    need(Dataset, dataset=dataset)
    need(SplatMesh, before=before, optional=True)
    need(GaussianCloud, splats=splats, optional=True)
    meshes = {} if mesh is None else {"mesh": mesh} if isinstance(mesh, SplatMesh) else dict(mesh)
    need_one_origin({"dataset": dataset, **meshes, "before": before, "splats": splats})
    views = dataset.scorable().test or dataset.test or dataset.views
    if samples is None:
        cameras = [view.camera for view in views]
        every_mesh = [*meshes.values(), *([] if before is None else [before])]
        samples = max((mesh_samples(dataset.look, m, cameras) for m in every_mesh), default=1)
    methods: dict[str, ImageAt] = {n: _mesh_renderer(m, samples, threads) for n, m in meshes.items()}
    others: dict[str, ImageAt] = {}
    if before is not None:
        others["before"] = _mesh_renderer(before, samples, threads)
    if splats is not None:
        # Against photographs splats look as in their training, against images of splats as these.
        if _targets_are_splats(dataset):
            look, plain = dataset.look, splats.of_degree(0)
        else:
            look, plain = "splats", _without_limit(splats) if splats.sh_degree == 0 else splats.of_degree(0)
        others["splats_sh0"] = _splat_renderer(plain, look, threads)
        if splats.sh_degree > 0:
            others["splats"] = _splat_renderer(splats, look, threads)
    if images is not None:
        others["images"] = images
    if taken := methods.keys() & others.keys():
        raise ValueError(f"a mesh cannot have the name {min(taken)!r}, which another method has")
    methods |= others
    if not methods:
        raise ValueError("there is nothing to evaluate: give a mesh, splats or images")
    if not views:
        raise ValueError("the data set has no view to evaluate on")
    if not dataset.test and not _targets_are_splats(dataset):
        warnings.warn(
            f"{dataset.name or 'the data set'}: no view is held out, so all {len(views)} training views are"
            " scored: scores of what was trained on them are too high",
            DataWarning,
            stacklevel=2,
        )
    found: dict[str, list[ViewScores]] = {name: [] for name in methods}
    measures = _Measures(lpips, fit_exposure, threads)
    for view in views:
        truth = _GroundTruth.of(view)
        drawn = {}
        for name, image_at in methods.items():
            color, alpha = image_at(view.camera, view.background)
            drawn[name] = np.clip(color, 0, 1)
            found[name].append(measures.of(drawn[name], alpha, truth))
        if on_view is not None:
            latest = {name: scores[-1] for name, scores in found.items()}
            on_view(ScoredView(view, truth.image, drawn, latest))
    counts = {name: len(one.faces) for name, one in meshes.items()}
    about = {
        "views": len(views),
        "held_out": bool(dataset.test),
        "look": dataset.look,
        "ground_truth": GROUND_TRUTHS[dataset.look] if _targets_are_splats(dataset) else "photographs",
        "samples": samples,
        "triangles": counts if len(counts) > 1 else next(iter(counts.values()), None),
        "splats": None if splats is None else len(splats),
    }
    return Report(dataset.name, tuple(MethodScores(n, tuple(s)) for n, s in found.items()), about)


def masked_ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None, threads: int | None = None) -> float:
    """``metrics.ssim`` of (h, w, 3) float32 images in the convention of 3DGS, where ``mask`` (h, w) is True.

    Masked pixels count as outside of the image. Computed by the compiled core.
    """
    from meshsplats._core.kernels import compare_images

    x, y = (np.ascontiguousarray(p[None], np.float32) for p in (a, b))
    inside = None if mask is None else np.ascontiguousarray(mask[None])
    pixels = a.shape[0] * a.shape[1] if mask is None else int(mask.sum())
    return compare_images(x, y, inside, ssim_weight=1, threads=threads).ssim / (pixels * a.shape[2])


def exposure_between(
    image: np.ndarray, target: np.ndarray, mask: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """(3,) gains and (3,) offsets, float32, by which ``image`` (h, w, 3) fits ``target`` best over ``mask``:
    least squares. A channel without contrast has an offset only."""
    counted = np.ones(image.shape[:2], bool) if mask is None else mask
    fit = np.empty((2, 3))
    for channel in range(3):
        x, y = (p[..., channel][counted].astype(np.float64) for p in (image, target))
        variance = x.var()
        gain = float(np.mean((x - x.mean()) * (y - y.mean())) / variance) if variance > 1e-12 else 1.0
        fit[:, channel] = gain, y.mean() - gain * x.mean()
    gains, offsets = fit.astype(np.float32)
    return gains, offsets


class _GroundTruth(NamedTuple):
    """What the images of a view are compared with."""

    name: str
    image: np.ndarray
    """(h, w, 3) float32 display RGB in [0, 1]."""
    mask: np.ndarray | None
    """(h, w) bool: pixels that count; None: all."""
    alpha: np.ndarray | None
    """(h, w) float32 of the photograph; None: all of it is opaque."""
    background: tuple[float, float, float]
    """Display RGB that shows through where it is not."""
    empty: np.ndarray | None
    """``_empty``."""

    @classmethod
    def of(cls, view: View) -> _GroundTruth:
        """ValueError if no pixel counts."""
        if view.mask is not None and not view.mask.any():
            raise ValueError(f"view {view.name!r}: its mask leaves no pixel to score")
        shown = np.clip(view.image, 0, 1)
        return cls(view.name, shown, view.mask, view.alpha, view.background, _empty(view))

    def psnr_exposed(self, image: np.ndarray) -> float:
        """PSNR of ``image``, (h, w, 3) over the same background, in the exposure that fits best: that of the
        photograph, not of the background."""
        counted, shown = self.mask, self.image
        if self.alpha is not None:
            opaque = self.alpha == 1 if counted is None else (self.alpha == 1) & counted
            counted = opaque if opaque.any() else counted
        gain, offset = exposure_between(image, self.image, counted)
        if self.alpha is not None:
            background = np.asarray(self.background, np.float32)
            shown = shown + (1 - self.alpha)[..., None] * (background * (gain - 1) + offset)
            shown = np.clip(shown, 0, 1)
        return psnr(np.clip(image * gain + offset, 0, 1), shown, mask=self.mask)


class _Measures(NamedTuple):
    """How images are scored."""

    lpips: Lpips | None
    fit_exposure: bool
    threads: int | None

    def of(self, image: np.ndarray, alpha: np.ndarray | None, truth: _GroundTruth) -> ViewScores:
        """The scores of an image, (h, w, 3) in [0, 1], with its (h, w) alpha or None."""
        name, target, mask, empty = truth.name, truth.image, truth.mask, truth.empty
        floaters = distance = fitted = None
        if empty is not None and alpha is not None:
            floaters = int((alpha[empty] > FLOATER_ALPHA).sum())
        if self.lpips is not None:
            compared = image if mask is None else np.where(mask[..., None], image, target)
            distance = self.lpips(compared, target)
        if self.fit_exposure:
            fitted = truth.psnr_exposed(image)
        score, likeness = psnr(image, target, mask=mask), masked_ssim(image, target, mask, self.threads)
        return ViewScores(name, score, likeness, distance, fitted, floaters)


def _empty(view: View) -> np.ndarray | None:
    """(h, w) bool: pixels that are empty in the ground truth, ``FLOATER_MARGIN`` away from the subject."""
    alpha = view.alpha
    if alpha is None:
        return None
    covered: np.ndarray = np.asarray(alpha > 0)
    size = 2 * FLOATER_MARGIN + 1
    for axis in (0, 1):
        pads = [(0, 0), (0, 0)]
        pads[axis] = (FLOATER_MARGIN, FLOATER_MARGIN)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(covered, pads), size, axis=axis)
        covered = np.asarray(windows.any(axis=-1))
    return ~covered if view.mask is None else ~covered & view.mask


def _targets_are_splats(dataset: Dataset) -> bool:
    return are_rendered(dataset.views[:1])


def _mesh_renderer(mesh: SplatMesh, samples: int, threads: int | None) -> ImageAt:
    def at(camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        return image_of(mesh, camera, background, samples=samples, threads=threads)

    return at


def _splat_renderer(cloud: GaussianCloud, look: Look, threads: int | None) -> ImageAt:
    def at(camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        rendered = draw_splats(cloud, camera, look, background=background, threads=threads)
        return rendered.color, rendered.alpha

    return at


def _without_limit(cloud: GaussianCloud) -> GaussianCloud:
    """Splats of degree 0 as their trainer draws them, where bright: colours above 1 stay. With harmonics of
    degree 1, which are 0, ``render_splats`` has no limit either."""
    return replace(cloud, sh=np.concatenate([cloud.sh, np.zeros((len(cloud), 3, 3), np.float32)], axis=1))


def _finite(value: float | None) -> float | None:
    """``value``, or None if it is infinite, which JSON cannot represent."""
    return value if value is not None and math.isfinite(value) else None
