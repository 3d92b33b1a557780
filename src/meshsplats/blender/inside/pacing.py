"""What the panel asks whenever it is drawn: of a large scene, it is looked for now and then."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from meshsplats.blender.inside.host import bpy

T = TypeVar("T")

_LONG = 0.02
"""Processor seconds: what takes as long delays the window."""
_REST = 30
"""After which multiple of its time what takes long is looked for again."""
_known: dict[tuple[str, ...], tuple[float, float, Any]] = {}
"""When they began, how long they took, and what was found."""


def paced(key: tuple[str, ...], find: Callable[[], T], *, now: bool = False) -> T:
    """What ``find`` returns or, without ``now``, may have returned a short while ago under this ``key`` in
    this file."""
    key, began, begun = (bpy.data.filepath, *key), time.monotonic(), time.thread_time()
    when, took, found = _known.get(key, (0.0, 0.0, None))
    if not now and took > _LONG and began - when < _REST * took:
        return found
    found = find()
    _known[key] = (began, time.thread_time() - begun, found)
    return found
