"""PLY files: splats, meshes, and the header and tables that both have."""
