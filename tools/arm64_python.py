"""Makes a folder with Debian's Python for arm64 that runs under qemu, for ``make test-arm64``:

    python tools/arm64_python.py build/arm64/root dist/meshsplats-*-manylinux_2_17_aarch64.whl
    qemu-aarch64-static -L build/arm64/root build/arm64/root/usr/bin/python3.11 -c 'import meshsplats'

Debian's packages are downloaded and unpacked, not installed; this needs apt-get, dpkg-deb and Debian 12 as
apt's source. Packages of Python come from the package index, for aarch64.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
PLATFORMS = [
    option
    for name in ("manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux2014_aarch64")
    for option in ("--platform", name)
]
FOR_ARM64 = [*PLATFORMS, "--python-version", "3.11", "--only-binary=:all:"]
DEBIAN = ["python3.11-minimal", "libpython3.11-minimal", "libpython3.11-stdlib", "libc6", "libgcc-s1"]
DEBIAN += ["libstdc++6", "zlib1g", "libexpat1", "libffi8", "libssl3", "libbz2-1.0", "liblzma5"]
PACKAGES = ["numpy", "pillow", "tyro", "rich", "pytest", "hypothesis"]


def make(root: Path) -> None:
    """Python and packages in the folder ``root``, which must not exist. It appears whole or not at all."""
    new = root.with_name(root.name + ".part").absolute()
    shutil.rmtree(new, ignore_errors=True)
    lists, archives = new / "lists", new / "archives"
    (lists / "partial").mkdir(parents=True)
    archives.mkdir()
    (new / "status").touch()
    options = ["-oAPT::Architecture=arm64", "-oAPT::Architectures=arm64", f"-oDir::State::Lists={lists}"]
    options += [f"-oDir::State::status={new / 'status'}", f"-oDir::Cache={new}"]
    subprocess.run(["apt-get", "-qq", *options, "update"], check=True)
    subprocess.run(["apt-get", "-qq", *options, "download", *DEBIAN], check=True, cwd=archives)
    for package in sorted(archives.glob("*.deb")):
        subprocess.run(["dpkg-deb", "--extract", str(package), str(new)], check=True)
    shutil.rmtree(lists)
    shutil.rmtree(archives)
    command = [*PIP, "install", "--quiet", *FOR_ARM64, "--target", str(_packages(new)), *PACKAGES]
    subprocess.run(command, check=True)
    new.replace(root)


def install(root: Path, wheel: Path) -> None:
    """Puts the wheel of MeshSplats in the place of the one that was there."""
    for old in _packages(root).glob("meshsplats*"):
        shutil.rmtree(old)
    # pip knows no platform by the wheel's own name besides those above.
    platforms = ["--platform", wheel.stem.rsplit("-", 1)[-1], "--python-version", "3.11"]
    command = [*PIP, "install", "--quiet", "--no-deps", "--no-index", "--only-binary=:all:", *platforms]
    subprocess.run([*command, "--upgrade", "--target", str(_packages(root)), str(wheel)], check=True)


def _packages(root: Path) -> Path:
    return root / "usr" / "local" / "lib" / "python3.11" / "dist-packages"


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes a Python for arm64 that runs under qemu.")
    parser.add_argument("root", type=Path)
    parser.add_argument("wheel", type=Path)
    options = parser.parse_args()
    if not options.root.is_dir():
        make(options.root)
    install(options.root, options.wheel)


if __name__ == "__main__":
    main()
