"""Parts of .glb files by the letter of the specification, without our reader or writer."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

JSON, BIN = 0x4E4F534A, 0x004E4942


def read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON and binary part of a file."""
    data = path.read_bytes()
    magic, version, total, json_length, json_kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, total, json_kind) == (b"glTF", 2, len(data), JSON)
    assert json_length % 4 == 0
    document = json.loads(data[20 : 20 + json_length])
    binary_length, kind = struct.unpack_from("<II", data, 20 + json_length)
    binary = data[28 + json_length :]
    assert kind == BIN
    assert binary_length == len(binary)
    assert binary_length % 4 == 0
    return document, binary


def write_glb(path: Path, document: dict[str, Any], binary: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), JSON)
    path.write_bytes(head + text + struct.pack("<II", len(binary), BIN) + binary)


def edit_glb(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Lets ``change`` alter the JSON part of a file in place."""
    document, binary = read_glb(path)
    change(document)
    write_glb(path, document, binary)
