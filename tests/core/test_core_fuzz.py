"""A few calls of tests/fuzz/fuzz_core.py; with sanitizers in `make test-sanitizers`."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest
from _local import script

from meshsplats._core import library

fuzz_core = script("tests/fuzz/fuzz_core.py")


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", fuzz_core.CALLS)
def test_made_up_arrays_give_a_result_or_a_clear_error(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of NumPy, above the core
        outcomes = fuzz_core.outcomes(name, seed=0, numbers=range(100))
    assert set(outcomes) <= {"done", "ValueError", "MemoryError"}
    assert outcomes["done"] >= 60


NOT_CALLED = {
    "ms_interface_version": "a number",
    "ms_layout": "a table, compared when the core is loaded",
    "ms_variant": "a name",
    "ms_best_variant": "a name",
    "ms_stop_with": "an address, for what takes long: tests/core/test_stopping.py",
}


def test_every_function_of_the_core_is_called(monkeypatch):
    """With a few made-up arrays each; a new function wants a call, or a reason here."""
    source = Path(__file__).parents[2] / "src" / "meshsplats" / "csrc" / "api.cpp"
    if not source.is_file():
        pytest.skip("the source of the core is not here")
    exported = set(re.findall(r"MS_EXPORT[^(]*?(ms_\w+)\(", source.read_text(encoding="utf-8")))
    load_core, called = library.load_core, set()

    class Core:
        def __init__(self, variant=None):
            self.core = load_core(variant)

        def __getattr__(self, name):
            called.add(name)
            return getattr(self.core, name)

    monkeypatch.setattr(library, "load_core", Core)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in fuzz_core.CALLS:
            fuzz_core.outcomes(name, seed=0, numbers=range(20))
    assert exported - called == set(NOT_CALLED) - called
    assert set(NOT_CALLED) <= exported
