"""Builds and checks wheels of MeshSplats for all platforms on one machine; ``make wheels`` runs it.

The core is compiled by Clang as the package ``ziglang`` brings it, with the headers and libraries of every
platform. Each variant is compiled once: its name in the cache is a hash of what it is made from. The Python
files and the metadata come from one wheel that the build backend packs without the core.

    python tools/wheels.py -o dist                       # all platforms
    python tools/wheels.py -o dist --only win_amd64      # one; may be repeated
    python tools/wheels.py --check dist/*.whl            # only the checks

Needs the packages of ``tools/requirements.txt``.
"""

from __future__ import annotations

import argparse
import base64
import functools
import hashlib
import os
import re
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import binaries
import zopfli.zlib

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src" / "meshsplats" / "csrc"
CACHE = ROOT / "build" / "wheels"
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
MAX_BYTES = 2_500_000
"""Of a wheel."""
SMALLER = [
    *("-mllvm", "-inline-threshold=45"),
    *("-mllvm", "-unroll-runtime=false"),
    *("-mllvm", "-unroll-allow-partial=false"),
]
"""LLVM's options for code that is a twentieth smaller and as fast (benchmarks/compilers.py). Loops with a
fixed number of iterations are still unrolled, which the core needs."""


@dataclass(frozen=True)
class Platform:
    tag: str  # of the wheel
    target: str  # zig's name of the platform, with the oldest system that is supported
    system: str  # linux, windows or macos
    machine: str  # x86_64 or arm64

    @property
    def target_options(self) -> list[str]:
        # Unlike for glibc, zig's code for musl is position-dependent by default.
        return ["-target", self.target, *(["-fPIC"] if self.target.endswith("-musl") else [])]

    @property
    def suffix(self) -> str:
        return {"linux": ".so", "windows": ".dll", "macos": ".dylib"}[self.system]


PLATFORMS = (
    Platform("manylinux_2_17_x86_64", "x86_64-linux-gnu.2.17", "linux", "x86_64"),
    Platform("manylinux_2_17_aarch64", "aarch64-linux-gnu.2.17", "linux", "arm64"),
    Platform("musllinux_1_2_x86_64", "x86_64-linux-musl", "linux", "x86_64"),
    Platform("win_amd64", "x86_64-windows-gnu", "windows", "x86_64"),
    Platform("win_arm64", "aarch64-windows-gnu", "windows", "arm64"),
    Platform("macosx_11_0_arm64", "aarch64-macos.11.0", "macos", "arm64"),
    # Aligned operator new calls aligned_alloc, which macOS has since 10.15.
    Platform("macosx_10_15_x86_64", "x86_64-macos.10.15", "macos", "x86_64"),
)


# Compiling


def variant_options(machine: str) -> dict[str, list[str]]:
    """Compiler options of each variant, from csrc/options.txt, in zig's spelling."""
    lines = (SOURCES / "options.txt").read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    options = {name: [zig_spelling(option) for option in rest] for name, *rest in rows}
    common = options.pop("common") + SMALLER
    if machine != "x86_64":
        return {"baseline": common}
    options["baseline"].append("-Os")  # zig takes -O2 for -O3; so it is as fast as GCC's, and a sixth smaller
    return {name: common + rest for name, rest in options.items()}


def zig_spelling(option: str) -> str:
    """zig names processors with underscores: -march=x86-64-v3 is -march=x86_64_v3."""
    name, equals, value = option.partition("=")
    return name + equals + value.replace("-", "_") if name in ("-march", "-mtune") else option


def source_hash() -> str:
    """Of the core's sources and of the compiler's version."""
    total = hashlib.sha256(f"ziglang {metadata.version('ziglang')}".encode())
    for path in sorted([*SOURCES.glob("*.h"), *SOURCES.glob("*.cpp")]):
        # Lines that are comments make no difference.
        content = re.sub(rb"(?m)^ *//.*\n", b"", path.read_bytes())
        total.update(f"{path.name} {len(content)} ".encode() + content)
    return total.hexdigest()


def zig(*arguments: str) -> None:
    command = [sys.executable, "-m", "ziglang", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode or "warning:" in done.stderr:  # the core compiles without a warning
        raise SystemExit(f"{' '.join(command)}\n{done.stdout}{done.stderr}")


def compiled_core(platform: Platform, variant: str, options: list[str]) -> Path:
    """The core's object file, from the cache where it is there."""
    options = [*platform.target_options, *options, f'-DMS_VARIANT="{variant}"']
    key = hashlib.sha256("\n".join([source_hash(), *options]).encode()).hexdigest()[:16]
    compiled = CACHE / f"{platform.tag}-{variant}-{key}.o"
    if not compiled.is_file():
        started = time.monotonic()
        CACHE.mkdir(parents=True, exist_ok=True)
        temporary = compiled.with_suffix(".part.o")
        zig("c++", *options, "-c", str(SOURCES / "api.cpp"), "-o", str(temporary))
        temporary.replace(compiled)
        print(f"  {variant}: compiled in {time.monotonic() - started:.0f} s", flush=True)
    return compiled


def linked_core(platform: Platform, variant: str, options: list[str]) -> bytes:
    """The core's library."""
    # Windows exports what is declared so, and nothing else.
    exports = {
        "linux": [f"-Wl,--version-script={SOURCES / 'exports.map'}"],
        "macos": [f"-Wl,-exported_symbols_list,{SOURCES / 'exports.macos'}"],
    }.get(platform.system, [])
    # -O3, in every step: zig builds its runtime libraries for it, and without it in debug mode. No processor
    # when linking: the runtimes would be built again for it.
    optimized = [*platform.target_options, "-O3"]
    with tempfile.TemporaryDirectory() as scratch:
        library = Path(scratch) / f"meshsplats_{variant}{platform.suffix}"  # macOS writes its name into it
        demangler = Path(scratch) / "no_demangler.o"
        zig("cc", *optimized, "-c", str(Path(__file__).with_name("no_demangler.c")), "-o", str(demangler))
        objects = [str(compiled_core(platform, variant, options)), str(demangler)]
        zig("c++", *optimized, "-s", "-shared", *exports, *objects, "-o", str(library))
        return library.read_bytes()


# Packing


def python_part() -> dict[str, bytes]:
    """Files of the wheel without the core, by name: packages, metadata, licence."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*PIP, "wheel", "--quiet", "--no-deps", "-C", "wheel.cmake=false"]
        command += ["-C", f"build-dir={folder}/build", "-w", folder, str(ROOT)]
        subprocess.run(command, check=True)
        with zipfile.ZipFile(next(Path(folder).glob("*.whl"))) as archive:
            return {name: archive.read(name) for name in archive.namelist() if not name.endswith("/")}


def pack(platform: Platform, files: dict[str, bytes], output: Path) -> Path:
    """Writes the wheel of a platform. The same files give the same bytes."""
    files = dict(files)
    info = next(name.split("/")[0] for name in files if name.endswith(".dist-info/WHEEL"))
    for variant, options in variant_options(platform.machine).items():
        name = f"meshsplats/_core/meshsplats_{variant}{platform.suffix}"
        files[name] = linked_core(platform, variant, options)
    tag = f"py3-none-{platform.tag}"
    wheel = files[f"{info}/WHEEL"].decode()
    wheel = re.sub(r"(?m)^Root-Is-Purelib: .*$", "Root-Is-Purelib: false", wheel)
    wheel = re.sub(r"(?m)^Tag: .*\n?", "", wheel).rstrip("\n") + f"\nTag: {tag}\n"
    files[f"{info}/WHEEL"] = wheel.encode()
    record = f"{info}/RECORD"
    files.pop(record)
    # The metadata comes last, as the specification of wheels recommends.
    names = sorted(files, key=lambda name: (name.startswith(info), name))
    rows = [f"{name},{_record_hash(files[name])},{len(files[name])}" for name in names]
    files[record] = "\n".join([*rows, f"{record},,", ""]).encode()

    output.mkdir(parents=True, exist_ok=True)
    target = output / f"{info.removesuffix('.dist-info')}-{tag}.whl"
    temporary = target.with_suffix(".part")
    moment = time.gmtime(int(os.environ.get("SOURCE_DATE_EPOCH", "315532800")))  # 1980, the first of zip
    executable = {name for name in names if name.endswith(platform.suffix)}
    temporary.write_bytes(small_zip({name: files[name] for name in [*names, record]}, executable, moment))
    temporary.replace(target)
    return target


def small_zip(files: dict[str, bytes], executable: set[str], moment: time.struct_time) -> bytes:
    """A .zip, by Zopfli a thirtieth smaller than by zlib. ``zipfile`` takes no compressed data."""
    year, month, day, hour, minute, second = moment[:6]
    date, clock = (year - 1980) << 9 | month << 5 | day, hour << 11 | minute << 5 | second // 2
    deflate, utf8, version, unix = 8, 1 << 11, 20, 3
    archive, directory = bytearray(), bytearray()
    for name, content in files.items():
        stream = zopfli_deflated(content)
        common = struct.pack(
            "<5H3I2H",
            *(version, utf8, deflate, clock, date),
            *(zlib.crc32(content), len(stream), len(content), len(name.encode()), 0),
        )
        mode = (0o100755 if name in executable else 0o100644) << 16
        directory += b"PK\1\2" + struct.pack("<2B", version, unix) + common
        directory += struct.pack("<3H2I", 0, 0, 0, mode, len(archive)) + name.encode()
        archive += b"PK\3\4" + common + name.encode() + stream
    end = struct.pack("<4H2IH", 0, 0, len(files), len(files), len(directory), len(archive), 0)
    return bytes(archive + directory + b"PK\5\6" + end)


@functools.cache
def zopfli_deflated(content: bytes) -> bytes:
    """The deflate stream alone: without zlib's header of 2 bytes and its checksum of 4."""
    return zopfli.zlib.compress(content, blocksplittingmax=0)[2:-4]  # 0: any number of blocks


def _record_hash(content: bytes) -> str:
    digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest())
    return f"sha256={digest.rstrip(b'=').decode()}"


# Checks


class Failed(Exception):
    """A wheel that must not be published, and why."""


def require(condition: object, message: str) -> None:
    if not condition:
        raise Failed(message)


def check(path: Path) -> str:
    """Raises Failed if something is wrong with a wheel; returns a line about it."""
    match = re.fullmatch(r"meshsplats-([0-9][^-]*)-py3-none-([a-z0-9_]+)\.whl", path.name)
    require(match, "the name is not meshsplats-VERSION-py3-none-PLATFORM.whl")
    assert match is not None
    version, tag = match.groups()
    platform = next((platform for platform in PLATFORMS if platform.tag == tag), None)
    require(platform, f"no such platform: {tag}")
    assert platform is not None
    size = path.stat().st_size
    require(size < MAX_BYTES, f"{size:,} bytes; must be under {MAX_BYTES:,}")
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    check_contents(files, version, platform)
    for name, content in files.items():
        if name.startswith("meshsplats/_core/") and name.endswith(platform.suffix):
            try:
                binaries.check(content, platform.system, platform.machine, platform.tag)
            except ValueError as error:
                raise Failed(f"{name}: {error}") from None
    if platform.tag.startswith("manylinux"):
        check_with_auditwheel(path, platform)
    check_that_pip_installs(path, platform)
    best = check_best_variant(files, platform)
    return f"{path.name}: {size:,} bytes{best}"


def check_contents(files: dict[str, bytes], version: str, platform: Platform) -> None:
    info = f"meshsplats-{version}.dist-info"
    for name in ("METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"):
        require(f"{info}/{name}" in files, f"{info}/{name} is missing")
    require(files[f"{info}/licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes(), "another licence")
    require(f"\nVersion: {version}\n" in files[f"{info}/METADATA"].decode(), "another version in METADATA")
    wheel = files[f"{info}/WHEEL"].decode()
    tags = re.findall(r"(?m)^Tag: (.*)$", wheel)
    require(tags == [f"py3-none-{platform.tag}"], f"WHEEL has tags {tags}")
    require("Root-Is-Purelib: false" in wheel, "WHEEL says that it is pure Python")

    expected = {
        f"meshsplats/_core/meshsplats_{variant}{platform.suffix}"
        for variant in variant_options(platform.machine)
    }
    expected |= package_files()
    found = {name for name in files if not name.startswith(info + "/")}
    missing, foreign = sorted(expected - found), sorted(found - expected)
    require(not missing, f"missing: {', '.join(missing)}")
    require(not foreign, f"does not belong here: {', '.join(foreign)}")

    rows = [line.rsplit(",", 2) for line in files[f"{info}/RECORD"].decode().splitlines()]
    require({name for name, _, _ in rows} == set(files), "RECORD does not list the files")
    for name, digest, _ in rows:
        if not name.endswith("/RECORD"):
            require(digest == _record_hash(files[name]), f"{name} is not as RECORD says")


def package_files() -> set[str]:
    """Files of the package besides its core: Python, and data of any kind that git does not ignore."""
    command = ["git", "-C", str(ROOT / "src"), "ls-files", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run([*command, "meshsplats"], capture_output=True, text=True, check=True)
    names = {name for name in done.stdout.splitlines() if (ROOT / "src" / name).is_file()}
    return {name for name in names if not name.startswith("meshsplats/csrc/")}


def check_with_auditwheel(path: Path, platform: Platform) -> None:
    command = [sys.executable, "-m", "auditwheel", "show", str(path)]
    done = subprocess.run(command, capture_output=True, text=True)
    text = " ".join(done.stdout.split())
    require(done.returncode == 0, f"auditwheel: {done.stdout}{done.stderr}")
    require(f'platform tag: "{platform.tag}"' in text, f"auditwheel: {done.stdout}")


def check_that_pip_installs(path: Path, platform: Platform) -> None:
    """As on a machine of the platform, for the lowest and the newest Python."""
    for python in ("3.10", "3.14"):
        with tempfile.TemporaryDirectory() as folder:
            command = [*PIP, "install", "--quiet", "--no-index", "--no-deps", "--only-binary=:all:"]
            command += ["--python-version", python, "--platform", platform.tag, "--target", folder, str(path)]
            done = subprocess.run(command, capture_output=True, text=True)
            require(done.returncode == 0, f"pip for Python {python}: {done.stderr}")
            installed = Path(folder) / "meshsplats" / "_core" / f"meshsplats_baseline{platform.suffix}"
            require(installed.is_file(), f"pip for Python {python} installed no core")


LOAD = """
import ctypes, sys
for path in sys.argv[1:]:
    core = ctypes.CDLL(path)
    core.ms_variant.restype = core.ms_best_variant.restype = ctypes.c_char_p
    print(core.ms_variant().decode(), core.ms_best_variant().decode())
"""


V3_FLAGS = "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3 avx avx2 bmi1 bmi2 f16c fma abm movbe xsave"
V4_FLAGS = "avx512f avx512bw avx512cd avx512dq avx512vl"
"""Linux's names of what the levels x86-64-v3 and v4 need."""


def best_variant_of_linux() -> str:
    """The best variant that this machine runs, from what Linux says about its processor."""
    text = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace")
    flags = next((set(line.split()) for line in text.splitlines() if line.startswith("flags")), set())
    if not flags.issuperset(V3_FLAGS.split()):
        return "baseline"
    return "v4" if flags.issuperset(V4_FLAGS.split()) else "v3"


def check_best_variant(files: dict[str, bytes], platform: Platform) -> str:
    """Every library, where this machine can load it, must name the best variant that this machine runs."""
    here = sys.platform == "linux" and os.uname().machine in ("x86_64", "aarch64")
    machine = {"x86_64": "x86_64", "aarch64": "arm64"}.get(os.uname().machine if here else "")
    libc = os.confstr("CS_GNU_LIBC_VERSION") if here else ""
    family = "manylinux" if libc else "musllinux"
    if not here or machine != platform.machine or not platform.tag.startswith(family):
        return ""
    best = best_variant_of_linux() if machine == "x86_64" else "baseline"
    with tempfile.TemporaryDirectory() as folder:
        for variant in variant_options(platform.machine):
            path = Path(folder) / f"meshsplats_{variant}.so"
            path.write_bytes(files[f"meshsplats/_core/{path.name}"])
            done = subprocess.run([sys.executable, "-c", LOAD, str(path)], capture_output=True, text=True)
            answer = done.stdout.strip()
            require(answer == f"{variant} {best}", f"{path.name}: {answer or done.stderr}; expected {best}")
    return f", best variant here: {best}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Builds and checks wheels for all platforms.")
    parser.add_argument("-o", "--output", type=Path, default=Path("dist"), help="folder for the wheels")
    tags = [platform.tag for platform in PLATFORMS]
    parser.add_argument("--only", action="append", choices=tags, metavar="TAG", help=", ".join(tags))
    parser.add_argument("--check", nargs="+", type=Path, metavar="WHEEL", help="check these, build nothing")
    options = parser.parse_args()
    wheels = options.check
    if not wheels:
        files = python_part()
        wheels = []
        for platform in PLATFORMS:
            if not options.only or platform.tag in options.only:
                print(platform.tag, flush=True)
                wheels.append(pack(platform, files, options.output))
    for wheel in wheels:
        try:
            print(check(wheel), flush=True)
        except Failed as error:
            raise SystemExit(f"{wheel.name}: {error}") from None


if __name__ == "__main__":
    main()
