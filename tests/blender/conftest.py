"""Shared by the tests in Blender."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def extension() -> Iterator[ModuleType]:
    """The extension, registered while the tests of a file run."""
    from _blender_extension import registered

    with registered() as module:
        yield module
