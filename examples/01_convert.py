"""Splats to a mesh that other programs open.

python examples/01_convert.py [scene.ply]        Without a file: the demo scene. Writes into example-output/.
"""

import sys
from pathlib import Path

import meshsplats as ms
from meshsplats.demo_scene import make_scene

out = Path("example-output")
out.mkdir(exist_ok=True)

cloud = ms.load_gaussians(sys.argv[1]) if len(sys.argv) > 1 else make_scene()
mesh = ms.convert(cloud)
print(f"{len(cloud):,} splats became {len(mesh.vertices):,} vertices and {len(mesh.faces):,} triangles")

# .glb for viewers, engines and Blender; .npz and .ply keep every array exactly.
for name in ("scene.glb", "scene.npz", "scene_mesh.ply"):
    ms.save_mesh(mesh, out / name)
    print(f"{out / name}: {(out / name).stat().st_size / 1e6:.1f} MB")

again = ms.load_mesh(out / "scene.glb")
assert (again.vertices == mesh.vertices).all()
