"""Estimates the memory of a fine-tuning up front, and checks that the machine has it."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path
from typing import Any

from meshsplats.cluster import memory_of_task
from meshsplats.datasets.splat_targets import RenderedSplats
from meshsplats.datasets.views import CACHE_BYTES, Dataset
from meshsplats.rendering.ordering import ordering_bytes
from meshsplats.scene.mesh import SplatMesh

VERTEX_BYTES = 7 * 4 * 6 + 4
"""Per vertex: position and colour, each with its gradient, two moments and their copies while a checkpoint is
written, and the size of the splat."""
BOUND_BYTES = 36 + 12 * 4
"""Additionally per vertex bound to a base mesh: corners, weights and their copies."""
SHADED_BYTES = 2 * 16
"""Additionally per vertex whose colour depends on the view: its colour there, and the gradient."""
HARMONIC_BYTES = 4 * 6
"""Per coefficient of the harmonics of splats: gradient, two moments and copies, as for vertices."""
FILTER_BYTES = 2 * 24 + 4 + 4 + 12
"""Additionally per vertex drawn with the low-pass filter: positions before and after, splat, and gradient."""
FACE_BYTES = 12 + 4 + 4 + 64
"""Per triangle: indices, splat and depth group, and the renderer's tile lists."""
PIXEL_BYTES = 12 * 12 + 64
"""Per pixel of one step: images, target and gradients, and the renderer's fragment queues."""
FACE_POOL_BYTES, POOL_LIMIT = 250, 256 << 20
"""Arrays that the compiled core keeps from image to image: bytes per triangle, and their limit in all."""
BASE_BYTES = 75 << 20
"""Python and the libraries."""


def estimate_memory(mesh: SplatMesh, dataset: Dataset, cache_bytes: int = CACHE_BYTES) -> int:
    """Peak memory in bytes of the whole process that fine-tunes ``mesh`` on ``dataset``.

    It is estimated from array sizes; ``cache_bytes`` is the limit of the data set's image cache.
    """
    vertex = BOUND_BYTES if mesh.binding is not None else 0
    vertex += FILTER_BYTES if mesh.filter_px2 else 0
    count = len(mesh.vertices)
    harmonics = 0
    if mesh.harmonics is not None:
        vertex += SHADED_BYTES
        harmonics = mesh.harmonics.size * HARMONIC_BYTES
    return estimate_bytes(count, len(mesh.faces), dataset, cache_bytes) + count * vertex + harmonics


def estimate_bytes(vertices: int, faces: int, dataset: Dataset, cache_bytes: int) -> int:
    """The same for a mesh with numbers of ``vertices`` and ``faces``, without a filter and not on a base."""
    views = dataset.views
    pixels = max((view.camera.width * view.camera.height for view in views), default=0)
    clouds = {id(v.source.cloud): v.source.cloud for v in views if isinstance(v.source, RenderedSplats)}
    arrays = (a for c in clouds.values() for a in (c.means, c.quaternions, c.scales, c.opacities, c.sh))
    return (
        BASE_BYTES
        + sum(array.nbytes for array in arrays)
        + min(faces * FACE_POOL_BYTES, POOL_LIMIT)
        + vertices * VERTEX_BYTES
        + faces * FACE_BYTES
        + pixels * PIXEL_BYTES
        + min(dataset.memory, cache_bytes)
    )


def available_memory(system: Path = Path("/")) -> int | None:
    """Bytes that this process may still allocate, by the system, the container and its Dask worker; None if
    unknown. ``system``: the root of the file system."""
    if sys.platform == "win32":
        free = _of_windows(ctypes.windll.kernel32)
    else:
        free = _of_linux(system)
    return min((known for known in (free, memory_of_task()) if known is not None), default=None)


class _MemoryStatus(ctypes.Structure):
    """MEMORYSTATUSEX of the Windows API."""

    _fields_ = (
        ("length", ctypes.c_uint32),
        ("load", ctypes.c_uint32),
        *((name, ctypes.c_uint64) for name in ("physical", "free_physical", "page_file", "free_page_file")),
        *((name, ctypes.c_uint64) for name in ("virtual", "free_virtual", "free_extended")),
    )


def _of_windows(kernel32: Any) -> int | None:
    """Free bytes of physical memory, at most those that the system would still commit to this process."""
    status = _MemoryStatus(length=ctypes.sizeof(_MemoryStatus))
    if not kernel32.GlobalMemoryStatusEx(ctypes.byref(status)):
        return None
    return min(status.free_physical, status.free_page_file)


def _of_linux(system: Path) -> int | None:
    """Free bytes by the system and by the container."""
    found = []
    try:
        for line in (system / "proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                found.append(int(line.split()[1]) << 10)
    except (OSError, ValueError):
        pass
    for limit, used, cached in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            file = system / "sys/fs/cgroup" / limit
            most = file.read_text().strip()
            if most.isdigit() and int(most) < 1 << 60:
                taken = int((system / "sys/fs/cgroup" / used).read_text())
                # What is kept of files counts as taken, but makes way for anything else.
                found.append(max(int(most) - taken + _counted(file.with_name("memory.stat"), cached), 0))
        except (OSError, ValueError):
            continue
    return min(found, default=None)


def _counted(statistics: Path, name: str) -> int:
    """A number of a control group's ``statistics``, 0 where it is not there."""
    try:
        return int(dict(line.split() for line in statistics.read_text().splitlines())[name])
    except (OSError, ValueError, KeyError):
        return 0


def check_memory(mesh: SplatMesh, dataset: Dataset, *, cache_bytes: int = CACHE_BYTES) -> int:
    """Returns ``estimate_memory``; raises MemoryError with advice if it exceeds ``available_memory``."""
    needed = estimate_memory(mesh, dataset, cache_bytes)
    what = f"fine-tuning {len(mesh.vertices):,} vertices on {len(dataset.views):,} images"
    check_bytes(needed, what, "convert fewer splats (``max_splats``)")
    return needed


def check_order_memory(mesh: SplatMesh) -> None:
    """Raises MemoryError with advice if finding the order of ``mesh`` for a file exceeds
    ``available_memory``."""
    needed, available = ordering_bytes(mesh), available_memory()
    if available is not None and needed > available:
        raise MemoryError(
            f"ordering {len(mesh.faces):,} triangles needs about {readable(needed)}, {readable(available)}"
            " are free: convert fewer splats (``max_splats``), or take another ``order`` than 'file'"
        )


def check_bytes(needed: int, what: str, advice: str) -> None:
    """Raises MemoryError if ``needed`` exceeds ``available_memory``. ``what``: the work; ``advice``: a way to
    make it smaller."""
    available = available_memory()
    if available is not None and needed > available:
        raise MemoryError(
            f"{what} needs about {readable(needed)}, {readable(available)} are free: {advice}, use smaller"
            " images (``downscale``, ``width``), or keep fewer of them in memory (``cache``)"
        )


def readable(size: float) -> str:
    """A size in bytes for people: 1.5 GB, 20 MB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
