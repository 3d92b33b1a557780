"""Words and numbers that options of several rooms take."""

from __future__ import annotations

from typing import Literal

Look = Literal["area", "splats"]
"""area: each pixel is the mean over its area, as in photographs, Blender, engines with MSAA and ray tracers.
splats: as a 3DGS viewer draws them, with its filter of 0.3 px^2 at the size of the image: wider in small
images, narrower in large ones."""

Device = Literal["cpu", "gpu"]
"""Where meshes are rendered: by the compiled core, or on a GPU by WebGPU."""

Missing = Literal["few", "error", "skip"]
"""What missing images mean: an error, or that their views are left out; few: left out if under a half."""

Masks = Literal["count", "subject"]
"""What masks of images mean: only pixels inside of them count, or they cut out a subject."""

MAX_SIDE = 1 << 15
"""Largest image side in pixels."""
