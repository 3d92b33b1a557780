"""Shading: the vertex colours in a view, where splats have spherical harmonics, and its backward pass.

It comes before rasterisation, so whatever draws triangles knows no harmonics.
"""

from __future__ import annotations

from ctypes import c_double
from dataclasses import replace

import numpy as np

from meshsplats._core import library
from meshsplats._core.structures import ShadingStruct
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh, Triangles


def camera_center(camera: Camera, pose: np.ndarray | None = None) -> np.ndarray:
    """(3,) float64 centre of ``camera``, or of the same camera with the world to camera ``pose`` (4, 4)."""
    if pose is None:
        return camera.center
    return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


class Shading:
    """Vertex colours as a camera sees them.

    Concretely, vertex i of splat s has the display colour ``max(0, colors[i, :3] + B @ harmonics[s])``, where
    B are real spherical harmonics of degree 1 and more (``sh_basis(d, degree)[1:]``) in the unit direction d
    from the camera's centre to the vertex. Opacities stay.

    Attributes:
        colors: (v, 4) float32.
    """

    def __init__(
        self,
        triangles: Triangles,
        camera: Camera,
        pose: np.ndarray | None = None,
        *,
        threads: int | None = None,
    ) -> None:
        """``triangles`` with harmonics, whose splats share no vertices, and which are kept, not copied.

        Raises ValueError for another number of splats than harmonics have rows.
        """
        assert triangles.harmonics is not None
        assert triangles.face_splat is not None
        self._triangles = triangles
        self.colors = np.empty_like(triangles.colors)
        count, terms, _ = triangles.harmonics.shape
        self._struct = ShadingStruct(
            vertex_count=len(triangles.vertices),
            face_count=len(triangles.faces),
            splat_count=count,
            terms=terms,
            threads=threads or library.processors(),
            vertices=library.pointer(triangles.vertices),
            colors=library.pointer(triangles.colors),
            faces=library.pointer(triangles.faces),
            face_splat=library.pointer(triangles.face_splat),
            harmonics=library.pointer(triangles.harmonics),
            eye=(c_double * 3)(*camera_center(camera, pose)),
            shaded=library.pointer(self.colors),
        )
        library.run("ms_shade", self._struct)

    def backward(self, gradient: np.ndarray, colors: np.ndarray, harmonics: np.ndarray | None) -> None:
        """Adds the gradients of ``triangles.colors`` and ``.harmonics`` to (v, 4) ``colors`` and, where it is
        given, (s, k, 3) ``harmonics``, for the (v, 4) ``gradient`` of the shaded colours; all float32,
        C-contiguous.

        Directions count as constant. Where a colour is held at 0, only a gradient that raises it counts. The
        result has the same bits with any number of threads.
        """
        self._struct.gradient = library.pointer(gradient)
        self._struct.color_gradient = library.pointer(colors)
        self._struct.harmonic_gradient = library.pointer(harmonics)
        library.run("ms_shade_backward", self._struct)


def shaded(
    triangles: Triangles, camera: Camera, pose: np.ndarray | None = None, *, threads: int | None = None
) -> Triangles:
    """``triangles`` with the colours that ``camera`` sees, and no harmonics; the same where it has none."""
    if triangles.harmonics is None:
        return triangles
    colors = Shading(triangles, camera, pose, threads=threads).colors
    return triangles._replace(colors=colors, harmonics=None)


def seen_from(mesh: SplatMesh, camera: Camera, *, threads: int | None = None) -> SplatMesh:
    """``mesh`` with the colours that ``camera`` sees, the same from everywhere."""
    if mesh.harmonics is None:
        return mesh
    return replace(mesh, colors=shaded(mesh.triangles, camera, threads=threads).colors, harmonics=None)
