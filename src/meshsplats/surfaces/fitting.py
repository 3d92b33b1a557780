"""The shape and the texture of a surface, fitted to images by gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from meshsplats.datasets.views import View
from meshsplats.errors import MissingDependencyError
from meshsplats.rendering.edges import faces_across
from meshsplats.surfaces.atlas import filled
from meshsplats.surfaces.images import Surface, SurfaceImage

BETAS = 0.9, 0.99
"""Decay of the means of the vertices' gradients and of their squares."""
SMALL = 0.1
"""Gradients of vertices, relative to the largest, from which steps have their whole length: smaller ones are
noise, as those of vertices that hardly any view shows."""
RELAXATION = 0.5, 0.1
"""Share of the error of a view that its texels take over, at the beginning and at the end."""
DOUBT = 0.25
"""Samples that a texel must have in a view for that view to count half."""
ROBUST = 0.1
"""Error of a pixel, in units of 1, from which it counts for a texture by its size only: highlights that few
views see, and what lies before the surface, do not stay in it."""
BACKGROUNDS = 1.0, 0.0, 0.5
_SOLID = 0.5
"""Opacity of an image from which its colour is that of a surface."""
_WHOLE = 0.99
"""Coverage of a pixel that shows nothing but the surface."""
_SEED = 7


class SmoothSteps:
    """Adam on vertices, in coordinates in which smooth motions are short (Nicolet and others 2021, Large
    Steps in Inverse Rendering of Geometry): u = (1 + stiffness L) x with the combinatorial Laplacian L.

    Each vertex has one second moment for its three coordinates: steps do not depend on the axes. With one
    for all vertices, as in the paper, the few at the outlines of large parts move, and the rest hardly.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, stiffness: float) -> None:
        try:
            from scipy import sparse
            from scipy.sparse.linalg import splu
        except ModuleNotFoundError as error:
            raise MissingDependencyError("a surface needs the extra 'base': pip install scipy") from error
        count = len(vertices)
        tails, heads = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        near = sparse.coo_matrix((np.ones(len(tails)), (tails, heads)), (count, count))
        near = ((near + near.T) > 0).astype(np.float64)
        matrix = sparse.identity(count) + stiffness * (sparse.diags(near.sum(axis=1).A1) - near)
        self._solve: Callable[[np.ndarray], np.ndarray] = splu(matrix.tocsc()).solve
        self._place = matrix @ vertices
        self._mean, self._square, self._count = np.zeros_like(vertices), np.zeros((count, 1)), 0

    def step(self, gradient: np.ndarray, rate: float) -> np.ndarray:
        """The vertices (v, 3) float64 after a step down ``gradient`` (v, 3), of up to about ``rate`` scene
        units for each; where gradients are below ``SMALL`` of the largest it is shorter."""
        slope = self._solve(gradient)
        first, second = BETAS
        self._count += 1
        self._mean = first * self._mean + (1 - first) * slope
        self._square = second * self._square + (1 - second) * np.square(slope).sum(axis=1, keepdims=True)
        largest = float(self._square.max(initial=0))
        if largest > 0:
            mean = self._mean / (1 - first**self._count)
            size = np.sqrt((self._square + SMALL**2 * largest) / (1 - second**self._count))
            self._place = self._place - rate * mean / size
        return self._solve(self._place)


def mean_colors(
    surface: Surface,
    views: Sequence[View],
    *,
    threads: int | None = None,
    progress: Callable[[], object] | None = None,
) -> Surface:
    """The surface with the mean of the images' colours at each texel; unseen ones are filled."""
    sums = np.zeros((*surface.texels.shape[:2], 4), np.float32)
    for view in views:
        target, background, counts, solid = target_of(view)
        image = SurfaceImage(surface, view.camera, background, gradients=False, threads=threads)
        sums += image.texel_sums(target, counts * solid * (image.coverage > _WHOLE))
        if progress is not None:
            progress()
    weight = sums[..., 3]
    return surface._replace(texels=filled(sums[..., :3] / np.where(weight > 0, weight, 1)[..., None], weight))


def fit(
    surface: Surface,
    views: Sequence[View],
    *,
    rounds: int,
    move: float,
    stiffness: float,
    threads: int | None = None,
    progress: Callable[[], object] | None = None,
) -> Surface:
    """The surface whose images are nearer to those of ``views``.

    Each round takes every view once, in a random order: the vertices follow the gradient of the square error,
    and the texels take over a part of their error in the view.

    Args:
        surface: with colours that are about right, such as ``mean_colors``.
        rounds: 1 or more.
        move: largest step of a vertex at the beginning, relative to the median edge; 0: the shape stays.
        stiffness: weight of the Laplacian.
        progress: called after each view.
    """
    rng = np.random.default_rng(_SEED)
    steps = SmoothSteps(surface.vertices, surface.faces, stiffness)
    corners = surface.vertices[surface.faces]
    edge = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    texels = surface.texels.copy()
    sums = np.empty((*texels.shape[:2], 4), np.float32)
    surface = surface._replace(across=faces_across(surface.faces), texels=texels)
    total = rounds * len(views)
    for number, index in enumerate(np.concatenate([rng.permutation(len(views)) for _ in range(rounds)])):
        target, background, counts, solid = target_of(views[index], number)
        image = SurfaceImage(surface, views[index].camera, background, gradients=move > 0, threads=threads)
        error = (image.color - target) * counts[..., None]
        vertices = surface.vertices
        if move:
            slope = image.vertex_gradients(error * np.float32(2 / error.size))
            vertices = steps.step(slope, move * edge * 0.1 ** (number / total))
        size = np.maximum.reduce([np.abs(error[..., k]) for k in range(3)])
        weight = counts * solid * (image.coverage > _WHOLE) * np.minimum(1, ROBUST / np.maximum(size, ROBUST))
        share = RELAXATION[0] + (RELAXATION[1] - RELAXATION[0]) * number / total
        image.relax(error, weight, share, DOUBT, sums)
        surface = surface._replace(vertices=vertices)
        if progress is not None:
            progress()
    return surface._replace(across=None)


class Target(NamedTuple):
    """What the image of a surface is compared with, float32."""

    color: np.ndarray
    """(h, w, 3)."""
    background: np.ndarray
    """(3,) or (h, w, 3): what is behind the surface."""
    counts: np.ndarray
    """(h, w): which pixels count, 0 or 1."""
    solid: np.ndarray
    """(h, w): which of them show something solid, 0 or 1."""


def target_of(view: View, number: int = 0) -> Target:
    """What the image of a surface is compared with in step ``number``.

    Images with alpha lie on white, black and grey in turn, so that there is an outline on one of them. Behind
    the surface, photographs show themselves: what it does not cover is no error.
    """
    image = view.load()
    everywhere = np.ones(image.color.shape[:2], np.float32)
    counts = everywhere if image.mask is None else image.mask.astype(np.float32)
    alpha = view.alpha
    if alpha is None:
        target = image.over()
        return Target(target, target, counts, everywhere)
    background = np.full(3, BACKGROUNDS[number % len(BACKGROUNDS)], np.float32)
    return Target(image.over(background), background, counts, (alpha >= _SOLID).astype(np.float32))
