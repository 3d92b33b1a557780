"""Which background a capture is drawn over: the one that its splats were trained over."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshsplats._arrays import evenly
from meshsplats.colors import linear_to_srgb, srgb_to_linear
from meshsplats.datasets.views import WHITE, Dataset, View
from meshsplats.errors import DataWarning
from meshsplats.evaluation.metrics import psnr
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

BLACK = (0.0, 0.0, 0.0)
CANDIDATES: Mapping[str, tuple[float, float, float]] = {"black": BLACK, "white": WHITE}
"""What splats are trained over."""
LOOKED_AT = 8
"""Most photographs, evenly spread, that the candidates are compared on."""
STRANGE = 12.0
"""dB below which pictures are not of what the photographs show: an even grey reaches nearly as much."""
MATTERS = 0.1
"""dB by which another background has to be better before a warning says so."""
_MOST_BYTES = 1 << 20

Reason = Literal["given", "model folder", "usual", "best for"]


@dataclass(frozen=True)
class Background:
    """A background, and why it was chosen."""

    color: tuple[float, float, float]
    """Display RGB in [0, 1]."""
    reason: Reason
    """given; named by the model folder; usual: white, behind pictures with alpha; best for: of black and
    white the one over which ``judge`` comes closer to the photographs."""
    judge: str = ""
    """Name of what was judged first."""
    psnr: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """For each scene that was judged and each background, its name or ``#rrggbb``: mean PSNR in dB on some of
    the photographs."""

    @property
    def name(self) -> str:
        return color_name(self.color)

    def describe(self) -> str:
        """In a few words, for people."""
        if self.reason != "best for":
            told = {"given": "as given", "model folder": "as the model folder says", "usual": "as usual"}
            return f"{self.name}, {told[self.reason]}"
        other = next(name for name in CANDIDATES if name != self.name)
        scores = self.psnr[self.judge]
        return (
            f"{self.name}, which fits the {self.judge} best: {scores[self.name]:.2f} dB on some of the"
            f" photographs, {scores[other]:.2f} over {other}"
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
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
    """The background that pictures of ``scenes`` are to be drawn over beside the photographs of ``dataset``.

    Photographs without alpha say nothing of what is behind what splats leave open, but the splats were
    trained over one colour, and lose decibels over another. It is ``given``, or ``named`` by what they came
    with (``model_background``); else white where the photographs have alpha, as it is usual; else the one of
    black and white over which the first of ``scenes`` (by name; splats before meshes made of them) has the
    higher mean PSNR, on up to ``LOOKED_AT`` training views. Splats are drawn with all they have.

    ``dataset.over(found.color)`` puts it to use. Warns with a DataWarning that names every scene that loses
    more than ``MATTERS`` dB by it.
    """
    views = evenly(dataset.train or dataset.views, LOOKED_AT)
    chosen = given if given is not None else named
    reason: Reason = "given" if given is not None else "model folder"
    candidates = dict(CANDIDATES)
    if not scenes or not any(_opaque(view) for view in views):
        candidates = {}
        if chosen is None:
            chosen, reason = WHITE, "usual"
    if chosen is not None:
        candidates[color_name(_rgb(chosen))] = _rgb(chosen)
    scores = {name: _scores(scene, views, candidates, threads) for name, scene in scenes.items()}
    judge = next(iter(scenes), "")
    if chosen is None:
        chosen, reason = candidates[max(CANDIDATES, key=lambda name: scores[judge][name])], "best for"
    found = Background(_rgb(chosen), reason, judge, scores)
    for name, psnrs in scores.items():
        best = max(psnrs, key=lambda color: psnrs[color])
        if psnrs[best] > psnrs[found.name] + MATTERS:
            warnings.warn(
                f"over {found.name} the {name} scores {psnrs[found.name]:.2f} dB on some of the photographs,"
                f" over {best} {psnrs[best]:.2f}, which it seems to be made for: compared over"
                f" {found.name}, it looks worse than it is",
                DataWarning,
                stacklevel=2,
            )
    return found


def warn_of_other_worlds(found: Background) -> None:
    """A DataWarning if what was judged shows hardly anything of the photographs."""
    scores = found.psnr.get(found.judge)
    if scores and max(scores.values()) < STRANGE:
        warnings.warn(
            f"the {found.judge} shows next to nothing of the photographs ({max(scores.values()):.1f} dB): the"
            " cameras and what they look at seem to be of different worlds, moved, turned or scaled;"
            " docs/datasets.md, 'One world', has the usual reasons",
            DataWarning,
            stacklevel=2,
        )


def model_background(path: str | os.PathLike[str]) -> tuple[float, float, float] | None:
    """What the model folder at ``path``, or that a splat file at ``path`` lies in, says that it was trained
    over: ``white_background`` in the ``cfg_args`` of the 3DGS code. None if nothing says so."""
    path = Path(path)
    folders = [path] if path.is_dir() else []
    if path.parent.name.startswith("iteration_") and path.parent.parent.name == "point_cloud":
        folders.append(path.parent.parent.parent)
    for folder in folders:
        try:
            with open(folder / "cfg_args", "rb") as file:
                text = file.read(_MOST_BYTES).decode("utf-8", "replace")
        except OSError:
            continue
        said = re.search(r"\bwhite_background\s*=\s*(True|False)\b", text)
        if said:
            return WHITE if said[1] == "True" else BLACK
    return None


def color_name(color: Sequence[float]) -> str:
    """black, white, or ``#rrggbb``."""
    for name, candidate in CANDIDATES.items():
        if tuple(color) == candidate:
            return name
    return "#" + "".join(f"{round(255 * c):02x}" for c in color)


def _opaque(view: View) -> bool:
    """Whether a photograph leaves nothing open."""
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
) -> dict[str, float]:
    """Mean PSNR by background."""
    from meshsplats.rendering import render, render_splats

    linear = isinstance(scene, SplatMesh) and scene.blending == "linear"
    found: dict[str, list[float]] = {name: [] for name in colors}
    for view in views:
        mask = view.mask
        if mask is not None and not mask.any():
            continue
        draw: Any = render_splats if isinstance(scene, GaussianCloud) else render
        drawn = draw(scene, view.camera, background=BLACK, threads=threads)
        through = 1 - drawn.alpha[..., None]
        for name, color in colors.items():
            behind = np.asarray(color, np.float32)
            picture = drawn.color + through * (srgb_to_linear(behind) if linear else behind)
            picture = np.clip(linear_to_srgb(picture) if linear else picture, 0, 1)
            truth = np.clip(view.load().over(color), 0, 1)
            found[name].append(min(psnr(picture, truth, mask=mask), 200.0))
    return {name: float(np.mean(values)) if values else 0.0 for name, values in found.items()}
