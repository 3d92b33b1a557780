"""Code that runs inside Blender 4.2 or newer; needs its module bpy and NumPy only.

The command line runs it through ``worker``; Blender's extension imports it directly.
"""

from __future__ import annotations

import sys

from meshsplats.errors import PACKAGE

_PYTHONS = ((3, 11), (3, 13))
_HERE = "" if sys.version_info[:2] in _PYTHONS else f" (this is {sys.version_info[0]}.{sys.version_info[1]})"
MISSING = (
    "Blender's Python module bpy is not installed in this environment. Make one for it, as it needs Python"
    f" 3.11 or 3.13{_HERE} and a NumPy of its own: python3.11 -m venv blender-env && blender-env/bin/pip"
    f" install '{PACKAGE}[blender]', which is a clone or a wheel; or name an installed Blender: --executable"
    " /path/to/blender"
)
"""Message for a missing bpy."""
