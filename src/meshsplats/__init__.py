"""MeshSplats: Gaussian splats as ordinary triangle meshes."""
