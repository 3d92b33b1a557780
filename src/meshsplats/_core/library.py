"""The compiled core behind ctypes: loads the variant that suits the processor, calls its functions."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from ctypes import POINTER, c_char_p, c_int, c_int64, c_void_p
from functools import cache
from pathlib import Path

import numpy as np

from meshsplats._core.layout import check_layout
from meshsplats._core.quota import processor_quota
from meshsplats._core.stopping import stoppable
from meshsplats._core.structures import (
    CameraStruct,
    ImageGradientsStruct,
    ImageStruct,
    MeshStruct,
    OptionsStruct,
    SplatsStruct,
    VertexGradientsStruct,
)

VARIANTS = ("v4", "v3", "baseline")
"""Instruction sets of the cores, best first: x86-64-v4 (AVX-512), x86-64-v3 (AVX2), any processor."""

SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
"""Of the cores' file names on this system."""

INTERFACE_VERSION = 17

QUICK_FRAGMENTS = 1e9
"""Images that cannot have more of them are soon drawn: in seconds, if each triangle were as large as they."""
LONG = frozenset(
    {"ms_nearest", "ms_merge_pairs", "ms_order_triangles", "ms_viewer_images", "ms_match_photos"}
    | {"ms_count_consistent", "ms_fill_depths", "ms_count_views", "ms_fuse_points"}
)
"""Functions other than those of images that may run for seconds."""


def pointer(array: np.ndarray | None) -> int | None:
    """Address of a C-contiguous array, for a structure that is used while the array is alive."""
    if array is None:
        return None
    if not array.flags.c_contiguous:
        raise ValueError("the core takes C-contiguous arrays only")
    return array.ctypes.data


def library_path(variant: str) -> Path | None:
    """The file of a variant of the core, or None where it was not built."""
    import meshsplats._core

    # An editable install keeps the compiled files in another folder of the package's path.
    for folder in meshsplats._core.__path__:
        path = Path(folder) / f"meshsplats_{variant}{SUFFIX}"
        if path.is_file():
            return path
    return None


def available_variants() -> list[str]:
    """The variants that were built and that this processor runs, best first; none where MESHSPLATS_LIBRARY
    takes their place."""
    baseline = library_path("baseline")
    if baseline is None or os.environ.get("MESHSPLATS_LIBRARY"):
        return []
    library = ctypes.CDLL(str(baseline))
    library.ms_best_variant.restype = c_char_p
    best = library.ms_best_variant().decode()
    runs = VARIANTS[VARIANTS.index(best) :]
    return [variant for variant in runs if library_path(variant)]


@cache
def load_core(variant: str | None = None) -> ctypes.CDLL:
    """The core's library; the best variant, or the one named by MESHSPLATS_VARIANT, unless another is asked
    for. MESHSPLATS_LIBRARY, the path of a library, takes the place of both: for developers, to run a core
    built with sanitizers.

    Raises ImportError if the core was not built, ValueError if the processor cannot run the variant.
    """
    if variant is None and (path := os.environ.get("MESHSPLATS_LIBRARY")):
        return _checked(ctypes.CDLL(path))
    available = available_variants()
    if not available:
        raise ImportError(
            "the compiled core of meshsplats is missing: install the package from a clone or a wheel (pip"
            " install /path/to/meshsplats) instead of running it from its sources"
        )
    wanted = variant or os.environ.get("MESHSPLATS_VARIANT") or available[0]
    if wanted not in available:
        raise ValueError(
            f"the core has no variant {wanted!r} that runs here; available: {', '.join(available)}"
        )
    return _checked(ctypes.CDLL(str(library_path(wanted))))


def _checked(library: ctypes.CDLL) -> ctypes.CDLL:
    """The library with the signatures of its functions. Raises ImportError if its interface is another."""
    library.ms_variant.restype = c_char_p
    if library.ms_interface_version() != INTERFACE_VERSION:
        raise ImportError(
            "the compiled core is of another version than the Python code: install the package again"
        )
    check_layout(library)
    message = [c_char_p, c_int]
    mesh_and_camera = [POINTER(MeshStruct), POINTER(CameraStruct), POINTER(OptionsStruct)]
    signatures: dict[str, list[type]] = {
        "ms_render_mesh": [*mesh_and_camera, POINTER(ImageStruct)],
        "ms_render_splats": [POINTER(SplatsStruct), *mesh_and_camera[1:], POINTER(ImageStruct)],
        "ms_rasterize": [*mesh_and_camera, POINTER(ImageStruct), c_int64, POINTER(c_void_p)],
        "ms_rasterize_backward": [
            *mesh_and_camera,
            c_void_p,
            POINTER(ImageGradientsStruct),
            POINTER(VertexGradientsStruct),
        ],
    }
    for name, arguments in signatures.items():
        function = getattr(library, name)
        function.restype = c_int
        function.argtypes = arguments + message
    for name in ("ms_free_tape", "ms_stop_with"):
        getattr(library, name).restype = None
        getattr(library, name).argtypes = [c_void_p]
    return library


def call(
    name: str,
    scene: MeshStruct | SplatsStruct,
    camera: CameraStruct,
    options: OptionsStruct,
    *arguments: object,
) -> None:
    """Runs a function of the core that draws, or the backward pass of one. Raises MemoryError, RuntimeError
    or, for splats that share vertices and cannot be filtered, ValueError, with the core's message; if what
    answers a signal raises, as KeyboardInterrupt, that."""
    count = scene.count if isinstance(scene, SplatsStruct) else scene.face_count
    most = count * camera.width * camera.height * options.samples**2
    given = scene, camera, options, *arguments
    status, text = _status(load_core(), name, given, is_long=most > QUICK_FRAGMENTS)
    if status == 1:
        raise MemoryError(f"{name}: {text}; render fewer triangles, pixels or samples at a time")
    if status == 3:
        raise ValueError(
            f"{text}: the filter moves each splat's vertices on their own. Give every splat"
            " its own vertices, or draw without the filter (filter_px2=0)"
        )
    if status:
        raise RuntimeError(f"{name}: {text}")


def run(name: str, argument: ctypes.Structure) -> None:
    """Runs a function of the core that takes one structure. Raises MemoryError, or ValueError with the core's
    message; ImportError if the core does not have it; one of ``LONG`` also as ``call`` does."""
    core = load_core()
    if not hasattr(core, name) and "baseline" in available_variants():
        core = load_core("baseline")  # has what gains nothing from wide vectors
    if not hasattr(core, name):
        raise ImportError(
            f"the compiled core has no {name}: it is older than the Python code, install the package again"
        )
    status, text = _status(core, name, (ctypes.byref(argument),), is_long=name in LONG)
    if status == 1:
        raise MemoryError(f"{name}: {text}")
    if status:
        raise ValueError(text)


def _status(core: ctypes.CDLL, name: str, arguments: tuple[object, ...], *, is_long: bool) -> tuple[int, str]:
    """The status that a function of the core returns, and its message. Signals end one that ``is_long``."""
    message = ctypes.create_string_buffer(256)

    def work() -> int:
        status: int = getattr(core, name)(*arguments, message, len(message))
        return status

    status = stoppable(core, work) if is_long else work()
    return status, message.value.decode()


def check_threads(threads: int | None) -> None:
    """ValueError for what is no number of threads; None: all processors."""
    if threads is not None and not (isinstance(threads, (int, np.integer)) and threads >= 1):
        raise ValueError(f"threads must be at least 1, got {threads!r}")


def thread_count(threads: int | None) -> int:
    """``threads``, by default all processors; at most 256."""
    return min(int(threads) if threads else processors(), 256)


def processors() -> int:
    """Processors this process may use: those that it may run on, or as many as its container's share of
    their time is worth, rounded up."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        count = os.cpu_count() or 1
    quota = _quota()
    return count if quota is None else min(count, math.ceil(quota))


_quota = cache(processor_quota)
