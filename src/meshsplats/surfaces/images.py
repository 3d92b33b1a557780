"""Images of a textured surface, opaque and unlit, with gradients for its vertices and its texture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import block_means
from meshsplats._common.kinds import need
from meshsplats._core.surfaces import (
    Samples,
    coordinate_gradients,
    relax_texels,
    texel_sums,
    texture_samples,
)
from meshsplats.formats.surfaces.corners import check_texture, opaque_pixels
from meshsplats.formats.surfaces.vertex_colors import texture_to_vertex_colors
from meshsplats.rendering import render
from meshsplats.rendering.backward import TAPE_BYTES, TapedRendering, TapeOptions
from meshsplats.rendering.edges import (
    Edged,
    FrontFaces,
    faces_across,
    index_digits,
    indices_of,
    motion_gradients,
)
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import Triangles

SAMPLES = 2
"""Samples along each side of a pixel."""
_MOST_TEXELS = 1 << 28
"""Numbers of a texture that is repeated, 1 GiB."""


class Surface(NamedTuple):
    """Triangles with a texture."""

    vertices: np.ndarray
    """(v, 3) float64."""
    faces: np.ndarray
    """(f, 3) int32."""
    uv: np.ndarray
    """(f, 3, 2) float32 texture coordinates of the corners, u to the right, v down."""
    texels: np.ndarray
    """(th, tw, 3) float32 display RGB."""
    across: np.ndarray | None = None
    """(f, 3) int32: ``faces_across`` of the faces, precomputed, for gradients."""


class SurfaceImage:
    """The image of a surface: the mean over ``SAMPLES`` x ``SAMPLES`` samples of each pixel."""

    color: np.ndarray
    """(h, w, 3) float32."""
    coverage: np.ndarray
    """(h, w) float32: the share of each pixel that shows the surface."""

    def __init__(
        self,
        surface: Surface,
        camera: Camera,
        background: np.ndarray,
        *,
        gradients: bool = True,
        threads: int | None = None,
    ) -> None:
        """Draws the image.

        Args:
            surface: its arrays are kept, not copied.
            camera: with a near plane.
            background: (3,) or (h, w, 3) float32.
            gradients: whether the image gets a backward pass.
        """
        self._surface, self._threads = surface, threads
        self._camera = fine = camera.scaled(SAMPLES)
        count = len(surface.faces)
        corners = Triangles(
            surface.vertices[surface.faces].reshape(-1, 3).astype(np.float32),
            np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
            np.tile(np.array([0, 0, 0, 1], np.float32), (3 * count, 1)),
            values=np.concatenate([surface.uv.reshape(-1, 2), index_digits(count)], axis=1, dtype=np.float32),
        )
        options, tape = TapeOptions(background=(0, 0, 0)), TAPE_BYTES if gradients else None
        self._image = TapedRendering(corners, fine, options, threads=threads, tape_bytes=tape)
        covered = self._image.alpha > 0.5
        attributes = self._image.attributes
        self._samples = Samples(np.ascontiguousarray(attributes[..., :2]), covered, SAMPLES)
        empty = np.asarray(background, np.float32)
        if empty.ndim == 3:
            empty = empty.repeat(SAMPLES, axis=0).repeat(SAMPLES, axis=1)
        self._colors = texture_samples(self._samples, surface.texels, empty, threads=threads)
        self.color, self.coverage = block_means(self._colors, SAMPLES), block_means(covered, SAMPLES)

    def vertex_gradients(self, gradient: np.ndarray) -> np.ndarray:
        """(v, 3) float64 gradient of a loss with respect to the vertices, of which ``gradient`` (h, w, 3)
        float32 is that with respect to the image: by the motion of the texture, and of visible edges."""
        surface, samples = self._surface, self._samples
        each = np.zeros((*gradient.shape[:2], 4), np.float32)
        each[..., :3] = gradient / SAMPLES**2
        attributes = np.zeros((*samples.covered.shape, 4), np.float32)
        attributes[..., :2] = coordinate_gradients(samples, surface.texels, each, threads=self._threads)
        count = 3 * len(surface.faces)
        moved = np.zeros((count, 3), np.float32)
        self._image.backward(
            np.zeros((*samples.covered.shape, 3), np.float32),
            None,
            attributes,
            vertices=moved,
            colors=np.zeros((count, 4), np.float32),
            vertex_attributes=np.zeros((count, 4), np.float32),
        )
        corners = surface.faces.ravel()
        total = [np.bincount(corners, moved[:, k], len(surface.vertices)) for k in range(3)]
        return np.stack(total, axis=1) + self._edges(gradient)

    def texel_sums(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(th, tw, 4) float32 sums of ``values`` (h, w, 3) times ``weight`` (h, w), and of the weights, of
        the pixels that show each texel, in samples."""
        each = _weighted(values, weight)
        return texel_sums(self._samples, self._surface.texels, each, threads=self._threads)

    def relax(
        self, error: np.ndarray, weight: np.ndarray, share: float, doubt: float, sums: np.ndarray
    ) -> None:
        """Takes off each texel, of the surface itself, ``share`` of the mean ``error`` (h, w, 3) of the
        samples that show it: a mean weighted by ``weight`` (h, w), with ``doubt`` more of a weight that has
        no error. ``sums`` (th, tw, 4) float32 is memory, overwritten."""
        each = _weighted(error, weight)
        texels = self._surface.texels
        relax_texels(self._samples, texels, each, sums, share=share, doubt=doubt, threads=self._threads)

    def _edges(self, gradient: np.ndarray) -> np.ndarray:
        """(v, 3) float64 gradient by the motion of visible edges."""
        surface = self._surface
        across = faces_across(surface.faces) if surface.across is None else surface.across
        opaque = np.ones((len(surface.vertices), 4), np.float32)
        front = FrontFaces(indices_of(self._image.attributes[..., 2:], self._samples.covered), self._colors)
        return motion_gradients(
            Edged(surface.vertices, surface.faces, opaque, across),
            self._camera,
            front,
            np.ascontiguousarray(gradient),
            0.5,
            threads=self._threads,
        )


def _weighted(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(h, w, 4) float32: ``values`` (h, w, 3) times ``weight`` (h, w), and the weights."""
    each = np.empty((*weight.shape, 4), np.float32)
    np.multiply(values, weight[..., None], out=each[..., :3])
    each[..., 3] = weight
    return each


def draw_surface(
    base: BaseMesh,
    camera: Camera,
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    threads: int | None = None,
) -> np.ndarray:
    """(h, w, 3) float32 image of an opaque mesh with one texture or with vertex colours, unlit: display RGB,
    the mean over 2 x 2 samples of each pixel. A texture with tints is drawn as vertex colours
    (``texture_to_vertex_colors``).

    Args:
        base: the mesh; grey where it has neither.
        camera: viewpoint, lens and size of the image.
        background: RGB, (3,) or (h, w, 3).
        threads: at most this many; all processors by default.

    Raises ValueError for a mesh with several textures, with a texture on some faces only, or with one that is
    repeated too often to be drawn: ``bind`` and ``render`` show these.
    """
    need(BaseMesh, base=base)
    need(Camera, camera=camera)
    check_texture(base)
    if base.textured and base.uv is not None and base.tints is None:
        surface = Surface(base.vertices.astype(np.float64), base.faces, *_unrolled(base))
        camera = camera.with_near_plane(base.vertices)
        behind = np.asarray(background, np.float32)
        return SurfaceImage(surface, camera, behind, gradients=False, threads=threads).color
    colored = texture_to_vertex_colors(base)
    if base.textured:
        colors = colored.colors.copy()
        colors[:, 3] = 1
        colored = replace(colored, colors=colors)
    return render(colored, camera, background=background, samples=SAMPLES, threads=threads).color


def _unrolled(base: BaseMesh) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates (f, 3, 2) float32 of ``base`` and texels (th, tw, 3), of its texture as far as the
    coordinates go: beyond its borders as it wraps. What repeats is left as it is, as it is drawn so."""
    assert base.uv is not None
    texture, texels = base.textures[0], opaque_pixels(base.textures[0])
    uv = base.uv.astype(np.float64)
    for axis, mode in enumerate(texture.wrap):
        side = texels.shape[1 - axis]
        along = uv[..., axis] * side
        first, last = int(np.floor(along.min() - 0.5)), int(np.floor(along.max() + 0.5))
        if mode == "repeat" or (first >= 0 and last < side):
            continue
        count = last - first + 1
        if count * texels.size // side > _MOST_TEXELS:
            raise ValueError(
                f"the texture is repeated too often to be drawn, from {'uv'[axis]} {along.min() / side:.3g}"
                f" to {along.max() / side:.3g}: render(bind(base, layers=1).mesh, camera) draws it"
            )
        texels = np.take(texels, Texture.wrapped(np.arange(first, last + 1), side, mode), axis=1 - axis)
        uv[..., axis] = (along - first) / count
    return uv.astype(np.float32), np.ascontiguousarray(texels)
