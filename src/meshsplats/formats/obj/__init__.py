"""Wavefront OBJ files, with the textures of their materials."""
