"""Code that runs inside Blender 4.2 or newer; needs its module bpy and NumPy only.

The command line runs it through ``worker``; Blender's extension imports it directly.
"""

from __future__ import annotations

import sys

from meshsplats.errors import PACKAGE

_PYTHONS = ((3, 11), (3, 13))
_HERE = "" if sys.version_info[:2] in _PYTHONS else f" (this is {sys.version_info[0]}.{sys.version_info[1]})"
_ON_WINDOWS = sys.platform == "win32"
_BLENDER = (
    r'"C:\Program Files\Blender Foundation\Blender 4.5\blender.exe"' if _ON_WINDOWS else "/path/to/blender"
)
_PIP = (
    r"py -3.11 -m venv blender-env, then blender-env\Scripts\pip"  # PowerShell 5 knows no &&
    if _ON_WINDOWS
    else "python3.11 -m venv blender-env && blender-env/bin/pip"
)
MISSING = (
    "Blender's Python module bpy is not installed in this environment. Name an installed Blender:"
    f" --executable {_BLENDER}; or make an environment for bpy, as it needs Python 3.11 or 3.13{_HERE} and a"
    f' NumPy of its own: {_PIP} install "{PACKAGE}[blender]", which is a '
    f"{'wheel' if _ON_WINDOWS else 'clone or a wheel'}"
)
"""Message for a missing bpy."""
