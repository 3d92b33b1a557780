"""Coverage-guided fuzzing of the readers with atheris (libFuzzer): inputs that reach new lines are kept and
changed further.

    pip install atheris
    python tests/fuzz/guided.py                              # every target; an hour in all
    python tests/fuzz/guided.py --target ply spz-2/inside --minutes 10
    python tests/fuzz/guided.py --target ply --replay FINDING

A target is one file of a seed of ``fuzz_readers.py``; NAME/inside is what is inside its compression, with
the compression made anew around it. Each input gives what the reader reads, or an error that it promises
(``Seed.errors``), within --seconds and 2 GB. Findings are kept and named; the exit status is 1 if there is
one. --corpus keeps what was reached for the next run. --inputs, in place of a time, tries the same inputs
each time.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from multiprocessing.connection import wait
from pathlib import Path
from types import FunctionType

import meshsplats

sys.path[:0] = [str(Path(__file__).parents[1] / part) for part in ("", "formats", "core", "rendering")]

PACKAGE = str(Path(meshsplats.__file__).parent)
MEGABYTES, MAX_BYTES = 2048, 1 << 16
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


def instrument() -> None:
    """Has atheris count the lines of the package: of what is imported by now."""
    import atheris

    for function in gc.get_objects():
        if isinstance(function, FunctionType) and function.__code__.co_filename.startswith(PACKAGE):
            atheris.instrument_func(function)


def fuzz(name: str, folder: Path, flags: list[str], log: Path) -> None:
    """Fuzzes one target in this process, which libFuzzer ends; what it prints goes to ``log``."""
    import atheris

    with log.open("wb") as printed:
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
    _, read, errors = targets(folder)[name]

    def one(data: bytes) -> None:
        with suppress(*errors):
            read(data)

    try:
        atheris.Setup([sys.argv[0], *flags], one)
        atheris.Fuzz()
    except SystemExit as stop:
        # libFuzzer writes a finding at C's exit, which a fork of multiprocessing leaves out.
        ctypes.CDLL(None).exit(stop.code)


def outcome(name: str, code: int | None, printed: str) -> tuple[int, list[Path]]:
    """The number of inputs that were tried, and the findings, which are named."""
    count = re.search(r"stat::number_of_executed_units: *(\d+)", printed)
    findings = [Path(path) for path in re.findall(r"Test unit written to (.+)", printed)]
    if code and not findings:
        raise RuntimeError(f"{name}: the fuzzer ended with {code}\n{printed[-2000:]}")
    for finding in findings:
        lines = [line for line in printed.splitlines() if "Error" in line or "ALARM" in line]
        print(f"{finding}: {lines[0].strip() if lines else 'see what --replay prints'}", flush=True)
    return int(count[1]) if count else 0, findings


def fuzz_all(
    chosen: dict[str, Target], limits: list[str], corpus: Path, keep: Path, scratch: Path
) -> tuple[int, int]:
    """The numbers of inputs and of findings of all targets. Each is a process of its own, as many at a time
    as there are processors: forks of this one, so that readers are imported and instrumented once.
    ``limits``: libFuzzer's."""
    flags = [*limits, f"-rss_limit_mb={MEGABYTES}", f"-max_len={MAX_BYTES}"]
    flags += ["-print_final_stats=1", "-seed=1"]
    for start, read, _ in chosen.values():
        read(start)  # imports the reader
    instrument()
    sys.stdout.flush()
    fork = multiprocessing.get_context("fork")
    waiting, running = iter(chosen), {}
    inputs = findings = 0
    while True:
        for name in islice(waiting, (os.cpu_count() or 1) - len(running)):
            place, found, folder = (top / name.replace("/", "~") for top in (corpus, keep, scratch))
            for each in (place, found, folder):
                each.mkdir(parents=True, exist_ok=True)
            (place / "start").write_bytes(chosen[name][0])
            log = folder / "log"
            process = fork.Process(
                target=fuzz, args=(name, folder, [*flags, f"-artifact_prefix={found}/", str(place)], log)
            )
            process.start()
            running[process.sentinel] = name, process, place, log
        if not running:
            return inputs, findings
        for sentinel in wait(list(running)):
            name, process, place, log = running.pop(sentinel)
            process.join()
            count, kept = outcome(name, process.exitcode, log.read_text("utf-8", "replace"))
            print(f"{name}: {count:,} inputs, {len(list(place.iterdir()))} kept", flush=True)
            inputs, findings = inputs + count, findings + len(kept)
            shutil.rmtree(log.parent)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--target", nargs="*", help="default: all")
    parser.add_argument("--minutes", type=float, default=60, help="for all targets together (default: 60)")
    parser.add_argument("--inputs", type=int, help="for each target, in place of a time")
    parser.add_argument(
        "--seconds", type=int, default=10, help="for one input; more where the machine is busy (default: 10)"
    )
    parser.add_argument(
        "--corpus", type=Path, help="folder of inputs that reach new lines (default: not kept)"
    )
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "meshsplats-fuzz")
    parser.add_argument("--replay", type=Path, help="reads this finding of the target, and does no more")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.exists() else None) as scratch:
        known = targets(Path(scratch))
        if unknown := sorted(set(options.target or []) - set(known)):
            parser.error(f"no target {unknown[0]}; there are {', '.join(known)}")
        chosen = {name: known[name] for name in options.target or known}
        if options.replay:
            for _, read, _ in chosen.values():
                read(options.replay.read_bytes())
            return 0
        seconds = max(1, round(60 * options.minutes * (os.cpu_count() or 1) / len(chosen)))
        limits = [f"-runs={options.inputs}" if options.inputs else f"-max_total_time={seconds}"]
        limits += [f"-timeout={options.seconds}", f"-report_slow_units={options.seconds}"]
        corpus = options.corpus or Path(scratch) / "corpus"
        counts, findings = fuzz_all(chosen, limits, corpus, options.keep, Path(scratch) / "runs")
    print(f"{counts:,} inputs to {len(chosen)} targets, {findings} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
