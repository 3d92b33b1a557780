"""Rendering with a backward pass: from image gradients to vertex gradients, on NumPy arrays."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from meshsplats._core import kernels, library, structures
from meshsplats.rendering.core_arguments import Pointers, camera_struct, checked_options, mesh_struct
from meshsplats.rendering.shading import Shading
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import MIN_TRANSMITTANCE, Triangles, checked_cutoff

TAPE_BYTES = 128 << 20
"""Largest size of the tape of one image, which takes about two bytes a fragment. The backward pass renders
tiles that did not fit once more."""


@dataclass(frozen=True)
class OpacityRamp:
    """A soft, differentiable alpha test in place of the hard one of ``render(mesh, camera, cutoff=...)``.

    The interpolated opacity a becomes ``clip(height + (a - cutoff) * k, 0, 1)`` with ``k = min(slope, 1 /
    (width |grad a|))``, where grad a is the gradient of a in the image, per pixel. Slope 1, height = cutoff
    and width 0 change nothing. Height 0.5, a large slope and width 1 give about the share of the pixel on the
    opaque side of the level set: what a depth buffer with many samples shows.
    """

    cutoff: float
    """Opacity c at which triangles will be cut, 0 to 1."""
    height: float = 0.5
    """Value at the cutoff, 0 to 1."""
    slope: float = 1e6
    """Greatest slope, above 0."""
    width: float = 1.0
    """Least width of the ramp in pixels, 0 or more."""
    leak: float = 0.0
    """Derivative that the backward pass uses where the ramp is 0 or 1, in place of 0."""

    def __post_init__(self) -> None:
        checked_cutoff(self.cutoff)
        if not (0 <= self.height <= 1 and self.slope > 0 and self.width >= 0 and self.leak >= 0):
            raise ValueError(f"not a ramp: {self}")


class ExpectedError(NamedTuple):
    """A further loss for the backward pass: ``sum_k T_k a_k |c_k - target|^2`` at each sample.

    The background is the last fragment. This is the expected square error of an image in which each fragment
    is opaque by a chance of its opacity a_k, and not there otherwise. It is linear in each opacity, so its
    minima lie at opacities of 0 and 1.
    """

    target: np.ndarray
    """(h, w, 3) float32 colours, finite."""
    weight: np.ndarray
    """(h, w) float32 weight of the loss in each pixel, which counts the mean over its samples."""


@dataclass(frozen=True, eq=False)
class TapeOptions:
    """Options of an image with a backward pass, as in ``render``."""

    background: Sequence[float] | np.ndarray = (1, 1, 1)
    samples: int = 1
    min_transmittance: float = MIN_TRANSMITTANCE
    pose: np.ndarray | None = None
    """(4, 4) float64 world to camera, overrides that of the camera."""
    ramp: OpacityRamp | None = None
    """Changes opacities."""
    listing: DrawOrder | None = None
    """Blend as viewers do that cull and do not sort, from a file with this order; in place of the order of
    the mesh."""


class TapedRendering:
    """The image that ``render`` gives, with a tape of the blended fragments for the backward pass."""

    def __init__(
        self,
        triangles: Triangles,
        camera: Camera,
        options: TapeOptions | None = None,
        *,
        threads: int | None = None,
        tape_bytes: int | None = TAPE_BYTES,
    ) -> None:
        """Runs the forward pass.

        Args:
            triangles: the mesh. Its arrays are kept, not copied, and must not change before ``backward``;
                normals are not used.
            camera: viewpoint, lens and size of the image.
            options: those of ``TapeOptions()`` by default.
            threads: at most this many; all processors by default.
            tape_bytes: limit on the size of the tape; None: no tape and no backward pass, which is faster.

        Raises ValueError for options out of range, and MemoryError where the scene does not fit.
        """
        options = options or TapeOptions()
        ramp, pose = options.ramp, options.pose
        self._tape = ctypes.c_void_p()
        keep = self._pointers = Pointers()
        self._options = checked_options(keep, camera, options.background, options.samples, threads)
        self._options.min_transmittance = options.min_transmittance
        if ramp is not None:
            if triangles.order == "splat" or options.listing is not None:
                raise ValueError(
                    "a ramp stands in for a cutoff, and cut triangles are for a depth buffer: render with"
                    " order='fragment'"
                )
            self._options.cutoff, self._options.ramp_height = ramp.cutoff, ramp.height
            self._options.ramp_slope, self._options.ramp_leak = ramp.slope, ramp.leak
            self._options.ramp_width = ramp.width * options.samples
        self._shading = None
        if triangles.harmonics is not None:
            self._shading = Shading(triangles, camera, pose, threads=threads)
            triangles = triangles._replace(colors=self._shading.colors, harmonics=None)
        self._camera = camera_struct(camera.with_near_plane(triangles.vertices, pose))
        if pose is not None:
            self._camera.world_to_camera = (ctypes.c_double * 12)(*pose[:3].ravel())
        triangles = triangles._replace(normals=None)
        if options.listing is not None:
            triangles = self._listed(triangles, options.listing, threads)
        self._mesh = mesh_struct(keep, triangles)
        if options.listing is not None:
            self._mesh.by_splat = 2
        width = self._mesh.attribute_count
        h, w = camera.height, camera.width
        self.color = np.empty((h, w, 3), np.float32)
        self.alpha = np.empty((h, w), np.float32)
        self.attributes = np.empty((h, w, width), np.float32)
        image = structures.ImageStruct(
            keep(self.color),
            keep(self.alpha),
            attributes=keep(self.attributes if width else None),
        )
        if tape_bytes is None:
            library.call("ms_render_mesh", self._mesh, self._camera, self._options, image)
        else:
            library.call(
                "ms_rasterize",
                self._mesh,
                self._camera,
                self._options,
                image,
                tape_bytes,
                ctypes.byref(self._tape),
            )
        self.fragments = int(image.fragments)

    def _listed(self, triangles: Triangles, order: DrawOrder, threads: int | None) -> Triangles:
        """``triangles`` as a viewer draws them, one after another."""
        if 2 * len(triangles.faces) != len(order.copies):
            raise ValueError(
                f"the order is of {len(order.copies) // 2:,} triangles, the mesh has {len(triangles.faces):,}"
            )
        if triangles.filter_px2:
            raise ValueError("viewers of files have no filter: an order of triangles needs filter_px2=0")
        shown = (triangles.vertices, triangles.faces, triangles.face_splat)
        faces, splats = kernels.listed_triangles(shown, (order.copies, order.starts), self._camera, threads)
        return triangles._replace(faces=faces, face_splat=splats, depth_group=None, order="fragment")

    @property
    def vertex_count(self) -> int:
        return self._mesh.vertex_count

    def __del__(self) -> None:
        if getattr(self, "_tape", None):
            library.load_core().ms_free_tape(self._tape)
            self._tape = ctypes.c_void_p()

    def backward(
        self,
        color: np.ndarray,
        alpha: np.ndarray | None,
        attributes: np.ndarray | None,
        *,
        vertices: np.ndarray,
        colors: np.ndarray,
        vertex_attributes: np.ndarray | None = None,
        harmonics: np.ndarray | None = None,
        expected: ExpectedError | None = None,
    ) -> None:
        """Runs the backward pass: adds vertex gradients to the arrays given.

        The fragments of a sample and their order count as constant. The gradient of an opacity of 1 takes
        account of the fragments behind it. The result has the same bits with any number of threads.

        Args:
            color: (h, w, 3) gradient of the image's colour.
            alpha, attributes: (h, w) and (h, w, k) gradients of those outputs, or None.
            vertices, colors, vertex_attributes: (v, 3), (v, 4) and (v, k), to be added to.
            harmonics: (s, k, 3), likewise, for triangles with harmonics; see ``Shading.backward``.
            expected: a further loss, whose gradient is added.

        The slope k of an ``OpacityRamp`` counts as constant, too. All arrays are float32 and C-contiguous.
        Raises ValueError for a rendering without a tape.
        """
        if not self._tape:
            raise ValueError("rendered without a tape (tape_bytes=None): no gradients are available")
        if attributes is not None and not self._mesh.attribute_count:
            attributes = None
        image_gradients = structures.ImageGradientsStruct(
            library.pointer(color),
            library.pointer(alpha),
            library.pointer(attributes),
            None if expected is None else library.pointer(expected.weight),
            None if expected is None else library.pointer(expected.target),
        )
        of_shaded = colors if self._shading is None else np.zeros_like(colors)
        vertex_gradients = structures.VertexGradientsStruct(
            library.pointer(vertices),
            library.pointer(of_shaded),
            None if attributes is None else library.pointer(vertex_attributes),
        )
        library.call(
            "ms_rasterize_backward",
            self._mesh,
            self._camera,
            self._options,
            self._tape,
            image_gradients,
            vertex_gradients,
        )
        if self._shading is not None:
            self._shading.backward(of_shaded, colors, harmonics)
