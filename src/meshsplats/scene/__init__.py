"""What a scene is made of: splats, the meshes of them, the meshes under them, and cameras."""
