"""Images by EEVEE, which Blender 5.3.0 now and then ends by a crash where there is no graphics card."""

from __future__ import annotations

import ctypes
import subprocess
import sys

from _needs import lacking

from meshsplats.blender import BlenderError, draw

ATTEMPTS = 4
_ANIMATION = """
import os, sys
import bpy
from meshsplats.blender.inside import far_to_near
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
if bpy.app.version < (4, 5, 0):
    bpy.app.handlers.frame_change_post.append(lambda scene, _: far_to_near.follow_camera(scene))
bpy.ops.render.render(animation=True)
os._exit(0)  # Blender 4.2 crashes when it ends
"""


def draw_by_eevee(*arguments, **options) -> None:
    """``draw``, once more after a crash; skips without EGL."""
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError as error:
        lacking("egl", str(error))
    for attempt in range(ATTEMPTS):
        try:
            return draw(*arguments, **options)
        except BlenderError as error:
            if "ended by signal" not in str(error) or attempt == ATTEMPTS - 1:
                raise


def draw_animation(blend) -> None:
    """The frames of a .blend, by a process of its own, once more after a crash."""
    for _ in range(ATTEMPTS):
        done = subprocess.run([sys.executable, "-c", _ANIMATION, str(blend)], capture_output=True, text=True)
        if done.returncode >= 0:
            break
    assert done.returncode == 0, done.stderr
