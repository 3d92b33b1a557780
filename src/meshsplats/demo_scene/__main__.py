"""``python -m meshsplats.demo_scene FILE.ply [COUNT]``."""

from meshsplats.demo_scene import main

main()
