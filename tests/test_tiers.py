"""Which tests are quick and which are slow."""

from __future__ import annotations

from _tiers import of_tier

pytest_plugins = "pytester"

TESTS = """
import pytest

def test_quick(): pass

@pytest.mark.slow
def test_slow(): pass

@pytest.mark.slow
@pytest.mark.parametrize("i", range(3))
def test_all_cases(i): pass

@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("i", range(5))
def test_some_cases(i): pass

@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("i", range(3))
def test_first_case(i): pass

@pytest.mark.slow(keep=9)
@pytest.mark.parametrize("i", range(2))
def test_no_case(i): pass
"""
QUICK = [
    "test_quick",
    *(f"test_some_cases[{i}]" for i in (0, 4)),
    "test_first_case[0]",
    *(f"test_no_case[{i}]" for i in (0, 1)),
]


def test_few_have_two_cases_of_a_function_at_most(pytester):
    pytester.makeini("[pytest]\nmarkers = slow(keep)")
    more = "\n@pytest.mark.parametrize('i', range(7))\ndef test_many_cases(i): pass\n"
    few, others = of_tier(pytester.getitems(TESTS + more), "few")
    assert [item.name for item in few] == [*QUICK, "test_many_cases[0]", "test_many_cases[6]"]
    assert len(few) + len(others) == 22


def test_each_test_is_of_one_tier_and_slow_functions_keep_some_cases(pytester):
    pytester.makeini("[pytest]\nmarkers = slow(keep)")
    items = pytester.getitems(TESTS)
    names = [item.name for item in items]
    quick, left_out = ([item.name for item in part] for part in of_tier(items, "quick"))
    assert quick == QUICK
    assert left_out == [name for name in names if name not in QUICK]
    slow, others = ([item.name for item in part] for part in of_tier(items, "slow"))
    assert (slow, others) == (left_out, quick)
    assert of_tier(items, "all") == (items, [])
