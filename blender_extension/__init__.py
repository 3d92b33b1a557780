# SPDX-License-Identifier: GPL-3.0-or-later
"""MeshSplats for Blender: Gaussian splats, and meshes made of them, by File > Import or drag and drop."""

from . import following, import_operator, object_operators, panel, settings, sorting


def register():
    settings.register()
    import_operator.register()
    object_operators.register()
    panel.register()
    following.register()
    sorting.register()


def unregister():
    sorting.unregister()
    following.unregister()
    panel.unregister()
    object_operators.unregister()
    import_operator.unregister()
    settings.unregister()
