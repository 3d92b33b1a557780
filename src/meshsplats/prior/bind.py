"""bind: splats laid on the faces of a base mesh."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

from meshsplats.base_mesh import BaseMesh
from meshsplats.binding import Binding
from meshsplats.datasets.views import View
from meshsplats.errors import DataWarning
from meshsplats.mesh import SplatMesh
from meshsplats.prior.color_projection import colors_from_views
from meshsplats.prior.model import MeshPrior
from meshsplats.prior.pattern import MOST, counts_by_area, face_pattern
from meshsplats.prior.shells import Looks, look_at_base

Source = Literal["auto", "texture", "vertices", "views", "grey"]
MAX_LAYERS = 16
MAX_TRIANGLES = 50_000_000
LAYER_OPACITY = 0.1
"""Share of the base's opacity that coplanar layers above the lowest begin with."""
SHELL_OPACITY = 0.3
"""Share of the base's opacity that layers above the lowest begin with where they are spaced."""
FAINT = 0.005
"""Most opacity that shells begin with where they stand out of the base: next to nothing shows, but training
can make more of it, which it cannot of 0."""
LAYERS = 6
SHELLS_DEPTH = 1 / 30
"""By default, depth of all shells together as a share of the diagonal of the base's box."""


def bind(
    base: BaseMesh,
    *,
    triangles: int = 1,
    by_area: bool = False,
    layers: int = LAYERS,
    spacing: float | None = None,
    colors: Source = "auto",
    views: Sequence[View] = (),
    threads: int | None = None,
) -> MeshPrior:
    """Lays ``triangles`` triangles a layer on every face of ``base``.

    Each layer covers each face exactly and begins with the base's colours. Its triangles on a face share
    vertices; those of different faces do not, so each face has colours of its own. The picture that training
    begins with is the base's: its own layer, the lowest, is as opaque as the base.

    By default the layers above it are shells inside the base: the base with its vertices moved along their
    normals, translucent and hidden at first. Where the base is not where the surface is, as with a visual
    hull or a coarse scan, training makes the outer shells transparent, and all together show what lies in
    the depth between them; where it is the surface, they stay hidden. Where the base is thinner than they are
    deep and they would stand out, they are almost transparent. The triangles of a face and shell share one
    depth group.

    With ``spacing`` 0 all layers lie in the base, those above the lowest almost transparent. In each face
    those of higher layers come first, as what is nearer does, and all share one depth group.

    Faces without area carry no triangles, with a counted DataWarning.

    Args:
        base: the mesh. Any will do: open, in several parts, non-manifold.
        triangles: a layer, 1 to 256; a square number fits without T-junctions.
        by_area: that many on average, square numbers about in proportion to the faces' areas.
        layers: 1 to 16.
        spacing: scene units from one layer to the next along the base's normals; below 0 they go inwards,
            above 0 outwards, where they show at first. By default all shells together are ``SHELLS_DEPTH`` of
            the diagonal of the base's box deep, on the side away from the ``views``; without views, from
            places all round.
        colors: where colours come from: 'texture', 'vertices' (vertex colours), 'views' (the views that see
            a place most squarely), 'grey'; 'auto': the first of these that there is. Where a textured base
            has faces without texture, they take vertex colours, if any.
        views: pictures with cameras: for 'views', and for where the shells go.
        threads: at most this many; all processors by default.

    Raises ValueError for a base without a face that has an area, options out of range, and colours that the
    base does not have.
    """
    if not 1 <= layers <= MAX_LAYERS:
        raise ValueError(f"layers must be a number from 1 to {MAX_LAYERS}, got {layers}")
    if spacing is not None and not np.isfinite(spacing):
        raise ValueError(f"spacing must be a finite length, got {spacing}")
    if not 1 <= triangles <= MOST:
        raise ValueError(f"triangles must be a number from 1 to {MOST}, got {triangles}")
    source = _source(base, colors, views)
    corners = base.vertices[base.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    solid = np.flatnonzero(areas > 0)
    if not len(solid):
        raise ValueError(f"none of the base's {len(base.faces):,} faces has an area: nothing to bind to")
    if len(solid) < len(base.faces):
        warnings.warn(
            f"{len(base.faces) - len(solid):,} of {len(base.faces):,} faces of the base have no area and"
            " carry no splats",
            DataWarning,
            stacklevel=2,
        )
    counts = np.full(len(solid), triangles)
    if by_area:
        counts = counts_by_area(areas[solid], triangles)
    total = int(counts.sum()) * layers
    if total > MAX_TRIANGLES:
        raise ValueError(
            f"{total:,} triangles are more than the {MAX_TRIANGLES:,} that fit: use fewer a face, or a"
            " coarser base"
        )
    looks = None
    if layers > 1 and spacing != 0:
        faces = base.faces[solid]
        looks = look_at_base(base.vertices, faces, [view.camera for view in views], threads=threads)
    if looks is None:
        spacing = spacing or 0.0
    elif spacing is None:
        depth = SHELLS_DEPTH * float(np.linalg.norm(np.ptp(corners[solid].reshape(-1, 3), axis=0)))
        spacing = (-depth if looks.facing else depth) / (layers - 1)
    laid = _laid_out(solid, counts, layers)
    face = laid.vertex_face[laid.triangles[:, 0]]
    binding = Binding(base.vertices, base.faces, laid.vertex_face, laid.weights, laid.layers, spacing)
    rgba = _colors(base, binding, source, views, threads)
    depth_group = face
    rgba[laid.layers > 0, 3] *= SHELL_OPACITY if spacing else LAYER_OPACITY
    if looks is not None:
        shells = face.astype(np.int64) * layers + laid.layers[laid.triangles[:, 0]]
        depth_group = np.unique(shells, return_inverse=True)[1].reshape(-1).astype(np.int32)
        if looks.facing == (spacing < 0):
            out = _standing_out(binding, looks)
            rgba[out, 3] = np.minimum(rgba[out, 3], np.float32(FAINT))
    mesh = SplatMesh(
        binding.positions(),
        laid.triangles,
        rgba,
        face_splat=face,
        normals=binding.normals(),
        depth_group=depth_group,
        up=base.up,
        binding=binding,
    )
    return MeshPrior(mesh)


def _standing_out(binding: Binding, looks: Looks) -> np.ndarray:
    """(v,) bool: the vertices of shells whose face at their layer has a corner outside the base."""
    result = np.zeros(len(binding.layers), bool)
    for layer in range(1, int(binding.layers.max()) + 1):
        out = looks.standing_out(binding.base_vertices + layer * binding.lift * binding.base_normals)
        own = binding.layers == layer
        result[own] = out[binding.base_faces[binding.vertex_face[own]]].any(axis=1)
    return result


class _Laid(NamedTuple):
    triangles: np.ndarray
    """(f, 3) int32 vertices, by face, then from the highest layer down."""
    vertex_face: np.ndarray
    """(v,) int32."""
    weights: np.ndarray
    """(v, 3) float32."""
    layers: np.ndarray
    """(v,) int32."""


def _laid_out(faces: np.ndarray, counts: np.ndarray, layers: int) -> _Laid:
    """Patterns of ``counts`` (m,) triangles on the base's ``faces`` (m,), once for each layer. Triangles of a
    face and layer share vertices; others do not."""
    triangles, owners, weights, levels = [], [], [], []
    start = 0
    for count in np.unique(counts):
        here = faces[counts == count].astype(np.int32)
        corners, numbers = np.unique(face_pattern(int(count)).reshape(-1, 3), axis=0, return_inverse=True)
        copies, size = len(here) * layers, len(corners)
        first = start + size * np.arange(copies, dtype=np.int64)[:, None, None]
        triangles.append((first + numbers.reshape(1, -1, 3)).reshape(-1, 3))
        owners.append(np.repeat(here, size * layers))
        weights.append(np.tile(corners, (copies, 1)))
        levels.append(np.tile(np.repeat(np.arange(layers - 1, -1, -1, dtype=np.int32), size), len(here)))
        start += size * copies
    if start > np.iinfo(np.int32).max:
        raise ValueError(f"{start:,} vertices are more than a mesh can number; use fewer triangles a face")
    owner, every = np.concatenate(owners), np.concatenate(triangles)
    order = np.argsort(owner[every[:, 0]], kind="stable")
    return _Laid(every[order].astype(np.int32), owner, np.concatenate(weights), np.concatenate(levels))


def _source(base: BaseMesh, colors: Source, views: Sequence[View]) -> Source:
    there: dict[str, bool] = {
        "texture": base.textured,
        "vertices": base.colors is not None,
        "views": len(views) > 0,
        "grey": True,
    }
    if colors not in get_args(Source):
        raise ValueError(f"colors must be one of {', '.join(get_args(Source))}, got {colors!r}")
    if colors == "auto":
        return next(name for name in get_args(Source) if there.get(name))
    if not there[colors]:
        what = {"texture": "the base has no texture", "vertices": "the base has no vertex colours"}
        raise ValueError(f"colors is {colors!r}, but {what.get(colors, 'there are no views')}; use 'auto'")
    return colors


def _colors(
    base: BaseMesh, binding: Binding, source: Source, views: Sequence[View], threads: int | None
) -> np.ndarray:
    """(v, 4) float32 display RGBA."""
    face, weights = binding.vertex_face, binding.weights
    if source == "vertices":
        return base.vertex_colors_at(face, weights)
    if source == "texture":
        rgba = base.texture_at(face, weights)
        bare = ~base.textured_faces()[face]
        if base.colors is not None and bare.any():
            rgba[bare] = base.vertex_colors_at(face[bare], weights[bare])
        return rgba
    rgba = np.full((len(face), 4), 0.5, np.float32)
    rgba[:, 3] = 1
    if source == "views":
        rgba[:, :3] = colors_from_views(binding, views, threads=threads)
    return rgba
