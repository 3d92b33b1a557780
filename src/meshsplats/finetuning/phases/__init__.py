"""The phases of a run: what its steps draw and compare, and what happens to the mesh between them."""
