"""Writing `.glb` files: the binary chunk, and the file around it."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

_MAX_BYTES = (1 << 32) - 1
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


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
