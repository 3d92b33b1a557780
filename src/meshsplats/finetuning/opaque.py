"""Meshes that are drawn with a depth buffer: every fragment is opaque or not there (``opacity='cutoff'``).

The hard cut at the cutoff has no derivative. In its place, a step renders a ramp of opacities around the
level set, which becomes steeper until it is one pixel wide. A part of the loss is the expected error of
images of random fragments: unlike that of the image, it does not accept a mean of layers for a color that
none of them has. Triangles that end at an edge, not at a level set, move by what the edge shows on its sides
(``rendering/edges.py``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.views import View
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.rendering.backward import ExpectedError
from meshsplats.rendering.edges import front_faces
from meshsplats.scene.mesh import SplatMesh

HIT_VIEWS = 64
"""Maximum number of training views, evenly spread, in which triangles are looked for."""
HIT_SAMPLES = 2
"""Samples along each side of a pixel there."""


def expected_error(
    target: np.ndarray, mask: np.ndarray | None, config: FinetuneConfig, share: float
) -> ExpectedError:
    """The expected error against ``target`` (h, w, 3) where ``mask`` counts, times ``share * l2_weight``."""
    pixels = np.ones(target.shape[:2], bool) if mask is None else mask
    weight = np.zeros(pixels.shape, np.float32)
    weight[pixels] = share * config.l2_weight / (3 * np.count_nonzero(pixels))
    # Masked values may be anything.
    known = target if mask is None else np.where(mask[..., None], target, 0)
    return ExpectedError(np.ascontiguousarray(known, np.float32), weight)


def visible_samples(
    mesh: SplatMesh, views: Sequence[View], cutoff: float, threads: int | None = None
) -> np.ndarray:
    """(f,) int64: at how many samples of all ``views`` together each triangle is in front, drawn with
    ``cutoff``: at most ``HIT_VIEWS`` of them, with ``HIT_SAMPLES`` x ``HIT_SAMPLES`` samples."""
    count = len(mesh.faces)
    hits = np.zeros(count, np.int64)
    for view in subsample(views, HIT_VIEWS):
        found = front_faces(mesh, view.camera.scaled(HIT_SAMPLES), cutoff, threads=threads).faces
        hits += np.bincount(found[found >= 0], minlength=count)
    return hits
