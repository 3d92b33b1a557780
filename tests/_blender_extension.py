"""The extension in this process, for the tests of its operators."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]


@contextmanager
def registered() -> Iterator[ModuleType]:
    """The extension's module, registered meanwhile."""
    sys.path.insert(0, str(ROOT))
    try:
        module = importlib.import_module("blender_extension")
        module.register()
        yield module
        module.unregister()
    finally:
        sys.path.remove(str(ROOT))
