"""The mesh in a container, as the page decodes it (``page/scene.js``): the inverse of ``packing``."""

from __future__ import annotations

import numpy as np

from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer.packing import others_than, predict
from meshsplats.viewer.streams import Unpacker


def unpack_mesh(data: bytes) -> SplatMesh:
    """The mesh in a container, as the page sees it: vertices in the order of their first use.

    Raises ValueError for anything else.
    """
    source = Unpacker(data)
    if source.header.get("kind") != "mesh":
        raise ValueError("the packed data is not a mesh")
    try:
        return _unpacked(source)
    except (KeyError, IndexError, TypeError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"packed data is broken: {type(error).__name__}: {error}") from None


def _unpacked(source: Unpacker) -> SplatMesh:
    header = source.header
    count = header["vertices"]
    if not 0 <= count <= source.longest:
        raise ValueError(f"packed data is broken: {count} vertices")
    positions, colors = np.zeros((count, 3)), np.zeros((count, 4))
    splat: np.ndarray | None
    if "patterns" in header:
        faces, splat = _unpack_fans(source, positions, colors)
    else:
        first = header["attributes"]
        positions[:] = np.cumsum(source.columns(first, 3), axis=0) * header["step"]
        colors[:] = np.cumsum(source.columns(first + 3, 4), axis=0)
        faces = _expanded_faces(source.columns(header["faces"], 3))
        splat = None if header["splat"] < 0 else source.row(header["splat"])
    scale = np.array([header["color"]] * 3 + [header["alpha"]], np.float64)
    positions += header["origin"]
    _unpack_far(source, positions)
    return SplatMesh(
        positions,
        faces.astype(np.int32),
        (colors / scale).astype(np.float32),
        face_splat=None if splat is None else splat.astype(np.int32),
        depth_group=None if header["group"] < 0 else source.row(header["group"]).astype(np.int32),
        up=header["up"],
        blending=header["blending"],
        filter_px2=header["filter"],
        order=header.get("order", "fragment"),
        harmonics=_unpack_harmonics(source),
    )


def _unpack_harmonics(source: Unpacker) -> np.ndarray | None:
    if "harmonics" not in source.header:
        return None
    known = source.header["harmonics"]
    values = source.columns(known["row"], 3 * known["terms"]) * known["step"]
    return values.astype(np.float32).reshape(-1, known["terms"], 3)


def _unpack_far(source: Unpacker, points: np.ndarray) -> None:
    """Puts the far points into ``points`` (n, 3)."""
    if source.header["far"] < 0:
        return
    halves = source.columns(source.header["far_places"], 6)
    bits = (halves[:, :3] << 16 | halves[:, 3:]).astype("<u4")
    points[source.row(source.header["far"])] = bits.view("<f4")


def _expanded_faces(compact: np.ndarray) -> np.ndarray:
    """The inverse of ``_compact_faces``."""
    flat = compact.ravel()
    fresh = flat == 0
    return (np.cumsum(fresh) - fresh - flat).reshape(-1, 3)


def _unpack_fans(
    source: Unpacker, positions: np.ndarray, colors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Faces (f, 3) and splats (f,); fills ``positions`` (v, 3), relative to the origin, and ``colors``
    (v, 4), in steps."""
    patterns = source.header["patterns"]
    choice, fan_splat = source.row(source.header["choice"]), source.row(source.header["splat"])
    sizes = np.array([pattern["size"] for pattern in patterns])[choice]
    counts = np.array([len(pattern["faces"]) for pattern in patterns])[choice]
    if max(int(sizes.sum()), int(counts.sum())) > source.longest:
        raise ValueError("packed data is broken: its fans have more vertices or faces than there are data")
    first, first_face = np.cumsum(sizes) - sizes, np.cumsum(counts) - counts
    faces = np.zeros((int(counts.sum()), 3), np.int64)
    step = source.header["step"]
    fine = step / source.header["finer"]
    for index, pattern in enumerate(patterns):
        rows = np.flatnonzero(choice == index)
        own, m = first[rows], pattern["size"]
        local = np.array(pattern["faces"])
        faces[first_face[rows][:, None] + np.arange(len(local))] = own[:, None, None] + local
        anchor = source.columns(pattern["anchor"], 3) * fine
        positions[own] = anchor
        known = [source.columns(at, 3) * fine for at in pattern["offsets"]]
        for j, offset in zip(pattern["basis"], known, strict=True):
            positions[own + j] = anchor + offset
        others = others_than(m, [0, *pattern["basis"]])
        predictions = predict(others, pattern["weights"], known, (len(own), 3))
        for at, (i, predicted) in zip(pattern["rest"], predictions, strict=True):
            positions[own + i] = anchor + (predicted + source.columns(at, 3) * step)

        colors[own, :3] = source.columns(pattern["rgb"], 3)
        for i, at in enumerate(pattern["shades"], 1):
            colors[own + i, :3] = colors[own, :3] + source.columns(at, 3)
        basis = pattern["alpha_basis"]
        opacities = [source.row(at).astype(np.float64) for at in pattern["alpha"]]
        for j, value in zip(basis, opacities, strict=True):
            colors[own + j, 3] = value
        predictions = predict(others_than(m, basis), pattern["alpha_weights"], opacities, (len(own),))
        for at, (i, predicted) in zip(pattern["alpha_rest"], predictions, strict=True):
            colors[own + i, 3] = np.floor(predicted + 0.5) + source.row(at)
    return faces, np.repeat(fan_splat, counts)
