"""What runs inside Blender, 4.2 or newer: needs its module bpy and NumPy, nothing else.

The command line runs it through ``worker``; Blender's extension imports it directly.
"""

from __future__ import annotations

import sys

MISSING = (
    "Blender's Python module bpy is not installed in this environment. Make one for it, as it needs Python"
    f" 3.11 and a NumPy of its own (this is Python {sys.version_info[0]}.{sys.version_info[1]}):"
    " python3.11 -m venv blender-env && blender-env/bin/pip install 'meshsplats[blender]'; or name an"
    " installed Blender: --executable /path/to/blender"
)
"""Said where bpy is needed and not there."""
