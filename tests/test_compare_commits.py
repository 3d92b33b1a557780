"""Which figures of two commits have moved by more than their noise."""

from __future__ import annotations

import pytest
from _local import script

tool = script("tools/compare_commits.py")


@pytest.mark.parametrize(
    ("name", "pairs", "change", "verdict"),
    [
        ("convert, s", [(1.0, 1.0)] * 5, 0.0, ""),
        ("convert, s", [(1.0, 1.004)] * 5, 0.4, ""),  # less than any measurement tells
        ("convert, s", [(1.0, 1.03), (2.0, 2.06), (1.1, 1.133), (3, 3.09), (1, 1.03)], 2.96, "worse"),
        ("convert, s", [(1.0, 0.97)] * 5, -3.05, "better"),
        ("convert, s", [(1.0, 1.5), (1.0, 0.7), (1.0, 1.05), (1.0, 0.8), (1.0, 1.4)], 4.88, ""),  # noise
        ("as converted, dB", [(34.0, 34.1)] * 5, 0.1, "better"),
        ("as converted, dB", [(34.0, 33.9)] * 5, -0.1, "worse"),
        ("as converted, dB", [(34.0, 33.99)] * 5, -0.01, ""),
    ],
)
def test_a_figure_has_moved_where_the_change_is_beyond_the_noise(name, pairs, change, verdict):
    _, _, found, noise, said = tool.compared(name, pairs)
    assert found == pytest.approx(change, abs=0.01)
    assert said == verdict
    if len(set(pairs)) == 1:
        assert noise == pytest.approx(0, abs=1e-9)


def test_the_noise_is_that_of_the_median():
    """1.58 times the interquartile range by the root of the number: changes of 0, 1, 2, 3 and 4 dB."""
    pairs = [(30.0, 30.0 + i) for i in range(5)]
    before, after, change, noise, said = tool.compared("x, dB", pairs)
    assert (before, after, change, said) == (30, 32, 2, "better")
    assert noise == pytest.approx(1.58 * 2 / 5**0.5)
