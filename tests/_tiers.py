"""Quick tests, which `make test` runs, slow ones (`make test-slow`), and the slowest (`make test-nightly`).

``@pytest.mark.slow`` marks a test as slow, ``@pytest.mark.nightly`` as one of the slowest; of one with
parameters, ``slow(keep=2)`` and ``nightly(keep=2)`` leave two cases, as far apart as may be, among the quick
tests. The tier ``daily`` has all but the slowest, ``few`` at most two of the quick cases of each test.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

TIERS = ("all", "daily", "quick", "slow", "nightly", "few")


def of_tier(items: Sequence[pytest.Item], tier: str) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """The tests of ``tier``, and the others, in the order of ``items``."""
    slow, nightly = marked(items, "slow"), marked(items, "nightly")
    quick = [item for item in items if item not in slow and item not in nightly]
    cases = cases_of(quick).values()
    tests = {
        "all": items,
        "daily": [item for item in items if item not in nightly],
        "quick": quick,
        "slow": slow,
        "nightly": nightly,
        "few": [same[i] for same in cases for i in far_apart(len(same), 2)],
    }
    wanted = set(tests[tier])
    return [item for item in items if item in wanted], [item for item in items if item not in wanted]


def has_none(path: Path, tier: str) -> bool:
    """Whether a file of tests names no marker of ``tier``: it has no slow, or no nightly, test."""
    if tier not in ("slow", "nightly") or not path.name.startswith("test_") or path.suffix != ".py":
        return False
    return f"mark.{tier}" not in path.read_text(encoding="utf-8")


def marked(items: Sequence[pytest.Item], name: str) -> set[pytest.Item]:
    """The tests with the marker ``name`` among ``items``, but for the cases that it keeps quick."""
    found: set[pytest.Item] = set()
    for cases in cases_of([item for item in items if item.get_closest_marker(name) is not None]).values():
        marker = cases[0].get_closest_marker(name)
        kept = far_apart(len(cases), int(marker.kwargs.get("keep", 0)) if marker is not None else 0)
        found.update(case for i, case in enumerate(cases) if i not in kept)
    return found


def cases_of(items: Sequence[pytest.Item]) -> dict[str, list[pytest.Item]]:
    """The ``items`` of each test function."""
    functions: dict[str, list[pytest.Item]] = {}
    for item in items:
        functions.setdefault(item.nodeid.partition("[")[0], []).append(item)
    return functions


def far_apart(count: int, some: int) -> set[int]:
    """At most ``some`` of the numbers below ``count``, as far apart as may be."""
    some = min(some, count)
    return {round(i * (count - 1) / max(some - 1, 1)) for i in range(some)}
