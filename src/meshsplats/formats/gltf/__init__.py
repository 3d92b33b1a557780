"""glTF and GLB files: meshes with textures, and splats (KHR_gaussian_splatting)."""
