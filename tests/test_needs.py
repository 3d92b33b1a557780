"""What is said of tests that were skipped, and when that is a failure."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest
from _needs import VARIABLE, lacking, skipped_lines


def test_a_test_without_its_browser_is_skipped_with_the_remedy(monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    with pytest.raises(pytest.skip.Exception, match=r"no browser: it does not start .*apt install chromium"):
        lacking("browser", "it does not start")


def test_it_fails_where_a_browser_is_required(monkeypatch):
    monkeypatch.setenv(VARIABLE, "gpu,browser")
    with pytest.raises(pytest.fail.Exception, match=r"MESHSPLATS_REQUIRE asks for .*browser, but it is gone"):
        lacking("browser", "it is gone")
    monkeypatch.setenv(VARIABLE, "gpu")
    with pytest.raises(pytest.skip.Exception):
        lacking("browser", "it is gone")


NOT_OF_EXTRAS = {"bpy", "gsply", "lpips", "mitsuba", "resource", "tomllib"}
"""Of environments of their own, of programs that tests compare with, and of systems."""


def test_every_package_that_tests_skip_without_is_here():
    texts = [path.read_text(encoding="utf-8") for path in Path(__file__).parent.rglob("*.py")]
    names = {name for text in texts for name in re.findall(r'importorskip\(\s*"(\w+)', text)}
    missing = sorted(name for name in names - NOT_OF_EXTRAS if find_spec(name) is None)
    if missing:
        lacking("extras", f"there is no {', '.join(missing)}")


def test_each_reason_has_a_line_with_its_count_the_most_frequent_first():
    reasons = [
        "Skipped: no symbolic links",
        *["Skipped: real data not here: a.ply"] * 2,
        "real data not here: b.ply",
    ]
    assert skipped_lines(reasons) == [
        "    3 skipped: real data not here: a.ply",
        "    1 skipped: no symbolic links",
    ]


def test_reasons_beyond_the_twelfth_are_counted():
    lines = skipped_lines([f"reason {i}" for i in range(12)] * 2 + ["one", "two"])
    assert len(lines) == 13
    assert lines[-1] == "    2 skipped for 2 other reasons"
