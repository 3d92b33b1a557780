"""Tilesets: a scene of any size as an octree of meshes, each for one distance."""
