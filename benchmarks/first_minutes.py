"""The first minutes of fine-tuning: is the result above its conversion at every size, and in time?

    python benchmarks/first_minutes.py SPLATS ... --minutes 1 3 5
    python benchmarks/first_minutes.py SPLATS ... --minutes 1 --busy 2
    python benchmarks/first_minutes.py SPLATS ... --minutes 3 -- --opacity cutoff

Runs ``meshsplats finetune`` as a user would, with what stands behind ``--`` as further options. The dB are
those that it prints: held-out views at degrees as stored, at four image widths, the larger ones in windows;
the conversion, and what was written. Seconds are those of the whole command. ``--busy``: beside as many
processes that do nothing but compute.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import tempfile
from pathlib import Path
from subprocess import CalledProcessError

from _common import Report, arguments, run


def main() -> None:
    own, _, more = " ".join(sys.argv[1:]).partition(" -- ")
    parser = arguments(__doc__)
    parser.add_argument("splats", nargs="+", type=Path)
    parser.add_argument("--minutes", nargs="+", type=float, default=[1.0])
    parser.add_argument("--busy", type=int, default=0, metavar="N")
    options = parser.parse_args(own.split())
    beside = [multiprocessing.Process(target=compute, daemon=True) for _ in range(options.busy)]
    for process in beside:
        process.start()
    with Report(options) as report:
        report.table(
            *("scene", "minutes", "seconds", "steps", "triangles", "MB", "converted, dB", "written, dB")
        )
        for splats in options.splats:
            for minutes in options.minutes:
                report.row(*row(splats, minutes, more.split()))
    for process in beside:
        process.kill()


def compute() -> None:
    while True:
        sum(range(10**6))


def row(splats: Path, minutes: float, more: list[str]) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "tuned.glb"
        words = ["finetune", str(splats), "-o", str(out), "--minutes", f"{minutes:g}", "--json", *more]
        log = Path(folder) / "log.txt"
        try:
            with open(log, "w") as messages:
                used = run([sys.executable, "-m", "meshsplats", *words], stderr=messages)
        except CalledProcessError:
            return [splats.name, f"{minutes:g}", log.read_text().strip().splitlines()[-1], *[""] * 5]
        result = json.loads(used.output)
        megabytes = out.stat().st_size / 1e6
    scores = result["psnr_by_width"]
    before = "/".join(f"{value:.1f}" for value in scores["converted"].values())
    after = "/".join(f"{value:.1f}" for value in scores["tuned"].values())
    if result["written"] == "converted":
        after = f"the conversion; tuned {after}"
    name = splats.stem if splats.name != "meta.json" else splats.parent.name
    figures = (f"{minutes:g}", f"{used.wall:.0f}", f"{result['steps']:,}", f"{result['triangles']:,}")
    return [name, *figures, f"{megabytes:.0f}", before, after]


if __name__ == "__main__":
    main()
