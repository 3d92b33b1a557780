"""Palettes of spherical harmonics: rows of many numbers, told by the nearest of a few."""

from __future__ import annotations

import numpy as np

_COARSE = 64
"""Groups that the rows are divided into first; each gets a palette of its own."""
_LARGEST_PART = 1 << 14
_ROUNDS = 6
_SAMPLE_ROUNDS = 8


def palette(rows: np.ndarray, size: int, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(size or fewer, m) float32 entries and (n,) labels for ``rows`` (n, m), which count by their
    ``weights`` (n,): all rows that differ, or else by k-means in two stages.

    The rows are divided into groups; each gets a share of the entries that grows with its variance, and
    k-means of its own. So a row is compared with a few hundred entries, not with all.
    """
    rng = np.random.default_rng(0)
    rows = np.ascontiguousarray(rows, np.float32)
    n = len(rows)
    _, first, alike = np.unique(rows @ rng.normal(size=rows.shape[1]), return_index=True, return_inverse=True)
    if len(first) <= size and (rows[first][alike] == rows).all():
        return rows[first], alike
    coarse = min(_COARSE, max(1, size // 16))
    chosen = rng.choice(n, min(n, 256 * coarse), replace=False)
    few, counted = rows[chosen], weights[chosen]
    centers = few[rng.choice(len(few), coarse, replace=False)]
    for _ in range(_SAMPLE_ROUNDS):
        centers = _moved(few, counted, centers)
    groups, errors = _nearest(rows, centers)
    errors *= weights
    order = np.argsort(groups, kind="stable")
    ends = np.cumsum(np.bincount(groups, minlength=coarse))
    shares = _shares(groups, errors, coarse, size)
    entries, labels, used = [], np.empty(n, np.int64), 0
    for k, (first, end) in enumerate(zip(np.concatenate([[0], ends[:-1]]), ends, strict=True)):
        members = order[first:end]
        if not len(members):
            continue
        own = rows[members]
        # Rows far from the others matter most, and the mean of few of them is near none.
        chance = np.sqrt(errors[members]).astype(np.float64) + 1e-9
        book = own[rng.choice(len(own), shares[k], replace=False, p=chance / chance.sum())]
        some = slice(None) if len(own) <= _LARGEST_PART else rng.choice(len(own), _LARGEST_PART, False)
        for _ in range(_ROUNDS):
            book = _moved(own[some], weights[members][some], book)
        labels[members] = _nearest(own, book)[0] + used
        entries.append(book)
        used += len(book)
    return np.concatenate(entries), labels


def _shares(groups: np.ndarray, errors: np.ndarray, coarse: int, size: int) -> np.ndarray:
    """How many of ``size`` entries each group gets: at least one, at most its rows."""
    counts = np.bincount(groups, minlength=coarse)
    wanted = np.sqrt(np.bincount(groups, errors, minlength=coarse) * counts) + 1e-9 * counts
    shares = np.minimum(counts, 1)
    for _ in range(coarse):  # what a group has no rows for goes to the others
        open_ = shares < counts
        left = size - int(shares.sum())
        if left <= 0 or not open_.any():
            break
        more = left * np.where(open_, wanted, 0) / wanted[open_].sum()
        added = np.minimum(more.astype(np.int64), counts - shares)
        if not added.any():
            break
        shares = shares + added
    return shares


def _nearest(rows: np.ndarray, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the entry nearest to each row, and the squared distance to it."""
    lengths = np.einsum("ij,ij->i", entries, entries)
    found, errors = np.empty(len(rows), np.int64), np.empty(len(rows), np.float32)
    step = max(1, (1 << 22) // len(entries))
    for start in range(0, len(rows), step):
        part = rows[start : start + step]
        distances = lengths - 2 * (part @ entries.T)
        best = distances.argmin(axis=1)
        found[start : start + step] = best
        errors[start : start + step] = distances[np.arange(len(part)), best]
    return found, np.maximum(errors + np.einsum("ij,ij->i", rows, rows), 0)


def _moved(rows: np.ndarray, weights: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """The weighted means of the rows that are nearest to each of ``entries``. Entries without any become the
    rows that are farthest from theirs."""
    labels, errors = _nearest(rows, entries)
    order = np.argsort(labels, kind="stable")
    used = labels[order]
    starts = np.flatnonzero(np.concatenate([[True], used[1:] != used[:-1]]))
    counted = weights[order, None]
    moved = entries.copy()
    sums = np.add.reduceat(rows[order] * counted, starts, axis=0)
    moved[used[starts]] = sums / np.add.reduceat(counted, starts, axis=0)
    empty = np.setdiff1d(np.arange(len(entries)), used[starts], assume_unique=True)[: len(rows)]
    moved[empty] = rows[np.argsort(-errors * weights, kind="stable")[: len(empty)]]
    return moved
