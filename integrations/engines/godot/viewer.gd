# Shows scene.glb with the shader of MeshSplats, from the camera in camera.json if that is there: "transform", 12
# numbers by columns, "fov", its vertical angle in degrees, "near" and "far"; "shader": false keeps the material of
# the file. Prints what the importer made of each mesh.
extends Node3D

const UNCOMPRESSED := 64  # harmonics in texture coordinates need all of their bits


func _ready() -> void:
	var given := {}
	if FileAccess.file_exists("res://camera.json"):
		given = JSON.parse_string(FileAccess.get_file_as_string("res://camera.json"))
	var document := GLTFDocument.new()
	var state := GLTFState.new()
	var data := FileAccess.get_file_as_bytes("res://scene.glb")
	var error := document.append_from_buffer(data, "res://", state, UNCOMPRESSED)
	if error != OK:
		push_error("scene.glb cannot be read: " + error_string(error))
		return
	var scene := document.generate_scene(state)
	for mesh in scene.find_children("*", "MeshInstance3D", true, false):
		print(_described(mesh))
	if given.get("shader", true):
		load("res://meshsplats.gd").dress(scene, load("res://meshsplats.gdshader").code)
	add_child(scene)
	var environment := Environment.new()
	environment.background_mode = Environment.BG_COLOR
	environment.background_color = Color.WHITE
	environment.tonemap_mode = Environment.TONE_MAPPER_LINEAR
	var place := WorldEnvironment.new()
	place.environment = environment
	add_child(place)
	add_child(_camera(scene, given))


func _camera(scene: Node, given: Dictionary) -> Camera3D:
	var camera := Camera3D.new()
	if given.has("transform"):
		var t: Array = given["transform"]
		var basis := Basis(Vector3(t[0], t[1], t[2]), Vector3(t[3], t[4], t[5]), Vector3(t[6], t[7], t[8]))
		camera.transform = Transform3D(basis, Vector3(t[9], t[10], t[11]))
		camera.fov = given["fov"]
		camera.near = given["near"]
		camera.far = given["far"]
	else:
		var box := bounds(scene)
		var distance := box.size.length()
		var eye := box.get_center() + Vector3(0, 0.3, 1).normalized() * distance
		camera.look_at_from_position(eye, box.get_center())
		camera.far = 4 * distance
	return camera


static func _described(node: MeshInstance3D) -> String:
	var vertices := 0
	for i in node.mesh.get_surface_count():
		vertices += node.mesh.surface_get_arrays(i)[Mesh.ARRAY_VERTEX].size()
	var material: BaseMaterial3D = node.mesh.surface_get_material(0)
	return JSON.stringify({
		"name": node.name, "vertices": vertices, "surfaces": node.mesh.get_surface_count(),
		"colored": node.mesh.surface_get_format(0) & Mesh.ARRAY_FORMAT_COLOR != 0,
		"unshaded": material.shading_mode == BaseMaterial3D.SHADING_MODE_UNSHADED,
		"transparency": material.transparency, "cull": material.cull_mode,
	})


static func bounds(node: Node) -> AABB:
	var box := AABB()
	for mesh in node.find_children("*", "MeshInstance3D", true, false):
		var own: AABB = mesh.global_transform * mesh.get_aabb()
		box = own if box.size == Vector3.ZERO else box.merge(own)
	return box
