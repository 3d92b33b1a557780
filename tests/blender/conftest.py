"""Shared by the tests in Blender."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def extension() -> Iterator[ModuleType]:
    """The extension, registered while the tests of a file run."""
    from _blender_extension import registered

    from meshsplats.blender.inside import pacing

    with registered() as module, pytest.MonkeyPatch.context() as patch:
        patch.setattr(pacing, "_LONG", math.inf)  # the panel asks at once, on busy machines too
        yield module
