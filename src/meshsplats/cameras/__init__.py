"""Where cameras stand: the subject of a scene, orbits and domes around it, and camera files."""
