"""The part of reading an animation of USD that runs in a process of its own.

    python -m meshsplats.formats.usd.frame_extraction FILE RESULT [X Y Z]

does what ``extraction`` does, and adds the vertices at all times.
"""

from __future__ import annotations

import sys
from functools import partial

from meshsplats.formats.usd.extraction import extract_meshes
from meshsplats.formats.usd.opening import main

if __name__ == "__main__":
    main(sys.argv[1:], partial(extract_meshes, frames=True))
