"""Which splats are floaters, or otherwise better left out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from meshsplats._common.cells import Cells
from meshsplats._common.chunks import chunks
from meshsplats._common.geometry import spacing
from meshsplats.cameras.framing import scene_bounds
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion.cleaning_rules import FLOATERS, CleaningRules
from meshsplats.conversion.fans import semi_axes
from meshsplats.conversion.selection import inside
from meshsplats.errors import DataWarning
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.scene.mesh import SplatMesh

Scene = TypeVar("Scene", GaussianCloud, SplatMesh, GaussianCloud | SplatMesh)
CELL = 2.5
"""Side of the cells for counting neighbours and connecting parts, in spacings of the splats."""
REACH = 1.5
"""Standard deviations at which a splat ends where its neighbours are counted."""
CHUNK = 1 << 14
"""Splats whose lengths are computed together."""


_WORDS = {
    "crop": "outside the box",
    "min_opacity": "fainter than {:g}",
    "max_distance": "farther than {:g} radii",
    "max_size": "longer than {:g} radii",
    "sparse": "fewer than {:.1%} of the usual neighbours",
    "min_part": "in components below {:.1%} of all opacity",
    "all": "together",
    "surroundings": "kept, as they surround the place",
}
"""Names of the rules in tables."""


@dataclass(frozen=True, eq=False)
class Findings:
    """The splats that the rules name."""

    gone: dict[str, np.ndarray]
    """For each rule (n,) bool: the splats that it removes."""
    opacities: np.ndarray
    """(n,) float32 opacities of the splats; for a mesh, the greatest of each splat's vertices."""
    owner: np.ndarray | None = None
    """(f,) int64 index of the splat that each triangle of a mesh belongs to; None for splats themselves."""
    surroundings: np.ndarray | None = None
    """(n,) bool: splats that would be among them, but surround a place (``surroundings.floaters``)."""
    camera: Camera | None = None
    """A view from within, where the scene is a place."""

    @property
    def kept(self) -> np.ndarray:
        """(n,) bool: the splats that no rule removes."""
        return ~np.any(list(self.gone.values()), axis=0)

    def counts(self) -> dict[str, dict[str, float]]:
        """For each rule, and for ``all`` together: count of removed splats and their share of all opacity.
        With ``surroundings``, the same of those that stay."""
        whole = max(float(self.opacities.sum(dtype=np.float64)), 1e-300)
        masks = {**self.gone, "all": ~self.kept}
        if self.surroundings is not None:
            masks["surroundings"] = self.surroundings
        return {
            name: {
                "splats": int(mask.sum()),
                "opacity": float(self.opacities[mask].sum(dtype=np.float64)) / whole,
            }
            for name, mask in masks.items()
        }

    def in_words(self, rules: CleaningRules) -> list[str]:
        """A line for each of the ``rules``, by which they were found, and for all together."""
        counts, total = self.counts(), len(self.opacities)
        if len(self.gone) == 1:
            del counts["all"]
        values = {**vars(rules), "crop": None}
        names = [_WORDS[name].format(values.get(name)) for name in counts]
        return [
            f"{name:<{max(map(len, names))}}  {count['splats']:>9,} of {total:,} splats,"
            f" {count['opacity']:.2%} of the opacity"
            for name, count in zip(names, counts.values(), strict=True)
        ]


def find(
    scene: GaussianCloud | SplatMesh, rules: CleaningRules = FLOATERS, most: float | None = None
) -> Findings:
    """The splats of ``scene`` that each of the ``rules`` removes.

    A rule that names splats with more than the share ``most`` of all opacity removes none, with a
    DataWarning: it has found the scene, not what hangs in it. Each triangle of a mesh without ``face_splat``
    counts as a splat. For parts and neighbours, centres are sorted into cells with a side of 2.5 spacings of
    the splats: those in adjacent cells are connected.

    Raises ValueError where there are no rules, and where no splat would be left.
    """
    given = [name for name, value in vars(rules).items() if value is not None]
    if not given:
        raise ValueError("no rule is given: set at least one of the cleaning rules")
    centers, reach, opacities, owner = _splats(scene)
    gone: dict[str, np.ndarray] = {}
    if rules.crop is not None:
        gone["crop"] = ~inside(centers, rules.crop, scene.origin)
    if rules.min_opacity is not None:
        gone["min_opacity"] = opacities < rules.min_opacity
    if any(name not in ("crop", "min_opacity") for name in given):
        bounds = scene_bounds(scene)
        lengths = np.empty(len(centers))
        for part in chunks(len(centers), CHUNK):
            lengths[part] = np.linalg.norm(reach[part].astype(np.float64), axis=2).max(axis=1)
    if rules.max_distance is not None:
        away = np.linalg.norm(centers - bounds.center, axis=1)
        gone["max_distance"] = away > rules.max_distance * bounds.radius
    if rules.max_size is not None:
        gone["max_size"] = lengths > rules.max_size * bounds.radius
    if rules.sparse is not None or rules.min_part is not None:
        cell = CELL * float(np.median(spacing(centers.astype(np.float32))))
        cell = max(cell, 1e-12 * bounds.radius)
        if rules.sparse is not None:
            near = _neighbours(centers, lengths, cell)
            gone["sparse"] = near < rules.sparse * float(np.median(near))
        if rules.min_part is not None:
            of_part = Cells(centers, cell, reach).parts()
            held = np.bincount(of_part, opacities)
            gone["min_part"] = (held < rules.min_part * held.sum())[of_part]
    found = Findings(gone, opacities, owner)
    for name, count in found.counts().items():
        if most is not None and name in gone and count["opacity"] > most:
            gone[name] = np.zeros_like(gone[name])
            warnings.warn(
                f"splats {_WORDS[name].format(vars(rules)[name])} have {count['opacity']:.0%} of all opacity:"
                f" they seem to be the scene itself and are kept; give ``{name}`` to remove them",
                DataWarning,
                stacklevel=3,
            )
    if not found.kept.any():
        counts = ", ".join(f"{name} {int(mask.sum()):,}" for name, mask in gone.items())
        raise ValueError(f"none of the {len(centers):,} splats would be left ({counts})")
    return found


def remove(scene: Scene, found: Findings) -> Scene:
    """``scene`` without the splats that ``find`` has found."""
    if isinstance(scene, SplatMesh):
        return scene.take(found.kept[found.owner])
    return scene.take(np.flatnonzero(found.kept))


def cropped(scene: Scene, box: Sequence[float] | None) -> Scene:
    """``scene`` with the splats whose centre is in the ``box`` x0 y0 z0 x1 y1 z1; None: all of them.

    Raises ValueError if there are none.
    """
    if box is None:
        return scene
    return remove(scene, find(scene, CleaningRules(crop=tuple(box))))  # type: ignore[arg-type]


def _neighbours(centers: np.ndarray, size: np.ndarray, cell: float) -> np.ndarray:
    """(n,) counts of the centres around each, in cells of twice its own ``size`` (n,), or twice ``cell``.

    A wall has few splats because they are large, with small ones scattered on it: none of them is a floater.
    """
    level = np.clip(np.ceil(np.log2(np.maximum(size / cell, 1))), 0, 8).astype(int)
    near = np.empty(len(centers), np.int64)
    cells = Cells(centers, 2 * cell)
    for doublings in np.unique(level).tolist():
        at = level == doublings
        near[at] = cells.coarser(doublings).near()[at]
    return near


def _splats(
    scene: GaussianCloud | SplatMesh,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """(n, 3) float64 centres, (n, 4, 3) float offsets to the ends of each splat, (n,) opacities, and for a
    mesh the (f,) index of each triangle's splat."""
    if isinstance(scene, GaussianCloud):
        order = np.argsort(scene.scales, axis=1)[:, 1:]
        sigma = np.take_along_axis(scene.scales, order, axis=1)
        half = REACH * semi_axes(scene.quaternions, order, sigma).transpose(2, 0, 1)
        return scene.means.astype(np.float64), np.concatenate([half, -half], axis=1), scene.opacities, None
    if not len(scene.faces):
        raise ValueError("the mesh has no triangles: there is nothing to clean")
    splats = scene.splats
    starts = splats.starts
    # Reductions over three corners as operations on whole arrays take a third of the time.
    a, b, c = (scene.vertices[corner].astype(np.float64) for corner in scene.faces.T)
    centers = splats.sums((a + b + c) / 3) / splats.counts[:, None]
    # The ends along the two axes of the frame that the splat is longest in.
    low = np.minimum.reduceat(np.minimum(np.minimum(a, b), c), starts) - centers
    high = np.maximum.reduceat(np.maximum(np.maximum(a, b), c), starts) - centers
    across = np.argsort(high - low, axis=1)[:, 1:, None] == np.arange(3)
    ends = np.concatenate([across * high[:, None], across * low[:, None]], axis=1)
    opacities = np.maximum.reduceat(scene.colors[scene.faces.ravel(), 3], 3 * starts)
    return centers, ends, opacities, splats.of_face


_SIDE = 480


def save_strip(
    scene: GaussianCloud | SplatMesh,
    left: GaussianCloud | SplatMesh,
    found: Findings,
    path: Path,
    threads: int | None,
) -> None:
    """Saves a strip of three images of ``scene`` to ``path``: as it is; with what was ``found`` in red; and
    what is ``left``."""
    from meshsplats.images.writing import save_image, strip
    from meshsplats.viewpoints.opening import opening_azimuth

    if found.camera is not None:
        whole = rest = found.camera
    else:
        azimuth = opening_azimuth(scene, threads=threads)
        lens: dict[str, Any] = {"azimuth": azimuth, "width": _SIDE, "height": _SIDE}
        whole, rest = orbit(scene, 1, **lens)[0], orbit(left, 1, **lens)[0]
    shown = ((scene, whole), (_marked(scene, found), whole), (left, rest))
    images = [_image(part, camera, threads) for part, camera in shown]
    save_image(path, strip(images, ("before", "removed", "after")))


def _image(scene: GaussianCloud | SplatMesh, camera: Camera, threads: int | None) -> np.ndarray:
    from meshsplats.rendering import render_splats
    from meshsplats.rendering.looks import image_of

    white: Sequence[float] = (1.0, 1.0, 1.0)
    if isinstance(scene, SplatMesh):
        return np.clip(image_of(scene, camera, white, samples=2, threads=threads)[0], 0, 1)
    return np.clip(render_splats(scene, camera, background=white, threads=threads).color, 0, 1)


def _marked(scene: GaussianCloud | SplatMesh, found: Findings) -> GaussianCloud | SplatMesh:
    """The scene with the removed splats in red, the rest in dull colours."""
    red = np.array([0.95, 0.05, 0.05], np.float32)
    if isinstance(scene, GaussianCloud):
        plain = scene.sh[:, :1] * np.float32(0.4)
        plain[~found.kept] = ((red - 0.5) / SH_C0)[None, None]
        return replace(scene, sh=plain)
    colors = scene.colors.copy()
    colors[:, :3] = 0.5 + 0.4 * (colors[:, :3] - 0.5)
    gone = scene.faces[~found.kept[found.owner]]
    colors[gone.ravel(), :3] = red
    return replace(scene, colors=colors)
