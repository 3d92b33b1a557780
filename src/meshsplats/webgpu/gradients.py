"""Gradients of meshes on the GPU: images with a tape, and their backward pass.

docs/webgpu-host.md describes the kernels.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import numpy as np

from meshsplats.errors import DeviceError
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh, Triangles
from meshsplats.scene.order import Order
from meshsplats.webgpu import frames, kernels
from meshsplats.webgpu.device import Device
from meshsplats.webgpu.frames import WINDOW_SAMPLES, MeshFrames, Output, Program, Work
from meshsplats.webgpu.layout import (
    FANS_IN_WORKGROUP,
    MAX_WORKGROUPS,
    check_count,
    check_fans,
    check_size,
    find_groups,
    halves,
)
from meshsplats.webgpu.renderer import DRAWING, Images, drawing_pipeline, fits
from meshsplats.webgpu.settings import DrawSettings

PAIR_BYTES = 100
"""Bytes of the marks of a pair, and of its places on the tape."""
FRAGMENT_BYTES = 16
SUM_BYTES = 64
"""Bytes of the sums of a triangle, over one tile or all."""
MAX_SUMS = 1 << 24
"""Sums of one window: their indices have 24 bits."""
MAX_FAN = 4096
"""Most triangles of a splat with a low-pass filter: one invocation goes through all of them nine times."""
MAX_VALENCE = 16_384
"""Most triangles at a vertex: one invocation adds them."""
ROWS = 32_768
"""Workgroups in each row of a dispatch that is larger than one dimension."""

_MARK_STEPS = {
    order: (*kernels.tile_steps(order), *kernels.mark_steps(), *kernels.place_steps())
    for order in get_args(Order)
}
"""Of colours that were shaded before: once for all windows, and where they are blended from."""
_MARK_AGAIN_STEPS = (*kernels.mark_again_steps(), *kernels.place_steps())
_FILTER_STEPS = tuple(kernels.filter_steps())
_gradient_steps = functools.lru_cache(maxsize=64)(kernels.gradient_steps)


@dataclass(frozen=True)
class Window:
    """A part of an image whose tape fits."""

    area: tuple[int, int, int, int]
    settings: DrawSettings
    rounds: int
    """Repetitions until all its tiles were finished."""
    fragments: int
    sums: int
    """Triangles with fragments, in all tiles."""
    tiles: int
    counters: np.ndarray


@dataclass(eq=False)
class Tape:
    """What the backward pass of an image starts from: the windows whose fragments it marks again. The arrays
    must not change."""

    triangles: Triangles
    camera: Camera
    settings: DrawSettings
    pose: np.ndarray | None = None
    """(4, 4) float64 world to camera; None: that of the camera."""
    windows: list[Window] = field(default_factory=list)
    work: Work = field(default_factory=Work)

    def part(self, area: tuple[int, int, int, int]) -> Camera:
        """The camera of a window."""
        return self.camera.window(*area)


@dataclass
class WindowLimit:
    """Most samples of the windows that are tried: one less than had too many fragments.

    The rounding of gradients depends on the windows. So a run whose bits are to be repeated has a limit of
    its own, which it keeps when it is resumed.
    """

    samples: int = WINDOW_SAMPLES


def harmonics_fit(device: Device, mesh: SplatMesh) -> bool:
    """Whether fused steps can have the harmonics of ``mesh`` and their moments on the GPU."""
    if mesh.harmonics is None:
        return True
    few = len(mesh.harmonics) <= MAX_WORKGROUPS * FANS_IN_WORKGROUP
    return few and mesh.harmonics.nbytes <= device.binding_limit


def check_limits(device: Device, mesh: SplatMesh) -> None:
    """Checks that gradients of ``mesh`` fit on the GPU.

    Raises:
        MemoryError: a mesh that does not fit into the buffers of the device.
        DeviceError: a vertex with too many triangles, or a splat with too many for the filter.
        ValueError: two splats share a vertex, and there is a filter.
    """
    vertices, faces = len(mesh.vertices), len(mesh.faces)
    groups = 0 if mesh.depth_group is None else len(np.unique(mesh.depth_group[mesh.depth_group >= 0]))
    check_size(device, "vertices", 16 * (2 * vertices + 2 * groups))
    check_count("vertices", vertices, 256)
    check_size(device, "triangles", SUM_BYTES * faces)
    check_size(device, "triangles", 4 * (vertices + 1 + 3 * faces))
    most = int(np.bincount(mesh.faces.ravel()).max(initial=0))
    if most > MAX_VALENCE:
        raise DeviceError(
            f"gradients on the GPU take vertices of up to {MAX_VALENCE:,} triangles; one has {most:,}."
            " Use device='cpu'"
        )
    if mesh.filter_px2 and faces:
        check_fans(mesh, MAX_FAN, filtered=True)
    if mesh.order == "splat":
        check_fans(mesh, frames.MAX_FAN, filtered=False)


def changing_mesh(triangles: Triangles) -> SplatMesh:
    """The mesh of a ``GradientRenderer`` for these triangles, wherever their vertices lie. Consecutive
    triangles of one splat have the same ``face_splat``, which need not ascend. Depth groups are left out
    where they have no effect, in the order of the splats."""
    face_splat, depth_group = triangles.face_splat, triangles.depth_group
    splat = None
    if face_splat is not None and len(face_splat):
        splat = np.cumsum(np.append(0, face_splat[1:] != face_splat[:-1])).astype(np.int32)
    vertices = len(triangles.vertices)
    return SplatMesh(
        np.zeros((vertices, 3), np.float32),
        triangles.faces.copy(),
        np.zeros((vertices, 4), np.float32),
        face_splat=splat,
        depth_group=None if depth_group is None or triangles.order == "splat" else depth_group.copy(),
        order=triangles.order,
    )


def _reserve(frames: MeshFrames, camera: Camera, settings: DrawSettings) -> None:
    """Room for the samples of an image, and for the marks of its fragments."""
    s = settings.samples
    frames.allocate("sums", 4 * (3 + frames.capacity // 2048))
    frames.allocate("samples", (32 * s * s + 16) * camera.width * camera.height)
    frames.allocate("counters", 64 + PAIR_BYTES * frames.capacity)
    for name in ("fragment_starts", "sum_starts", "marked"):
        frames.allocate(name, 4 * frames.capacity)
    frames.allocate("tape", FRAGMENT_BYTES)


def gradient_pipeline(
    device: Device, kernel: str, output: Output, settings: DrawSettings, groups: bool
) -> Any:
    """The pipeline of a kernel of images and their gradients."""
    if kernel in kernels.GRADIENT_KERNELS or kernel in ("tape", "tape_again"):
        queue = settings.long_queue if kernel == "tape_again" else settings.queue
        entry = "raster" if kernel in ("tape", "tape_again") else kernel
        return device.pipeline(
            entry,
            ("tape", queue, groups, settings.order),
            lambda: kernels.gradients_source(queue, groups=groups, order=settings.order),
        )
    if kernel == "widen_backward":
        return device.pipeline(kernel, ("filter",), kernels.filter_source)
    return drawing_pipeline(device, kernel, output, settings, groups)


GRADIENTS = Program(gradient_pipeline, _reserve, DRAWING.uniforms | {"modes"}, MAX_FAN)


class GradientRenderer:
    """A mesh on a GPU whose positions and colours change.

    Args:
        device: the GPU.
        mesh: the triangles; its positions and colours are not used.

    Raises:
        MemoryError: a mesh that does not fit into the buffers of the device.
        DeviceError: a vertex with too many triangles.
    """

    def __init__(self, device: Device, mesh: SplatMesh, program: Program = GRADIENTS) -> None:
        check_limits(device, mesh)
        self.mesh, self.device = mesh, device
        self.frames = MeshFrames(device, mesh, program)
        self.limit = WindowLimit()
        """Of windows, for images without one of their own."""
        self.marked: Tape | None = None
        """The tape whose only window is marked."""
        self._loaded: Tape | None = None  # whose positions and colours are on the GPU
        frames, counts = self.frames, self.frames.counts
        counts["run_columns"] = min(counts["runs"], ROWS)
        counts["run_rows"] = -(-counts["runs"] // ROWS)
        if not len(mesh.faces):
            return
        vertices = counts["vertices"] + 2 * counts["groups"]
        self.values_at = 16 * vertices
        """Byte of the buffer of projected vertices where what is blended begins."""
        corners = mesh.faces.ravel()
        starts = np.append(0, np.cumsum(np.bincount(corners, minlength=len(mesh.vertices))))
        parts = [starts, np.argsort(corners, kind="stable")]
        frames.allocate("projected", 16 * (vertices + len(mesh.vertices)))
        frames.allocate("gradients", 32 * len(mesh.vertices))
        frames.allocate("face_sums", SUM_BYTES * len(mesh.faces))
        frames.upload("vertex_corners", np.concatenate(parts).astype(np.uint32))
        modes = np.zeros((len(kernels.MODES), 64), np.uint32)
        modes[:, :4] = kernels.MODES
        frames.upload("modes", modes)

    # ---- Forward pass

    def forward(
        self,
        triangles: Triangles,
        camera: Camera,
        settings: DrawSettings,
        *,
        pose: np.ndarray | None = None,
        limit: WindowLimit | None = None,
    ) -> tuple[Images, Tape]:
        """Renders the mesh with these positions, colours and further values, and finds the windows of its
        tape.

        Args:
            triangles: those of the mesh, with other positions, colours and values.
            camera, settings: as in ``MeshRenderer.draw``; without ``max_layers`` and ``cutoff``.
            pose: (4, 4) float64 world to camera, overrides that of the camera.
            limit: of windows; by default that of all images of this renderer that have none.

        Returns:
            The images, and what ``backward`` takes.

        Raises:
            DeviceError: the GPU did not finish.
            MemoryError: a single pixel does not fit.
            ValueError: two splats share a vertex, and there is a filter.
        """
        camera = camera.with_near_plane(triangles.vertices, pose)
        h, w = camera.height, camera.width
        images = Images(np.zeros((h, w, 3), np.float32), np.ones((h, w), np.float32))
        values = triangles.values
        images.values = None if values is None else np.zeros((h, w, values.shape[1]), np.float32)
        tape = Tape(triangles, camera, settings, pose, work=images.work)
        if not len(self.mesh.faces):
            return images, tape
        with self.frames.lock:
            self._load(tape)
            waiting = [(0, 0, w, h)]
            while waiting:
                area = waiting.pop()
                window = self.mark_window(tape, area, limit or self.limit)
                if window is None:
                    waiting += halves(area, settings.order)
                    continue
                tape.windows.append(window)
                images.work.add(window.tiles, window.counters)
                part = np.s_[area[1] : area[1] + area[3], area[0] : area[0] + area[2]]
                with self.frames.pixels(area[2], area[3], settings.samples) as pixels:
                    images.color[part], images.transmittance[part] = pixels[..., :3], pixels[..., 3]
                if images.values is not None:
                    self._render_values(tape, window, images.values[part])
            images.work.bytes = self.frames.bytes
        return images, tape

    def _render_values(self, tape: Tape, window: Window, out: np.ndarray) -> None:
        """Blends the further values in place of the colours: the fragments and their marks are the same."""
        for columns, some in _triples(tape):
            self._load_values(some)
            self.try_mark(tape, window.area, window.settings)
            with self.frames.pixels(window.area[2], window.area[3], window.settings.samples) as pixels:
                out[..., columns] = pixels[..., : columns.stop - columns.start]
        self._load_values(tape.triangles.colors)

    def _load(self, tape: Tape) -> None:
        """Uploads positions and colours."""
        self._loaded, self.marked = None, None
        self.frames.prepare(tape.settings)
        self.frames.upload("vertices", tape.triangles.vertices)
        self.frames.upload("values", tape.triangles.colors)
        self._load_values(tape.triangles.colors)
        if self.frames.counts["groups"]:  # the plane of a group is that of its largest triangle
            moved = replace(self.mesh, vertices=tape.triangles.vertices)
            largest = find_groups(moved)[1]
            self.frames.write("mesh", largest, 4 * self.frames.offsets[2])
        self._loaded = tape

    def _load_values(self, values: np.ndarray) -> None:
        """Uploads what is blended: (v, 4) float32 colours and opacities."""
        self.frames.write("projected", np.ascontiguousarray(values), self.values_at)

    def mark_window(self, tape: Tape, area: tuple[int, int, int, int], limit: WindowLimit) -> Window | None:
        """``_mark``, which is left out for windows as large as one that had too many fragments."""
        samples = area[2] * area[3] * tape.settings.samples**2
        if samples > limit.samples and area[2:] != (1, 1):
            return None
        window = self._mark(tape, area)
        if window is None:
            limit.samples = samples - 1
        return window

    def _mark(self, tape: Tape, area: tuple[int, int, int, int]) -> Window | None:
        """Renders a window and marks its fragments; None if it has too many."""
        if not self._fits(area, tape.settings.samples):
            return None
        budgets = self.device.budgets if tape.settings.budget is None else (tape.settings.budget,)
        for budget in budgets:
            settings = replace(tape.settings, budget=budget)
            try:
                return self.try_mark(tape, area, settings)
            except DeviceError:
                if budget == budgets[-1]:
                    raise
        return None

    def _fits(self, window: tuple[int, int, int, int], samples: int) -> bool:
        size = window[2] * window[3] * (32 * samples**2 + 16)
        return size <= self.device.binding_limit and fits(self.device, window, samples)

    def try_mark(self, tape: Tape, area: tuple[int, int, int, int], settings: DrawSettings) -> Window | None:
        self.marked = None
        part = tape.part(area)
        most = min(kernels.MAX_PAIRS, (self.device.binding_limit - 64) // PAIR_BYTES)
        counts = self.frames.begin(part, settings, tape.pose)
        work = tape.work
        while True:
            rounds, counters = self.frames.repeat(
                _MARK_STEPS[settings.order], _MARK_AGAIN_STEPS, "color", counts, settings, work
            )
            needed = int(counters[0])
            if needed <= self.frames.capacity:
                break
            if needed > most:
                return None
            self.frames.capacity = min(most, needed + needed // 4)
            counts = self.frames.begin(part, settings, tape.pose)
        fragments, sums = int(counters[13]), int(counters[14])
        limit = self.device.binding_limit
        if FRAGMENT_BYTES * fragments > limit or SUM_BYTES * sums > limit or sums >= MAX_SUMS:
            return None
        window = Window(area, settings, rounds, fragments, sums, counts["tiles"], counters)
        if area[2:] == (tape.camera.width, tape.camera.height):
            self.marked = tape
        return window

    def mark_again(self, tape: Tape, window: Window) -> None:
        """Marks the fragments of a window of ``tape``, unless they are marked."""
        if self.marked is not tape and not self.try_mark(tape, window.area, window.settings):
            raise DeviceError(f"the GPU did not repeat its own image ({self.device.name})")

    # ---- Backward pass

    def backward(
        self, tape: Tape, gradient: np.ndarray, values: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The gradients of vertices.

        Args:
            tape: of ``forward``; its arrays have not changed.
            gradient: (h, w, 4) float32: of RGB without background, and of the background's share.
            values: (h, w, c) float32 gradient of the further values, or None.

        Returns:
            (v, 8) float32: of positions, in the axes of the camera, and 0; of RGB and opacity. And (v, c) of
            the further values, or None. The same bits every time.

        Raises:
            DeviceError: the GPU did not finish.
        """
        count = len(tape.triangles.vertices)
        more = None if values is None else np.zeros((count, values.shape[2]), np.float32)
        if not tape.windows:
            return np.zeros((count, 8), np.float32), more
        with self.frames.lock:
            if self._loaded is not tape:
                self._load(tape)
            result = self._add_windows(tape, gradient)
            if values is not None and more is not None:
                for columns, some in _triples(tape):
                    self._load_values(some)
                    part = np.zeros_like(gradient)
                    part[..., : columns.stop - columns.start] = values[..., columns]
                    found = self._add_windows(tape, part)
                    more[:, columns] = found[:, 4 : 4 + columns.stop - columns.start]
                    result[:, :3] += found[:, :3]
                    result[:, 7] += found[:, 7]
                self._load_values(tape.triangles.colors)
        return result, more

    def _add_windows(self, tape: Tape, gradient: np.ndarray) -> np.ndarray:
        """(v, 8) float32 gradients of what is blended now."""
        self.frames.clear("gradients")
        for window in tape.windows:
            self.mark_again(tape, window)
            self._add_window(tape, window, gradient)
        if tape.settings.filter_px2:
            last = tape.windows[-1]
            counts = self.frames.begin(tape.part(last.area), last.settings, tape.pose)
            self.frames.run(_FILTER_STEPS, "color", counts, last.settings)
        size = 32 * len(tape.triangles.vertices)
        return self.frames.read("gradients", size).view(np.float32).reshape(-1, 8)

    def _add_window(self, tape: Tape, window: Window, gradient: np.ndarray) -> None:
        """Adds the gradients of a window whose fragments are marked."""
        x, y, w, h = window.area
        s = window.settings.samples
        counts = self.make_room(tape, window)
        of_samples = np.ascontiguousarray(gradient[y : y + h, x : x + w]) * np.float32(1 / s**2)
        self.frames.write("samples", of_samples, 32 * w * h * s**2)
        self.frames.run(_gradient_steps(window.rounds), "color", counts, window.settings)
        counters = self.frames.counters()
        if counters[2] != counts["tiles"]:
            raise self.frames.unfinished(counts, counters)
        if counters[15]:
            raise DeviceError("a sample has too many fragments for gradients on the GPU: use device='cpu'")

    def make_room(self, tape: Tape, window: Window) -> dict[str, int]:
        """Room for the tape of a window, its frame and counts."""
        counts = self.frames.begin(tape.part(window.area), window.settings, tape.pose)
        self.frames.allocate("tape", FRAGMENT_BYTES * window.fragments)
        self.frames.allocate("tile_sums", SUM_BYTES * window.sums)
        return counts


def _triples(tape: Tape) -> Iterator[tuple[slice, np.ndarray]]:
    """The further values, three at a time: their columns, and (v, 4) float32 with the opacities."""
    values, colors = tape.triangles.values, tape.triangles.colors
    for first in range(0, 0 if values is None else values.shape[1], 3):
        assert values is not None
        columns = slice(first, min(first + 3, values.shape[1]))
        some = np.zeros((len(values), 4), np.float32)
        some[:, : columns.stop - first], some[:, 3] = values[:, columns], colors[:, 3]
        yield columns, some
