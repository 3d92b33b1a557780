"""Mutated files against the readers: each gives splats, a mesh or cameras, a FileFormatError or an OSError,
soon and in little memory.

    python tests/fuzz/fuzz_readers.py [--format ply ...] [--count 20000] [--seed 0] [--keep DIR]

Runs with a limit on the address space and an alarm for each file. A file that fails is kept in DIR; the exit
status is 1 if there is one.
"""

from __future__ import annotations

import argparse
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from fuzz.data_seeds import DATA_SEEDS
from fuzz.mesh_seeds import MESH_SEEDS
from fuzz.record_seeds import RECORD_SEEDS
from fuzz.seeds import SEEDS as SPLAT_SEEDS
from fuzz.seeds import Seed

SEEDS = [*SPLAT_SEEDS, *MESH_SEEDS, *DATA_SEEDS, *RECORD_SEEDS]
MEMORY = 512 << 20
SECONDS = 10
KINDS = np.array([4, 3, 3, 1, 1, 1, 1, 3, 3]) / 20
BYTES = [0, 1, 2, 9, 10, 13, 32, 45, 46, 48, 57, 127, 128, 254, 255]
INTEGERS = [0, 1, 2, 255, 256, 65535, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 62, (1 << 64) - 1]
WORDS = [
    b"-1",
    b"0",
    b"1",
    b"3",
    b"99999999999",
    b"1e11",
    b"1e999",
    b"nan",
    b"-0",
    b"",
    b"0x10",
    b"null",
    b"true",
    b"[]",
    b"[1]",
    b'"."',
]
WORDS += [b'"../../etc/passwd"', b'"/etc/passwd"', b"1" * 400, b"list", b"double", b"uchar", b"\xff\xfe"]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """A few random changes, mostly one, of bytes, words or whole pieces."""
    out = bytearray(data)
    for _ in range(int(rng.geometric(0.6))):
        n = len(out)
        if n == 0:
            return bytes(out)
        # Headers decide most: half of all changes are near the start.
        at = int(rng.integers(min(n, 2048) if rng.random() < 0.5 else n))
        kind = int(rng.choice(len(KINDS), p=KINDS))
        if kind == 0:
            out[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            out[at] = BYTES[int(rng.integers(len(BYTES)))]
        elif kind == 2:
            width = int(rng.choice([1, 2, 4, 8]))
            value = INTEGERS[int(rng.integers(len(INTEGERS)))] % (1 << (8 * width))
            out[at : at + width] = value.to_bytes(width, "little" if rng.random() < 0.7 else "big")
        elif kind == 3:
            del out[at:]
        elif kind == 4:
            out += rng.bytes(int(rng.integers(1, 64)))
        elif kind == 5:
            del out[at : at + int(rng.integers(1, 64))]
        elif kind == 6:
            out[at:at] = out[at : at + int(rng.integers(1, 256))]
        elif kind == 7:
            out[at : at + 4] = rng.choice(
                np.array([np.nan, np.inf, -np.inf, 0, 3e38, -1e-40], "<f4")
            ).tobytes()
        else:
            words = list(re.finditer(rb"[-+.\w\"/]+", bytes(out[:8192])))
            if words:
                chosen = words[int(rng.integers(len(words)))]
                out[chosen.start() : chosen.end()] = WORDS[int(rng.integers(len(WORDS)))]
    return bytes(out)


def mutated_files(seed: Seed, rng: np.random.Generator) -> dict[str, bytes]:
    """The seed's files with one of them mutated, inside its compression every other time."""
    files = dict(seed.files)
    names = seed.changed or list(files)
    name = names[int(rng.integers(len(names)))]
    if seed.inside is not None and rng.random() < 0.6:
        files[name] = seed.inside(files[name], lambda data: mutate(data, rng))
    else:
        files[name] = mutate(files[name], rng)
    return files


def put(folder: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def fuzz(seed: Seed, count: int, number: int, keep: Path) -> tuple[Counter[str], float]:
    """Outcomes of ``count`` mutations, and the seconds that the slowest file took."""
    outcomes: Counter[str] = Counter()
    slowest = 0.0
    for i in range(count):
        rng = np.random.default_rng([number, i, sum(seed.name.encode())])
        with tempfile.TemporaryDirectory() as folder:
            files = mutated_files(seed, rng)
            put(Path(folder), files)
            start = time.perf_counter()
            signal.alarm(SECONDS)
            try:
                seed.load(Path(folder) / seed.opened)
                outcome = "read"
            except seed.errors as error:
                outcome = type(error).__name__
            except (
                BaseException
            ) as error:  # whatever else happens is a finding, MemoryError and alarm included
                if isinstance(error, KeyboardInterrupt):
                    raise
                outcome = "FAILED"
                kept = keep / f"{seed.name}-{number}-{i}"
                put(kept, files)
                print(f"{kept}: {type(error).__name__}: {error}")
                traceback.print_tb(error.__traceback__, limit=-3)
            finally:
                signal.alarm(0)
            slowest = max(slowest, time.perf_counter() - start)
            outcomes[outcome] += 1
    return outcomes, slowest


class _Alarm(BaseException):
    """Passes through every handler but the fuzzer's own."""


def _alarm(signum: int, frame: object) -> None:
    raise _Alarm(f"no result after {SECONDS} s")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--format", nargs="*", choices=[s.name for s in SEEDS], help="if not given: all but usdc, usda"
    )
    parser.add_argument("--count", type=int, default=20_000, help="mutated files of each seed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "meshsplats-fuzz")
    args = parser.parse_args()

    signal.signal(signal.SIGALRM, _alarm)
    warnings.simplefilter("ignore")
    # Everything that is imported late is loaded before memory is limited.
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as folder:
            put(Path(folder), seed.files)
            seed.load(Path(folder) / seed.opened)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    failed = 0
    for seed in SEEDS:
        if seed.name in args.format if args.format else not seed.slow:
            outcomes, slowest = fuzz(seed, args.count, args.seed, args.keep)
            failed += outcomes["FAILED"]
            listed = ", ".join(f"{count} {what}" for what, count in sorted(outcomes.items()))
            print(f"{seed.name}: {listed}; slowest {slowest:.2f} s", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
