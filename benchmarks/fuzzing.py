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
    rows: dict[str, list[int]] = {}
    text = "\n".join(path.read_text("utf-8", "replace") for path in asked.logs)
    lines = text.replace("\r", "\n").splitlines()
    for line in lines:
        tried, called = TRIED.match(line), CALLED.match(line)
        if tried:
            row = rows.setdefault(known[tried[1].split("/")[0]], [0, 0, 0])
            row[0], row[1], row[2] = (
                row[0] + 1,
                row[1] + int(tried[2].replace(",", "")),
                row[2] + int(tried[3]),
            )
        elif called and not called[0].endswith("findings"):
            row = rows.setdefault("the core's entry points, under sanitizers", [0, 0, 0])
            row[0] += 1
            row[1] += sum(int(n) for n in re.findall(r"(\d+) \w+", called[2].replace(",", "")))
    found = sum(bool(FOUND.search(line)) for line in lines)
    with Report(asked) as report:
        report.table("of", "targets", "inputs", "reached new lines")
        for name, (targets, inputs, kept) in rows.items():
            report.row(name, targets, f"{inputs:,}", kept or "-")
        report.row(
            "all", sum(row[0] for row in rows.values()), f"{sum(row[1] for row in rows.values()):,}", ""
        )
        report.say(f"{found} findings")


if __name__ == "__main__":
    main()
