"""What tests take from this machine: real data, scripts of the repository, links, the words of its shell."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest

SHARED = Path(os.environ.get("MESHSPLATS_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))

linux_names = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="other systems have other limits of names"
)


def shared_data(path: str) -> Path:
    """A file of the local collection of real data, which is no part of the project; skips without it."""
    found = SHARED / path
    if not found.exists():
        pytest.skip(f"real data not here: {found} (set MESHSPLATS_SHARED_DATA to its folder)")
    return found


def script(place: str) -> ModuleType:
    """The module of a script of the repository, which is no part of the package; skips without it."""
    path = Path(__file__).parents[1] / place
    if not path.exists():
        pytest.skip(f"not here: {place}", allow_module_level=True)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look there for their module
    spec.loader.exec_module(module)
    return module


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
