"""Programs that tests need: without one they are skipped, or fail where MESHSPLATS_REQUIRE names it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from typing import NoReturn

import pytest

REMEDIES = {
    "browser": "Chromium: apt install chromium, or CHROMIUM=/path/to/it",
    "gpu": "a Vulkan driver: apt install mesa-vulkan-drivers libvulkan1 (on the processor), or that of a GPU",
    "dawn": "Dawn for node: make dawn, which needs npm (apt install nodejs npm)",
    "node": "packages of npm: make node-packages, or MESHSPLATS_NODE_FOLDER=folder/that/has/them",
    "egl": "EGL, by which EEVEE draws: apt install libegl1",
    "extras": "all extras of the package: pip install 'meshsplats[dev,torch]'",
    "qemu": "an emulator of other processors: apt install qemu-user",
}
VARIABLE = "MESHSPLATS_REQUIRE"


def lacking(need: str, reason: str) -> NoReturn:
    """Skips the test for lack of ``need``, or fails it where the run is required to have it."""
    remedy = REMEDIES[need]
    required = os.environ.get(VARIABLE, "").split(",")
    if need in required:
        pytest.fail(
            f"{VARIABLE} asks for the tests of {need}, but {reason}; it takes {remedy}", pytrace=False
        )
    pytest.skip(f"no {need}: {reason} ({remedy})")


def skipped_lines(reasons: Iterable[str], most: int = 12) -> list[str]:
    """A line for each reason, the most frequent first. Reasons are one that are the same up to a colon."""
    kinds: dict[str, list[str]] = {}
    for reason in reasons:
        kinds.setdefault(reason.removeprefix("Skipped: ").partition(":")[0], []).append(reason)
    ordered = sorted(kinds.values(), key=len, reverse=True)
    lines = []
    for same in ordered[:most]:
        text = Counter(same).most_common(1)[0][0].removeprefix("Skipped: ")
        lines.append(f"{len(same):5} skipped: {text}")
    if rest := sum(map(len, ordered[most:])):
        lines.append(f"{rest:5} skipped for {len(ordered) - most} other reasons")
    return lines
