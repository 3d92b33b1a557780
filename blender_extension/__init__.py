# SPDX-License-Identifier: GPL-3.0-or-later
"""MeshSplats for Blender: Gaussian splats, and meshes made of them, by File > Import or drag and drop."""

import importlib.util

from . import (
    bounces,
    cut_operator,
    export_operator,
    following,
    import_operator,
    light_operators,
    object_operators,
    panel,
    settings,
    sorting,
)
from .export_operator import (  # noqa: F401 - Blender's glTF exporter looks for them here
    glTF2_post_export_callback,
    glTF2_pre_export_callback,
    glTF2ExportUserExtension,
)


def register():
    if importlib.util.find_spec("numpy") is None:  # of some Linux distributions' Blenders
        raise RuntimeError(
            "MeshSplats needs NumPy, which the Python of this Blender lacks.\n"
            "Install it (Debian and Ubuntu: apt install python3-numpy) and start Blender again,\n"
            "or use Blender from blender.org."
        )
    settings.register()
    import_operator.register()
    export_operator.register()
    object_operators.register()
    light_operators.register()
    cut_operator.register()
    bounces.register()
    panel.register()
    following.register()
    sorting.register()


def unregister():
    sorting.unregister()
    following.unregister()
    panel.unregister()
    bounces.unregister()
    cut_operator.unregister()
    light_operators.unregister()
    object_operators.unregister()
    export_operator.unregister()
    import_operator.unregister()
    settings.unregister()
