"""Imports a .glb of MeshSplats into Unreal 5, with unlit materials of its vertex colours. Not run.

In the editor, *Output Log*, with *Cmd*: ``py "/path/import_meshsplats.py" "/path/engine.glb"``. Vertex
colours of the file are linear.
"""

import json
import struct
import sys

import unreal

FOLDER = "/Game/MeshSplats"


def run(path: str) -> None:
    """Imports the meshes of ``path`` below ``FOLDER`` and gives those of splats materials. Meshes of an
    earlier run are replaced, its materials are taken as they are."""
    looks = _looks(path)
    task = unreal.AssetImportTask()
    task.filename, task.destination_path = path, FOLDER
    task.automated, task.save, task.replace_existing = True, True, True
    unreal.AssetToolsHelpers.get_asset_tools().import_asset_tasks([task])
    for name in task.imported_object_paths:
        mesh = unreal.load_asset(name)
        if isinstance(mesh, unreal.StaticMesh):
            names = [str(slot.imported_material_slot_name) for slot in mesh.static_materials]
            slots = [i for i, material in enumerate(names) if material.startswith("splats")]
            for slot, look in zip(slots, looks, strict=False):  # an importer may join slots
                mesh.set_material(slot, _material(**look))
            unreal.EditorAssetLibrary.save_loaded_asset(mesh)


def _looks(path: str) -> list[dict]:
    """How each primitive of the mesh of splats is drawn: of a hybrid file, a solid and a blended one."""
    with open(path, "rb") as file:
        (length,) = struct.unpack("<12xI4x", file.read(20))
        document = json.loads(file.read(length))
    parts = next((mesh["primitives"] for mesh in document["meshes"] if mesh["name"] == "splats"), [])
    materials = [document["materials"][part["material"]] for part in parts]
    return [
        {
            "mode": material.get("alphaMode", "OPAQUE"),
            "two_sided": material.get("doubleSided", False),
            "cutoff": material.get("alphaCutoff", 0.5),
        }
        for material in materials
    ]


def _material(mode: str, two_sided: bool, cutoff: float):
    """Unlit; its emission is the vertex colour, its opacity that of the vertices unless solid."""
    blending = {
        "OPAQUE": (unreal.BlendMode.BLEND_OPAQUE, None),
        "MASK": (unreal.BlendMode.BLEND_MASKED, unreal.MaterialProperty.MP_OPACITY_MASK),
        "BLEND": (unreal.BlendMode.BLEND_TRANSLUCENT, unreal.MaterialProperty.MP_OPACITY),
    }
    blend_mode, opacity = blending[mode]
    name = f"M_MeshSplats_{mode.title()}{'' if two_sided else '_Culled'}"
    if unreal.EditorAssetLibrary.does_asset_exist(f"{FOLDER}/{name}"):
        return unreal.load_asset(f"{FOLDER}/{name}")
    tools = unreal.AssetToolsHelpers.get_asset_tools()
    material = tools.create_asset(name, FOLDER, unreal.Material, unreal.MaterialFactoryNew())
    material.set_editor_property("shading_model", unreal.MaterialShadingModel.MSM_UNLIT)
    material.set_editor_property("blend_mode", blend_mode)
    material.set_editor_property("opacity_mask_clip_value", cutoff)
    material.set_editor_property("two_sided", two_sided)
    editing = unreal.MaterialEditingLibrary
    color = editing.create_material_expression(material, unreal.MaterialExpressionVertexColor, -300, 0)
    editing.connect_material_property(color, "", unreal.MaterialProperty.MP_EMISSIVE_COLOR)
    if opacity is not None:
        editing.connect_material_property(color, "A", opacity)
    editing.recompile_material(material)
    unreal.EditorAssetLibrary.save_loaded_asset(material)
    return material


if __name__ == "__main__":
    if len(sys.argv) == 2:
        run(sys.argv[1])
    else:  # sys.exit would end the editor
        unreal.log_error(
            'no file: type py "import_meshsplats.py" "engine.glb" into the output log, with paths'
        )
