"""Makes all files of a release and tries those that run here; ``make release`` runs it.

    python tools/release.py -o dist              # refuses an unfinished changelog or uncommitted changes
    python tools/release.py -o dist --rehearsal  # the same without refusing

In ``dist``: the source distribution, wheels for all platforms, extensions for Blender, and SHA256SUMS. What
remains is in ``docs/releasing.md``. Needs the packages of ``tools/requirements.txt`` and Python 3.11.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

import tomllib

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
COMMANDS = (
    ["-m", "meshsplats.demo_scene", "scene.ply"],
    ["-m", "meshsplats", "doctor"],
    ["-m", "meshsplats", "info", "scene.ply"],
    ["-m", "meshsplats", "convert", "scene.ply", "-o", "scene.glb"],
    ["-m", "meshsplats", "render", "scene.glb", "-o", "scene.png", "--width", "200"],
    ["-m", "meshsplats", "compare", "scene.ply", "scene.glb", "-o", "compare", "--width", "100"],
)
"""A newcomer's first minute."""
RELEASED = re.compile(r"meshsplats-.+\.(whl|zip|tar\.gz|part)|SHA256SUMS")
"""Names of the files of a release, those of a run that was ended included."""


def output_of(*command: str) -> str:
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def version() -> str:
    """Of the package. SystemExit where the changelog does not begin with it."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    match = re.search(r'(?m)^version = "(.+)"$', text)
    assert match is not None
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    heading = re.search(r"(?m)^## (\S+)", changelog)
    if heading is None or heading[1] != match[1]:
        raise SystemExit(f"CHANGELOG.md does not begin with version {match[1]} of pyproject.toml")
    return match[1]


def unfinished(number: str) -> list[str]:
    """Reasons not to publish this state."""
    reasons = []
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    if not re.search(rf"(?m)^## {re.escape(number)} \(\d{{4}}-\d\d-\d\d\)$", changelog):
        reasons.append(f"CHANGELOG.md: the heading must be '## {number} (YYYY-MM-DD)'")
    if changes := output_of("git", "status", "--porcelain"):
        reasons.append(f"uncommitted changes:\n{changes}")
    return reasons


def check_output(folder: Path) -> None:
    """SystemExit if ``folder``, which is emptied, holds anything but files of a release."""
    if folder.exists() and not folder.is_dir():
        raise SystemExit(f"{folder} is a file: -o takes a folder")
    files = list(folder.iterdir()) if folder.exists() else []
    others = sorted(file.name for file in files if not (file.is_file() and RELEASED.fullmatch(file.name)))
    if others:
        raise SystemExit(
            f"{folder} would be emptied, but holds {len(others)} that are no part of a release: "
            f"{', '.join(others[:5])}; name another folder after -o, or move them away"
        )


def check_sdist(path: Path) -> None:
    """SystemExit unless the source distribution holds all that a build needs, and nothing compiled."""
    with tarfile.open(path) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    tracked = set(
        output_of("git", "ls-files", "src", "CMakeLists.txt", "pyproject.toml", "LICENSE").splitlines()
    )
    if missing := sorted(tracked - names):
        raise SystemExit(f"{path.name}: missing: {', '.join(missing)}")
    if compiled := sorted(name for name in names if name.endswith((".so", ".dll", ".dylib", ".pyc"))):
        raise SystemExit(f"{path.name}: compiled files: {', '.join(compiled)}")


def find_python(number: str) -> str | None:
    """An interpreter of this version that runs: from PATH or pyenv."""
    places = [shutil.which(f"python{number}"), *Path.home().glob(f".pyenv/versions/{number}.*/bin/python")]
    for place in filter(None, places):
        if subprocess.run([str(place), "-c", "import venv, ensurepip"], capture_output=True).returncode == 0:
            return str(place)
    return None


def check_extension(path: Path, number: str) -> None:
    """SystemExit unless an extension's manifest fits what is in the .zip, and its wheels one platform."""
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        facts = tomllib.loads(archive.read("blender_manifest.toml").decode())
    wheels = [wheel.removeprefix("./") for wheel in facts["wheels"]]
    (platform,) = facts["platforms"]
    first, beyond = facts["blender_version_min"], facts.get("blender_version_max")
    checks = {
        "id or version": (facts["id"], facts["version"]) == ("meshsplats", number),
        "wheels": set(wheels) == {name for name in names if name.startswith("wheels/")},
        "packages": [w.split("/")[1].split("-")[0] for w in wheels] == ["meshsplats", "pillow"],
        "name": path.stem == f"meshsplats-{number}-{platform.replace('-', '_')}-blender_{first[:-2]}",
        "Python": f"-cp{'311' if beyond else '313'}-" in wheels[1],
        "files": {"__init__.py", "LICENSE"} <= names,
    }
    if wrong := [name for name, right in checks.items() if not right]:
        raise SystemExit(f"{path.name}: wrong {', '.join(wrong)}")


def try_wheel(wheel: Path, number: str, constraints: Path | None = None) -> str:
    """Installs the wheel with Python ``number``, as a newcomer does, and runs the first commands; returns how
    it went."""
    python = find_python(number)
    if python is None:
        return "not on this machine"
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", f"{folder}/venv"], check=True)
        python = f"{folder}/venv/bin/python"
        pip = [python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
        pip += ["--only-binary=:all:", *(["--constraint", str(constraints)] if constraints else [])]
        wall, processor = time.monotonic(), processor_seconds()
        subprocess.run([*pip, str(wheel)], check=True)
        run_commands([python], folder)
        wall, processor = time.monotonic() - wall, processor_seconds() - processor
        numpy = output_of(python, "-c", "import numpy; print(numpy.__version__)")
    return f"ok with NumPy {numpy}, in {wall:.0f} s, {processor:.0f} s of processor time"


def processor_seconds() -> float:
    """Of the processes that this one started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_commands(python: list[str], folder: str, environment: dict[str, str] | None = None) -> None:
    """Runs ``COMMANDS`` in ``folder``. SystemExit if one fails."""
    for command in COMMANDS:
        done = subprocess.run(
            [*python, *command],
            cwd=folder,
            env={**os.environ, **(environment or {})},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        )
        if done.returncode:
            raise SystemExit(f"{' '.join([*python, *command])}\n{done.stdout}")


def try_elsewhere(wheels: list[Path]) -> None:
    """The wheels for Windows and arm64, where wine and qemu are installed."""
    windows = next(wheel for wheel in wheels if wheel.stem.endswith("win_amd64"))
    arm64 = next(wheel for wheel in wheels if wheel.stem.endswith("linux_2_17_aarch64"))
    build = ROOT / "build"
    if sys.version_info[:2] == (3, 11) and shutil.which("wine"):
        command = [sys.executable, str(ROOT / "tools/windows_python.py"), str(build / "windows/python")]
        subprocess.run([*command, str(windows)], check=True)
        environment = {"WINEPREFIX": str(build / "windows/prefix"), "WINEDEBUG": "-all", "WINEARCH": "win64"}
        with tempfile.TemporaryDirectory() as folder:
            run_commands(["wine", str(build / "windows/python/python.exe")], folder, environment)
        print(f"{windows.name} under wine: ok", flush=True)
    else:
        print(f"{windows.name}: not tried, which needs Python 3.11 and wine", flush=True)
    if shutil.which("qemu-aarch64-static") and shutil.which("apt-get"):
        root = build / "arm64/root"
        command = [sys.executable, str(ROOT / "tools/arm64_python.py"), str(root), str(arm64)]
        subprocess.run(command, check=True)
        with tempfile.TemporaryDirectory() as folder:
            run_commands(["qemu-aarch64-static", "-L", str(root), f"{root}/usr/bin/python3.11"], folder)
        print(f"{arm64.name} under qemu: ok", flush=True)
    else:
        print(f"{arm64.name}: not tried, which needs qemu-aarch64-static and apt-get", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes all files of a release.")
    parser.add_argument("-o", "--output", type=Path, default=Path("dist"), help="folder for the files")
    parser.add_argument("--rehearsal", action="store_true", help="an unfinished state is no error")
    options = parser.parse_args()
    output = options.output.resolve()
    check_output(output)
    number = version()
    reasons = unfinished(number)
    if reasons and not options.rehearsal:
        raise SystemExit("not ready for a release:\n" + "\n".join(reasons))

    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    os.environ["SOURCE_DATE_EPOCH"] = output_of("git", "log", "-1", "--format=%ct")
    subprocess.run([sys.executable, "-m", "build", "--sdist", "-o", str(output), str(ROOT)], check=True)
    check_sdist(output / f"meshsplats-{number}.tar.gz")
    subprocess.run([sys.executable, str(ROOT / "tools/wheels.py"), "-o", str(output)], check=True)
    wheels = sorted(output.glob("*.whl"))
    extension = [sys.executable, str(ROOT / "blender_extension/build.py"), "-o", str(output)]
    subprocess.run([*extension, "--wheel", *map(str, wheels)], check=True)
    for package in output.glob("*-blender_*.zip"):
        check_extension(package, number)

    native = next(wheel for wheel in wheels if wheel.stem.endswith(f"manylinux_2_17_{os.uname().machine}"))
    for python in PYTHONS:
        print(f"{native.name}, Python {python}: {try_wheel(native, python)}", flush=True)
    lowest = try_wheel(native, PYTHONS[0], ROOT / "lowest-constraints.txt")
    print(f"{native.name}, Python {PYTHONS[0]}, lowest versions: {lowest}", flush=True)
    try_elsewhere(wheels)

    files = sorted(path for path in output.iterdir() if path.name != "SHA256SUMS")
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in files]
    (output / "SHA256SUMS").write_text("\n".join([*sums, ""]), encoding="utf-8")
    print(f"{len(files)} files and SHA256SUMS in {output}")
    for reason in reasons:
        print(f"only a rehearsal: {reason}")


if __name__ == "__main__":
    main()
