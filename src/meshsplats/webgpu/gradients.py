"""Gradients of meshes on the GPU: images with a tape, and their backward pass.

docs/webgpu.md describes the kernels.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from meshsplats.camera import Camera
from meshsplats.errors import DeviceError
from meshsplats.mesh import SplatMesh, Triangles
from meshsplats.webgpu import kernels
from meshsplats.webgpu.device import Device, open_device
from meshsplats.webgpu.renderer import (
    WINDOW_SAMPLES,
    DrawSettings,
    Images,
    MeshRenderer,
    check_size,
    checked_fans,
    find_groups,
    frame_uniform,
    halves,
)

PAIR_BYTES = 100
"""Bytes of the marks of a pair, and of its places on the tape."""
FRAGMENT_BYTES = 16
SUM_BYTES = 64
"""Bytes of the sums of a triangle, over one tile or all."""
MAX_FAN = 4096
"""Most triangles of a splat with a low-pass filter: one invocation goes through all of them nine times."""
MAX_VALENCE = 16_384
"""Most triangles at a vertex: one invocation adds them."""
ROWS = 32_768
"""Workgroups in each row of a dispatch that is larger than one dimension."""

_MARK_STEPS = (*kernels.list_steps(), *kernels.mark_steps(), *kernels.place_steps())
_MARK_AGAIN_STEPS = (*kernels.mark_again_steps(), *kernels.place_steps())
_FILTER_STEPS = tuple(kernels.filter_steps())
_gradient_steps = functools.lru_cache(maxsize=64)(kernels.gradient_steps)


@dataclass(frozen=True)
class _Window:
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
class Forward:
    """A forward pass: its images, and what the backward pass starts from. Its arrays must not change."""

    triangles: Triangles
    camera: Camera
    pose: np.ndarray | None
    settings: DrawSettings
    images: Images
    windows: list[_Window]


@dataclass
class WindowLimit:
    """Most samples of the windows that are tried: one less than had too many fragments.

    The rounding of gradients depends on the windows. So a run whose bits are to be repeated has a limit of
    its own, which it keeps when it is resumed.
    """

    samples: int = WINDOW_SAMPLES


def check_limits(device: Device, mesh: SplatMesh) -> None:
    """Checks that gradients of ``mesh`` fit on the GPU.

    Raises:
        MemoryError: a mesh that does not fit into buffers of 128 MiB.
        DeviceError: a vertex with too many triangles, or a splat with too many for the filter.
        ValueError: two splats share a vertex, and there is a filter.
    """
    vertices, faces = len(mesh.vertices), len(mesh.faces)
    groups = 0 if mesh.depth_group is None else len(np.unique(mesh.depth_group[mesh.depth_group >= 0]))
    check_size(device, "vertices", 16 * (2 * vertices + 2 * groups))
    check_size(device, "triangles", SUM_BYTES * faces)
    check_size(device, "triangles", 4 * (vertices + 1 + 3 * faces))
    most = int(np.bincount(mesh.faces.ravel()).max(initial=0))
    if most > MAX_VALENCE:
        raise DeviceError(
            f"gradients on the GPU take vertices of up to {MAX_VALENCE:,} triangles; one has {most:,}."
            " Use device='cpu'"
        )
    if mesh.filter_px2 and faces:
        checked_fans(mesh, MAX_FAN)


_lock = threading.Lock()
_last: GradientRenderer | None = None
_last_arrays: tuple[np.ndarray | None, ...] = ()


def gradient_renderer(triangles: Triangles) -> GradientRenderer:
    """The renderer of ``triangles``, wherever their vertices lie: that of the last call if they are the same.
    Consecutive triangles of one splat have the same ``face_splat``, which need not ascend."""
    global _last, _last_arrays
    device = open_device()
    faces, face_splat, depth_group = arrays = (
        triangles.faces,
        triangles.face_splat,
        triangles.depth_group,
    )
    vertices = len(triangles.vertices)
    with _lock:
        if (
            _last is None
            or _last.device is not device
            or len(_last.mesh.vertices) != vertices
            or not all(map(_same, _last_arrays, arrays))
        ):
            _last = None  # frees its buffers first
            splat = None
            if face_splat is not None and len(face_splat):
                splat = np.cumsum(np.append(0, face_splat[1:] != face_splat[:-1])).astype(np.int32)
            blank = SplatMesh(
                np.zeros((vertices, 3), np.float32),
                faces.copy(),
                np.zeros((vertices, 4), np.float32),
                face_splat=splat,
                depth_group=None if depth_group is None else depth_group.copy(),
            )
            _last = GradientRenderer(device, blank)
            _last_arrays = tuple(None if part is None else part.copy() for part in arrays)
        return _last


def _same(one: np.ndarray | None, two: np.ndarray | None) -> bool:
    return one is two or (one is not None and two is not None and np.array_equal(one, two))


class GradientRenderer(MeshRenderer):
    """A mesh on a GPU whose positions and colours change.

    Args:
        device: the GPU.
        mesh: the triangles; its positions and colours are not used.

    Raises:
        MemoryError: a mesh that does not fit into buffers of 128 MiB.
        DeviceError: a vertex with too many triangles.
    """

    max_fan = MAX_FAN

    def __init__(self, device: Device, mesh: SplatMesh) -> None:
        check_limits(device, mesh)
        super().__init__(device, mesh)
        self._loaded: Forward | None = None  # whose positions and colours are on the GPU
        self._marked: Forward | None = None  # whose only window is marked
        self._limit = WindowLimit()
        runs = self._counts["runs"]
        self._counts["run_columns"] = min(runs, ROWS)
        self._counts["run_rows"] = -(-runs // ROWS)
        if not len(mesh.faces):
            return
        vertices = self._counts["vertices"] + 2 * self._counts["groups"]
        self._values_at = 16 * vertices
        corners = mesh.faces.ravel()
        starts = np.append(0, np.cumsum(np.bincount(corners, minlength=len(mesh.vertices))))
        parts = [starts, np.argsort(corners, kind="stable")]
        self._allocate("projected", 16 * (vertices + len(mesh.vertices)))
        self._allocate("gradients", 32 * len(mesh.vertices))
        self._allocate("face_sums", SUM_BYTES * len(mesh.faces))
        self._upload("vertex_corners", np.concatenate(parts).astype(np.uint32))
        modes = np.zeros((len(kernels.MODES), 64), np.uint32)
        modes[:, :4] = kernels.MODES
        self._upload("modes", modes)

    def _usage(self, name: str) -> int:
        return super()._usage("frame" if name == "modes" else name)

    def _begin(
        self, camera: Camera, settings: DrawSettings, pose: np.ndarray | None = None
    ) -> dict[str, int]:
        s = settings.samples
        w, h = camera.width * s, camera.height * s
        self._allocate("sums", 4 * (3 + self._capacity // 2048))
        self._allocate("samples", 32 * w * h + 16 * camera.width * camera.height)
        self._allocate("counters", 64 + PAIR_BYTES * self._capacity)
        for name in ("fragment_starts", "sum_starts", "marked"):
            self._allocate(name, 4 * self._capacity)
        self._allocate("tape", FRAGMENT_BYTES)
        counts = super()._begin(camera, settings) | {"width": w, "height": h}
        if pose is not None:
            frame = frame_uniform(camera, settings, counts, self._capacity, self._offsets, pose)
            self.device.device.queue.write_buffer(self._buffers["frame"], 0, frame)
        return counts

    def _pipeline(self, kernel: str, output: Any, settings: DrawSettings) -> Any:
        groups = self._counts["groups"] > 0
        if kernel in kernels.GRADIENT_KERNELS or kernel in ("tape", "tape_again"):
            queue = settings.long_queue if kernel == "tape_again" else settings.queue
            entry = "raster" if kernel in ("tape", "tape_again") else kernel
            return self.device.pipeline(
                entry,
                ("tape", queue, groups),
                lambda: kernels.gradients_source(queue, groups=groups),
            )
        if kernel == "widen_backward":
            return self.device.pipeline(kernel, ("filter",), kernels.filter_source)
        return super()._pipeline(kernel, output, settings)

    # ------------------------------------------------------------------------------------------ forward pass

    def forward(
        self,
        triangles: Triangles,
        camera: Camera,
        settings: DrawSettings,
        *,
        pose: np.ndarray | None = None,
        limit: WindowLimit | None = None,
    ) -> Forward:
        """Renders the mesh with these positions, colours and further values, and finds the windows of its
        tape.

        Args:
            triangles: those of ``gradient_renderer``.
            camera, settings: as in ``draw``; without ``max_layers`` and ``cutoff``.
            pose: (4, 4) float64 world to camera, overrides that of the camera.
            limit: of windows; by default that of all images of this renderer that have none.

        Raises:
            DeviceError: the GPU did not finish.
            MemoryError: a single pixel does not fit.
            ValueError: two splats share a vertex, and there is a filter.
        """
        h, w = camera.height, camera.width
        images = Images(np.zeros((h, w, 3), np.float32), np.ones((h, w), np.float32))
        values = triangles.values
        images.values = None if values is None else np.zeros((h, w, values.shape[1]), np.float32)
        result = Forward(triangles, camera, pose, settings, images, [])
        if not len(self.mesh.faces):
            return result
        with self._lock:
            self._load(result)
            waiting = [(0, 0, w, h)]
            while waiting:
                area = waiting.pop()
                window = self._mark_window(result, area, limit or self._limit)
                if window is None:
                    waiting += halves(area)
                    continue
                result.windows.append(window)
                images.work.add(window.tiles, window.counters)
                part = np.s_[area[1] : area[1] + area[3], area[0] : area[0] + area[2]]
                pixels = self._read(area[2], area[3], settings.samples)
                images.color[part], images.transmittance[part] = pixels[..., :3], pixels[..., 3]
                if images.values is not None:
                    self._render_values(result, window, images.values[part])
            images.work.bytes = self.bytes
        return result

    def _render_values(self, forward: Forward, window: _Window, out: np.ndarray) -> None:
        """Blends the further values in place of the colours: the fragments and their marks are the same."""
        for columns, some in _triples(forward):
            self._load_values(some)
            self._try_mark(forward, window.area, window.settings)
            pixels = self._read(window.area[2], window.area[3], window.settings.samples)
            out[..., columns] = pixels[..., : columns.stop - columns.start]
        self._load_values(forward.triangles.colors)

    def _load(self, forward: Forward) -> None:
        """Uploads positions and colours."""
        self._loaded, self._marked = None, None
        self._prepare_filter(forward.settings)
        self._upload("vertices", forward.triangles.vertices)
        self._upload("values", forward.triangles.colors)
        self._load_values(forward.triangles.colors)
        if self._counts["groups"]:  # the plane of a group is that of its largest triangle
            moved = replace(self.mesh, vertices=forward.triangles.vertices)
            largest = find_groups(moved)[1]
            self.device.device.queue.write_buffer(self._buffers["mesh"], 4 * self._offsets[2], largest)
        self._loaded = forward

    def _load_values(self, values: np.ndarray) -> None:
        """Uploads what is blended: (v, 4) float32 colours and opacities."""
        self.device.device.queue.write_buffer(
            self._buffers["projected"], self._values_at, np.ascontiguousarray(values)
        )

    def _part(self, forward: Forward, area: tuple[int, int, int, int]) -> Camera:
        return forward.camera.window(*area)

    def _mark_window(
        self, forward: Forward, area: tuple[int, int, int, int], limit: WindowLimit
    ) -> _Window | None:
        """``_mark``, which is left out for windows as large as one that had too many fragments."""
        samples = area[2] * area[3] * forward.settings.samples**2
        if samples > limit.samples and area[2:] != (1, 1):
            return None
        window = self._mark(forward, area)
        if window is None:
            limit.samples = samples - 1
        return window

    def _mark(self, forward: Forward, area: tuple[int, int, int, int]) -> _Window | None:
        """Renders a window and marks its fragments; None if it has too many."""
        if not self._fits(area, forward.settings.samples):
            return None
        budgets = self.device.budgets if forward.settings.budget is None else (forward.settings.budget,)
        for budget in budgets:
            settings = replace(forward.settings, budget=budget)
            try:
                return self._try_mark(forward, area, settings)
            except DeviceError:
                if budget == budgets[-1]:
                    raise
        return None

    def _fits(self, window: tuple[int, int, int, int], samples: int) -> bool:
        size = window[2] * window[3] * (32 * samples**2 + 16)
        return size <= self.device.binding_limit and super()._fits(window, samples)

    def _try_mark(
        self, forward: Forward, area: tuple[int, int, int, int], settings: DrawSettings
    ) -> _Window | None:
        self._marked = None
        part = self._part(forward, area)
        most = min(kernels.MAX_PAIRS, (self.device.binding_limit - 64) // PAIR_BYTES)
        counts = self._begin(part, settings, forward.pose)
        work = forward.images.work
        while True:
            rounds, counters = self._repeat(_MARK_STEPS, _MARK_AGAIN_STEPS, "color", counts, settings, work)
            needed = int(counters[0])
            if needed <= self._capacity:
                break
            if needed > most:
                return None
            self._capacity = min(most, needed + needed // 4)
            counts = self._begin(part, settings, forward.pose)
        fragments, sums = int(counters[13]), int(counters[14])
        limit = self.device.binding_limit
        if FRAGMENT_BYTES * fragments > limit or SUM_BYTES * sums > limit:
            return None
        window = _Window(area, settings, rounds, fragments, sums, counts["tiles"], counters)
        if area[2:] == (forward.camera.width, forward.camera.height):
            self._marked = forward
        return window

    # ------------------------------------------------------------------------------------------ backward pass

    def backward(
        self, forward: Forward, gradient: np.ndarray, values: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The gradients of vertices.

        Args:
            forward: the result of ``forward``, whose arrays have not changed.
            gradient: (h, w, 4) float32: of RGB without background, and of the background's share.
            values: (h, w, c) float32 gradient of the further values, or None.

        Returns:
            (v, 8) float32: of positions, in the axes of the camera, and 0; of RGB and opacity. And (v, c) of
            the further values, or None. The same bits every time.

        Raises:
            DeviceError: the GPU did not finish.
        """
        count = len(forward.triangles.vertices)
        more = None if values is None else np.zeros((count, values.shape[2]), np.float32)
        if not forward.windows:
            return np.zeros((count, 8), np.float32), more
        with self._lock:
            if self._loaded is not forward:
                self._load(forward)
            result = self._add_windows(forward, gradient)
            if values is not None and more is not None:
                for columns, some in _triples(forward):
                    self._load_values(some)
                    part = np.zeros_like(gradient)
                    part[..., : columns.stop - columns.start] = values[..., columns]
                    found = self._add_windows(forward, part)
                    more[:, columns] = found[:, 4 : 4 + columns.stop - columns.start]
                    result[:, :3] += found[:, :3]
                    result[:, 7] += found[:, 7]
                self._load_values(forward.triangles.colors)
        return result, more

    def _add_windows(self, forward: Forward, gradient: np.ndarray) -> np.ndarray:
        """(v, 8) float32 gradients of what is blended now."""
        self._clear("gradients")
        for window in forward.windows:
            if self._marked is not forward and not self._try_mark(forward, window.area, window.settings):
                raise DeviceError(f"the GPU did not repeat its own image ({self.device.name})")
            self._add_window(forward, window, gradient)
        if forward.settings.filter_px2:
            last = forward.windows[-1]
            counts = self._begin(self._part(forward, last.area), last.settings, forward.pose)
            self._run(_FILTER_STEPS, "color", counts, last.settings)
        size = 32 * len(forward.triangles.vertices)
        data = self.device.device.queue.read_buffer(self._buffers["gradients"], 0, size)
        return np.frombuffer(data, np.float32).reshape(-1, 8).copy()

    def _add_window(self, forward: Forward, window: _Window, gradient: np.ndarray) -> None:
        """Adds the gradients of a window whose fragments are marked."""
        x, y, w, h = window.area
        s = window.settings.samples
        counts = self._make_room(forward, window)
        of_samples = np.ascontiguousarray(gradient[y : y + h, x : x + w]) * np.float32(1 / s**2)
        self.device.device.queue.write_buffer(self._buffers["samples"], 32 * w * h * s**2, of_samples)
        self._run(_gradient_steps(window.rounds), "color", counts, window.settings)
        counters = self._counters()
        if counters[2] != counts["tiles"]:
            raise self._unfinished(counts, counters)
        if counters[15]:
            raise DeviceError("a sample has too many fragments for gradients on the GPU: use device='cpu'")

    def _make_room(self, forward: Forward, window: _Window) -> dict[str, int]:
        """Room for the tape of a window, its frame and counts."""
        counts = self._begin(self._part(forward, window.area), window.settings, forward.pose)
        self._allocate("tape", FRAGMENT_BYTES * window.fragments)
        self._allocate("tile_sums", SUM_BYTES * window.sums)
        return counts

    def _clear(self, name: str) -> None:
        encoder = self.device.device.create_command_encoder()
        encoder.clear_buffer(self._buffers[name])
        self.device.device.queue.submit([encoder.finish()])


def _triples(forward: Forward) -> Iterator[tuple[slice, np.ndarray]]:
    """The further values, three at a time: their columns, and (v, 4) float32 with the opacities."""
    values, colors = forward.triangles.values, forward.triangles.colors
    for first in range(0, 0 if values is None else values.shape[1], 3):
        assert values is not None
        columns = slice(first, min(first + 3, values.shape[1]))
        some = np.zeros((len(values), 4), np.float32)
        some[:, : columns.stop - first], some[:, 3] = values[:, columns], colors[:, 3]
        yield columns, some
