"""`.glb` files compressed by meshopt (``meshopt``), which viewers unpack as they load.

Positions and normals become integers of 16 bits (KHR_mesh_quantization), of which a node makes lengths; all
other arrays come back to the bit.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from meshsplats._common.kinds import need_choice
from meshsplats.formats.gltf.binary_chunk import BinaryChunk
from meshsplats.formats.gltf.document import MESHOPT
from meshsplats.formats.gltf.meshopt import encoded_attributes, encoded_triangles

Compression = Literal["meshopt"]

EXTENSIONS = ["KHR_mesh_quantization", MESHOPT]
_LARGEST = 65535
_MOST_BYTES = 256
"""Of an element."""


def check_compression(compression: str, color_type: str, *, is_ordered: bool) -> None:
    """ValueError for an unknown ``compression``, and for what it does not go with."""
    need_choice(Compression, compression=compression)
    if color_type != "uint16":
        raise ValueError(f"compressed colours are of type 'uint16', got {color_type!r}; leave one out")
    if is_ordered:
        raise ValueError("compression turns the corners of triangles: leave out order or compression")


class Grid(NamedTuple):
    """The points that positions are rounded to: ``offset + scale * k`` for integers k of 16 bits."""

    scale: float
    offset: tuple[float, float, float]

    @classmethod
    def of(cls, vertices: np.ndarray) -> Grid:
        """The finest for (v, 3) ``vertices``, at least one."""
        low = vertices.min(axis=0).astype(np.float64)
        longest = float((vertices.max(axis=0) - low).max())
        return cls(longest / _LARGEST or 1.0, (float(low[0]), float(low[1]), float(low[2])))

    def places(self, vertices: np.ndarray) -> np.ndarray:
        """(v, 3) uint16 k of the nearest points."""
        return np.rint((vertices - np.array(self.offset)) / self.scale).clip(0, _LARGEST).astype(np.uint16)

    @property
    def node(self) -> dict[str, Any]:
        """Entries of a node that makes positions of them."""
        return {"translation": list(self.offset), "scale": [self.scale] * 3}


def small_normals(normals: np.ndarray) -> np.ndarray:
    """(v, 3) int16 fractions of 32767."""
    return np.rint(normals * np.float32(32767)).astype(np.int16)


def with_compression(document: dict[str, Any], chunk: BinaryChunk) -> BinaryChunk:
    """The arrays of ``chunk``, those compressed that can be. Changes ``document`` so that it refers to them.

    The second buffer of the document stands for what they become, and has no data.
    """
    small, views, length = BinaryChunk(), [], 0
    for view, part in zip(chunk.views, chunk.parts, strict=True):
        packed = _packed(view, part)
        if packed is None:
            views.append(small.views[small.view(part)])
            continue
        data, stride, mode = packed
        place = small.views[small.view(np.frombuffer(data, np.uint8))]
        count = len(part) if "target" in view else part.nbytes // stride
        entry: dict[str, Any] = {"buffer": 1, "byteOffset": length, "byteLength": count * stride}
        if mode == "ATTRIBUTES" and "target" in view:
            entry["byteStride"] = stride
        entry |= {"target": view["target"]} if "target" in view else {}
        entry["extensions"] = {MESHOPT: place | {"byteStride": stride, "count": count, "mode": mode}}
        views.append(entry)
        length += count * stride + -count * stride % 4
    document["bufferViews"] = views
    fallback = {"byteLength": length, "extensions": {MESHOPT: {"fallback": True}}}
    document["buffers"] = [{"byteLength": small.length}, fallback]
    document["extensionsUsed"] = document.get("extensionsUsed", []) + EXTENSIONS
    document["extensionsRequired"] = EXTENSIONS
    return small


def _packed(view: dict[str, Any], part: np.ndarray) -> tuple[bytes, int, str] | None:
    """The data of an array, the bytes of an element and the mode; None if it stays as it is."""
    if not len(part):
        return None
    if view.get("target") == 34963:
        return encoded_triangles(part.reshape(-1, 3)), part.itemsize, "TRIANGLES"
    rows = np.ascontiguousarray(part.reshape(len(part), -1)).view(np.uint8)
    if "target" in view:  # elements of vertices begin every four bytes
        rows = np.pad(rows, ((0, 0), (0, -rows.shape[1] % 4)))
    elif rows.size % 4:
        return None
    elif rows.shape[1] % 4 or rows.shape[1] > _MOST_BYTES:
        rows = rows.reshape(-1, 4)
    return encoded_attributes(rows), rows.shape[1], "ATTRIBUTES"
