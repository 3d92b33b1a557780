"""Rendering with a backward pass on the GPU, with the interface of ``backward.TapedRendering``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats.camera import Camera
from meshsplats.mesh import MIN_TRANSMITTANCE, Triangles, checked_filter
from meshsplats.rendering.api import Device, Pointers, checked_options
from meshsplats.rendering.backward import TAPE_BYTES, ExpectedError, OpacityRamp, TapedRendering
from meshsplats.webgpu.frames import DrawSettings
from meshsplats.webgpu.gradients import WindowLimit, gradient_renderer
from meshsplats.webgpu.renderer import gpu_errors


class GpuRendering:
    """The image that ``render(device="gpu")`` gives, with a backward pass.

    Fragments are those of ``backward.TapedRendering``. The tape stays on the GPU until another image is
    rendered there; the backward pass then renders this one again.

    Attributes:
        color: (h, w, 3) float32 RGB over the background.
        alpha: (h, w) float32.
        attributes: (h, w, k) float32.
        fragments: count of blended fragments.
        forward: what the backward pass starts from.
    """

    def __init__(
        self,
        triangles: Triangles,
        camera: Camera,
        *,
        background: Sequence[float] | np.ndarray = (1, 1, 1),
        world_to_camera: np.ndarray | None = None,
        samples: int = 1,
        min_transmittance: float = MIN_TRANSMITTANCE,
        limit: WindowLimit | None = None,
    ) -> None:
        """Runs the forward pass. Arguments are those of ``backward.TapedRendering``, and ``limit`` as in
        ``GradientRenderer.forward``.

        Raises:
            ValueError: options out of range; two splats that share a vertex, with a filter.
            MissingDependencyError: no GPU, or no library for it.
            DeviceError: the GPU failed, or did not finish.
            MemoryError: the scene does not fit.
        """
        options = checked_options(Pointers(), camera, background, samples, None)
        self._background = np.asarray(background, np.float32)
        self._matrix = camera.world_to_camera if world_to_camera is None else world_to_camera
        if triangles.values is not None and not triangles.values.shape[1]:
            triangles = triangles._replace(values=None)
        settings = DrawSettings(
            samples=options.samples,
            min_transmittance=min_transmittance,
            filter_px2=checked_filter(triangles.filter_px2, triangles.face_splat),
        )
        with gpu_errors():
            self._renderer = gradient_renderer(triangles)
            self.forward = self._renderer.forward(
                triangles, camera, settings, pose=world_to_camera, limit=limit
            )
        images = self.forward.images
        self.color = images.color + images.transmittance[:, :, None] * self._background
        self.alpha = 1 - images.transmittance
        self.fragments = images.work.fragments
        none = np.zeros((camera.height, camera.width, 0), np.float32)
        self.attributes = none if images.values is None else images.values

    @property
    def vertex_count(self) -> int:
        return len(self.forward.triangles.vertices)

    def backward(
        self,
        color: np.ndarray,
        alpha: np.ndarray | None,
        attributes: np.ndarray | None,
        *,
        vertices: np.ndarray,
        colors: np.ndarray,
        vertex_attributes: np.ndarray | None = None,
        expected: ExpectedError | None = None,
    ) -> None:
        """Runs the backward pass: adds vertex gradients to the arrays given.

        Arguments are those of ``TapedRendering.backward``. The result has the same bits every time.

        Raises:
            ValueError: an expected error.
            DeviceError: the GPU failed, or did not finish.
        """
        if expected is not None:
            raise ValueError("the expected error needs device='cpu'")
        behind = (color * self._background).sum(axis=2)
        if alpha is not None:
            behind -= alpha
        gradient = np.concatenate([color, behind[:, :, None]], axis=2, dtype=np.float32)
        with gpu_errors():
            found, more = self._renderer.backward(
                self.forward, gradient, attributes if self.attributes.shape[2] else None
            )
        vertices += found[:, :3] @ self._matrix[:3, :3].astype(np.float32)
        colors += found[:, 4:]
        if more is not None and vertex_attributes is not None:
            vertex_attributes += more


AnyRendering = TapedRendering | GpuRendering


def taped_rendering(
    device: Device,
    triangles: Triangles,
    camera: Camera,
    *,
    ramp: OpacityRamp | None = None,
    threads: int | None = None,
    tape_bytes: int | None = TAPE_BYTES,
    limit: WindowLimit | None = None,
    **options: Any,
) -> AnyRendering:
    """The rendering of a device, with its backward pass.

    Arguments are those of ``TapedRendering``; ``threads`` and ``tape_bytes`` are for the CPU, ``limit`` is
    for the GPU (see ``GpuRendering``).

    Raises:
        ValueError: an option out of range, or a ramp on the GPU.
    """
    if device == "cpu":
        return TapedRendering(triangles, camera, ramp=ramp, threads=threads, tape_bytes=tape_bytes, **options)
    if ramp is not None:
        raise ValueError("opacity ramps need device='cpu'")
    return GpuRendering(triangles, camera, limit=limit, **options)
