"""Shared fixtures and paths."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("repeatable")

SHARED = Path(os.environ.get("MESHSPLATS_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))


def shared_data(path: str) -> Path:
    """A file of the local collection of real data, which is no part of the project; skips without it."""
    found = SHARED / path
    if not found.exists():
        pytest.skip(f"real data not here: {found} (set MESHSPLATS_SHARED_DATA to its folder)")
    return found


def words_of(command: str) -> list[str]:
    """The arguments of a command as the shell of this system splits it."""
    if sys.platform != "win32":
        return shlex.split(command)
    return [inner or word for inner, word in re.findall(r'"([^"]*)"|(\S+)', command)]


def make_link(link: Path, target: Path) -> None:
    """Makes a symbolic link; skips where this process may not, as on Windows by default."""
    try:
        link.symlink_to(target)
    except (OSError, NotImplementedError) as error:
        pytest.skip(f"no symbolic links here: {error}")
    if not link.is_symlink():
        pytest.skip("symbolic links are not recognised here")
