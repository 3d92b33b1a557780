"""Quick tests, which `make test` runs, and slow ones, which `make test-slow` runs.

``@pytest.mark.slow`` marks a test as slow; of one with parameters, ``slow(keep=2)`` leaves two cases, as far
apart as may be, among the quick tests. The tier ``few`` has at most two of the quick cases of each test.
"""

from __future__ import annotations

from collections.abc import Sequence

import pytest

TIERS = ("all", "quick", "slow", "few")


def of_tier(items: Sequence[pytest.Item], tier: str) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """The tests of ``tier``, and the others, in the order of ``items``."""
    if tier == "all":
        return list(items), []
    slow = slow_ones(items)
    if tier == "few":
        quick = cases_of([item for item in items if item not in slow])
        few = {cases[i] for cases in quick.values() for i in far_apart(len(cases), 2)}
        wanted = [item in few for item in items]
    else:
        wanted = [(item in slow) == (tier == "slow") for item in items]
    pairs = list(zip(items, wanted, strict=True))
    return [item for item, here in pairs if here], [item for item, here in pairs if not here]


def slow_ones(items: Sequence[pytest.Item]) -> set[pytest.Item]:
    """The slow tests among ``items``."""
    slow: set[pytest.Item] = set()
    for cases in cases_of([item for item in items if item.get_closest_marker("slow") is not None]).values():
        marker = cases[0].get_closest_marker("slow")
        kept = far_apart(len(cases), int(marker.kwargs.get("keep", 0)) if marker is not None else 0)
        slow.update(case for i, case in enumerate(cases) if i not in kept)
    return slow


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
