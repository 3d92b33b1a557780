"""A mesh on the GPU: its buffers, and the frames that run over them.

docs/webgpu-host.md describes the kernels.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from meshsplats.errors import DeviceError
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.webgpu import kernels
from meshsplats.webgpu.device import Device
from meshsplats.webgpu.layout import (
    FANS_IN_WORKGROUP,
    check_count,
    check_fans,
    check_size,
    find_fans,
    find_groups,
    find_owners,
    find_runs,
    tiles_of,
)
from meshsplats.webgpu.settings import DrawSettings, frame_uniform

WINDOW_SAMPLES = 1 << 22
"""Largest number of samples of a frame; larger images are drawn in windows."""

FIRST_PAIRS = 1 << 18
"""Room for pairs of a run and a tile, until a frame needs more."""

MAX_FAN = 8192
"""Most triangles of a splat with a low-pass filter or in the order of the splats: one invocation goes through
all of them, for the filter three times."""

Output = Literal[kernels.Output, "values"]
"""What a frame blends: the outputs of ``raster``, and other values than the colours."""

_RESOLVE_STEPS = tuple(kernels.resolve_steps())

MAX_ROUNDS = 10_000
"""Most repetitions of a frame's last steps."""


@dataclass
class Work:
    """Counters of what was drawn."""

    windows: int = 0
    frames: int = 0
    """With those that were repeated because lists were too short."""
    dispatches: int = 0
    """Of the last frame."""
    bytes: int = 0
    """Bytes of all buffers."""
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


class Program(NamedTuple):
    """What is particular to the frames of one purpose."""

    pipeline: Callable[[Device, str, Output, DrawSettings, bool], Any]
    """The pipeline of a kernel, for a device, an output and settings, and with depth groups or without."""
    reserve: Callable[[MeshFrames, Camera, DrawSettings], None] | None = None
    """Makes room for buffers that other frames do not have, or have smaller."""
    uniforms: frozenset[str] = frozenset({"frame", "digits"})
    """Names of the uniform buffers."""
    most_fan: int = MAX_FAN


class MeshFrames:
    """A mesh on a GPU, and the frames of a program over it.

    Args:
        device: the GPU.
        mesh: the triangles.
        program: of the frames.

    Raises MemoryError for a mesh that does not fit.
    """

    def __init__(self, device: Device, mesh: SplatMesh, program: Program) -> None:
        self.device, self.mesh = device, mesh
        self.lock = threading.Lock()
        self.capacity = FIRST_PAIRS
        """Room for pairs of a run and a tile."""
        self._program = program
        self._buffers: dict[str, Any] = {}
        self._staging: Any = None
        """The buffer that everything is read through: making one takes longer than reading."""
        self._bind_groups: dict[tuple[Any, ...], Any] = {}
        self._runs = runs = find_runs(mesh.faces, mesh.face_splat)
        self._by_splat = False
        """Whether the runs on the GPU are in the order of the splats of a frame."""
        parts = [mesh.faces.view(np.uint32).ravel(), runs]
        self.counts = {"one": 1, "vertices": len(mesh.vertices), "faces": len(mesh.faces), "runs": len(runs)}
        self.counts |= {"splats": 0, "groups": 0, "harmonics": 0}
        self.offsets = (3 * len(mesh.faces), 0, 0)
        if mesh.depth_group is not None and (mesh.depth_group >= 0).any():
            of_face, largest = find_groups(mesh)
            parts += [of_face, largest]
            start = 3 * len(mesh.faces) + len(runs)
            self.offsets = (3 * len(mesh.faces), start, start + len(of_face))
            self.counts["groups"] = len(largest)
        if self.counts["runs"] >= kernels.MAX_RUNS:
            raise MemoryError(
                f"the mesh has {len(runs):,} runs of triangles; the GPU takes {kernels.MAX_RUNS:,}"
            )
        if not len(mesh.faces):
            return
        check_size(device, "vertices", 16 * (len(mesh.vertices) + 2 * self.counts["groups"]))
        check_count("vertices", len(mesh.vertices), 256)
        check_size(device, "triangles", 4 * sum(map(len, parts)))
        self.upload("vertices", mesh.vertices)
        self._upload_colors(mesh)
        self.upload("mesh", np.concatenate(parts))
        self.allocate("projected", 16 * (len(mesh.vertices) + 2 * self.counts["groups"]))
        self.allocate("group_bounds", 8 * self.counts["groups"])
        self.allocate("boxes", 8 * len(runs))
        self.allocate("offsets", 4 * len(runs))
        self.allocate("plan", 64)
        self.allocate("counters", 64)
        self.allocate("frame", 256)
        digits = np.zeros((len(kernels.DIGITS) + 1, 64), np.uint32)
        digits[:-1, :2] = kernels.DIGITS
        digits[:-1, 2] = 1
        self.upload("digits", digits)

    def _upload_colors(self, mesh: SplatMesh) -> None:
        """What is blended or, for view-dependent colours, what ``shade`` makes it of."""
        if mesh.harmonics is None:
            self.upload("values", mesh.colors)
            return
        check_size(self.device, "splats with harmonics", mesh.harmonics.nbytes)
        self.counts["harmonics"] = mesh.harmonics.shape[1]
        self.upload("base", mesh.colors)
        self.upload("harmonics", mesh.harmonics)
        self.upload("owners", find_owners(mesh))
        self.allocate("values", mesh.colors.nbytes)

    # ---- Buffers

    def _usage(self, name: str) -> int:
        import wgpu

        usage = wgpu.BufferUsage
        if name in self._program.uniforms:
            return int(usage.UNIFORM | usage.COPY_DST)
        indirect = usage.INDIRECT if name in ("plan", "lists", "again") else 0
        return int(usage.STORAGE | usage.COPY_DST | usage.COPY_SRC | indirect)

    def allocate(self, name: str, size: int) -> None:
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

    def upload(self, name: str, array: np.ndarray) -> None:
        data = np.ascontiguousarray(array)
        self.allocate(name, data.nbytes)
        if data.nbytes:
            self.write(name, data)

    def write(self, name: str, array: np.ndarray, offset: int = 0) -> None:
        """Writes an array into a buffer from byte ``offset`` on."""
        self.device.device.queue.write_buffer(self._buffers[name], offset, array)

    @contextlib.contextmanager
    def reading(self, name: str, size: int) -> Iterator[np.ndarray]:
        """(size / 4,) uint32: the first bytes of a buffer, in memory that is there as long as the context."""
        import wgpu

        gpu, known = self.device.device, self._staging
        if known is None or known.size < size:
            usage = int(wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST)
            known = self._staging = gpu.create_buffer(size=size, usage=usage)
        encoder = gpu.create_command_encoder()
        encoder.copy_buffer_to_buffer(self._buffers[name], 0, known, 0, size)
        gpu.queue.submit([encoder.finish()])
        known.map_sync(wgpu.MapMode.READ, 0, size)
        try:
            yield np.frombuffer(known.read_mapped(0, size, copy=False), np.uint32)
        finally:
            known.unmap()

    def read(self, name: str, size: int) -> np.ndarray:
        """(size / 4,) uint32: the first bytes of a buffer."""
        with self.reading(name, size) as words:
            return words.copy()

    def clear(self, name: str) -> None:
        encoder = self.device.device.create_command_encoder()
        encoder.clear_buffer(self._buffers[name])
        self.device.device.queue.submit([encoder.finish()])

    def copy(self, source: str, target: str, offset: int, size: int) -> None:
        """Copies the first ``size`` bytes of a buffer to byte ``offset`` of another."""
        encoder = self.device.device.create_command_encoder()
        encoder.copy_buffer_to_buffer(self._buffers[source], 0, self._buffers[target], offset, size)
        self.device.device.queue.submit([encoder.finish()])

    @property
    def bytes(self) -> int:
        """Bytes of all buffers."""
        return sum(buffer.size for buffer in self._buffers.values())

    def prepare(self, settings: DrawSettings) -> None:
        """Uploads what a filter and the order of blending need.

        Raises DeviceError and ValueError as ``check_fans``.
        """
        by_splat = settings.order == "splat"
        if settings.filter_px2:
            check_fans(self.mesh, self._program.most_fan, filtered=True)
        if by_splat:
            check_fans(self.mesh, MAX_FAN, filtered=False)
        if (settings.filter_px2 or by_splat) and "fans" not in self._buffers:
            check_count("splats", len(self.mesh.splats), FANS_IN_WORKGROUP)
            self.upload("fans", find_fans(self.mesh))
            self.counts["splats"] = len(self.mesh.splats)
        if self._by_splat and not by_splat:
            self.write("mesh", self._runs, 4 * self.offsets[0])
        self._by_splat = by_splat

    # ---- Frames

    def begin(self, camera: Camera, settings: DrawSettings, pose: np.ndarray | None = None) -> dict[str, int]:
        """Sizes the buffers of a frame and writes its uniforms; returns the counts of its steps.

        Args:
            pose: (4, 4) float64 world to camera, overrides that of the camera.
        """
        if self._program.reserve is not None:
            self._program.reserve(self, camera, settings)
        s = settings.samples
        w, h = camera.width * s, camera.height * s
        counts = self.counts | {
            "tiles": tiles_of(w) * tiles_of(h),
            "columns": camera.width,
            "rows": camera.height,
            "width": w,
            "height": h,
        }
        counts["fans"] = counts["splats"] if settings.filter_px2 else 0
        room = self.capacity
        if settings.order == "splat":
            counts["groups"] = 0
            room = max(room, counts["runs"])
        blocks = -(-room // 2048)
        self.allocate("pairs_a", 8 * room)
        self.allocate("pairs_b", 8 * room)
        self.allocate("table", 4 * 256 * blocks)
        self.allocate("sums", 4 * (2 + max(-(-256 * blocks // 2048), -(-counts["runs"] // 2048))))
        self.allocate("lists", 16 * (counts["tiles"] + 1))
        self.allocate("again", 16 * (counts["tiles"] + 1))
        self.allocate("samples", 32 * w * h)
        if s > 1:
            self.allocate("pixels", 16 * camera.width * camera.height)
        frame = frame_uniform(camera, settings, counts, self.capacity, self.offsets, pose)
        self.write("frame", frame)
        return counts

    def repeat(
        self,
        steps: Sequence[dict[str, Any]],
        again: Sequence[dict[str, Any]],
        output: Output,
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
            self.run(steps, output, counts, settings, work)
            counters = self.counters()
            if counters[0] > self.capacity or counters[2] == counts["tiles"]:
                return rounds, counters
            if counters[9] or counters[12] or (previous is not None and previous == counters[3]):
                break
            previous = counters[3]
            steps = again
        raise self.unfinished(counts, counters)

    def unfinished(self, counts: dict[str, int], counters: np.ndarray) -> DeviceError:
        return DeviceError(
            f"the GPU did not finish {counts['tiles'] - int(counters[2]):,} of {counts['tiles']:,} tiles"
            f" ({self.device.name}): use device='cpu'"
        )

    def counters(self) -> np.ndarray:
        return self.read("counters", 64)

    @contextlib.contextmanager
    def pixels(self, width: int, height: int, samples: int) -> Iterator[np.ndarray]:
        """(h, w, 4) float32: the pixels of the last frame, as ``reading`` has them."""
        name = "samples"
        if samples > 1:
            counts = {"columns": width, "rows": height}
            self.run(_RESOLVE_STEPS, "color", counts, DrawSettings())
            name = "pixels"
        with self.reading(name, 16 * width * height) as words:
            yield words.view(np.float32).reshape(height, width, 4)

    def run(
        self,
        steps: Sequence[dict[str, Any]],
        output: Output,
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
            groups = self.counts["groups"] > 0 and settings.order == "fragment"
            pipeline = self._program.pipeline(self.device, step["kernel"], output, settings, groups)
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

    def _bind_group(self, pipeline: Any, bind: dict[str, str], output: Output) -> Any:
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
