"""The engine of the GPU: WebGPU. What it cannot do is said here, and in docs/webgpu.md."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from meshsplats._core.kernels import regular_polygon
from meshsplats.errors import DeviceError
from meshsplats.rendering.backward import TAPE_BYTES, ExpectedError, TapeOptions
from meshsplats.rendering.core_arguments import Pointers, checked_options
from meshsplats.rendering.engine import Drawn, ImageOptions, Need
from meshsplats.rendering.shading import Shading
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh, Triangles, checked_filter
from meshsplats.webgpu.device import open_device
from meshsplats.webgpu.frames import WINDOW_SAMPLES
from meshsplats.webgpu.gradients import (
    GradientRenderer,
    WindowLimit,
    changing_mesh,
    check_limits,
    harmonics_fit,
)
from meshsplats.webgpu.renderer import Images, MeshRenderer
from meshsplats.webgpu.settings import DrawSettings
from meshsplats.webgpu.training import Parameters, Rates, Sums, Trainer, most_pixels

CANNOT: Mapping[Need, str] = {
    "cutoff": "opacity 'cutoff' needs device 'cpu': the GPU has no gradients for a cutoff",
    "file order": "order 'file' needs device 'cpu': the GPU draws sorted fragments and splats alone",
}
"""What is refused, and how."""
NOT_FUSED: frozenset[Need] = frozenset(
    (
        "base mesh",
        "exposure",
        "linear light",
        "frozen",
        "depth groups",
        "loss",
        "dropout",
    )
)
"""Needs that fused steps do not support. Such runs compute the loss and the update themselves, with images
and gradients from here; so do those with images of more than ``most_pixels`` pixels, or with harmonics that
do not fit. Meshes that do not fit are in ``gradients.check_limits``."""


class GpuEngine:
    """Draws on the best GPU of this machine. The last mesh that was drawn stays there, and so do the last
    triangles with gradients."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._drawing: MeshRenderer | None = None
        self._drawn: tuple[np.ndarray | None, ...] = ()
        """Copies of what ``_drawing`` has on the GPU."""
        self._taping: GradientRenderer | None = None
        self._taped: tuple[np.ndarray | None, ...] = ()
        """Copies of the triangles of ``_taping``."""

    def check(self, needs: Collection[Need] = (), mesh: SplatMesh | None = None) -> None:
        for need in needs:
            if need in CANNOT:
                raise ValueError(CANNOT[need])
        device = open_device()
        if mesh is not None:
            check_limits(device, mesh)

    def render(self, mesh: SplatMesh, camera: Camera, options: ImageOptions) -> Drawn:
        if options.median_depth:
            raise ValueError("median_depth needs device 'cpu'")
        settings = DrawSettings(
            samples=options.samples,
            max_layers=options.max_layers,
            min_transmittance=options.min_transmittance,
            cutoff=-1.0 if options.cutoff is None else options.cutoff,
            filter_px2=options.filter_px2,
            order=options.order,
        )
        with self.errors():
            drawn = self.renderer_of(mesh).draw(
                camera, settings, depth=options.depth, normals=options.normals, values=options.values
            )
        add_background(drawn, np.asarray(options.background, np.float32))
        return Drawn(
            drawn.color,
            1 - drawn.transmittance,
            drawn.depth,
            drawn.normals,
            drawn.values,
            None,
            drawn.work.fragments,
        )

    def tape(
        self,
        triangles: Triangles,
        camera: Camera,
        options: TapeOptions | None = None,
        *,
        tape_bytes: int | None = TAPE_BYTES,
        limit: WindowLimit | None = None,
    ) -> GpuRendering:
        """``Engine.tape``. The tape lies on the GPU, whatever ``tape_bytes`` is.

        Args:
            limit: of windows; by default that of all images of these triangles that have none.
        """
        return GpuRendering(self, triangles, camera, options or TapeOptions(), limit)

    def session(self, mesh: SplatMesh) -> GpuSession:
        return GpuSession(self, mesh)

    @contextlib.contextmanager
    def errors(self) -> Iterator[None]:
        """Turns the errors of wgpu into MemoryError and DeviceError, and opens the device anew afterwards.

        Raises MissingDependencyError at once if there is no wgpu or no GPU, and DeviceError in a process that
        was forked from the one that opened the device.
        """
        open_device().check_process()
        import wgpu

        try:
            yield
        except wgpu.GPUError as error:
            self.forget()
            open_device.cache_clear()  # it may be lost
            if isinstance(error, MemoryError):
                raise MemoryError(f"the GPU has too little memory: {error}") from None
            raise DeviceError(f"the GPU failed: {error}") from None

    def forget(self) -> None:
        """Frees the meshes on the GPU."""
        with self._lock:
            self._drawing = self._taping = None
            self._drawn = self._taped = ()

    def renderer_of(self, mesh: SplatMesh) -> MeshRenderer:
        """The renderer of ``mesh``: that of the last call if it was for the same mesh, and nobody has written
        into its arrays since. To compare them takes a fifth of the time of sending them."""
        arrays = (mesh.vertices, mesh.faces, mesh.colors, mesh.face_splat, mesh.depth_group, mesh.harmonics)
        with self._lock:
            known = self._drawing
            if known is None or known.mesh is not mesh or not all(map(_same, self._drawn, arrays)):
                known = self._drawing = None  # frees its buffers first
                known = self._drawing = MeshRenderer(open_device(), mesh)
                self._drawn = _copies(arrays)
            return known

    def gradients_of(self, triangles: Triangles) -> GradientRenderer:
        """The renderer of ``triangles``, wherever their vertices lie: that of the last call if they are the
        same."""
        device = open_device()
        arrays = (triangles.faces, triangles.face_splat, triangles.depth_group)
        with self._lock:
            known = self._taping
            if (
                known is None
                or known.device is not device
                or len(known.mesh.vertices) != len(triangles.vertices)
                or known.mesh.order != triangles.order
                or not all(map(_same, self._taped, arrays))
            ):
                known = self._taping = None  # frees its buffers first
                known = self._taping = GradientRenderer(device, changing_mesh(triangles))
                self._taped = _copies(arrays)
            return known


def add_background(images: Images, background: np.ndarray) -> None:
    """Puts a ``background``, float32 RGB (3,) or (h, w, 3), behind the colours of images."""
    if background.any():
        for channel in range(3):
            images.color[..., channel] += images.transmittance * background[..., channel]


@functools.lru_cache(maxsize=1)
def gpu_engine() -> GpuEngine:
    """The engine of this process."""
    return GpuEngine()


def _copies(arrays: Sequence[np.ndarray | None]) -> tuple[np.ndarray | None, ...]:
    return tuple(None if part is None else part.copy() for part in arrays)


def _same(one: np.ndarray | None, two: np.ndarray | None) -> bool:
    return one is two or (one is not None and two is not None and np.array_equal(one, two))


class GpuRendering:
    """The image that ``render(device="gpu")`` gives, with a backward pass.

    Fragments are those of ``backward.TapedRendering``. The tape stays on the GPU until another image is
    rendered there; the backward pass then renders this one again.

    Attributes:
        color: (h, w, 3) float32 RGB over the background.
        alpha: (h, w) float32.
        attributes: (h, w, k) float32.
        fragments: count of blended fragments.
        tape: what the backward pass starts from.
    """

    def __init__(
        self,
        engine: GpuEngine,
        triangles: Triangles,
        camera: Camera,
        options: TapeOptions,
        limit: WindowLimit | None = None,
    ) -> None:
        """Runs the forward pass; see ``GpuEngine.tape``.

        Raises:
            ValueError: options out of range, a ramp; two splats that share a vertex, with a filter.
            MissingDependencyError: no GPU, or no library for it.
            DeviceError: the GPU failed, or did not finish.
            MemoryError: the scene does not fit.
        """
        if options.ramp is not None:
            raise ValueError(CANNOT["cutoff"])
        checked = checked_options(Pointers(), camera, options.background, options.samples, None)
        self._shading = None
        if triangles.harmonics is not None:
            self._shading = Shading(triangles, camera, options.pose)
            triangles = triangles._replace(colors=self._shading.colors, harmonics=None)
        self._engine = engine
        self._background = np.asarray(options.background, np.float32)
        self._matrix = camera.world_to_camera if options.pose is None else options.pose
        if triangles.values is not None and not triangles.values.shape[1]:
            triangles = triangles._replace(values=None)
        settings = DrawSettings(
            samples=checked.samples,
            min_transmittance=options.min_transmittance,
            filter_px2=checked_filter(triangles.filter_px2, triangles.face_splat),
            order=triangles.order,
        )
        with engine.errors():
            self._renderer = engine.gradients_of(triangles)
            images, self.tape = self._renderer.forward(
                triangles, camera, settings, pose=options.pose, limit=limit
            )
        add_background(images, self._background)
        self.color = images.color
        self.alpha = 1 - images.transmittance
        self.fragments = images.work.fragments
        none = np.zeros((camera.height, camera.width, 0), np.float32)
        self.attributes = none if images.values is None else images.values

    @property
    def vertex_count(self) -> int:
        return len(self.tape.triangles.vertices)

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

        Arguments are those of ``TapedRendering.backward``. The result has the same bits every time.

        Raises:
            ValueError: an expected error.
            DeviceError: the GPU failed, or did not finish.
        """
        if expected is not None:
            raise ValueError(CANNOT["cutoff"])
        behind = (color * self._background).sum(axis=2)
        if alpha is not None:
            behind -= alpha
        gradient = np.concatenate([color, behind[:, :, None]], axis=2, dtype=np.float32)
        with self._engine.errors():
            found, more = self._renderer.backward(
                self.tape, gradient, attributes if self.attributes.shape[2] else None
            )
        vertices += found[:, :3] @ self._matrix[:3, :3].astype(np.float32)
        if self._shading is None:
            colors += found[:, 4:]
        else:
            self._shading.backward(np.ascontiguousarray(found[:, 4:]), colors, harmonics)
        if more is not None and vertex_attributes is not None:
            vertex_attributes += more


class GpuSession:
    """A run on the GPU, where positions, colours and moments stay between fused steps.

    Attributes:
        limit: of its windows: rounding depends on them, so a resumed run has the same.
    """

    def __init__(self, engine: GpuEngine, mesh: SplatMesh) -> None:
        self.limit = WindowLimit()
        self._engine, self._mesh = engine, mesh
        self._trainer: Trainer | None = None

    def tape(self, triangles: Triangles, camera: Camera, options: TapeOptions) -> GpuRendering:
        return self._engine.tape(triangles, camera, options, limit=self.limit)

    def fused_steps(self, camera: Camera, needs: Collection[Need]) -> GpuSession | None:
        device = open_device()
        able = NOT_FUSED.isdisjoint(needs) and camera.width * camera.height <= most_pixels(device)
        return self if able and harmonics_fit(device, self._mesh) else None

    def step(
        self,
        now: Parameters,
        camera: Camera,
        options: TapeOptions,
        target: np.ndarray,
        mask: np.ndarray | None,
        rates: Rates,
    ) -> Sums:
        """``FusedSteps.step``."""
        settings = DrawSettings(
            samples=options.samples,
            min_transmittance=options.min_transmittance,
            filter_px2=self._mesh.filter_px2,
            order=self._mesh.order,
        )
        red, green, blue = map(float, options.background)
        with self._engine.errors():
            if self._trainer is None:
                self._trainer = Trainer(open_device(), self._mesh, now, self.limit)
            return self._trainer.step(camera, settings, target, mask, (red, green, blue), rates)

    def round_fans(self, corners: int, share: float) -> None:
        assert self._trainer is not None
        with self._engine.errors():
            self._trainer.round_fans(regular_polygon(corners - 1), share)

    def fetch(self, into: Parameters) -> None:
        assert self._trainer is not None
        with self._engine.errors():
            self._trainer.fetch(into)

    def release(self) -> None:
        self._trainer = None

    def arrays(self) -> dict[str, np.ndarray]:
        return {"window_samples": np.array(self.limit.samples, np.int64)}

    def resume(self, arrays: dict[str, np.ndarray]) -> None:
        found = arrays.get("window_samples")
        if found is None:  # begun on the processor
            return
        if found.shape != () or found.dtype != np.int64 or not 0 < found <= WINDOW_SAMPLES:
            raise ValueError(f"window_samples must be a whole number from 1 to {WINDOW_SAMPLES}, got {found}")
        self.limit.samples = int(found)
