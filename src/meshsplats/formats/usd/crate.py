"""The tokens of a binary USD file, without usd-core: enough to tell what kinds of prims it holds.

A crate file ends in a table of sections; TOKENS is a list of strings, each ended by 0, packed as one LZ4
block. https://github.com/PixarAnimationStudios/OpenUSD, pxr/usd/sdf/crateFile.h
"""

from __future__ import annotations

import struct
from typing import BinaryIO

_SECTIONS = 64
_MOST = 4 << 20
"""Bytes of tokens that are unpacked; real files have a few kilobytes."""


def is_crate(file: BinaryIO) -> bool:
    """Whether a USD file, opened at its start, is binary. It is at its start again then."""
    found = file.read(8) == b"PXR-USDC"
    file.seek(0)
    return found


def holds_token(file: BinaryIO, token: bytes) -> bool:
    """Whether ``token`` is among those of an opened crate file; False for a broken one."""
    try:
        return token in _tokens(file).split(b"\0")
    except (struct.error, IndexError, ValueError):
        return False


def _tokens(file: BinaryIO) -> bytes:
    head = file.read(24)
    (table,) = struct.unpack_from("<q", head, 16)
    _go(file, table)
    (count,) = struct.unpack("<Q", file.read(8))
    for _ in range(min(count, _SECTIONS)):
        name, start, _size = struct.unpack("<16sqq", file.read(32))
        if name.rstrip(b"\0") == b"TOKENS":
            _go(file, start)
            _number, length, packed = struct.unpack("<QQQ", file.read(24))
            return _unpacked(file.read(min(packed, _MOST)), min(length, _MOST))
    return b""


def _go(file: BinaryIO, place: int) -> None:
    if place < 0:
        raise ValueError("a section before the file")
    file.seek(place)


def _unpacked(data: bytes, length: int) -> bytes:
    """Up to ``length`` bytes of data that OpenUSD has packed: a number of chunks, 0 for a single one, each
    with its size before it; and LZ4 blocks."""
    if not data[0]:
        return _lz4(data[1:], length)
    out, at = b"", 1
    for _ in range(data[0]):
        (size,) = struct.unpack_from("<i", data, at)
        if size < 0:
            raise ValueError("a chunk of negative size")
        out += _lz4(data[at + 4 : at + 4 + size], length - len(out))
        at += 4 + size
    return out


def _lz4(data: bytes, length: int) -> bytes:
    """Up to about ``length`` bytes of an LZ4 block: literals, and copies of what came before."""
    out, at = bytearray(), 0
    while at < len(data) and len(out) < length:
        kind = data[at]
        at += 1
        literals, at = _count(data, at, kind >> 4)
        out += data[at : at + literals]
        at += literals
        if at >= len(data):
            break
        (back,) = struct.unpack_from("<H", data, at)
        copied, at = _count(data, at + 2, kind & 15)
        copied += 4
        if not 0 < back <= len(out) or copied > length:
            raise ValueError("a copy of what is not there")
        piece = bytes(out[-back:])
        out += (piece * (copied // back + 1))[:copied]
    return bytes(out)


def _count(data: bytes, at: int, nibble: int) -> tuple[int, int]:
    """A count whose first 4 bits are ``nibble``, and where the data go on."""
    if nibble < 15:
        return nibble, at
    while True:
        more = data[at]
        at += 1
        nibble += more
        if more < 255:
            return nibble, at
