"""Files of an evaluation: scores, their table, strips and enlarged crops of some views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from meshsplats._common.arrays import spread_indices
from meshsplats._common.words import plural
from meshsplats._files.atomic import write_json, write_text
from meshsplats.evaluation.benchmarks import BenchmarkResult
from meshsplats.evaluation.report import Report, ScoredView
from meshsplats.evaluation.strips import markdown_table, view_crop, view_strip
from meshsplats.images.writing import save_image
from meshsplats.rendering.looks import GROUND_TRUTHS

RESULTS, PER_VIEW, REPORT, TABLE = "results.json", "per_view.json", "report.json", "table.md"
"""results.json and per_view.json are laid out as the 3DGS code does; report.json has everything."""


class Strips:
    """Saves strips and enlarged crops of ``strips`` views, evenly spread over the ``names`` of all of them,
    into ``folder``. Called with each view in turn (``on_view`` of ``evaluate``); the error is ``amplify``
    times as large."""

    def __init__(self, folder: Path, names: Sequence[str], strips: int, amplify: float) -> None:
        self._folder, self._names, self._amplify = folder, names, amplify
        self._shown, self._count = set(spread_indices(len(names), strips)), 0

    def __call__(self, scored: ScoredView) -> None:
        if self._count in self._shown:
            for part, make in ("strips", view_strip), ("crops", view_crop):
                (self._folder / part).mkdir(exist_ok=True)
                save_image(self._folder / part / self._names[self._count], make(scored, self._amplify))
        self._count += 1


def save_report(report: Report, folder: Path) -> None:
    """Writes the four files of one scene into ``folder``, which exists."""
    table = markdown_table([report], notes=notes([report]))
    _save(folder, report.results(), report.per_view(), report.to_dict(), table)


def save_benchmark(result: BenchmarkResult, folder: Path, protocol: str) -> None:
    """Writes the four files of all scenes of a benchmark into ``folder``, which exists."""
    whole = {"protocol": protocol, **result.to_dict()}
    _save(folder, result.means(), result.per_view(), whole, result.table(notes(result.reports)))


def notes(reports: Sequence[Report]) -> list[str]:
    """Notes under the table: views that are not held out, the ground truth, the samples and the background of
    each scene; how LPIPS was measured."""
    found = []
    for report in reports:
        about, scene = report.about, "" if len(reports) == 1 else f"{report.scene}: "
        trained_on = about.get("trained_on", {})
        if about["held_out"] is False and not trained_on:
            found.append(f"{scene}Views: {plural(about['views'], 'training view')}, as none is held out.")
        found += [
            f"{scene}Not held out: {path} was trained on {views}." for path, views in trained_on.items()
        ]
        samples = f"meshes with {about['samples']} x {about['samples']} samples per pixel"
        found.append(f"{scene}Ground truth: {about['ground_truth']}; {samples}.")
        if about["splats"] is not None and about["ground_truth"] not in GROUND_TRUTHS.values():
            trained = about.get("splats_trained_width")
            other = f", not at that of their training, {trained} pixels wide" if trained else ""
            found.append(f"{scene}Splats: {GROUND_TRUTHS['splats'].removeprefix('splats ')}{other}.")
        found.append(f"{scene}Background: {about['background_description']}.")
    about = reports[0].about
    if about.get("lpips_network"):
        found.append(f"LPIPS: network {about['lpips_network']}, convention {about['lpips_convention']!r}.")
    return found


def _save(folder: Path, results: Any, per_view: Any, report: Any, table: str) -> None:
    for name, content in (RESULTS, results), (PER_VIEW, per_view), (REPORT, report):
        write_json(folder / name, content)
    write_text(folder / TABLE, table)
