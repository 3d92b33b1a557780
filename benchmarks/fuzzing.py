"""Counts of what the fuzzers tried and found, from what they printed.

    python tests/fuzz/guided.py --inputs 20000 > readers.log
    make fuzz-core > core.log
    python benchmarks/fuzzing.py readers.log core.log

A row for each kind of reader, and one for the calls of the compiled core. Findings are inputs that ended in
anything but a result or an error that the reader promises.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from _common import ROOT, Report, arguments

sys.path[:0] = [str(ROOT / "tests" / part) for part in ("", "formats", "core", "rendering")]

TRIED = re.compile(r"^(\S+): ([\d,]+) inputs, (\d+) kept$")
"""A line of guided.py."""
CALLED = re.compile(r"^(\w+): ((?:[\d,]+ \w+(?:, )?)+)\s*$")
"""A line of fuzz_core.py."""
FOUND = re.compile(r"^\S+[/\\](?:crash|timeout|oom|leak|slow-unit)-\w+: |runtime error: |AddressSanitizer: ")


def kinds() -> dict[str, str]:
    """What a seed is a file of, by its name."""
    from fuzz.data_seeds import DATA_SEEDS
    from fuzz.mesh_seeds import MESH_SEEDS
    from fuzz.record_seeds import RECORD_SEEDS
    from fuzz.seeds import SEEDS

    groups = {
        "splats": SEEDS,
        "meshes": MESH_SEEDS,
        "data sets, archives, camera paths": DATA_SEEDS,
        "configurations, checkpoints, tilesets, chains, journals, pages, cameras": RECORD_SEEDS,
    }
    return {seed.name: kind for kind, seeds in groups.items() for seed in seeds}


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("logs", type=Path, nargs="+")
    asked = parser.parse_args()
    known = kinds()
    rows: dict[str, list[tuple[str, int, int]]] = {}
    text = "\n".join(path.read_text("utf-8", "replace") for path in asked.logs)
    lines = text.replace("\r", "\n").splitlines()
    for line in lines:
        tried, called = TRIED.match(line), CALLED.match(line)
        if tried:
            kind, count, kept = known[tried[1].split("/")[0]], tried[2].replace(",", ""), tried[3]
            rows.setdefault(kind, []).append((tried[1], int(count), int(kept)))
        elif called:
            count = sum(int(n) for n in re.findall(r"(\d+) \w+", called[2].replace(",", "")))
            rows.setdefault("the core's entry points, under sanitizers", []).append((called[1], count, 0))
    with Report(asked) as report:
        report.table("of", "targets", "inputs", "of them kept, for new lines")
        for kind, runs in rows.items():
            kept = sum(run[2] for run in runs)
            report.row(kind, len({run[0] for run in runs}), f"{sum(run[1] for run in runs):,}", kept or "-")
        every = [run for runs in rows.values() for run in runs]
        report.row("all", len({run[0] for run in every}), f"{sum(run[1] for run in every):,}", "")
        report.say()
        report.say(f"{sum(bool(FOUND.search(line)) for line in lines)} findings")


if __name__ == "__main__":
    main()
