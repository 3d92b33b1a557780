# SPDX-License-Identifier: GPL-3.0-or-later
"""Packs the extension with a wheel of MeshSplats for one platform, ready for Blender's Get Extensions >
Install from Disk:

    python blender_extension/build.py -o dist

The wheel is built from this source tree for the machine it runs on, or given with ``--wheel``.
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
]
"""The end of a wheel's name, and what Blender calls that platform."""


def platform_of(wheel: str) -> str:
    """Blender's name of the platform that ``wheel``, a file name, was built for. Raises ValueError if none
    fits."""
    tag = wheel.removesuffix(".whl").rsplit("-", 1)[-1]
    for pattern, name in PLATFORMS:
        if re.fullmatch(pattern, tag):
            return name
    raise ValueError(f"{wheel}: not a wheel of a platform that Blender runs on")


def manifest(wheel: str) -> str:
    """The manifest of the extension with ``wheel``, a file name, and its platform."""
    text = (HERE / "blender_manifest.toml").read_text(encoding="utf-8")
    version = wheel.split("-")[1]
    text = re.sub(r'(?m)^version = ".*"$', f'version = "{version}"', text, count=1)
    lines = f'platforms = ["{platform_of(wheel)}"]\nwheels = ["./wheels/{wheel}"]'
    return re.sub(r"(?m)^# build\.py .*$", lines, text, count=1)


def pack(wheel: Path, folder: Path) -> Path:
    """Writes the extension with ``wheel`` into ``folder``; returns the .zip."""
    name = f"meshsplats-{wheel.name.split('-')[1]}-{platform_of(wheel.name).replace('-', '_')}.zip"
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / name
    temporary = target.with_suffix(".part")
    try:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("blender_manifest.toml", manifest(wheel.name))
            for source in sorted(HERE.glob("*.py")):
                if source.name != Path(__file__).name:
                    archive.write(source, source.name)
            archive.write(HERE / "LICENSE", "LICENSE")
            archive.write(wheel, f"wheels/{wheel.name}", zipfile.ZIP_STORED)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
    return target


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
        "--wheel", type=Path, help="a wheel of MeshSplats; built from the source tree if left out"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wheel = options.wheel or build_wheel(Path(folder))
        print(pack(wheel, options.output))


if __name__ == "__main__":
    main()
