"""The blended part of a mesh for depth buffers (``soft_share``): fans of splats that have no opaque stand-in.

A viewer draws the opaque triangles first, with its depth buffer, and blends the others over them in the order
of the file. Where few fragments lie in front of the opaque ones, that order hardly matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._arrays import subsample
from meshsplats.datasets.views import View
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render
from meshsplats.rendering.backward import TapedRendering

MAX_OPACITY = np.float32(254 / 255)
"""Greatest opacity of a corner of blended triangles, so that they differ from opaque ones."""
ERROR_VIEWS = 24
"""Maximum number of training views, evenly spread, in which splats are compared with opaque triangles."""
ERROR_SAMPLES = 2
"""Samples along each side of a pixel there."""


def soft_fraction(config: FinetuneConfig, fraction: float) -> float:
    """Share of the phase with blended triangles that is over, after ``fraction`` of the run; below 0 before
    it."""
    return (fraction - 1 + config.soft_phase) / config.soft_phase if config.soft_share else -1.0


def opaque_fraction(config: FinetuneConfig, fraction: float) -> float:
    """Share of the phase before that is over; of the run, if there is no other."""
    return min(1.0, fraction / (1 - config.soft_phase)) if config.soft_share else fraction


def with_soft_splats(
    core: SplatMesh, start: SplatMesh, views: Sequence[View], share: float, threads: int | None = None
) -> SplatMesh:
    """``core``, opaque triangles, with fans of ``start``, the mesh that it was made from, in place of those
    that fail most.

    A splat is scored by the sum over the pixels of ``views`` of T a (1 - a) e, with the opacity a of its
    fragments and the transmittance T in front of them: what is lost if a fragment is drawn solid by a chance
    of a has this factor. e is the squared error of ``core`` less that of ``start``. Of the splats with
    positive scores, those with the highest score per triangle take up to ``share`` times as many triangles as
    ``start`` has.

    Returns:
        A mesh whose opaque triangles have three corners of opacity 1, and its blended ones none.
    """
    assert core.face_splat is not None
    assert start.face_splat is not None
    scores = softness(core, start, views, threads)
    triangles = np.bincount(start.face_splat, minlength=len(scores))
    best = np.argsort(-scores / np.maximum(triangles, 1), kind="stable")
    best = best[scores[best] > 0]
    chosen = np.zeros(len(scores), bool)
    chosen[best[np.cumsum(triangles[best]) <= share * len(start.faces)]] = True
    soft = start.keep_faces(chosen[start.face_splat])
    colors = soft.colors.copy()
    colors[:, 3] = np.minimum(colors[:, 3], MAX_OPACITY)
    return _joined(core.keep_faces(~chosen[core.face_splat]), replace(soft, colors=colors))


def softness(
    core: SplatMesh, start: SplatMesh, views: Sequence[View], threads: int | None = None
) -> np.ndarray:
    """The score of each splat, by its index; see ``with_soft_splats``."""
    assert start.face_splat is not None
    vertex_splat = np.zeros(len(start.vertices), np.int64)
    vertex_splat[start.faces] = start.face_splat[:, None]
    sums = np.zeros(len(start.vertices))
    for view in subsample(views, ERROR_VIEWS):
        background, camera = view.background, view.camera
        opaque = render(core, camera, background=background, samples=ERROR_SAMPLES, threads=threads).color
        values = np.zeros((len(start.vertices), 1), np.float32)
        rendering = TapedRendering.of(start, camera, values, background=background, threads=threads)
        error, blended = (
            np.square(color - view.image).sum(axis=2, keepdims=True) for color in (opaque, rendering.color)
        )
        error -= blended
        if view.mask is not None:
            error[~view.mask] = 0  # masked values may be anything
        sums += rendering.scatter_to_vertices(error)[:, 0]
    # A corner has the sum of e T a, weighted by its barycentric weight: by these, 1 - a is interpolated.
    sums *= 1 - start.colors[:, 3]
    return np.bincount(vertex_splat, sums, int(start.face_splat.max()) + 1)


def _joined(core: SplatMesh, soft: SplatMesh) -> SplatMesh:
    """The triangles of both, in the order of their splats, which they do not share."""
    splats = np.concatenate([core.face_splat, soft.face_splat])
    order = np.argsort(splats, kind="stable")
    groups = None
    if core.depth_group is not None and soft.depth_group is not None:
        groups = np.concatenate([core.depth_group, soft.depth_group])[order]
    return replace(
        core,
        vertices=np.concatenate([core.vertices, soft.vertices]),
        faces=np.concatenate([core.faces, soft.faces + len(core.vertices)])[order],
        colors=np.concatenate([core.colors, soft.colors]),
        face_splat=splats[order],
        depth_group=groups,
        attributes={name: np.concatenate([a, soft.attributes[name]]) for name, a in core.attributes.items()},
    )
