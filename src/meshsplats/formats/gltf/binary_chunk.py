"""Writing `.glb` files: the binary chunk, the document that describes it, and the file around both."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.formats._orientation import turned_origin, up_quaternion
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.mesh import SplatMesh

_MAX_BYTES = (1 << 32) - 1
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


class BinaryChunk:
    """Builder of the binary chunk: arrays in order, each aligned to 4 bytes."""

    def __init__(self) -> None:
        self.parts: list[np.ndarray] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.length = 0

    def view(self, array: np.ndarray, target: int | None = None) -> int:
        """Appends ``array``; returns the index of its buffer view."""
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.length, "byteLength": little.nbytes}
        if target is not None:
            view["target"] = target
        self.parts.append(little)
        self.views.append(view)
        self.length += little.nbytes + -little.nbytes % 4
        return len(self.views) - 1

    def accessor(self, array: np.ndarray, component: int, target: int, **more: Any) -> int:
        """Appends an array of numbers (n,) or (n, 1..4); returns the index of its accessor."""
        columns = 1 if array.ndim == 1 else array.shape[1]
        accessor = {
            "bufferView": self.view(array, target),
            "componentType": component,
            "count": len(array),
            "type": _TYPES[columns],
            **more,
        }
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def attribute(self, array: np.ndarray) -> int:
        """Appends an attribute of vertices (n,) or (n, 1..4): floats, or integers that stand for fractions;
        returns the index of its accessor."""
        fractions = {} if array.dtype == np.float32 else {"normalized": True}
        return self.accessor(array, _COMPONENTS[array.dtype.name], _ARRAY_BUFFER, **fractions)

    def positions(self, array: np.ndarray) -> int:
        """Appends positions (n, 3), floats or whole numbers, with their bounds; returns the index of their
        accessor."""
        bounds = {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        return self.accessor(array, _COMPONENTS[array.dtype.name], _ARRAY_BUFFER, **bounds)

    def indices(self, faces: np.ndarray, count: int | None = None) -> int:
        """Appends the corners of ``faces`` (f, 3) int32; returns the index of their accessor. In 16 bits
        where the ``count`` of vertices is given, and allows that: the largest index is kept free, which
        graphics interfaces use as a restart mark."""
        small = count is not None and count <= 0xFFFF
        corners = faces.reshape(-1)
        corners = corners.astype(np.uint16) if small else corners.view(np.uint32)
        return self.accessor(corners, _COMPONENTS[corners.dtype.name], _ELEMENT_ARRAY_BUFFER)

    def document(
        self,
        nodes: list[dict[str, Any]],
        meshes: list[dict[str, Any]],
        materials: list[dict[str, Any]] | None = None,
        *,
        extensions: dict[str, list[str]] | None = None,
    ) -> dict[str, Any]:
        """The JSON part of a file of what was appended; the first of ``nodes`` is the scene. ``extensions``:
        extensionsUsed and extensionsRequired that are to stand in front of what grows."""
        from meshsplats import __version__

        return {
            "asset": {"version": "2.0", "generator": f"MeshSplats {__version__}"},
            **(extensions or {}),
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": meshes,
            **({} if materials is None else {"materials": materials}),
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }


def placed_node(name: str, held: SplatMesh | BaseMesh, **more: Any) -> dict[str, Any]:
    """The node ``name`` that turns the ``up`` of what it holds to +y, and puts it at its ``origin``."""
    node = {"name": name, **more, "rotation": up_quaternion(held.up)}
    return node | ({"translation": turned_origin(held).tolist()} if held.origin.any() else {})


def write_binary(path: Path, document: dict[str, Any], chunk: BinaryChunk, *, what: str, advice: str) -> None:
    """Writes ``document`` and its ``chunk`` to ``path``. ValueError for more than the 4 GiB that a file can
    hold: ``what`` takes them, and ``advice`` ends the sentence."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + chunk.length
    if total > _MAX_BYTES:
        raise ValueError(f"{what} would take {total:,} bytes, a .glb file can hold {_MAX_BYTES:,}{advice}")
    with open(path, "wb") as file:
        file.write(struct.pack("<4sIIII", b"glTF", 2, total, len(text), 0x4E4F534A))
        file.write(text)
        file.write(struct.pack("<II", chunk.length, 0x004E4942))
        for part in chunk.parts:
            file.write(part.data)
            file.write(b"\0" * (-part.nbytes % 4))
