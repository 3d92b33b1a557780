"""``python -m meshsplats``: the same as the command ``meshsplats``."""

from __future__ import annotations

import sys

from meshsplats.cli import main

if __name__ == "__main__":
    sys.exit(main())
