"""What the writers of small splat files share: orders, rotations and codebooks that lose little."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from meshsplats._common.geometry import morton_codes, quaternions_of

BOOK = 256
"""Entries of a codebook."""
_ROUNDS = 100
_BINS = 1 << 14
_AT_ONCE = 1 << 16


def sorted_in_space(points: np.ndarray) -> np.ndarray:
    """(n,) indices of ``points`` (n, 3) in Morton order: neighbours in a file are then neighbours in space,
    and differ little.

    Coordinates are compared by logarithm, so that far outliers do not leave one cell to all others.
    """
    center = np.median(points, axis=0)
    away = points - center
    least = float(np.finfo(np.float32).tiny)
    usual = max(float(np.median(np.abs(away))), 1e-30 * float(np.abs(away).max()), least)
    logs = np.sign(away) * np.log1p(np.abs(away) / usual)
    low, high = logs.min(axis=0), logs.max(axis=0)
    side = float((high - low).max()) or 1.0
    return np.argsort(morton_codes(logs, low, side, 16), kind="stable")


def order_for_streams(points: np.ndarray, shapes: np.ndarray) -> np.ndarray | slice:
    """In which order to write splats whose attributes are compressed as streams: sorted in space, or as they
    are where one in four has the very shape (n, k) of the one before. A cloud made by dividing splats repeats
    itself so, and compressors find it; sorting would scatter it."""
    repeats = (shapes[1:] == shapes[:-1]).all(axis=1)
    return slice(None) if 4 * int(repeats.sum()) > len(shapes) else sorted_in_space(points)


def nearest_axes(
    quaternions: np.ndarray, scales: np.ndarray, *, third_stays: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """The same ellipsoids by their smallest rotations: (n, 4) quaternions, (n, 3) scales.

    A Gaussian does not change when its axes change signs and places. Of the 24 rotations that name it, the
    one nearest to none has a w above 0.85 and the others below 0.39: w, the largest, can be left out, and the
    others take fewer bits. ``third_stays``: the third axis keeps its place, for flat splats (kernel '2dgs'),
    whose third scale readers drop. The nearest of the 8 rotations that do so has a w above 0.65 and the
    others below sqrt(1/2).
    """
    turns, places = _cube()
    conjugates = (turns * np.array([1, -1, -1, -1], np.float32)).T
    allowed = np.flatnonzero(places[:, 2] == 2)
    turned, moved = np.empty_like(quaternions), np.empty_like(scales)
    for start in range(0, len(quaternions), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        q = quaternions[part]
        best = (
            allowed[np.abs(turns[allowed] @ q.T).argmax(axis=0)] if third_stays else _nearest_turn(q, turns)
        )
        (aw, ax, ay, az), (bw, bx, by, bz) = np.ascontiguousarray(q.T), conjugates[:, best]
        w = aw * bw - ax * bx - ay * by - az * bz
        sign = np.where(w < 0, np.float32(-1), np.float32(1))
        turned[part, 0] = w * sign
        turned[part, 1] = (aw * bx + ax * bw + ay * bz - az * by) * sign
        turned[part, 2] = (aw * by - ax * bz + ay * bw + az * bx) * sign
        turned[part, 3] = (aw * bz + ax * by - ay * bx + az * bw) * sign
        rows = 3 * np.arange(len(q))[:, None]
        moved[part] = scales[part].reshape(-1)[rows + places[best]]
    return turned, moved


def _nearest_turn(q: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """(n,) which of the ``turns`` g (24, 4) of a cube is nearest to each of ``q`` (n, 4): the one of largest
    |w| of q * conj(g), their dot product.

    Turns have one component 1, or two of sqrt(1/2), or four of 1/2, with any signs: the largest product is
    that of the largest component of q, of the two largest, or of all, which is found ten times as fast as by
    all products.
    """
    a, b, c, d = sizes = np.abs(np.ascontiguousarray(q.T))
    largest, second = np.maximum(np.maximum(a, b), np.maximum(c, d)), np.empty_like(a)
    np.maximum(np.minimum(np.maximum(a, b), np.maximum(c, d)), np.minimum(a, b), out=second)
    np.maximum(second, np.minimum(c, d), out=second)
    two, four = (largest + second) * np.float32(np.sqrt(0.5)), (a + b + c + d) * np.float32(0.5)
    least = np.where(two > largest, second, largest)
    least[four > np.maximum(two, largest)] = 0
    code = np.zeros(len(q), np.uint8)
    for i, size in enumerate(sizes):
        code += np.where(size < least, 1, np.where(q[:, i] < 0, 0, 2)).astype(np.uint8) * np.uint8(3**i)
    table = np.full(81, -1)
    for sign in (-1, 1):
        table[(np.rint(np.sign(sign * turns)).astype(int) + 1) @ 3 ** np.arange(4)] = np.arange(len(turns))
    best = table[code]
    ties = np.flatnonzero(best < 0)  # of the second largest with the third
    best[ties] = np.abs(turns @ q[ties].T).argmax(axis=0)
    return best


def _cube() -> tuple[np.ndarray, np.ndarray]:
    """The rotations g (24, 4) of a cube, and (24, 3) which axis of q is each axis of q conj(g)."""
    turns, places = [], []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                turns.append(quaternions_of(matrix[None])[0])
                # R_q = R R_g: what R_g's columns call axis order[i] is axis i of R.
                places.append(order)
    return np.array(turns, np.float32), np.array(places)


def codebook(values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """(256,) float32 ascending: the numbers by which ``values`` are told with the least mean square error,
    each counted by its weight.

    Lloyd's method on a histogram, from the density at which many values are best told, the cube root of their
    own (Panter and Dite 1951).
    """
    values = values.reshape(-1).astype(np.float64)
    low, high = float(values.min()), float(values.max())
    if low == high:
        return np.full(BOOK, low, np.float32)
    counts, edges = np.histogram(values, _BINS, (low, high), weights=weights)
    sums, _ = np.histogram(values, edges, weights=values if weights is None else values * weights)
    middles = (edges[:-1] + edges[1:]) / 2
    centers = np.divide(sums, counts, out=middles.copy(), where=counts > 0)
    smooth = np.convolve(counts.astype(np.float64), np.ones(65) / 65, "same")
    share = np.cumsum(np.cbrt(smooth) + 1e-12)
    book = np.interp((np.arange(BOOK) + 0.5) / BOOK * share[-1], share, centers)
    cumulated = [np.concatenate([[0.0], np.cumsum(a)]) for a in (counts, sums)]
    for _ in range(_ROUNDS):
        border = np.searchsorted(centers, (book[1:] + book[:-1]) / 2)
        ends = np.concatenate([[0], border, [_BINS]])
        count, total = (np.diff(c[ends]) for c in cumulated)
        moved = np.sort(np.divide(total, count, out=book.copy(), where=count > 0))
        if np.abs(moved - book).max() <= 1e-6 * (high - low):
            break
        book = moved
    return book.astype(np.float32)


def nearest_entry(values: np.ndarray, book: np.ndarray) -> np.ndarray:
    """uint8 index of the entry of the ascending ``book`` nearest to each of ``values``, of any shape."""
    borders = (book[1:].astype(np.float64) + book[:-1]) / 2
    return np.searchsorted(borders, values).astype(np.uint8)


def as_bytes(values: np.ndarray) -> np.ndarray:
    """``values``, of any shape, rounded to 0 to 255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
