"""ICC profiles of colours, written by hand."""

from __future__ import annotations

import struct

ADOBE_RGB = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
"""XYZ (D50) of its primaries."""


def tag(kind: bytes, *values: float) -> bytes:
    numbers = [round(value * 65536) for value in values]
    return kind + bytes(4) + struct.pack(f">{len(values)}i", *numbers)


def profile(primaries=ADOBE_RGB, gamma=2.19921875) -> bytes:
    """An ICC profile of three primaries and a gamma."""
    curve = b"curv" + bytes(4) + struct.pack(">IHH", 1, round(gamma * 256), 0)
    tags = {b"wtpt": tag(b"XYZ ", 0.9642, 1.0, 0.8249)}
    for name, primary in zip((b"r", b"g", b"b"), primaries, strict=True):
        tags |= {name + b"XYZ": tag(b"XYZ ", *primary), name + b"TRC": curve}
    start, table, data = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">II", start + len(data), len(content))
        data += content
    head = struct.pack(">I4sI4s4s4s", start + len(data), bytes(4), 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + tag(b"", 0.9642, 1.0, 0.8249)[4:] + bytes(48)
    return head[:128] + table + data
