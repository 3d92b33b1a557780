"""Optimisation steps on the GPU: positions, colours and moments stay there, and only targets travel.

docs/webgpu-host.md describes the kernels.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from meshsplats.errors import DeviceError
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import MAX_COLOR, SplatMesh
from meshsplats.webgpu import kernels
from meshsplats.webgpu.device import Device
from meshsplats.webgpu.frames import Output
from meshsplats.webgpu.gradients import GRADIENTS, GradientRenderer, Tape, WindowLimit, gradient_pipeline
from meshsplats.webgpu.layout import find_splat_vertices, halves
from meshsplats.webgpu.settings import DrawSettings

DERIVATIVE_BYTES = 48
"""Bytes of the derivatives of SSIM in each pixel, the largest buffer of an image."""
SIDE = 16
"""Pixels along each side of a workgroup that compares images."""

_STORE_STEPS, _LOSS_STEPS = tuple(kernels.store_steps()), tuple(kernels.loss_steps())
_SHADE_STEPS = tuple(kernels.shade_steps())
_ROUND_STEPS = tuple(kernels.round_steps())
_ADAM_STEPS = (*kernels.filter_steps(), *kernels.adam_steps())
_window_steps = functools.lru_cache(maxsize=64)(kernels.window_steps)


class Moments(NamedTuple):
    """The moments of an optimiser, both (v, k) float32."""

    mean: np.ndarray
    square: np.ndarray


class Parameters(NamedTuple):
    """What steps change, and what they know of each vertex."""

    vertices: np.ndarray
    """(v, 3) float32 positions."""
    colors: np.ndarray
    """(v, 4) float32 RGBA."""
    position_moments: Moments
    color_moments: Moments
    units: np.ndarray | None = None
    """(v,) float32 factors of the learning rate of positions; None: 1."""
    transparent: np.ndarray | None = None
    """(v,) bool: vertices whose opacity stays 0 once it is 0; None: no vertex."""
    harmonics: np.ndarray | None = None
    """(s, k, 3) float32 of each splat; None: colours do not depend on the view."""
    harmonic_moments: Moments | None = None
    """Both (s, 3 k) float32."""


@dataclass(frozen=True)
class Rates:
    """What one step takes."""

    l1: float
    ssim: float
    l2: float
    """Derivatives of the loss with respect to the sums of |x - y|, SSIM, and (x - y)^2."""
    colors: float
    positions: float
    """Learning rates with Adam's bias corrections; 0: positions are fixed."""
    harmonics: float
    """The same of harmonics; 0: they are fixed."""
    opacity_kept: float
    """Share of its opacity that a vertex with a gradient keeps."""
    betas: tuple[float, float]
    epsilons: tuple[float, float]
    """Adam's, for colours and harmonics, and for positions."""


class Sums(NamedTuple):
    """Sums over the channels of the pixels that count, and whether the gradients are finite."""

    l1: float
    ssim: float
    l2: float
    finite: bool


def _pipeline(device: Device, kernel: str, output: Output, settings: DrawSettings, groups: bool) -> Any:
    if kernel in kernels.TRAINING_KERNELS:
        return device.pipeline(kernel, ("training",), kernels.training_source)
    return gradient_pipeline(device, kernel, output, settings, groups)


TRAINING = GRADIENTS._replace(pipeline=_pipeline, uniforms=GRADIENTS.uniforms | {"step", "rounding"})


def most_pixels(device: Device) -> int:
    """Most pixels of an image of a fused step."""
    return device.binding_limit // DERIVATIVE_BYTES


class Trainer:
    """A mesh whose positions, colours and moments are on a GPU.

    Args:
        device: the GPU.
        mesh: the triangles, without depth groups; its positions and colours are not used.
        start: where steps begin; copied.
        limit: of windows.

    Raises:
        MemoryError: a mesh that does not fit into the buffers of the device.
        DeviceError: a vertex with too many triangles.
    """

    def __init__(self, device: Device, mesh: SplatMesh, start: Parameters, limit: WindowLimit) -> None:
        self.mesh = mesh
        self._taping = GradientRenderer(device, mesh, TRAINING)
        self._frames = self._taping.frames
        self._limit = limit
        assert not self._frames.counts["groups"]
        count = len(mesh.vertices)
        self._frames.upload("vertices", start.vertices)
        self._frames.upload("base", start.colors)
        padded = np.zeros((count, 2, 4), np.float32)
        padded[:, 0, :3], padded[:, 1, :3] = start.position_moments
        self._frames.upload("position_moments", padded)
        self._frames.upload("color_moments", np.stack(start.color_moments, axis=1))
        traits = np.zeros((count, 2), np.float32)
        traits[:, 0] = 1 if start.units is None else start.units
        traits[:, 1] = 0 if start.transparent is None else start.transparent
        self._frames.upload("traits", traits)
        self._frames.counts["harmonic_splats"] = 0
        if start.harmonics is not None and start.harmonic_moments is not None:
            self._frames.counts["harmonic_splats"] = len(start.harmonics)
            self._frames.upload("harmonics", start.harmonics)
            self._frames.upload("harmonic_means", start.harmonic_moments.mean)
            self._frames.upload("harmonic_squares", start.harmonic_moments.square)
            self._frames.upload("splat_vertices", find_splat_vertices(mesh))
        self._frames.allocate("results", 64)
        self._frames.allocate("step", 112)
        self._frames.allocate("rounding", 16)

    def step(
        self,
        camera: Camera,
        settings: DrawSettings,
        target: np.ndarray,
        mask: np.ndarray | None,
        background: Sequence[float],
        rates: Rates,
    ) -> Sums:
        """Renders the mesh, compares the image with a target, and takes a step of Adam.

        Args:
            camera: of at most ``most_pixels`` pixels.
            settings: as in ``GradientRenderer.forward``.
            target: (h, w, 3) float32 RGB.
            mask: (h, w) bool, True where pixels count; None: all do.
            background: RGB behind the mesh.
            rates: of the loss and of Adam.

        Returns:
            The sums. If they or the gradients are not finite, nothing has changed.

        Raises:
            DeviceError: the GPU did not finish; nothing has changed.
            MemoryError: a single pixel does not fit.
        """
        with self._frames.lock:
            self._prepare(camera, settings, target, mask)
            tape = Tape(self.mesh.triangles, camera, settings)
            self._shade(tape)
            waiting = [(0, 0, camera.width, camera.height)]
            while waiting:
                area = waiting.pop()
                window = self._taping.mark_window(tape, area, self._limit)
                if window is None:
                    waiting += halves(area, settings.order)
                    continue
                tape.windows.append(window)
                self._write_step(tape, window.area, 0, background, rates, masked=mask is not None)
                self._run_for(_STORE_STEPS, tape, window.area)
            self._run_for(_LOSS_STEPS, tape, tape.windows[-1].area)
            self._frames.clear("gradients")
            for window in tape.windows:
                self._taping.mark_again(tape, window)
                counts = self._taping.make_room(tape, window)
                tiles, masked = counts["tiles"], mask is not None
                self._write_step(tape, window.area, tiles, background, rates, masked=masked)
                steps = _window_steps(window.rounds)
                self._frames.run(steps, "color", counts | self._image_counts(camera), window.settings)
            last = tape.windows[-1]
            counts = self._frames.begin(tape.part(last.area), last.settings)
            self._frames.run(_ADAM_STEPS, "color", counts, last.settings)
            words = self._frames.read("results", 32)
        if words[4]:
            raise DeviceError(
                f"the GPU did not finish a backward pass ({self._frames.device.name}): use device='cpu'"
            )
        l1, l2, ssim = (float(value) for value in words[:3].view(np.float32))
        return Sums(l1, ssim, l2, not words[5])

    def round_fans(self, polygon: np.ndarray, share: float) -> None:
        """Moves each fan, a centre and a rim of as many corners as ``polygon``, (n, 2), has, by a ``share``
        of the way towards an affine image of it."""
        corners = 1 + len(polygon)
        fans = len(self.mesh.vertices) // corners
        words = np.array([0, corners, fans, 0], np.uint32)
        words[:1].view(np.float32)[:] = share
        with self._frames.lock:
            self._frames.upload("polygon", np.asarray(polygon, np.float32))
            self._frames.write("rounding", words)
            self._frames.run(_ROUND_STEPS, "color", {"fans": fans}, DrawSettings())

    def fetch(self, into: Parameters) -> None:
        """Writes positions, colours and the moments of both into the arrays of ``into``."""
        count = len(self.mesh.vertices)
        vertices = self._read("vertices", 12 * count).reshape(count, 3)
        colors = self._read("base", 16 * count).reshape(count, 4)
        positions = self._read("position_moments", 32 * count).reshape(count, 2, 4)[..., :3]
        of_colors = self._read("color_moments", 32 * count).reshape(count, 2, 4)
        into.vertices[:], into.colors[:] = vertices, colors
        for known, found in ((into.position_moments, positions), (into.color_moments, of_colors)):
            known.mean[:], known.square[:] = found[:, 0], found[:, 1]
        if into.harmonics is not None and into.harmonic_moments is not None:
            for name, array in (
                ("harmonics", into.harmonics),
                ("harmonic_means", into.harmonic_moments.mean),
                ("harmonic_squares", into.harmonic_moments.square),
            ):
                array[:] = self._read(name, array.nbytes).reshape(array.shape)

    def _read(self, name: str, size: int) -> np.ndarray:
        return self._frames.read(name, size).view(np.float32)

    def _prepare(
        self, camera: Camera, settings: DrawSettings, target: np.ndarray, mask: np.ndarray | None
    ) -> None:
        """Makes room for an image, and uploads its target."""
        pixels = camera.width * camera.height
        assert pixels <= most_pixels(self._frames.device)
        self._frames.prepare(settings)
        self._frames.allocate("image", 16 * pixels)
        self._frames.allocate("image_gradient", 16 * pixels)
        self._frames.allocate("derivatives", DERIVATIVE_BYTES * pixels)
        groups = -(-camera.width // SIDE) * -(-camera.height // SIDE)
        self._frames.allocate("losses", 16 * groups)
        self._frames.allocate("target", 16 * pixels)
        self._frames.write("target", np.ascontiguousarray(target, np.float32))
        if mask is not None:
            self._frames.write("target", mask.astype(np.float32), 12 * pixels)

    def _shade(self, tape: Tape) -> None:
        """Finds the colours of a view, and puts them where they are blended from."""
        size = 16 * len(self.mesh.vertices)
        if self._frames.counts["harmonics"]:
            counts = self._frames.begin(tape.part((0, 0, 1, 1)), tape.settings)
            self._frames.run(_SHADE_STEPS, "color", counts, tape.settings)
        else:
            self._frames.copy("base", "values", 0, size)
        self._frames.copy("values", "projected", self._taping.values_at, size)

    @staticmethod
    def _image_counts(camera: Camera) -> dict[str, int]:
        return {"image_columns": camera.width, "image_rows": camera.height}

    def _run_for(self, steps: Sequence[dict[str, Any]], tape: Tape, area: tuple[int, int, int, int]) -> None:
        counts = self._frames.counts | self._image_counts(tape.camera)
        counts |= {"columns": area[2], "rows": area[3]}
        self._frames.run(steps, "color", counts, tape.settings)

    def _write_step(
        self,
        tape: Tape,
        area: tuple[int, int, int, int],
        tiles: int,
        background: Sequence[float],
        rates: Rates,
        *,
        masked: bool,
    ) -> None:
        """Writes the uniform ``Step`` of a window."""
        data = np.zeros(28, np.float32)
        words = data.view(np.uint32)
        camera = tape.camera
        words[:8] = camera.width, camera.height, *area, tape.settings.samples, tiles
        data[8:12] = *background, rates.epsilons[1]
        data[12:16] = rates.l1, rates.ssim, rates.l2, rates.epsilons[0]
        data[16:20] = rates.colors, rates.positions, 1 - rates.betas[0], 1 - rates.betas[1]
        data[20:22] = rates.harmonics, MAX_COLOR if self._frames.counts["harmonics"] else 1
        words[22:24] = masked, self._frames.counts["harmonic_splats"]
        data[24] = rates.opacity_kept
        self._frames.write("step", data)
