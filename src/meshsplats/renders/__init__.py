"""Images of splats, meshes and tilesets as files."""
