"""Coverage-guided fuzzing of the readers with atheris (libFuzzer): inputs that reach new lines are kept and
changed further.

    pip install atheris
    python tests/fuzz/guided.py                              # every target; an hour in all
    python tests/fuzz/guided.py --target ply spz-2/inside --minutes 10

A target is one file of a seed of ``fuzz_readers.py``; NAME/inside is what is inside its compression, with
the compression made anew around it. Each input gives what the reader reads, or an error that it promises
(``Seed.errors``), within 10 s and 2 GB. Findings are kept and named; the exit status is 1 if there is one.
--corpus keeps what was reached for the next run. --inputs, in place of a time, tries the same inputs each
time.
"""

from __future__ import annotations

import argparse
import gc
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import FunctionType

sys.path[:0] = [str(Path(__file__).parents[1] / part) for part in ("", "formats", "core", "rendering")]

SECONDS, MEGABYTES, MAX_BYTES = 10, 2048, 1 << 16
"""Limits of one input."""
OPAQUE = (".png", ".webp")
"""Parsed by Pillow alone."""
Target = tuple[bytes, Callable[[bytes], object], tuple[type[Exception], ...]]
"""What it starts with, what reads a changed one, and what that may raise."""


def targets(folder: Path) -> dict[str, Target]:
    """The targets by name; their files are written into ``folder``."""
    from fuzz.fuzz_readers import SEEDS, put

    found: dict[str, Target] = {}
    for seed in SEEDS:
        if seed.slow:
            continue
        names = [name for name in seed.changed or seed.files if not name.endswith(OPAQUE)]
        put(folder / seed.name, seed.files)
        for name in names:

            def read(data: bytes, seed=seed, name=name) -> object:
                (folder / seed.name / name).write_bytes(data)
                return seed.load(folder / seed.name / seed.opened)

            title = seed.name if len(names) == 1 else f"{seed.name}/{name.replace('/', '_')}"
            found[title] = seed.files[name], read, seed.errors
            if seed.inside is not None:
                start, read_inside = inside(seed.inside, seed.files[name], read)
                found[f"{title}/inside"] = start, read_inside, seed.errors
    return found


def inside(
    change: Callable[[bytes, Callable[[bytes], bytes]], bytes], whole: bytes, read: Callable[[bytes], object]
) -> tuple[bytes, Callable[[bytes], object]]:
    """Start and reader of a target within a compressed file. The first byte of an input says which part the
    rest replaces."""
    parts: list[bytes] = []

    def note(part: bytes) -> bytes:
        parts.append(part)
        return part

    change(whole, note)

    def read_changed(data: bytes) -> object:
        chosen, seen = (data[0] if data else 0) % len(parts), iter(range(len(parts)))
        return read(change(whole, lambda part: data[1:] if next(seen) == chosen else part))

    return b"\0" + parts[0], read_changed


def run_target(name: str, flags: list[str]) -> None:
    """Fuzzes in this process, which libFuzzer ends."""
    import atheris

    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").exists() else None) as folder:
        start, read, errors = targets(Path(folder))[name]
        read(start)  # imports the reader
        for function in gc.get_objects():
            if isinstance(function, FunctionType) and str(function.__module__).startswith("meshsplats."):
                atheris.instrument_func(function)

        def one(data: bytes) -> None:
            with suppress(*errors):
                read(data)

        atheris.Setup([sys.argv[0], *flags], one)
        atheris.Fuzz()


def fuzz(name: str, start: bytes, limit: str, corpus: Path, keep: Path) -> tuple[int, list[Path]]:
    """The number of inputs that a process of its own tried, and the findings. ``limit``: libFuzzer's."""
    place, found = corpus / name.replace("/", "~"), keep / name.replace("/", "~")
    for each in (place, found):
        each.mkdir(parents=True, exist_ok=True)
    (place / "start").write_bytes(start)
    flags = [limit, f"-timeout={SECONDS}", f"-rss_limit_mb={MEGABYTES}"]
    flags += [
        f"-max_len={MAX_BYTES}",
        f"-artifact_prefix={found}/",
        "-print_final_stats=1",
        "-seed=1",
        str(place),
    ]
    command = [sys.executable, __file__, "--run", name, *flags]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    count = re.search(r"stat::number_of_executed_units: *(\d+)", done.stderr)
    findings = [Path(path) for path in re.findall(r"Test unit written to (.+)", done.stderr)]
    if done.returncode and not findings:
        raise RuntimeError(f"{name}: the fuzzer ended with {done.returncode}\n{done.stderr[-2000:]}")
    for finding in findings:
        lines = [line for line in done.stderr.splitlines() if "Error" in line or "ALARM" in line]
        print(f"{finding}: {lines[0].strip() if lines else 'see what it prints'}", flush=True)
    return int(count[1]) if count else 0, findings


def main() -> int:
    if sys.argv[1:2] == ["--run"]:
        run_target(sys.argv[2], sys.argv[3:])
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--target", nargs="*", help="default: all")
    parser.add_argument("--minutes", type=float, default=60, help="for all targets together (default: 60)")
    parser.add_argument("--inputs", type=int, help="for each target, in place of a time")
    parser.add_argument(
        "--corpus", type=Path, help="folder of inputs that reach new lines (default: not kept)"
    )
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "meshsplats-fuzz")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        known = targets(Path(scratch))
        if unknown := sorted(set(options.target or []) - set(known)):
            parser.error(f"no target {unknown[0]}; there are {', '.join(known)}")
        chosen = {name: known[name] for name in options.target or known}
        corpus = options.corpus or Path(scratch) / "corpus"
        workers = os.cpu_count() or 1
        seconds = max(1, round(60 * options.minutes * workers / len(chosen)))
        limit = f"-runs={options.inputs}" if options.inputs else f"-max_total_time={seconds}"

        def run(name: str) -> tuple[int, int]:
            count, found = fuzz(name, chosen[name][0], limit, corpus, options.keep)
            reached = len(list((corpus / name.replace("/", "~")).iterdir()))
            print(f"{name}: {count:,} inputs, {reached} kept", flush=True)
            return count, len(found)

        with ThreadPoolExecutor(workers) as pool:
            counts, findings = map(sum, zip(*pool.map(run, chosen), strict=True))
    print(f"{counts:,} inputs to {len(chosen)} targets, {findings} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
