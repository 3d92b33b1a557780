"""How the triangles of a mesh lie in buffers, and images in windows and tiles."""

from __future__ import annotations

import numpy as np

from meshsplats.errors import DeviceError
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.order import Order
from meshsplats.webgpu import kernels
from meshsplats.webgpu.device import Device

MAX_WORKGROUPS = 65_535
"""Of a dispatch, along each dimension."""
FANS_IN_WORKGROUP = 64
"""Splats of a workgroup that handles whole splats."""


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


def check_count(name: str, count: int, in_workgroup: int) -> None:
    """MemoryError for more of something than one dispatch of workgroups takes."""
    most = MAX_WORKGROUPS * in_workgroup
    if count > most:
        raise MemoryError(
            f"the mesh has too many {name} for the GPU: {count:,}; it takes {most:,}. Use device='cpu'"
        )


def check_fans(mesh: SplatMesh, most: int, *, filtered: bool) -> None:
    """Checks the splats of a mesh for the order of the splats, or for the low-pass filter.

    Raises:
        DeviceError: a splat of more than ``most`` triangles.
        ValueError: two splats share a vertex, and there is a filter.
    """
    largest = int(mesh.splats.counts.max(initial=0))
    if largest > most:
        what = "filter" if filtered else "order of the splats"
        raise DeviceError(
            f"the {what} of the GPU takes splats of up to {most:,} triangles; one has {largest:,}."
            " Use device='cpu'"
        )
    if filtered and mesh.splats.share_vertices:
        raise ValueError("two splats share a vertex: a filter widens the triangles of each splat apart")


def find_fans(mesh: SplatMesh) -> np.ndarray:
    """(2 s + 1,) uint32 first triangle of each splat, and their count; then the first run of each splat."""
    runs = -(-mesh.splats.counts // kernels.RUN)
    parts = [mesh.splats.starts, [len(mesh.faces)], np.cumsum(runs) - runs]
    return np.concatenate(parts).astype(np.uint32)


def find_owners(mesh: SplatMesh) -> np.ndarray:
    """(v,) uint32 splat of each vertex, from 0 on without gaps; 2^32 - 1 for a vertex of no triangle."""
    owners = np.full(len(mesh.vertices), 0xFFFFFFFF, np.uint32)
    owners[mesh.faces] = mesh.splats.of_face[:, None]
    return owners


def find_splat_vertices(mesh: SplatMesh) -> np.ndarray:
    """(s + 1 + n,) uint32 first vertex of each splat, and their count n; then the vertices of one splat after
    the other, each in ascending order."""
    owners = find_owners(mesh)
    used = np.flatnonzero(owners != 0xFFFFFFFF)
    listed = used[np.argsort(owners[used], kind="stable")]
    starts = np.append(0, np.cumsum(np.bincount(owners[used], minlength=len(mesh.splats))))
    return np.concatenate([starts, listed]).astype(np.uint32)


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


def tiles_of(samples: int) -> int:
    return -(-samples // kernels.TILE)


def halves(window: tuple[int, int, int, int], order: Order) -> list[tuple[int, int, int, int]]:
    """Two windows (x, y, width, height) in pixels; large ones begin at a tile of the core, whose size
    depends on the ``order`` of blending."""
    x, y, w, h = window
    if max(w, h) == 1:
        raise MemoryError("the GPU cannot hold the triangles of a single pixel: use device='cpu'")
    half = max(w, h) // 2
    side = kernels.CORE_TILES[order]
    if half >= 4 * side:
        half -= half % side
    if w >= h:
        return [(x, y, half, h), (x + half, y, w - half, h)]
    return [(x, y, w, half), (x, y + half, w, h - half)]
