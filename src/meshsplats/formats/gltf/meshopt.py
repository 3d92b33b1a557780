"""The codec of EXT_meshopt_compression: attributes and triangles, version 0, which every decoder reads.

https://github.com/KhronosGroup/glTF/blob/main/extensions/2.0/Vendor/EXT_meshopt_compression/README.md

Bytes of an attribute are stored apart, as differences from those of the element before, sixteen to a group,
with 0, 2, 4 or 8 bits each; those that do not fit into 2 or 4 bits follow behind. Triangles are coded by an
edge of a triangle before and a vertex, which is the next one or was there a short while ago.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_ATTRIBUTES, _TRIANGLES = 0xA0, 0xE1
_GROUP = 16
_BLOCK_BYTES, _MOST = 0x2000, 0x100
_AT_ONCE = 64
"""Blocks whose bytes are found before their numbers are read."""
_TAIL = 32
"""Least bytes at the end of attributes."""
_PER_BYTE = {1: 4, 2: 2}
"""By mode of a group: numbers in a byte."""
_NEXT, _EXPLICIT = 0x0, 0xF
_ALONE, _FROM_DATA, _NOT_NEXT = 0xF0, 0xFE, 0xFF
"""Codes of triangles that share no edge with one before: three new vertices; others, the first of them new;
and not."""
_AUX = 16
"""Bytes of a table at the end of triangles, of which only the first one, three new vertices, is needed."""


def block_of(stride: int) -> int:
    """Elements of ``stride`` bytes in a block."""
    return min(_BLOCK_BYTES // stride // _GROUP * _GROUP, _MOST)


# -- attributes


def encoded_attributes(values: np.ndarray) -> bytes:
    """(n, stride) uint8 elements, at least one; stride 4, 8, ... 256."""
    n, stride = values.shape
    before = np.concatenate([values[:1], values[:-1]])
    moved = (values - before).view(np.int8)
    deltas = ((moved << 1) ^ (moved >> 7)).view(np.uint8)
    size = block_of(stride)
    whole = n // size * size
    parts = [bytes([_ATTRIBUTES])]
    if whole:
        parts.append(_encoded_blocks(deltas[:whole].reshape(-1, size, stride)))
    if whole < n:
        parts.append(_encoded_blocks(deltas[None, whole:]))
    return b"".join(parts) + bytes(max(_TAIL - stride, 0)) + values[0].tobytes()


def _encoded_blocks(deltas: np.ndarray) -> bytes:
    """``deltas`` (blocks, elements, stride)."""
    blocks, elements, stride = deltas.shape
    groups = -(-elements // _GROUP)
    rows = np.zeros((blocks, stride, groups * _GROUP), np.uint8)
    rows[:, :, :elements] = deltas.transpose(0, 2, 1)
    rows = rows.reshape(-1, groups, _GROUP)
    sizes = np.stack(
        [
            np.where((rows == 0).all(axis=2), 0, 99),
            4 + (rows >= 3).sum(axis=2),
            8 + (rows >= 15).sum(axis=2),
            np.full(rows.shape[:2], _GROUP),
        ]
    )
    modes = sizes.argmin(axis=0)
    sizes = np.take_along_axis(sizes, modes[None], axis=0)[0]
    heads = -(-groups // 4)
    lengths = heads + sizes.sum(axis=1)
    starts = np.cumsum(lengths) - lengths
    places = starts[:, None] + heads + np.cumsum(sizes, axis=1) - sizes
    out = np.zeros(int(lengths.sum()), np.uint8)
    padded = np.zeros((len(rows), 4 * heads), np.uint8)
    padded[:, :groups] = modes
    shifts = np.array([0, 2, 4, 6], np.uint8)
    out[starts[:, None] + np.arange(heads)] = (padded.reshape(-1, heads, 4) << shifts).sum(axis=2)
    for mode, per_byte in _PER_BYTE.items():
        at, own = places[modes == mode], rows[modes == mode]
        bits = 8 // per_byte
        most = (1 << bits) - 1
        shifts = np.arange(8 - bits, -1, -bits, dtype=np.uint8)
        fields = np.minimum(own, most).reshape(len(own), _GROUP // per_byte, per_byte)
        packed = (fields << shifts).sum(axis=2)
        out[at[:, None] + np.arange(packed.shape[1])] = packed
        large = own >= most
        behind = at[:, None] + packed.shape[1] + np.cumsum(large, axis=1) - 1
        out[behind[large]] = own[large]
    at = places[modes == 3]
    out[at[:, None] + np.arange(_GROUP)] = rows[modes == 3]
    return out.tobytes()


def decoded_attributes(data: bytes, count: int, stride: int) -> np.ndarray:
    """(count, stride) uint8 elements.

    Raises ValueError for data that are broken, or of a later version.
    """
    if not data or data[0] != _ATTRIBUTES:
        raise ValueError(f"attributes of another version of meshopt, {data[:1].hex()}")
    size = block_of(stride)
    heads = count // size * -(-size // 64) + -(-(count % size) // 64)
    if 1 + heads * stride + max(_TAIL, stride) > len(data):
        raise ValueError(f"{count:,} elements in {len(data):,} bytes")
    deltas = np.empty((count, stride), np.uint8)
    scan = _Scan(data, data.translate(_THREES), data.translate(_FIFTEENS))
    at, whole = 1, count // size * size
    for first in range(0, whole, size * _AT_ONCE):
        last = min(first + size * _AT_ONCE, whole)
        rows, at = _decoded_blocks(scan, at, ((last - first) // size, stride, size // _GROUP))
        deltas[first:last] = rows.transpose(0, 2, 1).reshape(-1, stride)
    if whole < count:
        rows, at = _decoded_blocks(scan, at, (1, stride, -(-(count - whole) // _GROUP)))
        deltas[whole:] = rows[0, :, : count - whole].T
    if at != len(data) - max(_TAIL, stride):
        raise ValueError(f"{at:,} of {len(data):,} bytes are used")
    moved = (deltas >> 1) ^ -(deltas & 1)
    moved[:1] += np.frombuffer(data, np.uint8, stride, len(data) - stride)
    return np.cumsum(moved, axis=0, dtype=np.uint8)


class _Scan(NamedTuple):
    """Data of attributes, and of each byte how many fields of 2 and of 4 bits are full."""

    data: bytes
    threes: bytes
    fifteens: bytes


def _decoded_blocks(scan: _Scan, at: int, shape: tuple[int, int, int]) -> tuple[np.ndarray, int]:
    """(blocks, stride, 16 groups) differences of blocks of this ``shape``, blocks, stride and groups, from
    byte ``at`` on, and where they end."""
    data, threes, fifteens = scan
    blocks, stride, groups = shape
    heads = -(-groups // 4)
    still = bytes(heads)
    found: tuple[list[int], ...] = ([], [], [], [])
    for row in range(0, blocks * stride * groups, groups):
        head, at = at, at + heads
        if data[head:at] == still:
            continue
        modes = [mode for byte in data[head:at] for mode in _MODES[byte]][:groups]
        for group, mode in enumerate(modes, row):
            if mode:
                found[mode].extend((group, at))
                if mode == 3:
                    at += 16
                elif mode == 2:
                    at += 8 + sum(fifteens[at : at + 8])
                else:
                    at += 4 + sum(threes[at : at + 4])
    source = np.frombuffer(data, np.uint8)
    rows = np.zeros((blocks * stride * groups, _GROUP), np.uint8)
    for mode, listed in enumerate(found):
        if not listed:
            continue
        row, place = np.array(listed).reshape(-1, 2).T
        if place.max() + _GROUP > len(source) or at > len(source):
            raise ValueError("the data are truncated")
        if mode == 3:
            rows[row] = source[place[:, None] + np.arange(_GROUP)]
            continue
        per_byte = _PER_BYTE[mode]
        bits = 8 // per_byte
        most = (1 << bits) - 1
        packed = source[place[:, None] + np.arange(_GROUP // per_byte)]
        shifts = np.arange(8 - bits, -1, -bits, dtype=np.uint8)
        own = (packed[:, :, None] >> shifts & most).reshape(-1, _GROUP)
        large = own == most
        behind = place[:, None] + packed.shape[1] + np.cumsum(large, axis=1, dtype=np.uint8) - 1
        own[large] = source[behind[large]]
        rows[row] = own
    return rows.reshape(blocks, stride, -1), at


_MODES = [[b >> s & 3 for s in (0, 2, 4, 6)] for b in range(256)]
_THREES = bytes(modes.count(3) for modes in _MODES)
_FIFTEENS = bytes((b >> 4 == 15) + (b & 15 == 15) for b in range(256))


# -- triangles


def encoded_triangles(faces: np.ndarray) -> bytes:
    """(f, 3) vertex indices, which come back in this order; the corners of a triangle may be rotated.

    Small where triangles are fans, each with vertices of its own that are numbered as they come.
    """
    corners = faces.astype(np.int64)
    count = len(corners)
    # Where each vertex comes first; as long as they come in their order, each is the next one.
    names, order, flat = np.unique(corners, return_index=True, return_inverse=True)
    rising = np.diff(order, prepend=-1) > 0
    rising &= names == np.arange(len(names))
    numbered = len(rising) if rising.all() else int(rising.argmin())
    new = np.zeros((count, 3), bool)
    new.reshape(-1)[order[:numbered]] = True
    beside = np.zeros(count, bool)
    beside[1:] = (corners[1:, 0] == corners[:-1, 0]) & (corners[1:, 1] == corners[:-1, 2])
    turned = ~new[:, 0] & new[:, 1] & new[:, 2]  # that code would mean something else
    beside[1:] &= ~turned[:-1]
    own = flat.reshape(-1, 3)
    for array in (corners, own, new):
        array[turned] = np.roll(array[turned], -1, axis=1)

    named = np.ones((count, 3), bool)
    named[beside, :2] = False
    explicit, depth = _explicit(own, new, beside, named)
    code = np.where(new, _NEXT, np.where(explicit, _EXPLICIT, depth + ~beside[:, None]))
    aux = code[:, 1] << 4 | code[:, 2]
    from_data = ~beside & ~new.all(axis=1)
    alone = np.where(from_data, np.where(new[:, 0], _FROM_DATA, _NOT_NEXT), _ALONE)
    codes = np.where(beside, code[:, 2], alone).astype(np.uint8)

    ids = corners[explicit]
    moved = np.diff(ids, prepend=0)
    numbers = ((moved << 1) ^ (moved >> 63)).astype(np.uint64)
    lengths = 1 + sum((numbers >> np.uint64(7 * k) > 0).astype(int) for k in range(1, 5))
    septets = numbers[:, None] >> np.arange(0, 35, 7, dtype=np.uint64) & np.uint64(0x7F)
    septets |= np.where(np.arange(5) < lengths[:, None] - 1, np.uint64(0x80), np.uint64(0))
    rows, columns = np.nonzero(explicit)
    keys = np.concatenate([4 * np.flatnonzero(from_data), 4 * rows + columns + 1])
    table = np.zeros((len(keys), 5), np.uint8)
    table[: len(keys) - len(ids), 0] = aux[from_data]
    table[len(keys) - len(ids) :] = septets
    sizes = np.concatenate([np.ones(len(keys) - len(ids), int), lengths])
    in_order = np.argsort(keys)
    data = table[in_order][np.arange(5) < sizes[in_order, None]]
    return bytes([_TRIANGLES]) + codes.tobytes() + data.tobytes() + bytes(_AUX)


def _explicit(
    corners: np.ndarray, new: np.ndarray, beside: np.ndarray, named: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(f, 3) bool which corners are written as numbers, of those that are ``named``, and (f, 3) how many
    vertices were pushed since each.

    New vertices and those written are pushed; the others are found among the last that were. What is
    written moves these away, so that it is found step by step.
    """
    least, most = beside.astype(int)[:, None], np.where(beside, 12, 13)[:, None]
    explicit = np.zeros_like(new)
    explicit[:, 0] = named[:, 0] & ~new[:, 0]
    while True:
        pushed = (new | explicit).ravel()
        place = np.cumsum(pushed) - 1
        first = np.full(int(corners.max(initial=-1)) + 1, -(1 << 40))
        own = np.flatnonzero(pushed)[::-1]
        first[corners.ravel()[own]] = place[own]
        before = np.concatenate([[0], place[2::3][:-1] + 1])[: len(corners)]
        depth = before[:, None] - 1 - first[corners]
        missed = named & ~new & ~explicit & ((depth < least) | (depth > most))
        if not missed.any():
            return explicit, depth
        explicit |= missed


def decoded_triangles(data: bytes, count: int) -> np.ndarray:
    """(count,) int64 indices of the corners of triangles, at least 0.

    Raises ValueError for data that are broken, or of a later version.
    """
    if not data or data[0] != _TRIANGLES:
        raise ValueError(f"triangles of another version of meshopt, {data[:1].hex()}")
    triangles, end = count // 3, len(data) - _AUX
    at = 1 + triangles
    if count % 3 or at > end:
        raise ValueError(f"{count:,} indices in {len(data):,} bytes")
    codes = np.frombuffer(data, np.uint8, triangles, 1)
    edge, how = codes >> 4, codes & 15
    alone, exact = codes >= _ALONE, codes >= _FROM_DATA
    aux = np.frombuffer(data, np.uint8, _AUX, end)[how]
    aux[exact], numbers, at = _following(data, at, codes[exact | (~alone & (how == _EXPLICIT))])
    if at > end:
        raise ValueError("the data are truncated")

    # What is said of each corner; the first two of a triangle at an edge are those of the edge.
    said = np.stack([np.where(codes == _NOT_NEXT, _EXPLICIT, _NEXT), aux >> 4, aux & 15], axis=1)
    said[~alone, 2] = how[~alone]
    named = np.ones((triangles, 3), bool)
    named[~alone, :2] = False
    new = named & (said == _NEXT)
    explicit = named & (said == _EXPLICIT) & (exact | ~alone)[:, None]
    explicit[:, 2] |= ~alone & (how > 12)
    place = np.int32 if count < 1 << 30 else np.int64  # half the memory
    value = np.zeros(count + 1, np.int64)  # behind them that of edges before the first
    before = np.cumsum(new, dtype=place) - new.ravel()
    restarts = np.where(exact & (aux == 0), before[::3], 0)
    before -= np.repeat(np.maximum.accumulate(restarts), 3)
    value[:-1][new.ravel()] = before[new.ravel()]
    del before
    steps = np.where(said[explicit] == 13, -1, 1)
    steps[said[explicit] == _EXPLICIT] = numbers
    value[:-1][explicit.ravel()] = np.cumsum(steps)

    # The others are among the last that were new or explicit, ...
    pushed = (new | explicit).ravel()
    recent = np.concatenate([np.zeros(16, np.int64), value[:-1][pushed]])
    row, column = np.nonzero(named & ~new & ~explicit)
    depth = said[row, column] + ~alone[row]
    value[3 * row + column] = recent[16 + (np.cumsum(pushed, dtype=place) - pushed)[3 * row] - depth]
    # ... or corners of an edge of a triangle before, and so on.
    made = np.where(alone, np.int8(3), np.int8(2))
    first = np.cumsum(made, dtype=place) - made
    row = np.flatnonzero(~alone)
    number = first[row] - 1 - edge[row]
    owner = np.repeat(np.arange(triangles, dtype=place), made)[number]
    side = number - first[owner] + 3 - made[owner]
    source = np.arange(count + 1, dtype=place)
    source[3 * row] = np.where(number < 0, count, 3 * owner + (side + 1) % 3)
    source[3 * row + 1] = np.where(number < 0, count, 3 * owner + side)
    while not np.array_equal(further := source[source], source):
        source = further
    indices: np.ndarray = value[source[:-1]]
    if len(indices) and indices.min() < 0:
        raise ValueError("an index below 0")
    return indices


def _following(data: bytes, at: int, codes: np.ndarray) -> tuple[list[int], list[int], int]:
    """What follows at byte ``at`` for those ``codes`` that need it: bytes for the corners of triangles, steps
    from one number to the next, and where they end."""
    found: list[int] = []
    numbers: list[int] = []
    for code in codes.tolist():
        count = 1
        if code >= _FROM_DATA:
            own, at = data[at], at + 1
            found.append(own)
            count = (code == _NOT_NEXT) + (own >> 4 == _EXPLICIT) + (own & 15 == _EXPLICIT)
        for _ in range(count):
            value = shift = 0
            while data[at] > 0x7F and shift < 28:
                value |= (data[at] & 0x7F) << shift
                at, shift = at + 1, shift + 7
            value |= (data[at] & 0x7F) << shift
            at += 1
            numbers.append(value >> 1 ^ -(value & 1))
    return found, numbers, at
