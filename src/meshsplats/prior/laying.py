"""bind: splats bound to the faces of a base mesh."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple, get_args

import numpy as np

from meshsplats._common.kinds import as_whole, need, need_all, need_choice
from meshsplats.datasets.views import View
from meshsplats.errors import DataWarning
from meshsplats.prior.model import MeshPrior
from meshsplats.prior.options import LAYERS, Source
from meshsplats.prior.pattern import MAX_PER_FACE, counts_by_area, face_pattern
from meshsplats.prior.shells import DepthViews, render_depth_views
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.binding import Binding
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces.color_projection import colors_from_views

MAX_LAYERS = 16
MAX_TRIANGLES = 50_000_000
LAYER_OPACITY = 0.1
"""Initial opacity of coplanar layers above the lowest, as a share of the base's opacity."""
SHELL_OPACITY = 0.3
"""Initial opacity of spaced layers above the lowest, as a share of the base's opacity."""
FAINT = 0.005
"""Maximum initial opacity of shells that protrude through the base: almost invisible, but unlike 0 it has a
gradient."""
SHELLS_DEPTH = 1 / 30
"""Default depth of all shells together, relative to the diagonal of the base's bounding box."""


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
    """Binds ``triangles`` triangles per layer to every face of ``base``.

    Each layer covers each face exactly and starts with the base's colours. The triangles of one face share
    vertices; those of different faces do not, so that each face has its own colours. The lowest layer lies in
    the base and is as opaque as the base, so that the initial image is that of the base.

    By default the layers above it are shells inside the base: copies of the base moved along its normals,
    translucent and hidden at first. Where the base does not match the surface, as with a visual hull or a
    coarse scan, training makes the outer shells transparent, and all shells together represent the depth
    between them. Where the base matches, they stay hidden. Where the base is thinner than the shells are deep
    and they would protrude, they start almost transparent. The triangles of one face and shell share a depth
    group.

    With ``spacing`` 0 all layers lie in the base, those above the lowest almost transparent. The triangles of
    a face share a depth group, in which higher layers come first, that is nearer.

    Faces without area carry no triangles; a DataWarning counts them.

    Args:
        base: the base mesh. It may be open, non-manifold or in several parts.
        triangles: triangles per face and layer, 1 to 256. Square numbers fit without T-junctions.
        by_area: ``triangles`` is the average, and the counts are square numbers roughly proportional to the
            areas of the faces.
        layers: number of layers, 1 to 16.
        spacing: distance between layers along the base's normals in scene units; negative inwards, positive
            outwards, where the layers are visible at first. By default all shells together are
            ``SHELLS_DEPTH`` of the diagonal of the base's bounding box deep, on the side facing away from the
            ``views``; without views, from cameras in all directions.
        colors: source of the initial colours: 'texture', 'vertices' (vertex colours), 'views' (the views that
            see a point most frontally), or 'grey'. 'auto' takes the first that is available. Faces of a
            textured base without texture take vertex colours, if any.
        views: images with cameras, for the colours of 'views' and the side of the shells; their cameras are
            relative to the origin of the base.
        threads: maximum number of threads; all processors by default.

    Returns:
        A mesh prior with the stored base positions.

    Raises:
        ValueError: a base without any face that has an area, options out of range, colours that the base does
            not have.
    """
    need(BaseMesh, base=base)
    need_all(View, views=views)
    layers = _whole("layers", layers, MAX_LAYERS)
    if spacing is not None and not np.isfinite(spacing):
        raise ValueError(f"spacing must be a finite length, got {spacing}")
    triangles = _whole("triangles", triangles, MAX_PER_FACE)
    source = _color_source(base, colors, views)
    solid, areas = _faces_with_area(base)
    counts = counts_by_area(areas, triangles) if by_area else np.full(len(solid), triangles)
    total = int(counts.sum()) * layers
    if total > MAX_TRIANGLES:
        raise ValueError(
            f"{total:,} triangles are more than the {MAX_TRIANGLES:,} that fit: use fewer per face, or a"
            " coarser base"
        )
    depth_views = None
    if layers > 1 and spacing != 0:
        faces = base.faces[solid]
        depth_views = render_depth_views(
            base.vertices, faces, [view.camera for view in views], threads=threads
        )
        if spacing is None:
            corners = base.vertices[faces].astype(np.float64)
            depth = SHELLS_DEPTH * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
            spacing = (-depth if depth_views.facing else depth) / (layers - 1)
    spacing = spacing or 0.0
    layout = _lay_out(solid, counts, layers)
    face = layout.vertex_face[layout.triangles[:, 0]]
    binding = Binding(base.vertices, base.faces, layout.vertex_face, layout.weights, layout.layers, spacing)
    rgba = _colors(base, binding, source, views, threads)
    depth_group = face
    rgba[layout.layers > 0, 3] *= SHELL_OPACITY if spacing else LAYER_OPACITY
    if depth_views is not None:
        shells = face.astype(np.int64) * layers + layout.layers[layout.triangles[:, 0]]
        depth_group = np.unique(shells, return_inverse=True)[1].reshape(-1).astype(np.int32)
        if depth_views.facing == (spacing < 0):
            out = _protruding(binding, depth_views)
            rgba[out, 3] = np.minimum(rgba[out, 3], np.float32(FAINT))
    mesh = SplatMesh(
        binding.positions(),
        layout.triangles,
        rgba,
        face_splat=face,
        normals=binding.normals(),
        depth_group=depth_group,
        up=base.up,
        binding=binding,
        origin=base.origin,
    )
    return MeshPrior(mesh)


def _faces_with_area(base: BaseMesh) -> tuple[np.ndarray, np.ndarray]:
    """Indices (m,) of the faces of ``base`` that have an area, and their areas (m,); warns of the others."""
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
            stacklevel=3,
        )
    return solid, areas[solid]


def _protruding(binding: Binding, depth_views: DepthViews) -> np.ndarray:
    """(v,) bool: the vertices of shells whose face at their layer has a corner outside the base."""
    result = np.zeros(len(binding.layers), bool)
    # Faces with corners where the base has no normal move by themselves.
    has_normal = np.any(binding.base_normals, axis=1)
    alone = np.flatnonzero(~has_normal[binding.base_faces].all(axis=1))
    for layer in range(1, int(binding.layers.max()) + 1):
        out = depth_views.protruding(binding.base_vertices + layer * binding.lift * binding.base_normals)
        of_face = out[binding.base_faces].any(axis=1)
        corners = binding.lifted(alone, np.full(len(alone), layer)).reshape(-1, 3)
        of_face[alone] = depth_views.protruding(corners).reshape(-1, 3).any(axis=1)
        own = binding.layers == layer
        result[own] = of_face[binding.vertex_face[own]]
    return result


class _Layout(NamedTuple):
    """Triangles on the faces of a base; the other fields are as in ``Binding``."""

    triangles: np.ndarray
    """(f, 3) int32 vertex indices, ordered by face, then from the highest layer down."""
    vertex_face: np.ndarray
    """(v,) int32."""
    weights: np.ndarray
    """(v, 3) float32."""
    layers: np.ndarray
    """(v,) int32."""


def _lay_out(faces: np.ndarray, counts: np.ndarray, layers: int) -> _Layout:
    """Patterns of ``counts`` (m,) triangles on the base's ``faces`` (m,), once for each layer. Triangles of
    one face and layer share vertices; others do not."""
    triangles, owners, weights, levels = [], [], [], []
    start = 0
    for count in np.unique(counts):
        here = faces[counts == count].astype(np.int32)
        corners, indices = np.unique(face_pattern(int(count)).reshape(-1, 3), axis=0, return_inverse=True)
        copies, size = len(here) * layers, len(corners)
        first = start + size * np.arange(copies, dtype=np.int64)[:, None, None]
        triangles.append((first + indices.reshape(1, -1, 3)).reshape(-1, 3))
        owners.append(np.repeat(here, size * layers))
        weights.append(np.tile(corners, (copies, 1)))
        levels.append(np.tile(np.repeat(np.arange(layers - 1, -1, -1, dtype=np.int32), size), len(here)))
        start += size * copies
    if start > np.iinfo(np.int32).max:
        raise ValueError(f"{start:,} vertices are more than a mesh can index; use fewer triangles per face")
    owner, unordered = np.concatenate(owners), np.concatenate(triangles)
    order = np.argsort(owner[unordered[:, 0]], kind="stable")
    return _Layout(unordered[order].astype(np.int32), owner, np.concatenate(weights), np.concatenate(levels))


def _color_source(base: BaseMesh, colors: Source, views: Sequence[View]) -> Source:
    available: dict[str, bool] = {
        "texture": base.textured,
        "vertices": base.colors is not None,
        "views": len(views) > 0,
        "grey": True,
    }
    need_choice(Source, colors=colors)
    if colors == "auto":
        return next(name for name in get_args(Source) if available.get(name))
    if not available[colors]:
        reasons = {"texture": "the base has no texture", "vertices": "the base has no vertex colours"}
        raise ValueError(f"colors is {colors!r}, but {reasons.get(colors, 'there are no views')}; use 'auto'")
    return colors


def _colors(
    base: BaseMesh, binding: Binding, source: Source, views: Sequence[View], threads: int | None
) -> np.ndarray:
    """(v, 4) float32 display RGBA of the vertices of ``binding``."""
    face, weights = binding.vertex_face, binding.weights
    if source == "vertices":
        return base.vertex_colors_at(face, weights)
    if source == "texture":
        return base.colors_at(face, weights)
    rgba = np.full((len(face), 4), 0.5, np.float32)
    rgba[:, 3] = 1
    if source == "views":
        rgba[:, :3] = colors_from_views(binding, views, threads=threads)
    return rgba


def _whole(name: str, value: object, most: int) -> int:
    number = as_whole(name, value)
    if not 1 <= number <= most:
        raise ValueError(f"{name} must be a number from 1 to {most}, got {number}")
    return number
