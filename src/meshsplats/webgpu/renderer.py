"""Draws meshes on the GPU: buffers, frames, windows of the image. docs/webgpu.md describes the kernels."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from meshsplats.camera import Camera
from meshsplats.errors import DeviceError
from meshsplats.mesh import MIN_TRANSMITTANCE, SplatMesh
from meshsplats.webgpu import kernels
from meshsplats.webgpu.device import BUDGET, Device, open_device

WINDOW_SAMPLES = 1 << 22
"""Largest number of samples of a frame; larger images are drawn in windows."""

FIRST_PAIRS = 1 << 18
"""Room for pairs of a run and a tile, until a frame needs more."""

CORE_TILE = 16
"""Samples along each side of a tile of the core, from whose corners the core's depths are rounded."""

MAX_FAN = 8192
"""Most triangles of a splat with a low-pass filter: one invocation goes through all of them three times."""

_Output = Literal[kernels.Output, "values"]
"""What a frame blends: the outputs of ``raster``, and other values than the colours."""

_LIST_STEPS, _RASTER_STEPS = tuple(kernels.list_steps()), tuple(kernels.raster_steps())
_AGAIN_STEPS, _RESOLVE_STEPS = tuple(kernels.again_steps()), tuple(kernels.resolve_steps())

MAX_ROUNDS = 10_000
"""Most repetitions of a frame's last steps."""


@dataclass(frozen=True)
class DrawSettings:
    """What does not change from window to window."""

    samples: int = 1
    max_layers: int = 0
    min_transmittance: float = MIN_TRANSMITTANCE
    cutoff: float = -1.0
    filter_px2: float = 0.0
    queue: int = kernels.QUEUE
    long_queue: int = kernels.LONG_QUEUE
    budget: int | None = None
    """Loop iterations of one walk through a tile list; None: those of the device."""


@dataclass
class Work:
    """Counters of what was drawn."""

    windows: int = 0
    frames: int = 0
    """With those that were repeated because lists were too short."""
    dispatches: int = 0
    """Of the last frame."""
    bytes: int = 0
    """Of all buffers."""
    tiles: int = 0
    pairs: int = 0
    """Pairs of a run and a tile in its box."""
    walks: int = 0
    """Through tile lists."""
    most_walks: int = 0
    tests: int = 0
    """Of a triangle at a sample."""
    fragments: int = 0
    """Blended."""
    overflowed: int = 0
    """Samples whose queue was too short in the first walk."""

    def add(self, tiles: int, counters: np.ndarray) -> None:
        """Adds a finished window."""
        self.windows += 1
        self.tiles += tiles
        self.pairs += int(counters[0])
        self.walks += int(counters[3])
        self.most_walks = max(self.most_walks, int(counters[4]))
        self.tests += int(counters[5]) + (int(counters[6]) << 32)
        self.fragments += int(counters[7]) + (int(counters[8]) << 32)
        self.overflowed += int(counters[11])


@dataclass
class Images:
    """The outputs of ``draw``: sums over the fragments of each pixel, weighted as their colours are."""

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

    output: _Output
    vertex_values: np.ndarray | None
    """(v, 4) float32: what is blended, and opacities; None: the depth."""
    image: np.ndarray
    """(h, w, c) float32, where it goes."""


def draw(
    mesh: SplatMesh,
    camera: Camera,
    settings: DrawSettings,
    *,
    depth: bool = False,
    normals: bool = False,
    values: np.ndarray | None = None,
) -> Images:
    """Draws a mesh on the best GPU of this machine; arguments are those of ``rendering.render``, checked.

    Args:
        values: (v, c) float32 further values of the vertices to blend.

    Raises:
        MissingDependencyError: there is no wgpu or no GPU.
        DeviceError: the GPU failed or did not finish.
        MemoryError: the scene does not fit.
        ValueError: two splats share a vertex, and the mesh has a filter.
    """
    with gpu_errors():
        return _renderer(mesh).draw(camera, settings, depth=depth, normals=normals, values=values)


@contextlib.contextmanager
def gpu_errors() -> Iterator[None]:
    """Turns the errors of wgpu into MemoryError and DeviceError, and opens the device anew afterwards.

    Raises MissingDependencyError at once if there is no wgpu or no GPU.
    """
    open_device()
    import wgpu

    try:
        yield
    except wgpu.GPUError as error:
        _forget()  # the device may be lost
        if isinstance(error, MemoryError):
            raise MemoryError(f"the GPU has too little memory: {error}") from None
        raise DeviceError(f"the GPU failed: {error}") from None


_lock = threading.Lock()
_last: MeshRenderer | None = None


def _renderer(mesh: SplatMesh) -> MeshRenderer:
    """The renderer of ``mesh``: that of the last call if it was for the same mesh."""
    global _last
    with _lock:
        if _last is None or _last.mesh is not mesh:
            _last = None  # frees its buffers first
            _last = MeshRenderer(open_device(), mesh)
        return _last


def _forget() -> None:
    """Opens the device anew at the next call."""
    global _last
    with _lock:
        _last = None
        open_device.cache_clear()


class MeshRenderer:
    """A mesh on a GPU."""

    max_fan = MAX_FAN

    def __init__(self, device: Device, mesh: SplatMesh) -> None:
        self.device = device
        self.mesh = mesh
        self._lock = threading.Lock()
        self._buffers: dict[str, Any] = {}
        self._bind_groups: dict[tuple[Any, ...], Any] = {}
        self._capacity = FIRST_PAIRS
        self._fans = 0
        runs = find_runs(mesh.faces, mesh.face_splat)
        parts = [mesh.faces.view(np.uint32).ravel(), runs]
        self._counts = {"one": 1, "vertices": len(mesh.vertices), "faces": len(mesh.faces), "runs": len(runs)}
        self._counts |= {"fans": 0, "groups": 0}
        self._offsets = (3 * len(mesh.faces), 0, 0)
        if mesh.depth_group is not None and (mesh.depth_group >= 0).any():
            of_face, largest = find_groups(mesh)
            parts += [of_face, largest]
            start = 3 * len(mesh.faces) + len(runs)
            self._offsets = (3 * len(mesh.faces), start, start + len(of_face))
            self._counts["groups"] = len(largest)
        if self._counts["runs"] >= kernels.MAX_RUNS:
            raise MemoryError(
                f"the mesh has {len(runs):,} runs of triangles; the GPU takes {kernels.MAX_RUNS:,}"
            )
        if not len(mesh.faces):
            return
        check_size(device, "vertices", 16 * (len(mesh.vertices) + 2 * self._counts["groups"]))
        check_size(device, "triangles", 4 * sum(map(len, parts)))
        self._upload("vertices", mesh.vertices)
        self._upload("values", mesh.colors)
        self._upload("mesh", np.concatenate(parts))
        self._allocate("projected", 16 * (len(mesh.vertices) + 2 * self._counts["groups"]))
        self._allocate("group_bounds", 8 * self._counts["groups"])
        self._allocate("boxes", 8 * len(runs))
        self._allocate("offsets", 4 * len(runs))
        self._allocate("plan", 64)
        self._allocate("counters", 64)
        self._allocate("frame", 256)
        digits = np.zeros((len(kernels.DIGITS) + 1, 64), np.uint32)
        digits[:-1, :2] = kernels.DIGITS
        digits[:-1, 2] = 1
        self._upload("digits", digits)

    # ------------------------------------------------------------------------------------------ buffers

    def _usage(self, name: str) -> int:
        import wgpu

        usage = wgpu.BufferUsage
        if name in ("frame", "digits"):
            return int(usage.UNIFORM | usage.COPY_DST)
        indirect = usage.INDIRECT if name in ("plan", "lists", "again") else 0
        return int(usage.STORAGE | usage.COPY_DST | usage.COPY_SRC | indirect)

    def _allocate(self, name: str, size: int) -> None:
        """A buffer of at least ``size`` bytes; its contents are lost if it grows."""
        size = max(64, -(-size // 16) * 16)
        old = self._buffers.get(name)
        if old is not None and old.size >= size:
            return
        if size > self.device.binding_limit:
            raise MemoryError(f"the GPU cannot hold {name}: {size / 2**20:.0f} MiB")
        if old is not None:
            del self._buffers[name]
            self._bind_groups.clear()
            old.destroy()
        self._buffers[name] = self.device.device.create_buffer(size=size, usage=self._usage(name))

    def _upload(self, name: str, array: np.ndarray) -> None:
        data = np.ascontiguousarray(array)
        self._allocate(name, data.nbytes)
        if data.nbytes:
            self.device.device.queue.write_buffer(self._buffers[name], 0, data)

    # ------------------------------------------------------------------------------------------ drawing

    def draw(
        self,
        camera: Camera,
        settings: DrawSettings,
        *,
        depth: bool = False,
        normals: bool = False,
        values: np.ndarray | None = None,
    ) -> Images:
        h, w = camera.height, camera.width
        images = Images(np.zeros((h, w, 3), np.float32), np.ones((h, w), np.float32))
        images.depth = np.zeros((h, w), np.float32) if depth else None
        images.normals = np.zeros((h, w, 3), np.float32) if normals else None
        images.values = None if values is None else np.zeros((h, w, values.shape[1]), np.float32)
        if not len(self.mesh.faces):
            return images
        budgets = self.device.budgets if settings.budget is None else (settings.budget,)
        with self._lock:
            self._prepare_filter(settings)
            passes = list(self._passes(images, values))
            waiting = [(0, 0, w, h)]
            while waiting:
                window = waiting.pop()
                if not self._fits(window, settings.samples):
                    waiting += halves(window)
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
                    waiting += halves(window)
            images.work.bytes = self.bytes
        return images

    @property
    def bytes(self) -> int:
        """Bytes of all buffers."""
        return sum(buffer.size for buffer in self._buffers.values())

    def _prepare_filter(self, settings: DrawSettings) -> None:
        if not settings.filter_px2 or "fans" in self._buffers:
            return
        starts = checked_fans(self.mesh, self.max_fan)
        self._upload("fans", starts)
        self._fans = len(starts) - 1

    def _fits(self, window: tuple[int, int, int, int], samples: int) -> bool:
        w, h = window[2] * samples, window[3] * samples
        most = min(WINDOW_SAMPLES, self.device.binding_limit // 32)
        return w * h <= most and _tiles(w) * _tiles(h) <= kernels.MAX_TILES

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
        counts = self._begin(part, settings)
        work = images.work
        while True:
            counters = self._frame("color", counts, settings, work)
            needed = int(counters[0])
            if needed <= self._capacity:
                break
            if needed > min(kernels.MAX_PAIRS, self.device.binding_limit // 8):
                return False
            self._capacity = min(kernels.MAX_PAIRS, self.device.binding_limit // 8, needed + needed // 4)
            counts = self._begin(part, settings)
        work.add(counts["tiles"], counters)
        rows, columns = slice(y0, y0 + h), slice(x0, x0 + w)
        pixels = self._read(w, h, settings.samples)
        images.color[rows, columns] = pixels[..., :3]
        images.transmittance[rows, columns] = pixels[..., 3]
        for one in passes:
            if one.vertex_values is not None:
                self._upload("other_values", one.vertex_values)
            self._frame(one.output, counts, settings, None)
            channels = one.image.shape[2]
            one.image[rows, columns] = self._read(w, h, settings.samples)[..., :channels]
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

    def _begin(self, camera: Camera, settings: DrawSettings) -> dict[str, int]:
        """Sizes the buffers of a frame and writes its uniforms; returns the counts of its steps."""
        s = settings.samples
        w, h = camera.width * s, camera.height * s
        counts = self._counts | {
            "tiles": _tiles(w) * _tiles(h),
            "columns": camera.width,
            "rows": camera.height,
        }
        if settings.filter_px2:
            counts["fans"] = self._fans
        blocks = -(-self._capacity // 2048)
        self._allocate("pairs_a", 8 * self._capacity)
        self._allocate("pairs_b", 8 * self._capacity)
        self._allocate("table", 4 * 256 * blocks)
        self._allocate("sums", 4 * (2 + max(-(-256 * blocks // 2048), -(-counts["runs"] // 2048))))
        self._allocate("lists", 16 * (counts["tiles"] + 1))
        self._allocate("again", 16 * (counts["tiles"] + 1))
        self._allocate("samples", 32 * w * h)
        if s > 1:
            self._allocate("pixels", 16 * camera.width * camera.height)
        frame = frame_uniform(camera, settings, counts, self._capacity, self._offsets)
        self.device.device.queue.write_buffer(self._buffers["frame"], 0, frame)
        return counts

    def _frame(
        self, output: _Output, counts: dict[str, int], settings: DrawSettings, work: Work | None
    ) -> np.ndarray:
        """Renders one frame to the samples, until all tiles are finished; returns the counters."""
        steps = (*_LIST_STEPS, *_RASTER_STEPS) if output == "color" else _RASTER_STEPS
        return self._repeat(steps, _AGAIN_STEPS, output, counts, settings, work)[1]

    def _repeat(
        self,
        steps: Sequence[dict[str, Any]],
        again: Sequence[dict[str, Any]],
        output: _Output,
        counts: dict[str, int],
        settings: DrawSettings,
        work: Work | None,
    ) -> tuple[int, np.ndarray]:
        """Takes ``steps``, then those of ``again`` until all tiles are finished or the lists are too short;
        the repetitions, and the counters."""
        if work is not None:
            work.frames += 1
            work.dispatches = 0
        previous = None
        for rounds in range(MAX_ROUNDS):
            self._run(steps, output, counts, settings, work)
            counters = self._counters()
            if counters[0] > self._capacity or counters[2] == counts["tiles"]:
                return rounds, counters
            if counters[9] or counters[12] or (previous is not None and previous == counters[3]):
                break
            previous = counters[3]
            steps = again
        raise self._unfinished(counts, counters)

    def _unfinished(self, counts: dict[str, int], counters: np.ndarray) -> DeviceError:
        return DeviceError(
            f"the GPU did not finish {counts['tiles'] - int(counters[2]):,} of {counts['tiles']:,} tiles"
            f" ({self.device.name}): use device='cpu'"
        )

    def _counters(self) -> np.ndarray:
        data = self.device.device.queue.read_buffer(self._buffers["counters"], 0, 64)
        return np.frombuffer(data, np.uint32).copy()

    def _read(self, width: int, height: int, samples: int) -> np.ndarray:
        """(h, w, 4) float32: the pixels of the last frame."""
        name = "samples"
        if samples > 1:
            counts = {"columns": width, "rows": height}
            self._run(_RESOLVE_STEPS, "color", counts, DrawSettings())
            name = "pixels"
        data = self.device.device.queue.read_buffer(self._buffers[name], 0, 16 * width * height)
        return np.frombuffer(data, np.float32).reshape(height, width, 4)

    def _run(
        self,
        steps: Sequence[dict[str, Any]],
        output: _Output,
        counts: dict[str, int],
        settings: DrawSettings,
        work: Work | None = None,
    ) -> None:
        gpu = self.device.device
        encoder = gpu.create_command_encoder()
        compute = None
        for step in steps:
            if "clear" in step:
                if compute is not None:
                    compute.end()
                    compute = None
                encoder.clear_buffer(self._buffers[step["clear"]], step["from"], step.get("size"))
                continue
            if "if" in step and not counts[step["if"]]:
                continue
            if compute is None:
                compute = encoder.begin_compute_pass()
            pipeline = self._pipeline(step["kernel"], output, settings)
            compute.set_pipeline(pipeline)
            compute.set_bind_group(0, self._bind_group(pipeline, step["bind"], output))
            if "indirect" in step:
                name, byte = step["indirect"]
                compute.dispatch_workgroups_indirect(self._buffers[name], byte)
            else:
                sizes = [step["count"], step.get("rows", ("one", 1))]
                compute.dispatch_workgroups(*(-(-counts.get(name, 1) // n) for name, n in sizes))
            if work is not None:
                work.dispatches += 1
        if compute is not None:
            compute.end()
        gpu.queue.submit([encoder.finish()])

    def _bind_group(self, pipeline: Any, bind: dict[str, str], output: _Output) -> Any:
        other = output in ("values", "vertex_normals", "face_normals")
        key = (pipeline, other, *bind.items())
        if key not in self._bind_groups:
            self._bind_groups[key] = self._new_bind_group(pipeline, bind, other)
        return self._bind_groups[key]

    def _new_bind_group(self, pipeline: Any, bind: dict[str, str], other: bool) -> Any:
        entries = []
        for binding, name in bind.items():
            base, _, index = name.partition(".")
            if base == "values" and other:
                base = "other_values"
            buffer = self._buffers[base]
            offset, size = (256 * int(index), 16) if index else (0, buffer.size)
            entries.append(
                {"binding": int(binding), "resource": {"buffer": buffer, "offset": offset, "size": size}}
            )
        return self.device.device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)

    def _pipeline(self, kernel: str, output: _Output, settings: DrawSettings) -> Any:
        groups = self._counts["groups"] > 0
        blended: kernels.Output = "color" if output == "values" else output
        if kernel in ("raster", "raster_again"):
            queue = settings.queue if kernel == "raster" else settings.long_queue
            return self.device.pipeline(
                "raster",
                ("raster", queue, blended, groups),
                lambda: kernels.raster_source(queue, output=blended, groups=groups),
            )
        return self.device.pipeline(kernel, ("lists",), kernels.lists_source)


def frame_uniform(
    camera: Camera,
    settings: DrawSettings,
    counts: dict[str, int],
    capacity: int,
    offsets: Sequence[int],
    pose: np.ndarray | None = None,
) -> np.ndarray:
    """The bytes of the uniform ``Frame``; ``pose`` (4, 4) float64 overrides that of the camera."""
    s = settings.samples
    w, h = camera.width * s, camera.height * s
    data = np.zeros(64, np.float32)
    words = data.view(np.uint32)
    matrix = camera.world_to_camera if pose is None else pose
    for i in range(3):
        data[4 * i : 4 * i + 3] = matrix[i, :3]
    center = camera.center if pose is None else -np.linalg.solve(pose[:3, :3], pose[:3, 3])
    data[12:15] = center
    data[16:19] = center - data[12:15]
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) * s
    data[20:24] = lens
    data[24:28] = camera.near, settings.min_transmittance, settings.cutoff, settings.filter_px2 * s * s
    words[28:32] = w, h, _tiles(w), _tiles(h)
    words[32:36] = counts["vertices"], counts["faces"], counts["runs"], counts["fans"]
    words[36:39] = counts["groups"], capacity, settings.max_layers
    words[39] = BUDGET if settings.budget is None else settings.budget
    words[40:43] = offsets
    words[43] = s
    for i in range(3):
        data[44 + 4 * i : 47 + 4 * i] = matrix[i, :3] - data[4 * i : 4 * i + 3]
    data[56:60] = lens - data[20:24]
    return data


def find_runs(faces: np.ndarray, face_splat: np.ndarray | None) -> np.ndarray:
    """(r,) uint32 runs: the first face, and from bit 29 on the count less 1.

    A run holds up to 8 consecutive triangles of one splat; without splats, such that each has a vertex of the
    one before.
    """
    count = len(faces)
    if not count:
        return np.zeros(0, np.uint32)
    if face_splat is not None:
        new = face_splat[1:] != face_splat[:-1]
    else:
        new = ~(faces[1:, :, None] == faces[:-1, None, :]).any(axis=(1, 2))
    starts = np.flatnonzero(np.concatenate([[True], new]))
    lengths = np.diff(np.append(starts, count))
    pieces = -(-lengths // kernels.RUN)
    before = np.cumsum(pieces) - pieces
    first = np.repeat(starts, pieces) + kernels.RUN * (np.arange(pieces.sum()) - np.repeat(before, pieces))
    ends = np.minimum(first + kernels.RUN, np.repeat(starts + lengths, pieces))
    return (first.astype(np.uint32) | ((ends - first - 1).astype(np.uint32) << np.uint32(29))).astype(
        np.uint32
    )


def check_size(device: Device, name: str, size: int) -> None:
    """MemoryError if ``size`` bytes for the vertices or triangles of a mesh are too many for a buffer."""
    if size > device.binding_limit:
        raise MemoryError(
            f"the mesh has too many {name} for the GPU: {size / 2**20:.0f} MiB; a buffer holds"
            f" {device.binding_limit >> 20} MiB. Use device='cpu'"
        )


def checked_fans(mesh: SplatMesh, most: int) -> np.ndarray:
    """(s + 1,) uint32 first triangle of each splat, and their count, for the filter.

    Raises:
        DeviceError: a splat of more than ``most`` triangles.
        ValueError: two splats share a vertex.
    """
    starts = np.append(mesh.splats.starts, len(mesh.faces)).astype(np.uint32)
    if np.diff(starts).max() > most:
        raise DeviceError(
            f"the filter of the GPU takes splats of up to {most:,} triangles; one has"
            f" {np.diff(starts).max():,}. Use device='cpu'"
        )
    if mesh.splats.share_vertices:
        raise ValueError("two splats share a vertex: a filter widens the triangles of each splat apart")
    return starts


def find_groups(mesh: SplatMesh) -> tuple[np.ndarray, np.ndarray]:
    """(f,) uint32 depth group of each face, without gaps, 2^32 - 1 for none; and (g,) uint32 the face of each
    group with the largest area in world space."""
    assert mesh.depth_group is not None
    chosen = np.flatnonzero(mesh.depth_group >= 0)
    _, group = np.unique(mesh.depth_group[chosen], return_inverse=True)
    group = group.reshape(-1)
    corners = mesh.vertices[mesh.faces[chosen]].astype(np.float64)
    area = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) ** 2).sum(axis=1)
    order = np.lexsort((chosen, -area, group))  # the first of equal areas
    heads = np.concatenate([[True], np.diff(group[order]) > 0])
    of_face = np.full(len(mesh.faces), 0xFFFFFFFF, np.uint32)
    of_face[chosen] = group
    return of_face, chosen[order[heads]].astype(np.uint32)


def _tiles(samples: int) -> int:
    return -(-samples // kernels.TILE)


def halves(window: tuple[int, int, int, int]) -> list[tuple[int, int, int, int]]:
    """Two windows (x, y, width, height) in pixels; large ones begin at a tile of the core."""
    x, y, w, h = window
    if max(w, h) == 1:
        raise MemoryError("the GPU cannot hold the triangles of a single pixel: use device='cpu'")
    half = max(w, h) // 2
    if half >= 4 * CORE_TILE:
        half -= half % CORE_TILE
    if w >= h:
        return [(x, y, half, h), (x + half, y, w - half, h)]
    return [(x, y, w, half), (x, y + half, w, h - half)]
