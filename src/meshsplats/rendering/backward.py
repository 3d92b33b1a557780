"""Pictures with a way back: from gradients of a picture to those of the mesh, on NumPy arrays."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from meshsplats._core import library
from meshsplats.camera import Camera
from meshsplats.mesh import checked_filter
from meshsplats.rendering.api import MIN_TRANSMITTANCE, Alive, camera_struct, checked_options, compact_groups

TAPE_BYTES = 128 << 20
"""Most memory that the log of one picture takes: about two bytes for each fragment. Going back, tiles whose
log did not fit are drawn once more."""


class TapedRendering:
    """A picture of a mesh, drawn as ``render`` draws it, with a log of what was blended."""

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        colors: np.ndarray,
        attributes: np.ndarray | None,
        camera: Camera,
        *,
        background: Sequence[float] | np.ndarray = (1, 1, 1),
        world_to_camera: np.ndarray | None = None,
        face_splat: np.ndarray | None = None,
        depth_group: np.ndarray | None = None,
        filter_px2: float = 0.0,
        samples: int = 1,
        min_transmittance: float = MIN_TRANSMITTANCE,
        threads: int | None = None,
        tape_bytes: int | None = TAPE_BYTES,
    ) -> None:
        """Arrays are those of a ``SplatMesh``, C-contiguous, float32 and int32, and are kept, not copied:
        they must not change until ``back`` is called. ``attributes`` are (v, k); ``world_to_camera`` (4, 4)
        takes the place of the camera's; without ``tape_bytes`` the picture is drawn faster and there is no
        way back."""
        keep = self._keep = Alive()
        self._options = checked_options(keep, camera, background, samples, threads)
        self._options.min_transmittance = min_transmittance
        self._camera = camera_struct(camera)
        if world_to_camera is not None:
            self._camera.world_to_camera = (library.c_double * 12)(*world_to_camera[:3].ravel())
        width = 0 if attributes is None else attributes.shape[1]
        self._mesh = library.MeshStruct(
            vertex_count=len(vertices),
            face_count=len(faces),
            vertices=keep(vertices),
            colors=keep(colors),
            faces=keep(faces),
            face_splat=keep(face_splat),
            depth_group=keep(compact_groups(depth_group)),
            normals=None,
            attributes=keep(attributes if width else None),
            attribute_count=width,
            filter_px2=checked_filter(filter_px2, face_splat),
        )
        h, w = camera.height, camera.width
        self.color = np.empty((h, w, 3), np.float32)
        self.alpha = np.empty((h, w), np.float32)
        self.attributes = np.empty((h, w, width), np.float32)
        picture = library.ImageStruct(
            keep(self.color), keep(self.alpha), None, None, keep(self.attributes if width else None), 0
        )
        self._log = ctypes.c_void_p()
        if tape_bytes is None:
            library.call("ms_render_mesh", self._mesh, self._camera, self._options, picture)
        else:
            library.call(
                "ms_rasterize",
                self._mesh,
                self._camera,
                self._options,
                picture,
                tape_bytes,
                ctypes.byref(self._log),
            )
        self.fragments = int(picture.fragments)

    @property
    def vertex_count(self) -> int:
        return self._mesh.vertex_count

    def __del__(self) -> None:
        if getattr(self, "_log", None):
            library.load_core().ms_free_tape(self._log)
            self._log = ctypes.c_void_p()

    def back(
        self,
        color: np.ndarray,
        alpha: np.ndarray | None,
        attributes: np.ndarray | None,
        *,
        vertices: np.ndarray,
        colors: np.ndarray,
        vertex_attributes: np.ndarray | None = None,
    ) -> None:
        """Adds to ``vertices`` (v, 3), ``colors`` (v, 4) and ``vertex_attributes`` (v, k) the gradients that
        follow from those of the picture's ``color`` (h, w, 3), ``alpha`` (h, w) and ``attributes`` (h, w, k).
        All float32, C-contiguous.

        Which triangles a sample sees and in which order is constant. The gradient of an opacity a of 1 is
        that of what is behind it. The result has the same bits with any number of threads.
        """
        if not self._log:
            raise ValueError("the picture was drawn without a log: there is no way back")
        if attributes is not None and not self._mesh.attribute_count:
            attributes = None
        given = library.ImageGradientsStruct(
            library.pointer(color), library.pointer(alpha), library.pointer(attributes)
        )
        out = library.VertexGradientsStruct(
            library.pointer(vertices),
            library.pointer(colors),
            None if attributes is None else library.pointer(vertex_attributes),
        )
        library.call("ms_rasterize_backward", self._mesh, self._camera, self._options, self._log, given, out)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(v, k) float32: for each vertex the sum of ``values`` (h, w, k) by the weights with which it is
        blended into the pixels. A picture made with k attributes, of any values: a weight is the derivative
        of the picture of an attribute by that attribute."""
        mesh = self._mesh
        sums = np.zeros((mesh.vertex_count, mesh.attribute_count), np.float32)
        self.back(
            np.zeros_like(self.color),
            None,
            np.ascontiguousarray(values, np.float32),
            vertices=np.zeros((mesh.vertex_count, 3), np.float32),
            colors=np.zeros((mesh.vertex_count, 4), np.float32),
            vertex_attributes=sums,
        )
        return sums


def shown_pixels(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    camera: Camera,
    *,
    mask: np.ndarray | None = None,
    samples: int = 1,
    face_splat: np.ndarray | None = None,
    depth_group: np.ndarray | None = None,
    filter_px2: float = 0.0,
    threads: int | None = None,
) -> np.ndarray:
    """(v,) float32 pixels that a picture shows of each vertex: sums of its blending weights, of pixels where
    ``mask``, (h, w) bool."""
    picture = TapedRendering(
        vertices,
        faces,
        colors,
        np.zeros((len(vertices), 1), np.float32),
        camera,
        face_splat=face_splat,
        depth_group=depth_group,
        filter_px2=filter_px2,
        samples=samples,
        threads=threads,
    )
    return picture.spread(np.ones_like(picture.attributes) if mask is None else mask[..., None])[:, 0]
