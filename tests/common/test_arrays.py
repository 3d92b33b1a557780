"""Samples of sequences and arrays."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats._common.arrays import subsample


@pytest.mark.parametrize("count", [1, 19, 20, 21, 28, 39, 40, 41, 59, 1000])
def test_samples_are_as_many_as_may_be_and_evenly_spread(count):
    chosen = subsample(range(count), 20)
    assert len(chosen) == min(count, 20)
    assert chosen[0] == 0
    # The way from the last one round to the first counts, too: cameras may stand in a circle.
    gaps = np.diff([*chosen, count])
    assert gaps.max() - gaps.min() <= 1
    if count % 20 == 0:
        assert set(gaps) == {count // 20}


def test_samples_of_large_arrays_where_numbers_have_32_bits(monkeypatch):
    """By default, those of NumPy 1 on Windows."""
    real = np.arange
    monkeypatch.setattr(np, "arange", lambda *a, dtype=np.int32, **more: real(*a, dtype=dtype, **more))
    chosen = subsample(real(1_000_000), 10_000)
    assert np.array_equal(chosen, real(10_000, dtype=np.int64) * 100)


def test_samples_are_of_the_kind_of_what_they_are_of():
    rows = np.arange(21.0).reshape(7, 3)
    assert np.array_equal(subsample(rows, 3), rows[[0, 2, 4]])
    assert subsample(tuple("abcde"), 2) == ("a", "c")
    assert subsample("abcde", 3) == ["a", "b", "d"]
    assert subsample((), 3) == ()
    assert len(subsample(rows[:0], 3)) == 0
