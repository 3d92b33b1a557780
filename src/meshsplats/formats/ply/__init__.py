"""PLY files: splats, meshes, and the header and tables of both."""
