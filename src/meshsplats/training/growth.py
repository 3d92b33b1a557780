"""Growth (densification in 3DGS): fans that no view shows are pruned, and those in which several views find
errors are split in two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from meshsplats.datasets.views import View
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import (
    TRAINING_MIN_TRANSMITTANCE,
    exposed,
    exposed_over,
    exposure_of,
    samples_of,
)
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.devices import engine
from meshsplats.rendering.engine import scatter_to_vertices
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

JUDGED_VIEWS = 20
"""Maximum number of training views, evenly spread, in which fans are judged."""
SHELL = "shell"
"""Attribute of a mesh in training: 1 for the fans of the shell, which are never dropped, else 0."""
MIN_PIXELS = 0.02
"""A fan that adds fewer pixels than this to each judged view is dropped, if it is in the image of one..."""
TRAINED_PIXELS = 0.2
"""...and if the steps since the last event have seen fewer of it than this: judged views look at the backs of
walls that others show."""
SEEN = "seen"
"""Attribute of a mesh in training: ``State.squares`` at the last event."""
CLEAR = 0.5
"""A fan with a greater share of its pixels where photographs are transparent is dropped."""
MIN_OPACITY = 0.02
"""A fan of less opacity is dropped."""
NEAR = 0.3
"""Depth of a near field, as a share of the depth where the scene begins..."""
FRONT, LARGEST = 0.02, 1e-3
"""...before which this share of the scene lies, and share of an image that one fan is at most."""
SMALLEST = 0.7
"""Pixels that a fan must contribute to a view to be halved."""

OVERLAP = 0.2
"""The halves of a splat of length 2 along its longest axis reach from -OVERLAP to 1, and back."""

HALF = (1 + OVERLAP) / 2
"""Share of the splat's area that each half fills."""


class Scores(NamedTuple):
    """What views say of n fans."""

    error: np.ndarray
    """(n,) sum of the error in the pixels of each fan, by its share in them, without the view that has most:
    an error that one view sees is that view's."""
    most_pixels: np.ndarray
    """(n,) largest contribution to any view, in pixels."""
    clear_share: np.ndarray
    """(n,) share of its pixels that are transparent in the photographs."""
    in_view: np.ndarray
    """(n,) bool: whether the centre lies in the image of any view."""
    image_pixels: int
    """Pixels of the largest image."""


def score(state: State, views: Sequence[View], turn: int = 0, fraction: float = 1.0) -> Scores:
    """Judges the fans of ``state`` in up to ``JUDGED_VIEWS`` of ``views``, others in each ``turn``, after
    ``fraction`` of the run."""
    mesh = state.result()
    corners = corners_of(mesh)
    n = fan_count(mesh)
    total, most, pixels = np.zeros(n), np.zeros(n), np.zeros(n)
    all_pixels, clear_pixels = np.zeros(n), np.zeros(n)
    in_view, largest = np.zeros(n, bool), 0
    triangles = mesh.triangles._replace(values=np.zeros((len(mesh.vertices), 3), np.float32))
    drawing = engine(state.device, state.threads)
    step = -(-len(views) // JUDGED_VIEWS)
    for index in range(turn % step, len(views), step):
        view = views[index]
        samples = samples_of(view, state.config, fraction)
        options = TapeOptions(view.background, samples, TRAINING_MIN_TRANSMITTANCE[mesh.blending])
        rendering = drawing.tape(triangles, view.camera, options)
        exposure = exposure_of(state, index)
        image = exposed(rendering.color, exposure)
        target = exposed_over(view.load(), view.background, exposure)
        counts = np.ones(image.shape[:2], np.float32)
        difference = np.square(image - target).sum(axis=2)
        if view.mask is not None:
            difference[~view.mask] = 0
            counts[~view.mask] = 0
        alpha = view.alpha
        clear = np.zeros_like(counts) if alpha is None else (1 - alpha) * counts
        sums = scatter_to_vertices(rendering, np.stack([difference, counts, clear], axis=2))
        error, count, outside = sums.reshape(n, corners, 3).sum(axis=1, dtype=np.float64).T
        total += error
        np.maximum(most, error, out=most)
        np.maximum(pixels, count, out=pixels)
        all_pixels += count
        clear_pixels += outside
        in_view |= view.camera.sees(mesh.vertices[::corners])
        largest = max(largest, counts.size)
    clear_share = clear_pixels / np.maximum(all_pixels, 1e-9)
    return Scores(total - most, pixels, clear_share, in_view, largest)


def corners_of(mesh: SplatMesh) -> int:
    """Vertices of each fan of a mesh of equal fans, which lie one after the other."""
    assert mesh.face_splat is not None
    return int(mesh.faces[mesh.face_splat == mesh.face_splat[0]].max()) + 1


def fan_count(mesh: SplatMesh) -> int:
    """Number of fans of such a mesh."""
    return len(mesh.vertices) // corners_of(mesh)


def grow(state: State, found: Scores, target: int) -> State:
    """Drops the fans that ``found`` has no use for, and halves those with the largest error until there are
    ``target``. A halved fan is never dropped: there may be fewer."""
    corners, n = corners_of(state.mesh), fan_count(state.mesh)
    opacity = state.colors[:, 3].reshape(n, corners).max(axis=1)
    hidden = (found.most_pixels < MIN_PIXELS) & (trained_pixels(state, found) < TRAINED_PIXELS)
    useless = hidden | (opacity < MIN_OPACITY) | (found.clear_share > CLEAR)
    keep = ~(found.in_view & useless)
    if SHELL in state.mesh.attributes:  # others see what is behind everything
        keep |= state.mesh.attributes[SHELL][::corners] > 0
    if not keep.any():
        keep[:] = True
    kept = np.flatnonzero(keep)
    able = kept[(found.most_pixels[kept] >= SMALLEST) & (found.error[kept] > 0)]
    wanted = min(max(target - len(kept), 0), len(able))
    halved = np.sort(able[np.argsort(-found.error[able], kind="stable")][:wanted])
    grown = select_fans(state, kept, halved)
    grown.mesh = replace(grown.mesh, attributes={**grown.mesh.attributes, SEEN: grown.squares()})
    return grown


def trained_pixels(state: State, found: Scores) -> np.ndarray:
    """(n,) about how many pixels the steps since the last event have seen of each fan, a root of squares: by
    the gradients of its colours, which are those of a pixel times its pixels. Squares are never subtracted,
    as they forget: they only tell the fans that no step has reached."""
    squares, before = state.squares(), state.mesh.attributes.get(SEEN)
    if before is not None:
        squares[squares == before] = 0
    of_pixel = max(1 - state.config.ssim_weight, 0.01) / (3 * found.image_pixels)
    found_pixels: np.ndarray = np.sqrt(squares).reshape(fan_count(state.mesh), -1).sum(axis=1) / of_pixel
    return found_pixels


class NearFields(NamedTuple):
    """The space right in front of the cameras, where nothing may float."""

    cameras: tuple[Camera, ...]
    depths: np.ndarray
    """(views,) depth of the near field of each camera, scene units."""

    @classmethod
    def around(cls, views: Sequence[View], mesh: SplatMesh) -> NearFields:
        """Those of ``views`` for a scene that ``mesh``, its fans at the start, shows roughly: ``NEAR`` times
        the depth before which a ``FRONT`` of the area that all fans have in an image lies. Fans behind walls
        are many, but small in the image; one right in front of the lens counts as ``LARGEST`` of it."""
        fans = mesh.vertices.reshape(fan_count(mesh), -1, 3)
        centers, areas = fans[:, 0], fans.var(axis=1).sum(axis=1)
        depths = np.zeros(len(views))
        for i, view in enumerate(views):
            positions, depth = view.camera.project(centers)
            shown = np.flatnonzero(view.camera.in_image(positions))
            if len(shown):
                order = shown[np.argsort(depth[shown], kind="stable")]
                whole = view.camera.width * view.camera.height / (view.camera.fx * view.camera.fy)
                shares = areas[order] / np.square(depth[order]) / whole
                sums = np.cumsum(np.minimum(shares, LARGEST), dtype=np.float64)
                depths[i] = NEAR * float(depth[order][np.searchsorted(sums, FRONT * sums[-1])])
        return cls(tuple(view.camera for view in views), depths)

    def contain(self, mesh: SplatMesh) -> np.ndarray:
        """(n,) bool: the fans whose centre lies in the near field of a camera."""
        centers = mesh.vertices[:: corners_of(mesh)]
        inside = np.zeros(len(centers), bool)
        for camera, limit in zip(self.cameras, self.depths, strict=True):
            axis = camera.world_to_camera[2].astype(np.float32)
            depth = centers @ axis[:3] + axis[3]
            rows = np.flatnonzero((depth > 0) & (depth < limit))
            if len(rows):
                # The near plane is as near as it gets here: what it cuts off floats there, too.
                closest = replace(camera, near=min(camera.near or np.inf, 1e-3 * float(limit)))
                inside[rows] |= closest.sees(centers[rows])
        return inside


def select_fans(state: State, kept: np.ndarray, halved: np.ndarray | None = None) -> State:
    """The state with the fans ``kept``, of which each of ``halved`` becomes two; both ascending indices."""
    halved = np.zeros(0, np.int64) if halved is None else halved
    mesh, corners = state.mesh, corners_of(state.mesh)
    sides = len(mesh.faces) // (len(mesh.vertices) // corners)
    source = np.concatenate([kept, halved])
    n = len(source)
    rows = (source[:, None] * corners + np.arange(corners)).ravel()
    positions = state.vertices[rows].reshape(n, corners, 3)
    sizes = state.sizes[rows].reshape(n, corners)
    colors = state.colors[rows].reshape(n, corners, 4)
    place = np.searchsorted(kept, halved)
    if len(halved):
        whole, tints = positions[place], colors[place, :, :3]
        added = np.arange(len(kept), n)
        for where, half in zip((place, added), split_in_halves(whole), strict=True):
            positions[where] = half
            colors[where, :, :3] = colors_at(whole, tints, half)
        sizes[place] *= np.sqrt(np.float32(HALF))
        sizes[len(kept) :] = sizes[place]
    faces = mesh.faces[:sides] + corners * np.arange(n, dtype=np.int32)[:, None, None]
    arrays = mesh.rows(vertex=rows, splat=source) | {
        "vertices": positions.reshape(-1, 3),
        "faces": faces.reshape(-1, 3),
        "colors": colors.reshape(-1, 4),
        "face_splat": np.repeat(np.arange(n, dtype=np.int32), sides),
    }
    if state.harmonics is not None:  # both halves inherit them as they are now
        arrays["harmonics"] = state.harmonics[source]
    grown = replace(mesh, **arrays)
    result = state.rebuild(grown, rows, sizes.ravel())
    fresh = np.concatenate([place, np.arange(len(kept), n)])
    result.restart((fresh[:, None] * corners + np.arange(corners)).ravel())
    return result


def colors_at(fans: np.ndarray, colors: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, m, c) float32 values that fans with vertices (n, k, 3), centre first, and ``colors`` (n, k, c) have
    at ``points`` (n, m, 3), by barycentric weights in the triangle nearest to each."""
    center = fans[:, :1].astype(np.float64)
    first = fans[:, 1:] - center
    second = np.roll(first, -1, axis=1)
    offset = points - center
    a, b, c = (
        np.einsum("nsi,nsi->ns", *pair)[:, None]
        for pair in ((first, first), (first, second), (second, second))
    )
    along = np.einsum("nmi,nsi->nms", offset, first), np.einsum("nmi,nsi->nms", offset, second)
    area = np.maximum(a * c - b * b, 1e-30)
    u, v = (c * along[0] - b * along[1]) / area, (a * along[1] - b * along[0]) / area
    weights = np.stack([1 - u - v, u, v], axis=-1)
    sector = weights.min(axis=-1).argmax(axis=-1)
    weights = np.take_along_axis(weights, sector[..., None, None], axis=2)[:, :, 0]
    weights = np.clip(weights, 0, 1)
    weights /= weights.sum(axis=-1, keepdims=True)
    rim = np.stack([sector + 1, (sector + 1) % first.shape[1] + 1], axis=-1)
    corners = np.concatenate([np.zeros_like(rim[..., :1]), rim], axis=-1)
    found = np.take_along_axis(colors[:, None], corners.reshape(len(fans), 1, -1, 1), axis=2)
    found = found.reshape(*corners.shape, colors.shape[2])
    return np.einsum("nmk,nmkc->nmc", weights, found).astype(np.float32)


def split_in_halves(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of two halves, (n, k, 3) float32 each, of every splat with vertices ``positions``.

    ``positions`` is (n, k, 3). The halves lie side by side along the splat's longest axis and overlap a
    little.
    """
    exact = positions.astype(np.float64)
    offset = exact - exact.mean(axis=1, keepdims=True)
    axis = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 2]
    along = np.einsum("nki,ni->nk", offset, axis)
    narrower = exact - (1 - HALF) * along[..., None] * axis[:, None]
    shift = (1 - HALF) * np.abs(along).max(axis=1)[:, None, None] * axis[:, None]
    return (narrower + shift).astype(np.float32), (narrower - shift).astype(np.float32)
