"""Imports a .glb of MeshSplats into Unreal 5, with an unlit material of its vertex colours. Not run.

In the editor's Python: ``import_meshsplats.run("/path/engine.glb")``. Vertex colours of the file are linear.
"""

import unreal

FOLDER = "/Game/MeshSplats"


def run(path: str) -> None:
    """Imports the meshes of ``path`` below ``FOLDER`` and gives them the material."""
    task = unreal.AssetImportTask()
    task.filename, task.destination_path = path, FOLDER
    task.automated, task.save, task.replace_existing = True, True, True
    tools = unreal.AssetToolsHelpers.get_asset_tools()
    tools.import_asset_tasks([task])
    material = _material(tools)
    for name in task.imported_object_paths:
        mesh = unreal.load_asset(name)
        if isinstance(mesh, unreal.StaticMesh):
            for slot in range(len(mesh.static_materials)):
                mesh.set_material(slot, material)


def _material(tools):
    """Unlit, of both sides; its emission is the vertex colour."""
    material = tools.create_asset("M_MeshSplats", FOLDER, unreal.Material, unreal.MaterialFactoryNew())
    material.set_editor_property("shading_model", unreal.MaterialShadingModel.MSM_UNLIT)
    material.set_editor_property("two_sided", True)
    editing = unreal.MaterialEditingLibrary
    color = editing.create_material_expression(material, unreal.MaterialExpressionVertexColor, -300, 0)
    editing.connect_material_property(color, "", unreal.MaterialProperty.MP_EMISSIVE_COLOR)
    editing.recompile_material(material)
    return material
