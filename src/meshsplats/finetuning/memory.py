"""How much memory a fine-tuning needs, and whether the machine has it: told before the work, not found
out."""

from __future__ import annotations

from pathlib import Path

from meshsplats.datasets.splat_targets import RenderedSplats
from meshsplats.datasets.views import CACHE_BYTES, Dataset
from meshsplats.mesh import SplatMesh

VERTEX_BYTES = 7 * 4 * 6 + 4
"""Values, gradients, two moments and their copies while a checkpoint is written, for position and colour, and
the size of the vertex' splat."""
BOUND_BYTES = 36 + 12 * 4
"""More for a vertex that is bound to a base mesh: corners, weights and their copies."""
FILTER_BYTES = 2 * 24 + 4 + 4 + 12
"""More for a vertex drawn with a filter: where it is before and after, its splat, and its gradient."""
FACE_BYTES = 12 + 4 + 4 + 64
"""A triangle, its splat and depth group, and the renderer's lists of them."""
PIXEL_BYTES = 12 * 12 + 64
"""Pictures, truth and gradients of one step, and the fragments that wait in the renderer's tiles."""
FACE_KEPT, MOST_KEPT = 250, 256 << 20
"""Arrays of the compiled core for each triangle, which it keeps from picture to picture, and most of them."""
BASE_BYTES = 75 << 20
"""Python and the libraries."""


def needed_memory(mesh: SplatMesh, dataset: Dataset, cache_bytes: int = CACHE_BYTES) -> int:
    """Bytes of the whole process that fine-tunes ``mesh`` on ``dataset``, at its peak, estimated from sizes
    alone."""
    views = dataset.views
    vertex = VERTEX_BYTES + (BOUND_BYTES if mesh.binding is not None else 0)
    vertex += FILTER_BYTES if mesh.filter_px2 else 0
    pixels = max((view.camera.width * view.camera.height for view in views), default=0)
    clouds = {id(v.source.cloud): v.source.cloud for v in views if isinstance(v.source, RenderedSplats)}
    arrays = (a for c in clouds.values() for a in (c.means, c.quaternions, c.scales, c.opacities, c.sh))
    return (
        BASE_BYTES
        + sum(array.nbytes for array in arrays)
        + min(len(mesh.faces) * FACE_KEPT, MOST_KEPT)
        + len(mesh.vertices) * vertex
        + len(mesh.faces) * FACE_BYTES
        + pixels * PIXEL_BYTES
        + min(dataset.memory, cache_bytes)
    )


def available_memory() -> int | None:
    """Bytes this process may still take: what the system calls available, and what a container leaves; None
    where neither is known."""
    found = []
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                found.append(int(line.split()[1]) << 10)
    except (OSError, ValueError):
        pass
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        try:
            most = Path(limit).read_text().strip()
            if most.isdigit() and int(most) < 1 << 60:
                found.append(max(int(most) - int(Path(used).read_text()), 0))
        except (OSError, ValueError):
            continue
    return min(found, default=None)


def check_memory(mesh: SplatMesh, dataset: Dataset, *, cache_bytes: int = CACHE_BYTES) -> int:
    """``needed_memory``; MemoryError with advice if it is more than ``available_memory``."""
    needed = needed_memory(mesh, dataset, cache_bytes)
    available = available_memory()
    if available is not None and needed > available:
        raise MemoryError(
            f"fine-tuning {len(mesh.vertices):,} vertices on {len(dataset.views):,} pictures needs about"
            f" {readable(needed)}, {readable(available)} are free: convert fewer splats (--max-splats), use"
            " smaller pictures (--downscale, --width), or keep fewer of them in memory (--cache)"
        )
    return needed


def readable(size: float) -> str:
    """1.5 GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
