"""Which photographs are matched with each other where all pairs are too many: those that look alike, and
those that follow each other.

Image retrieval by bags of visual words (Sivic and Zisserman 2003: Video Google), as COLMAP's vocabulary
tree matching: photographs look alike that share rare features. The vocabulary is made of the photographs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.words import natural_key

ALL_UP_TO = 60
"""Photographs up to which all pairs are matched."""
ALIKE = 16
"""Photographs that look most like each..."""
NEXT = 4
"""... and that follow it in the sequence of their names, which it is matched with."""
WORDS = 1024
"""Size of the vocabulary."""
FEATURES = 600
"""Features of a photograph, at most and evenly spread, that vote for likeness."""
SAMPLE = 30_000
"""Features that the vocabulary is made from, at most."""
ROUNDS = 6
"""Rounds of k-means."""
BLOCK = 4096
"""Features that are compared with the words together."""


def in_sequence(names: Sequence[str]) -> list[str]:
    """``names`` as they are counted: 2.jpg before 10.jpg."""
    return sorted(names, key=natural_key)


def alike_pairs(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """(n, 2) int64 pairs i < j of photographs to match, sorted: of all where there are few.

    ``descriptors``: (features, 128) of each photograph, ``in_sequence``.
    """
    count = len(descriptors)
    if count <= ALL_UP_TO:
        return np.stack(np.triu_indices(count, 1), axis=1)
    likeness = likenesses(descriptors)
    np.fill_diagonal(likeness, -1)
    chosen = np.zeros((count, count), bool)
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, :ALIKE]
    chosen[np.arange(count)[:, None], nearest] = True
    for step in range(1, NEXT + 1):
        rows = np.arange(count - step)
        chosen[rows, rows + step] = True
    return np.argwhere(np.triu(chosen | chosen.T, 1))


def likenesses(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """(count, count) float32 cosines of the photographs' words, weighed by how rare they are."""
    some = [_unit(subsample(rows, FEATURES)) for rows in descriptors]
    words = _vocabulary(np.concatenate(some))
    histograms = np.array([np.bincount(_nearest(rows, words), minlength=len(words)) for rows in some])
    share = (histograms > 0).mean(axis=0)
    weight = np.log(1 / np.maximum(share, 1 / len(some)))
    table = np.sqrt(histograms) * weight.astype(np.float32)
    table /= np.maximum(np.linalg.norm(table, axis=1, keepdims=True), 1e-12)
    return np.asarray(table @ table.T)


def _unit(rows: np.ndarray) -> np.ndarray:
    values = rows.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)


def _vocabulary(features: np.ndarray) -> np.ndarray:
    """(words, 128) float32 unit vectors: spherical k-means of a sample of ``features``."""
    rng = np.random.default_rng(0)
    sample = features[np.sort(rng.permutation(len(features))[:SAMPLE])]
    words = sample[rng.permutation(len(sample))[:WORDS]]
    for _ in range(ROUNDS):
        own = _nearest(sample, words)
        sums = np.zeros_like(words)
        np.add.at(sums, own, sample)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        words = np.where(length > 0, sums / np.maximum(length, 1e-12), words)
    return words


def _nearest(rows: np.ndarray, words: np.ndarray) -> np.ndarray:
    """(n,) the index of the word nearest to each of ``rows`` (n, 128), unit vectors."""
    starts = range(0, len(rows), BLOCK)
    parts = [(rows[start : start + BLOCK] @ words.T).argmax(axis=1) for start in starts]
    return np.concatenate(parts or [np.zeros(0, np.int64)])
