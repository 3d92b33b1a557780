"""Which tests are quick, which are slow, and which run nightly."""

from __future__ import annotations

from _tiers import TIERS, has_none, of_tier

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

@pytest.mark.nightly
def test_slowest(): pass

@pytest.mark.nightly(keep=1)
@pytest.mark.parametrize("i", range(3))
def test_slowest_cases(i): pass
"""
MARKERS = "[pytest]\nmarkers = slow(keep)\n  nightly(keep)"
QUICK = [
    "test_quick",
    *(f"test_some_cases[{i}]" for i in (0, 4)),
    "test_first_case[0]",
    *(f"test_no_case[{i}]" for i in (0, 1)),
    "test_slowest_cases[0]",
]
NIGHTLY = ["test_slowest", *(f"test_slowest_cases[{i}]" for i in (1, 2))]


def test_few_have_two_cases_of_a_function_at_most(pytester):
    pytester.makeini(MARKERS)
    more = "\n@pytest.mark.parametrize('i', range(7))\ndef test_many_cases(i): pass\n"
    few, others = of_tier(pytester.getitems(TESTS + more), "few")
    assert [item.name for item in few] == [*QUICK, "test_many_cases[0]", "test_many_cases[6]"]
    assert len(few) + len(others) == 26


def test_each_test_is_of_one_tier_and_some_cases_stay_quick(pytester):
    pytester.makeini(MARKERS)
    items = pytester.getitems(TESTS)
    names = [item.name for item in items]
    tiers = {tier: [item.name for item in of_tier(items, tier)[0]] for tier in ("quick", "slow", "nightly")}
    assert tiers["quick"] == QUICK
    assert tiers["nightly"] == NIGHTLY
    assert tiers["slow"] == [name for name in names if name not in (*QUICK, *NIGHTLY)]
    daily, left_out = ([item.name for item in part] for part in of_tier(items, "daily"))
    assert (daily, left_out) == ([name for name in names if name not in NIGHTLY], NIGHTLY)
    assert of_tier(items, "all") == (items, [])


def test_files_without_a_test_of_the_tier_are_not_imported(tmp_path):
    path = tmp_path / "test_some.py"
    for text, without in (
        ("def test_slow(): pass", {"slow", "nightly"}),
        ("@pytest.mark.slow(keep=2)\ndef test(): pass", {"nightly"}),
        ("pytestmark = [pytest.mark.nightly]", {"slow"}),
    ):
        path.write_text(text)
        assert {tier for tier in TIERS if has_none(path, tier)} == without
    path.write_text("")
    (tmp_path / "conftest.py").write_text("")
    assert has_none(path, "slow")
    assert not has_none(tmp_path / "conftest.py", "slow")
    assert not has_none(tmp_path, "slow")
