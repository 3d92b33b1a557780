"""The binary chunk of a `.glb` file, as it is written."""

from __future__ import annotations

from typing import Any

import numpy as np

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
