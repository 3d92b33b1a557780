"""The errors and warnings that users meet. Messages say what was expected, what was found and what to do."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Callable


class NamingOptions:
    """Base of errors and warnings that may name options: in double backquotes, so that programs can show them
    in their own way, as flags of a command line say. ``str`` shows the bare names."""

    def __str__(self) -> str:
        return self.spelled(str)

    def spelled(self, how: Callable[[str], str]) -> str:
        """The message with the names of options as ``how`` shows them."""
        return with_options(super().__str__(), how)


def with_options(text: str, how: Callable[[str], str]) -> str:
    """``text`` with the names of options in double backquotes as ``how`` shows them."""
    return re.sub(r"``(\w+)``", lambda match: how(match[1]), text)


class FileFormatError(NamingOptions, ValueError):
    """A file that cannot be read: broken, truncated, hostile or of another format."""

    @property
    def filename(self) -> str | None:
        """The file or folder that the message begins with, as of an ``OSError``; None if there is none."""
        parts = str(self).split(": ")
        heads = (": ".join(parts[:count]) for count in range(1, len(parts)))
        return next((head for head in heads if os.path.lexists(head)), None)


class OverwritingError(ValueError):
    """An output would replace a file that is read, or another output."""


class EarlierRunError(NamingOptions, FileExistsError):
    """What an earlier run, or somebody else, has left where a run would write."""


class NothingToResumeError(NamingOptions, FileNotFoundError):
    """There is no earlier run to go on with."""


class OptionValueError(NamingOptions, ValueError):
    """A value of an option that is out of range."""


class OptionsError(OptionValueError):
    """Options that contradict each other or have no effect."""


class MissingDependencyError(ImportError):
    """An optional library is missing; the message says how to install it."""


GET_TORCH = (
    "the build for processors will do: pip install torch --index-url https://download.pytorch.org/whl/cpu"
)
"""For messages: on Linux, torch from most registries comes with gigabytes of CUDA libraries."""
PACKAGE = r"C:\path\to\meshsplats-...whl" if sys.platform == "win32" else "/path/to/meshsplats"
"""For messages, what pip installs where the package is not installed yet, as it is on no index: a wheel, or a
clone, which Visual C++ cannot compile."""


class DataWarning(NamingOptions, UserWarning):
    """Some of the data was left out or altered; the message counts it."""


_INSIDE = ("meshsplats", "dataclasses")


def warn_of_data(message: str) -> None:
    """A DataWarning with ``message``, unless it is empty, at the line that called this package, be it through
    ``dataclasses.replace``."""
    if not message:
        return
    frame, level = sys._getframe(1), 2
    while (back := frame.f_back) and str(back.f_globals.get("__name__")).partition(".")[0] in _INSIDE:
        frame, level = back, level + 1
    warnings.warn(message, DataWarning, stacklevel=level + 1)


class StraysWarning(DataWarning):
    """Splats lie far outside of the scene, or are far larger than it."""


class NoColorsWarning(DataWarning):
    """A mesh file without vertex colours was read as grey, of glTF as white."""


class NoTextureWarning(DataWarning):
    """The textures of a mesh file were left out, or became vertex colours."""


class AnimationWarning(DataWarning):
    """Of a mesh file with an animation, the first time was read."""


class DivergenceError(ValueError):
    """An optimisation met values that are not finite; the message names the view."""


class DeviceError(RuntimeError):
    """The GPU failed, or cannot draw this; the message says what to do."""


class ClusterError(RuntimeError):
    """The workers of a cluster are lost; what finished tasks have written stays."""


class OtherRunError(ValueError):
    """The checkpoint to resume from belongs to another run; the message names the differences."""
