# Gives meshes of MeshSplats the shader beside this script, with the opacity and the sides of their own materials.
extends RefCounted


static func dress(node: Node, code: String) -> void:
	if node is MeshInstance3D and node.mesh != null:
		var note := note_of(node)
		for i in node.mesh.get_surface_count():
			var material := ShaderMaterial.new()
			material.shader = _shader(code, node.mesh.surface_get_material(i))
			if note.has("viewColors") and node.mesh.surface_get_format(i) & Mesh.ARRAY_FORMAT_TEX_UV:
				var colors: Dictionary = note["viewColors"]
				material.set_shader_parameter("view_dependent", true)
				material.set_shader_parameter("base", colors.get("base", 1.0))
				material.set_shader_parameter("scale", colors.get("scale", 1.0))
			node.mesh.surface_set_material(i, material)
	for child in node.get_children():
		dress(child, code)


# Godot 4.4 and newer keep glTF's extras as the metadata "extras", of the mesh or of its node.
static func note_of(node: MeshInstance3D) -> Dictionary:
	for owner in [node.mesh, node]:
		if owner.has_meta("extras"):
			return owner.get_meta("extras").get("meshsplats", {})
	return {}


static func _shader(code: String, material: Material) -> Shader:
	var alpha := ""
	if material is BaseMaterial3D:
		if material.cull_mode == BaseMaterial3D.CULL_BACK: # a file with an order
			code = code.replace("cull_disabled", "cull_back")
		if material.transparency != BaseMaterial3D.TRANSPARENCY_DISABLED:
			alpha = "ALPHA = COLOR.a;"
		if material.transparency == BaseMaterial3D.TRANSPARENCY_ALPHA_SCISSOR:
			alpha += " ALPHA_SCISSOR_THRESHOLD = %f;" % material.alpha_scissor_threshold
	var shader := Shader.new()
	shader.code = code.replace("// alpha", alpha)
	return shader
