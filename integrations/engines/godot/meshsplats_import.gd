# Import script of Godot 4 for .glb files of MeshSplats: gives their meshes the shader beside it. Not run.
@tool
extends EditorScenePostImport


func _post_import(scene: Node) -> Object:
	_dress(scene)
	return scene


func _dress(node: Node) -> void:
	if node is MeshInstance3D and node.mesh != null:
		var material := ShaderMaterial.new()
		material.shader = load(get_script().resource_path.get_base_dir().path_join("meshsplats.gdshader"))
		var note: Dictionary = _note(node)
		if note.has("viewColors") and node.mesh.surface_get_format(0) & Mesh.ARRAY_FORMAT_TEX_UV:
			var colors: Dictionary = note["viewColors"]
			material.set_shader_parameter("view_dependent", true)
			material.set_shader_parameter("base", colors.get("base", 1.0))
			material.set_shader_parameter("scale", colors.get("scale", 1.0))
		for i in node.mesh.get_surface_count():
			node.mesh.surface_set_material(i, material)
	for child in node.get_children():
		_dress(child)


# Godot 4.4 keeps glTF's extras as the metadata "extras", of the mesh or of its node.
func _note(node: MeshInstance3D) -> Dictionary:
	for owner in [node.mesh, node]:
		if owner.has_meta("extras"):
			return owner.get_meta("extras").get("meshsplats", {})
	return {}
