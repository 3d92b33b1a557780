"""Camera placement: the subject of a scene, orbits and domes around it; camera files."""
