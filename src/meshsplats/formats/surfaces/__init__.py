"""Writers of opaque surfaces with textures, for programs of all kinds."""
