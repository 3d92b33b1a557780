# Import script of Godot 4 for .glb files of MeshSplats: gives their meshes the shader beside it.
@tool
extends EditorScenePostImport


func _post_import(scene: Node) -> Object:
	var folder: String = get_script().resource_path.get_base_dir()
	var shader: Shader = load(folder.path_join("meshsplats.gdshader"))
	load(folder.path_join("meshsplats.gd")).dress(scene, shader.code)
	return scene
