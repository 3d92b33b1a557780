# SPDX-License-Identifier: GPL-3.0-or-later
"""Packs the extension with wheels, ready for Blender's Get Extensions > Install from Disk: a .zip for each
platform and each range of Blender versions, because Blender unpacks only one wheel of a package.

    python blender_extension/build.py -o dist                        # for this machine
    python blender_extension/build.py -o dist --wheel dist/*.whl     # for all that Blender runs on
    python blender_extension/build.py -o dist --python 3.13          # for a Blender with another Python

The wheel of MeshSplats is built from this source tree, or given with ``--wheel``. Pillow, which .sog files
need and Blender's Python lacks, is fetched for the same platform, or given with ``--pillow``.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
PLATFORMS = [
    (r"(many)?linux.*_x86_64", "linux-x64"),
    (r"(many)?linux.*_aarch64", "linux-arm64"),
    (r"macosx.*_arm64", "macos-arm64"),
    (r"macosx.*_x86_64", "macos-x64"),
    (r"win_amd64", "windows-x64"),
    (r"win_arm64", "windows-arm64"),
]
"""The end of a wheel's name, and what Blender calls that platform."""
RANGES = {"4.2": ("3.11", "5.1.0"), "5.1": ("3.13", None)}
"""By the first Blender of a range: its Python, and the first Blender beyond the range."""
PIP_PLATFORMS = {
    "linux-x64": ["manylinux_2_28_x86_64", "manylinux_2_27_x86_64", "manylinux2014_x86_64"],
    "linux-arm64": ["manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux2014_aarch64"],
    "macos-arm64": ["macosx_11_0_arm64"],
    "macos-x64": ["macosx_10_13_x86_64", "macosx_10_10_x86_64"],
    "windows-x64": ["win_amd64"],
    "windows-arm64": ["win_arm64"],
}
"""Pip's names for Blender's platforms."""


def platform_of(wheel: str) -> str:
    """Blender's name of the platform that ``wheel``, a file name, was built for. Raises ValueError if none
    fits."""
    tag = wheel.removesuffix(".whl").rsplit("-", 1)[-1]
    for pattern, name in PLATFORMS:
        if re.fullmatch(pattern, tag):
            return name
    raise ValueError(f"{wheel}: not a wheel of a platform that Blender runs on")


def manifest(wheels: list[str], blender: str) -> str:
    """The manifest of the extension with ``wheels``, file names, the first that of MeshSplats, for the range
    of versions that ``blender`` begins."""
    text = (HERE / "blender_manifest.toml").read_text(encoding="utf-8")
    version = wheels[0].split("-")[1]
    text = re.sub(r'(?m)^version = ".*"$', f'version = "{version}"', text, count=1)
    paths = ", ".join(f'"./wheels/{wheel}"' for wheel in wheels)
    lines = f'platforms = ["{platform_of(wheels[0])}"]\nwheels = [{paths}]'
    beyond = RANGES[blender][1]
    versions = f'blender_version_min = "{blender}.0"'
    if beyond:
        versions += f'\nblender_version_max = "{beyond}"'
    text = re.sub(r"(?m)^blender_version_min = .*$", versions, text, count=1)
    return re.sub(r"(?m)^# build\.py .*$", lines, text, count=1)


def pack(wheels: list[Path], folder: Path, blender: str, python: str | None = None) -> Path:
    """Writes the extension with ``wheels``, the first that of MeshSplats, into ``folder``; returns the .zip.
    ``blender`` is the first version of the range that it is for, and ``python`` that of its Python, named
    where it is not the one of blender.org's builds.

    Raises ValueError for wheels of different platforms.
    """
    names = [wheel.name for wheel in wheels]
    platforms = sorted({platform_of(name) for name in names})
    if len(platforms) > 1:
        raise ValueError(f"the wheels are for different platforms: {', '.join(platforms)}")
    name = f"meshsplats-{names[0].split('-')[1]}-{platforms[0].replace('-', '_')}-blender_{blender}"
    name += f"-python_{python}.zip" if python else ".zip"
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / name
    temporary = target.with_suffix(".part")
    try:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("blender_manifest.toml", manifest(names, blender))
            for source in sorted(HERE.glob("*.py")):
                if source.name != Path(__file__).name:
                    archive.write(source, source.name)
            archive.write(HERE / "LICENSE", "LICENSE")
            for wheel in wheels:
                archive.write(wheel, f"wheels/{wheel.name}", zipfile.ZIP_STORED)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
    return target


def fetch_pillow(platform: str, python: str, folder: Path) -> Path:
    """A wheel of Pillow for the version ``python`` on ``platform``, as Blender names it, from the package
    index."""
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
    command += ["--python-version", python, "--dest", str(folder)]
    for name in PIP_PLATFORMS[platform]:
        command += ["--platform", name]
    subprocess.run([*command, "pillow"], check=True)
    return next(folder.glob("pillow-*.whl"))


def build_wheel(folder: Path) -> Path:
    """A wheel of the source tree that this file belongs to."""
    build = folder / "build"
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-C", f"build-dir={build}"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(HERE.parent)], check=True)
    return next(folder.glob("meshsplats-*.whl"))


def main() -> None:
    parser = argparse.ArgumentParser(description="Packs the Blender extension.")
    parser.add_argument("-o", "--output", type=Path, default=Path("dist"), help="folder for the .zip")
    parser.add_argument(
        "--wheel",
        type=Path,
        nargs="+",
        help="wheels of MeshSplats, those for musl are passed over; built from the source tree if left out",
    )
    parser.add_argument(
        "--blender", nargs="+", choices=RANGES, default=list(RANGES), help="first version of each range"
    )
    parser.add_argument(
        "--python",
        help="version of Blender's Python, such as 3.13: Blenders of Linux distributions run with that of the"
        " system, which is not always blender.org's (3.11 up to Blender 5.0, then 3.13)",
    )
    parser.add_argument("--pillow", type=Path, help="a wheel of Pillow; fetched if left out")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if not options.wheel:
            print("building the wheel of MeshSplats, which takes a minute", flush=True)
        for wheel in options.wheel or [build_wheel(Path(folder))]:
            if "-musllinux_" in wheel.name:  # Blender does not run there
                continue
            platform = platform_of(wheel.name)
            for blender in options.blender:
                place = Path(folder) / f"{platform}-{blender}"
                python = options.python or RANGES[blender][0]
                pillow = options.pillow or fetch_pillow(platform, python, place)
                print(pack([wheel, pillow], options.output, blender, options.python), flush=True)


if __name__ == "__main__":
    main()
