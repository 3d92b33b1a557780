"""Draws meshes on the GPU, in windows of the image. docs/webgpu-host.md describes the kernels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import numpy as np

from meshsplats.errors import DeviceError
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.order import Order
from meshsplats.webgpu import frames, kernels
from meshsplats.webgpu.device import Device
from meshsplats.webgpu.frames import MeshFrames, Output, Program, Work
from meshsplats.webgpu.layout import halves, tiles_of
from meshsplats.webgpu.settings import DrawSettings

_LIST_STEPS = {order: tuple(kernels.list_steps(order)) for order in get_args(Order)}
_RASTER_STEPS = tuple(kernels.raster_steps())
_AGAIN_STEPS = tuple(kernels.again_steps())


@dataclass
class Images:
    """Images of a mesh: sums over the fragments of each pixel, weighted as their colours are."""

    color: np.ndarray
    """(h, w, 3) float32, without the background."""
    transmittance: np.ndarray
    """(h, w) float32."""
    depth: np.ndarray | None = None
    normals: np.ndarray | None = None
    values: np.ndarray | None = None
    work: Work = field(default_factory=Work)


@dataclass(frozen=True)
class _Pass:
    """A walk through the lists of an image for another output than colour."""

    output: Output
    vertex_values: np.ndarray | None
    """(v, 4) float32: what is blended, and opacities; None: the depth."""
    image: np.ndarray
    """(h, w, c) float32, where it goes."""


def drawing_pipeline(
    device: Device, kernel: str, output: Output, settings: DrawSettings, groups: bool
) -> Any:
    """The pipeline of a kernel that draws."""
    blended: kernels.Output = "color" if output == "values" else output
    if kernel in ("raster", "raster_again"):
        queue = settings.queue if kernel == "raster" else settings.long_queue
        return device.pipeline(
            "raster",
            ("raster", queue, blended, groups, settings.order),
            lambda: kernels.raster_source(queue, output=blended, groups=groups, order=settings.order),
        )
    return device.pipeline(kernel, ("lists",), kernels.lists_source)


DRAWING = Program(drawing_pipeline)


def fits(device: Device, window: tuple[int, int, int, int], samples: int) -> bool:
    """Whether a frame may have the samples of a ``window`` (x, y, width, height)."""
    w, h = window[2] * samples, window[3] * samples
    most = min(frames.WINDOW_SAMPLES, device.binding_limit // 32)
    return w * h <= most and tiles_of(w) * tiles_of(h) <= kernels.MAX_TILES


class MeshRenderer:
    """A mesh on a GPU, for images.

    Raises:
        MemoryError: a mesh that does not fit.
    """

    def __init__(self, device: Device, mesh: SplatMesh) -> None:
        self.mesh = mesh
        self._frames = MeshFrames(device, mesh, DRAWING)

    def draw(
        self,
        camera: Camera,
        settings: DrawSettings,
        *,
        depth: bool = False,
        normals: bool = False,
        values: np.ndarray | None = None,
    ) -> Images:
        """Draws the mesh; arguments are those of ``rendering.render``, checked.

        Args:
            values: (v, c) float32 further values of the vertices to blend.

        Raises:
            DeviceError: the GPU did not finish.
            MemoryError: the scene does not fit.
            ValueError: two splats share a vertex, and there is a filter.
        """
        camera = camera.with_near_plane(self.mesh.vertices)
        h, w = camera.height, camera.width
        images = Images(np.zeros((h, w, 3), np.float32), np.ones((h, w), np.float32))
        images.depth = np.zeros((h, w), np.float32) if depth else None
        images.normals = np.zeros((h, w, 3), np.float32) if normals else None
        images.values = None if values is None else np.zeros((h, w, values.shape[1]), np.float32)
        if not len(self.mesh.faces):
            return images
        budgets = self._frames.device.budgets if settings.budget is None else (settings.budget,)
        with self._frames.lock:
            self._frames.prepare(settings)
            passes = list(self._passes(images, values))
            waiting = [(0, 0, w, h)]
            while waiting:
                window = waiting.pop()
                if not fits(self._frames.device, window, settings.samples):
                    waiting += halves(window, settings.order)
                    continue
                for budget in budgets:
                    try:
                        drawn = self._draw_window(
                            camera, window, replace(settings, budget=budget), images, passes
                        )
                        break
                    except DeviceError:
                        if budget == budgets[-1]:
                            raise
                if not drawn:
                    waiting += halves(window, settings.order)
            images.work.bytes = self._frames.bytes
        return images

    def _draw_window(
        self,
        camera: Camera,
        window: tuple[int, int, int, int],
        settings: DrawSettings,
        images: Images,
        passes: Sequence[_Pass],
    ) -> bool:
        """Draws a window; False if it has too many pairs."""
        x0, y0, w, h = window
        part = camera.window(x0, y0, w, h)
        counts = self._frames.begin(part, settings)
        work, most = images.work, min(kernels.MAX_PAIRS, self._frames.device.binding_limit // 8)
        while True:
            counters = self._frame("color", counts, settings, work)
            needed = int(counters[0])
            if needed <= self._frames.capacity:
                break
            if needed > most:
                return False
            self._frames.capacity = min(most, needed + needed // 4)
            counts = self._frames.begin(part, settings)
        work.add(counts["tiles"], counters)
        rows, columns = slice(y0, y0 + h), slice(x0, x0 + w)
        with self._frames.pixels(w, h, settings.samples) as pixels:
            images.color[rows, columns] = pixels[..., :3]
            images.transmittance[rows, columns] = pixels[..., 3]
        for one in passes:
            if one.vertex_values is not None:
                self._frames.upload("other_values", one.vertex_values)
            self._frame(one.output, counts, settings, None)
            channels = one.image.shape[2]
            with self._frames.pixels(w, h, settings.samples) as pixels:
                one.image[rows, columns] = pixels[..., :channels]
        return True

    def _passes(self, images: Images, values: np.ndarray | None) -> Iterator[_Pass]:
        """The passes for the outputs besides colour."""
        if images.depth is not None:
            yield _Pass("depth", None, images.depth[:, :, None])
        alpha = self.mesh.colors[:, 3:]
        if images.normals is not None:
            known = self.mesh.normals
            of_vertex = self.mesh.vertices if known is None else known
            together = np.concatenate([of_vertex, alpha], axis=1, dtype=np.float32)
            yield _Pass("face_normals" if known is None else "vertex_normals", together, images.normals)
        if values is not None and images.values is not None:
            for first in range(0, values.shape[1], 3):
                some = values[:, first : first + 3]
                padding = np.zeros((len(some), 3 - some.shape[1]), np.float32)
                together = np.concatenate([some, padding, alpha], axis=1, dtype=np.float32)
                yield _Pass("values", together, images.values[:, :, first : first + some.shape[1]])

    def _frame(
        self, output: Output, counts: dict[str, int], settings: DrawSettings, work: Work | None
    ) -> np.ndarray:
        """Renders one frame to the samples, until all tiles are finished; returns the counters."""
        steps = (*_LIST_STEPS[settings.order], *_RASTER_STEPS) if output == "color" else _RASTER_STEPS
        return self._frames.repeat(steps, _AGAIN_STEPS, output, counts, settings, work)[1]
