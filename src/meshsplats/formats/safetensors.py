"""Safetensors: named arrays and a few texts in one file.

A file is the length of a JSON header (8 bytes, little endian), the header with each array's type, shape and
offsets and with texts under ``__metadata__``, then the arrays in C order without gaps. Specification:
https://huggingface.co/docs/safetensors.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from meshsplats._files.atomic import atomic_path
from meshsplats.errors import FileFormatError

_TYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "|i1",
    "U64": "<u8",
    "U32": "<u4",
    "U16": "<u2",
    "U8": "|u1",
    "BOOL": "|b1",
}
_NAMES = {np.dtype(dtype): name for name, dtype in _TYPES.items()}
_TEXTS = "__metadata__"
_MAX_HEADER_BYTES = 100_000_000
"""Limit of the format, in bytes."""


def save_safetensors(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]
) -> None:
    """Writes ``arrays`` and the texts ``metadata``, whole or not at all; replaces an older file.

    Raises:
        TypeError: the format does not have the type of an array.
    """
    packed = {}
    for name, array in arrays.items():
        little = np.asarray(array, order="C")
        little = little.astype(little.dtype.newbyteorder("<"), copy=False)
        if little.dtype not in _NAMES or name == _TEXTS:
            raise TypeError(f"safetensors files cannot hold an array {name!r} of type {little.dtype}")
        packed[name] = little
    # With the largest elements first, every array is aligned.
    order = sorted(packed, key=lambda name: (-packed[name].itemsize, name))
    header: dict[str, Any] = {_TEXTS: dict(metadata)} if metadata else {}
    end = 0
    for name in order:
        begin, end = end, end + packed[name].nbytes
        shape = list(packed[name].shape)
        header[name] = {"dtype": _NAMES[packed[name].dtype], "shape": shape, "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with atomic_path(path, needs=8 + len(text) + end) as temporary, open(temporary, "wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name in order:
            file.write(packed[name].reshape(-1).view(np.uint8).data)


def load_safetensors(
    path: str | os.PathLike[str], *, only_texts: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The arrays in the file (none with ``only_texts``) and its texts.

    Numbers of bfloat16, which NumPy lacks, become float32.

    Raises:
        FileFormatError: the file is broken or has an unknown type; raised before memory is allocated.
        OSError: the file cannot be read.
    """
    arrays = {}
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > min(size - 8, _MAX_HEADER_BYTES):
            raise _error(path, f"{size:,} bytes do not hold its header")
        entries, texts = _parse_header(path, file.read(length), size - 8 - length)
        for name, entry in ({} if only_texts else entries).items():
            try:
                array = np.empty(entry.shape, entry.dtype)
            except ValueError as problem:  # empty, but too long in the other directions
                raise _error(path, f"{name[:60]!r} has the shape {entry.shape} ({problem})") from None
            file.seek(8 + length + entry.begin)
            if array.size and file.readinto(array.reshape(-1).view(np.uint8).data) != array.nbytes:
                raise _error(path, "it ends too early")
            if entry.bfloat16:
                array = (array.astype(np.uint32) << np.uint32(16)).view(np.float32)
            arrays[name] = array
    return arrays, texts


class _Entry(NamedTuple):
    dtype: np.dtype
    shape: tuple[int, ...]
    begin: int
    bfloat16: bool
    """The values are the upper halves of float32."""


def _parse_header(
    path: str | os.PathLike[str], text: bytes, size: int
) -> tuple[dict[str, _Entry], dict[str, str]]:
    """The entries of a header for ``size`` bytes of arrays, and its texts."""
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise _error(path, f"its header is no JSON ({str(problem)[:100]})") from None
    if not isinstance(header, dict):
        raise _error(path, "its header is no JSON object")
    texts = header.pop(_TEXTS, {})
    if not isinstance(texts, dict) or not all(isinstance(value, str) for value in texts.values()):
        raise _error(path, f"{_TEXTS} must hold texts")
    entries, total = {}, 0
    for name, entry in header.items():
        entry = entry if isinstance(entry, dict) else {}
        stored = str(entry.get("dtype"))
        shape, offsets = _whole(entry.get("shape")), _whole(entry.get("data_offsets"))
        if shape is None or offsets is None or len(offsets) != 2:
            raise _error(path, f"{name[:60]!r} needs a shape and two data_offsets")
        if stored != "BF16" and stored not in _TYPES:
            raise _error(path, f"{name[:60]!r} is of the unknown type {stored[:20]}")
        dtype = np.dtype("<u2" if stored == "BF16" else _TYPES[stored])
        begin, end = offsets
        if not begin <= end <= size or end - begin != math.prod(shape) * dtype.itemsize:
            raise _error(path, f"{name[:60]!r} of shape {shape} in bytes {begin} to {end} of {size:,}")
        entries[name] = _Entry(dtype, shape, begin, stored == "BF16")
        total += end - begin
    if total != size:
        raise _error(path, f"its arrays fill {total:,} of {size:,} bytes")
    return entries, texts


def _whole(values: Any) -> tuple[int, ...] | None:
    """A short list of whole numbers >= 0; None for anything else."""
    if not isinstance(values, list) or len(values) > 32:
        return None
    good = all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v < 1 << 62 for v in values)
    return tuple(values) if good else None


def _error(path: str | os.PathLike[str], message: str) -> FileFormatError:
    return FileFormatError(f"{os.fspath(path)}: not a safetensors file: {message}")
