"""Quick tests, which `make test` runs, and slow ones, which `make test-slow` runs.

``@pytest.mark.slow`` marks a test as slow; of one with parameters, ``slow(keep=2)`` leaves two cases, as far
apart as may be, among the quick tests.
"""

from __future__ import annotations

from collections.abc import Sequence

import pytest

TIERS = ("all", "quick", "slow")


def of_tier(items: Sequence[pytest.Item], tier: str) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """The tests of ``tier``, and the others, in the order of ``items``."""
    if tier == "all":
        return list(items), []
    slow = slow_ones(items)
    wanted = [(item in slow) == (tier == "slow") for item in items]
    pairs = list(zip(items, wanted, strict=True))
    return [item for item, here in pairs if here], [item for item, here in pairs if not here]


def slow_ones(items: Sequence[pytest.Item]) -> set[pytest.Item]:
    """The slow tests among ``items``."""
    functions: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("slow") is not None:
            functions.setdefault(item.nodeid.partition("[")[0], []).append(item)
    slow: set[pytest.Item] = set()
    for cases in functions.values():
        marker = cases[0].get_closest_marker("slow")
        keep = min(int(marker.kwargs.get("keep", 0)), len(cases)) if marker is not None else 0
        kept = {round(i * (len(cases) - 1) / max(keep - 1, 1)) for i in range(keep)}
        slow.update(case for i, case in enumerate(cases) if i not in kept)
    return slow
