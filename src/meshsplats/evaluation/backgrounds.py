"""The background that a capture is rendered over: the one that its splats were trained with."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.kinds import described, need, require
from meshsplats.datasets.photo_file import PhotoFile
from meshsplats.datasets.views import WHITE, Dataset, ImageCache, View
from meshsplats.errors import DataWarning
from meshsplats.evaluation.metrics import psnr
from meshsplats.images.reading import converted_profile
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

BLACK = (0.0, 0.0, 0.0)
CANDIDATES: Mapping[str, tuple[float, float, float]] = {"black": BLACK, "white": WHITE}
"""The backgrounds that splats are usually trained with."""
MAX_VIEWS = 8
"""Maximum number of photographs, evenly spread, that the candidates are compared on."""
UNRELATED_PSNR = 12.0
"""dB below which images do not show the content of the photographs: a uniform grey reaches nearly as much."""
ALIKE = 0.65
"""Correlation of coarse images above which they show the same from the same place, however far apart their
colours are. Trained splats in their own frame, but too bright or too faint, have 0.74 or more; turned, moved
or scaled until less than ``UNRELATED_PSNR`` is left, at most 0.59 (tests/evaluation/test_frames.py)."""
SPARSE, IN_VIEW = 0.06, 0.1
"""Share of the images below which a scene hardly covers them; share of its points from which on it is in
view."""
WARNING_GAIN = 0.1
"""dB by which another background must be better for a warning."""
_MAX_BYTES = 1 << 20

_BLOCKS = 24
"""Blocks along the shorter side of coarse images."""
_MAX_POINTS = 20_000
"""Points of a scene that are looked for in the images."""

Reason = Literal["given", "model folder", "usual", "covered", "contrast", "best for"]
_IN_WORDS = {
    "given": "as given",
    "model folder": "as the model folder says",
    "usual": "as usual",
    "covered": "which fans cover",
    "contrast": "as the subject is bright",
}


@dataclass(frozen=True)
class Shown:
    """What images of a scene show of the photographs; means over some of the views."""

    coverage: float
    """Share of the image that the scene covers: its mean alpha."""
    in_view: float
    """Share of its splats or vertices that lie in the image."""
    likeness: float
    """Correlation of the brightness of coarse images, -1 to 1, over the better background."""


@dataclass(frozen=True)
class Background:
    """A background, and the reason for it."""

    color: tuple[float, float, float]
    """Display RGB in [0, 1]."""
    reason: Reason
    """given: by the caller. model folder: named by it. usual: white, for images with alpha. covered: it
    hardly matters, as a training covers it by its fans. contrast: black, from which a bright subject stands
    out. best for: that of black and white over which ``judge`` is closer to the photographs."""
    judge: str = ""
    """Name of the scene that was scored first."""
    psnr: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Mean PSNR in dB on some of the photographs, by scene and by background, its name or ``#rrggbb``."""
    shown: Shown | None = None
    """What the scene that was scored first shows; None if none was."""

    @property
    def name(self) -> str:
        """black, white, or ``#rrggbb``."""
        return color_name(self.color)

    def describe(self) -> str:
        """The background and its reason in a few words."""
        if self.reason != "best for":
            return f"{self.name}, {_IN_WORDS[self.reason]}"
        other = next(name for name in CANDIDATES if name != self.name)
        scores = self.psnr[self.judge]
        return (
            f"{self.name}, which fits the {self.judge} best: {scores[self.name]:.2f} dB on some of the"
            f" photographs, {scores[other]:.2f} over {other}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Colour, description and scores, for JSON."""
        scores = {scene: dict(found) for scene, found in self.psnr.items()}
        return {
            "background": list(self.color),
            "background_description": self.describe(),
            "background_psnr": scores,
        }


def find_background(
    dataset: Dataset,
    scenes: Mapping[str, GaussianCloud | SplatMesh],
    *,
    given: Sequence[float] | None = None,
    named: Sequence[float] | None = None,
    threads: int | None = None,
) -> Background:
    """Finds the background for rendering ``scenes`` against the photographs of ``dataset``.

    Photographs without alpha do not show the background behind transparent splats, but the splats were
    trained with one colour and lose decibels over another. Use the result with ``dataset.over(found.color)``.

    Args:
        scenes: splats and meshes by name; splats before meshes that were made from them. With neither
            ``given`` nor ``named``, and photographs without alpha, the background is that of black and white
            over which the first scene has the higher mean PSNR, on up to ``MAX_VIEWS`` training views. Splats
            are rendered with all spherical harmonics. Photographs with alpha usually mean white.
        given: display RGB in [0, 1] of the caller's choice.
        named: display RGB in [0, 1] from the model folder (``model_background``).
        threads: maximum number of threads; all processors by default.

    Raises ValueError for a background of another shape, or out of this range.

    Returns:
        The background with its reason and the scores. A DataWarning names each scene that loses more than
        ``WARNING_GAIN`` dB by it.
    """
    need(Dataset, dataset=dataset)
    if not isinstance(scenes, Mapping):
        what = described(scenes)
        raise TypeError(f"scenes must be a dict of splats and meshes by name, got {what}: {{'mesh': mesh}}")
    for name, scene in scenes.items():
        if not isinstance(scene, SplatMesh):
            require(GaussianCloud, f"scenes[{name!r}]", scene)
    views = subsample(dataset.train or dataset.views, MAX_VIEWS)
    chosen = given if given is not None else named
    if chosen is not None and not (np.shape(chosen) == (3,) and all(0 <= part <= 1 for part in chosen)):
        raise ValueError(f"a background must be RGB from 0 to 1, got {chosen!r}; divide bytes by 255")
    reason: Reason = "given" if given is not None else "model folder"
    candidates = dict(CANDIDATES)
    if not scenes or not any(_opaque(view) for view in views):
        candidates = {}
        if chosen is None:
            chosen, reason = WHITE, "usual"
    if chosen is not None:
        candidates[color_name(_rgb(chosen))] = _rgb(chosen)
    scored = {name: _scores(scene, views, candidates, threads) for name, scene in scenes.items()}
    scores = {name: psnrs for name, (psnrs, _) in scored.items()}
    judge = next(iter(scenes), "")
    if chosen is None:
        chosen, reason = candidates[max(CANDIDATES, key=lambda name: scores[judge][name])], "best for"
    shown = scored[judge][1] if scored else None
    found = Background(_rgb(chosen), reason, judge, scores, shown)
    for name, psnrs in scores.items():
        best = max(psnrs, key=lambda color: psnrs[color])
        if psnrs[best] > psnrs[found.name] + WARNING_GAIN:
            warnings.warn(
                f"over {found.name} the {name} scores {psnrs[found.name]:.2f} dB on some of the photographs,"
                f" over {best} {psnrs[best]:.2f}, which it seems to be made for: over {found.name} its scores"
                " are too low",
                DataWarning,
                stacklevel=2,
            )
    splats = {name: scene for name, scene in scenes.items() if isinstance(scene, GaussianCloud)}
    if splats:
        _warn_of_profiles(splats, views, found, threads)
    return found


def _warn_of_profiles(
    splats: Mapping[str, GaussianCloud], views: Sequence[View], found: Background, threads: int | None
) -> None:
    """Issues a DataWarning for ``splats`` that fit the photographs of ``views`` better as these are stored,
    without their colour profile: most programs that train splats ignore it."""
    files = [view.source for view in views if isinstance(view.source, PhotoFile)]
    profile = next(filter(None, (converted_profile(file.path) for file in files)), "")
    if not profile or len(files) < len(views):
        return
    stored = [
        replace(view, source=replace(file, as_stored=True, store=ImageCache(0)))
        for view, file in zip(views, files, strict=True)
    ]
    for name, cloud in splats.items():
        before = found.psnr[name][found.name]
        raw = _scores(cloud, stored, {found.name: found.color}, threads)[0][found.name]
        if raw > before + WARNING_GAIN:
            warnings.warn(
                f"the colours of the photographs are converted from {profile} to sRGB: over these the {name}"
                f" scores {before:.2f} dB on some of them, over the colours as they are stored {raw:.2f}. It"
                " seems to have been trained without regard to the profile, and its scores are too low: give"
                " photographs without it, or splats that were trained on photographs in sRGB",
                DataWarning,
                stacklevel=3,
            )


def warn_of_frame_mismatch(found: Background) -> None:
    """Issues a DataWarning if the scene that was scored shows almost nothing of the photographs, with the
    likely reason: another frame, a scene that is nearly empty or tiny, or other colours."""
    scores = found.psnr.get(found.judge)
    if scores and max(scores.values()) < UNRELATED_PSNR:
        reason = (
            "cameras and the scene seem to be in different frames, moved, rotated or scaled;"
            " docs/datasets.md, 'One world', has the usual reasons"
        )
        if found.shown is not None and found.shown.likeness >= ALIKE:
            reason = (
                "frames of cameras and scene agree, as coarse images are alike"
                f" (correlation {found.shown.likeness:.2f}): exposure, colours or opacities differ"
            )
        elif found.shown is not None and found.shown.coverage < SPARSE and found.shown.in_view >= IN_VIEW:
            reason = (
                f"scene covers {found.shown.coverage:.1%} of the images, though {found.shown.in_view:.0%} of"
                " it lies in view: it is nearly empty or faint, or much smaller than what photographs show"
            )
        warnings.warn(
            f"the {found.judge} shows almost nothing of the photographs ({max(scores.values()):.1f} dB): the"
            f" {reason}",
            DataWarning,
            stacklevel=2,
        )


def model_background(path: str | os.PathLike[str]) -> tuple[float, float, float] | None:
    """The training background of the model folder ``path``, or of the one that the splat file ``path`` is in.

    It is ``white_background`` in the ``cfg_args`` of the 3DGS code. None if it is not there.
    """
    found = model_settings(path)
    setting = found and re.search(r"\bwhite_background\s*=\s*(True|False)\b", found[1])
    return None if not setting else WHITE if setting[1] == "True" else BLACK


def model_settings(path: str | os.PathLike[str]) -> tuple[Path, str] | None:
    """The ``cfg_args`` of the 3DGS code and their text, for a model folder ``path`` or the one that the splat
    file ``path`` is in. None if they are not there."""
    path = Path(path)
    folders = [path]
    if path.parent.name.startswith("iteration_") and path.parent.parent.name == "point_cloud":
        folders.append(path.parent.parent.parent)
    for folder in folders:
        try:
            with open(folder / "cfg_args", "rb") as file:
                return folder / "cfg_args", file.read(_MAX_BYTES).decode("utf-8", "replace")
        except (OSError, ValueError):  # none there, or a name that no file can have
            continue
    return None


def color_name(color: Sequence[float]) -> str:
    """black, white, or ``#rrggbb``."""
    for name, candidate in CANDIDATES.items():
        if tuple(color) == candidate:
            return name
    return "#" + "".join(f"{round(255 * c):02x}" for c in color)


def _opaque(view: View) -> bool:
    """Whether an image has no transparent pixel."""
    alpha = view.alpha
    return alpha is None or bool((alpha >= 1).all())


def _rgb(color: Sequence[float]) -> tuple[float, float, float]:
    red, green, blue = map(float, color)
    return red, green, blue


def _scores(
    scene: GaussianCloud | SplatMesh,
    views: Sequence[View],
    colors: Mapping[str, tuple[float, float, float]],
    threads: int | None,
) -> tuple[dict[str, float], Shown]:
    """Mean PSNR of ``scene`` on ``views`` in dB, by background, and what it shows."""
    from meshsplats.rendering import render, render_splats

    linear = isinstance(scene, SplatMesh) and scene.blending == "linear"
    found: dict[str, list[float]] = {name: [] for name in colors}
    alike: dict[str, list[float]] = {name: [] for name in colors}
    coverage, in_view = [], []
    points = subsample(scene.means if isinstance(scene, GaussianCloud) else scene.vertices, _MAX_POINTS)
    for view in views:
        mask = view.mask
        if mask is not None and not mask.any():
            continue
        draw: Any = render_splats if isinstance(scene, GaussianCloud) else render
        rendered = draw(scene, view.camera, background=BLACK, threads=threads)
        transmittance = 1 - rendered.alpha[..., None]
        coverage.append(float(rendered.alpha.mean()))
        in_view.append(float(view.camera.sees(points).mean()) if len(points) else 0.0)
        for name, color in colors.items():
            display = np.asarray(color, np.float32)
            image = rendered.color + transmittance * (srgb_to_linear(display) if linear else display)
            image = np.clip(linear_to_srgb(image) if linear else image, 0, 1)
            target = np.clip(view.load().over(color), 0, 1)
            found[name].append(min(psnr(image, target, mask=mask), 200.0))
            alike[name].append(_likeness(image, target, mask))
    means = {name: float(np.mean(values)) if values else 0.0 for name, values in found.items()}
    best = alike[max(means, key=lambda name: means[name])] if means else []
    return means, Shown(*(float(np.mean(values)) if values else 0.0 for values in (coverage, in_view, best)))


def _likeness(image: np.ndarray, target: np.ndarray, mask: np.ndarray | None) -> float:
    """Correlation of the brightness of two images (h, w, 3) in coarse blocks; 0 where one is uniform."""
    weight = np.ones(image.shape[:2], np.float32) if mask is None else mask.astype(np.float32)
    shares = _coarse(weight)
    counted = shares > 0.5
    one, other = (
        _coarse(pixels.mean(axis=2) * weight)[counted] / shares[counted] for pixels in (image, target)
    )
    if len(one) < 2 or one.std() < 1e-4 or other.std() < 1e-4:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])


def _coarse(values: np.ndarray) -> np.ndarray:
    """Means of ``values`` (h, w) in square blocks; what is left over at the right and below is cut."""
    height, width = values.shape
    side = max(1, min(height, width) // _BLOCKS)
    rows, columns = height // side, width // side
    return values[: rows * side, : columns * side].reshape(rows, side, columns, side).mean(axis=(1, 3))


def choose_background(
    given: Sequence[float] | None,
    photographs: Dataset | None,
    scenes: Mapping[str, GaussianCloud | SplatMesh],
    source: Path | None,
    threads: int | None = None,
    *,
    whole: bool = True,
) -> Background:
    """The background of images of ``scenes``: the ``given`` one, display RGB in [0, 1]; else white, or beside
    ``photographs`` the one that the model folder ``source`` names or that fits the scenes best. Warns where
    scenes and photographs disagree, as they must for scenes that are not ``whole``."""
    if photographs is None:
        red, green, blue = WHITE if given is None else given
        return Background((red, green, blue), "usual" if given is None else "given")
    named = None if source is None else model_background(source)
    found = find_background(photographs, scenes, given=given, named=named, threads=threads)
    if whole:
        warn_of_frame_mismatch(found)
    return found
