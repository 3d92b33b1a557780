"""Makes a Python for Windows that runs under wine, for ``make test-windows``:

    python tools/windows_python.py build/windows dist/meshsplats-*-win_amd64.whl

The interpreter is that of python.org as the wheel of panda3d carries it (python311.dll and its modules); a
few lines of C, compiled by zig, start it. The standard library is that of the Python that runs this script,
which must be 3.11. Packages come from the package index, for Windows. Needs ``tools/requirements.txt``.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

PYTHON = "3.11"
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
FOR_WINDOWS = ["--platform", "win_amd64", "--python-version", PYTHON, "--only-binary=:all:"]
PACKAGES = [
    "numpy==1.26.4",  # newer ones want ucrtbase.crealf, which wine 8 lacks
    "pillow>=9.2",
    "tyro>=0.9.16",
    "rich>=13",
    "pytest>=8",
    "hypothesis>=6.100",
    "colorama",  # of pytest on Windows: pip reads markers as of the machine it runs on
    "trimesh>=4",
    "pygltflib>=1.16",
    "usd-core>=23.11",
    "zstandard>=0.20",
    "scikit-image>=0.22,<0.26",
    "scipy<1.16",
    "fast-simplification>=0.1.7",
    "uvunwrap>=0.3",
]
LAUNCHER = """
#include <windows.h>
int wmain(int argc, wchar_t **argv) {
    HMODULE python = LoadLibraryW(L"python311.dll");
    int (*run)(int, wchar_t **) = python ? (void *)GetProcAddress(python, "Py_Main") : 0;
    return run ? run(argc, argv) : 1;
}
"""


def make(folder: Path) -> None:
    """Python and packages in ``folder``, which must not exist. It appears whole or not at all."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        new = Path(scratch) / "python"
        new.mkdir()
        command = [*PIP, "download", "--quiet", "--no-deps", *FOR_WINDOWS, "--dest", scratch, "panda3d"]
        subprocess.run(command, check=True)
        with zipfile.ZipFile(next(Path(scratch).glob("panda3d-*.whl"))) as archive:
            for name in archive.namelist():
                base = name.removeprefix("deploy_libs/")
                wanted = base in ("python311.dll", "sqlite3.dll", "VCRUNTIME140.dll")
                if base != name and (wanted or base.endswith(".pyd") or base.startswith("lib")):
                    (new / base).write_bytes(archive.read(name))
        source = Path(scratch) / "python.c"
        source.write_text(LAUNCHER)
        command = [sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu", "-O3", "-s"]
        subprocess.run([*command, "-municode", str(source), "-o", str(new / "python.exe")], check=True)
        left_out = shutil.ignore_patterns("site-packages", "test", "config-*", "lib-dynload", "__pycache__")
        shutil.copytree(sysconfig.get_path("stdlib"), new / "Lib", ignore=left_out)
        packages = new / "Lib" / "site-packages"
        command = [*PIP, "install", "--quiet", *FOR_WINDOWS, "--target", str(packages), *PACKAGES]
        subprocess.run(command, check=True)
        new.replace(folder)


def install(folder: Path, wheel: Path) -> None:
    """Puts the wheel of MeshSplats in the place of the one that was there."""
    packages = folder / "Lib" / "site-packages"
    for old in packages.glob("meshsplats*"):
        shutil.rmtree(old)
    command = [*PIP, "install", "--quiet", "--no-deps", "--no-index", *FOR_WINDOWS, "--upgrade"]
    subprocess.run([*command, "--target", str(packages), str(wheel)], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes a Python for Windows that runs under wine.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("wheel", type=Path)
    options = parser.parse_args()
    if sys.version_info[:2] != (3, 11):
        raise SystemExit(f"needs Python {PYTHON}, whose standard library it copies")
    if not (options.folder / "python.exe").is_file():
        make(options.folder)
    install(options.folder, options.wheel)


if __name__ == "__main__":
    main()
