"""Which variant of the core a processor gets: levels of x86-64 as the psABI defines them."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from _needs import lacking

from meshsplats._core import library

x86_64 = pytest.mark.skipif(
    platform.machine().lower() not in ("x86_64", "amd64"), reason="x86-64 has variants"
)
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")

V3 = {"cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3"}
V3 |= {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}
V4 = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
EMULATOR = shutil.which("qemu-x86_64-static") or shutil.which("qemu-x86_64")


def best_variant(path: Path) -> str:
    core = ctypes.CDLL(str(path))
    core.ms_best_variant.restype = ctypes.c_char_p
    return core.ms_best_variant().decode()


@x86_64
@linux
def test_the_best_variant_is_that_of_the_flags_that_linux_lists():
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    flags = set(next(line for line in lines if line.startswith("flags")).split())
    expected = "baseline" if not flags >= V3 else "v4" if flags >= V4 else "v3"
    for variant in library.available_variants():
        path = library.library_path(variant)
        assert path is not None
        assert best_variant(path) == expected


@pytest.mark.slow(keep=3)
@x86_64
@linux
@pytest.mark.parametrize(
    ("processor", "expected"),
    [
        ("Nehalem", "baseline"),
        ("SandyBridge", "baseline"),  # AVX, but not AVX2
        ("Haswell", "v3"),
        # One extension less than x86-64-v3 wants. Not bmi1, which glibc uses wherever there is avx2.
        *((f"Haswell,-{name}", "baseline") for name in ["abm", "movbe", "f16c", "bmi2", "fma", "avx2"]),
        ("Haswell,-xsave", "baseline"),  # the operating system does not save the wide registers
    ],
)
def test_an_emulated_processor_gets_the_variant_that_it_runs(processor, expected):
    if EMULATOR is None:
        lacking("qemu", "qemu-x86_64 is not installed")
    path = library.library_path("baseline")
    code = "import ctypes, sys\nanswer = ctypes.CDLL(sys.argv[1]).ms_best_variant\n"
    code += "answer.restype = ctypes.c_char_p\nprint(answer().decode())"
    python = os.path.realpath(sys.executable)
    command = [EMULATOR, "-cpu", processor, python, "-I", "-S", "-c", code, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == expected, done.stderr
