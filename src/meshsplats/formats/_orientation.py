"""Turns between files with other axes and ours."""

from __future__ import annotations

import numpy as np

HALF_TURN_X = np.diag([1.0, -1.0, -1.0])
"""Half turn about x: from y up to y down and back; reverses z, too."""
HALF_TURN_Z = np.diag([-1.0, -1.0, 1.0])
"""Half turn about z: from y up to y down and back; reverses x, too."""
