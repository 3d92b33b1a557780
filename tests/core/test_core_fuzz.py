"""A few calls of tests/fuzz/fuzz_core.py; with sanitizers in `make test-sanitizers`."""

from __future__ import annotations

import warnings

import pytest
from _local import script

fuzz_core = script("tests/fuzz/fuzz_core.py")


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", fuzz_core.CALLS)
def test_made_up_arrays_give_a_result_or_a_clear_error(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of NumPy, above the core
        outcomes = fuzz_core.outcomes(name, seed=0, numbers=range(100))
    assert set(outcomes) <= {"done", "ValueError", "MemoryError"}
    assert outcomes["done"] >= 60
