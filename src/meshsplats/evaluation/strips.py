"""What goes with scores: strips and crops of the pictures, tables, and pictures that were made elsewhere."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from meshsplats.camera import Camera
from meshsplats.evaluation.report import ImageAt, Report, ScoredView
from meshsplats.images.writing import amplified_error, strip

CROP_SHARE = 4
"""A crop's side is this part of the picture's shorter side."""
CROP_SCALE = 3
"""Crops are enlarged so many times, without smoothing."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def view_strip(scored: ScoredView, amplify: float) -> np.ndarray:
    """(h', w', 3): truth | each method | error of the first method, under captions with the PSNR."""
    pictures = [scored.truth, *scored.pictures.values()]
    captions = ["truth", *(f"{name} {scored.scores[name].psnr:.2f} dB" for name in scored.pictures)]
    first = next(iter(scored.pictures.values()))
    return strip(
        [*pictures, amplified_error(scored.truth, first, amplify)], [*captions, f"error x {amplify:g}"]
    )


def view_crop(scored: ScoredView, amplify: float) -> np.ndarray:
    """The same of the part where the first method's error is largest, enlarged."""
    first = next(iter(scored.pictures.values()))
    top, left, side = worst_window(np.square(first - scored.truth).sum(axis=2))
    part = (slice(top, top + side), slice(left, left + side))

    def enlarged(picture: np.ndarray) -> np.ndarray:
        return picture[part].repeat(CROP_SCALE, axis=0).repeat(CROP_SCALE, axis=1)

    pictures = [enlarged(p) for p in (scored.truth, *scored.pictures.values())]
    return strip(
        [*pictures, enlarged(amplified_error(scored.truth, first, amplify))],
        ["truth", *scored.pictures, "error"],
    )


def worst_window(error: np.ndarray) -> tuple[int, int, int]:
    """Top, left and side of the square window with the largest sum of ``error`` (h, w)."""
    side = max(1, min(error.shape) // CROP_SHARE)
    total = np.pad(error.astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    top, left = np.unravel_index(int(sums.argmax()), sums.shape)
    return int(top), int(left), side


def image_folder(folder: str | os.PathLike[str], cameras: Sequence[Camera]) -> ImageAt:
    """Pictures made elsewhere, one file for each of ``cameras``.

    A file belongs to the view of its name, without folder and suffix; or, if there are as many files as views
    and none fits by name, files in natural order (2 before 10) belong to views in theirs. Pictures with alpha
    are composited over the background.

    Raises FileNotFoundError for a missing folder or picture, ValueError for a picture of another size.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder of pictures at {folder}")
    files = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()]
    by_name = {p.stem: p for p in files}
    stems = [Path(camera.name).stem for camera in cameras]
    if all(stem in by_name for stem in stems):
        chosen = [by_name[stem] for stem in stems]
    elif len(files) == len(cameras) and not any(stem in by_name for stem in stems):
        chosen = sorted(files, key=_natural)
    else:
        missing = [stem for stem in stems if stem not in by_name]
        raise FileNotFoundError(
            f"{folder}: {len(files)} pictures for {len(cameras)} views, none named {missing[0]!r}"
            f" ({len(missing)} missing); name them as the views, or give exactly one for each view"
        )
    place = {id(camera): path for camera, path in zip(cameras, chosen, strict=True)}

    def at(camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray | None]:
        from meshsplats.images.reading import load_image

        pixels = load_image(place[id(camera)]).astype(np.float32) / 255
        if pixels.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"{place[id(camera)]} has {pixels.shape[1]} x {pixels.shape[0]} pixels, the view"
                f" {camera.width} x {camera.height}"
            )
        if pixels.shape[2] == 3:
            return pixels, None
        alpha = pixels[..., 3]
        behind = np.asarray(background, np.float32)
        return pixels[..., :3] * alpha[..., None] + (1 - alpha[..., None]) * behind, alpha

    return at


def markdown_table(
    reports: Sequence[Report],
    *,
    title: str = "",
    reported: Mapping[str, tuple[float, float, float]] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """A table of the scenes' means by method, with the mean over the scenes where there are several, and
    figures ``reported`` elsewhere (PSNR, SSIM, LPIPS); ``notes`` follow it. Columns without a value are left
    out."""
    heads, table = score_table(reports, reported or {})
    lines = [f"# {title}", ""] if title else []
    lines += [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    lines += [f"| {' | '.join(row)} |" for row in table]
    return "\n".join([*lines, *(f"\n{note}" for note in notes)]) + "\n"


_COLUMNS = {
    "PSNR": ("mean", "psnr", 2),
    "median PSNR": ("median", "psnr", 2),
    "SSIM": ("mean", "ssim", 4),
    "LPIPS": ("mean", "lpips", 4),
    "PSNR fitted": ("mean", "psnr_exposure", 2),
    "floater px": ("mean", "floaters", 1),
}
"""Head, statistic, score and digits."""


def score_table(
    reports: Sequence[Report], reported: Mapping[str, tuple[float, float, float]]
) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of ``markdown_table``."""
    rows: list[tuple[str, str, list[float | None]]] = []
    for report in reports:
        for scores in report.methods:
            values = [getattr(scores, statistic)(name) for statistic, name, _ in _COLUMNS.values()]
            rows.append((report.scene, scores.method, values))
    if len(reports) > 1:
        for method in dict.fromkeys(method for _, method, _ in rows):
            columns = zip(*(values for _, name, values in rows if name == method), strict=True)
            means = [None if None in column else float(np.mean(np.array(column))) for column in columns]
            rows.append(("mean", method, means))
    for name, (psnr, ssim, lpips) in reported.items():
        rows.append(("reported", name, [psnr, None, ssim, lpips, None, None]))
    shown = [i for i in range(len(_COLUMNS)) if any(values[i] is not None for _, _, values in rows)]
    digits = [digits for _, _, digits in _COLUMNS.values()]
    return ["scene", "method", *(list(_COLUMNS)[i] for i in shown)], [
        [scene, method, *("" if (v := values[i]) is None else f"{v:.{digits[i]}f}" for i in shown)]
        for scene, method, values in rows
    ]


def _natural(path: Path) -> list:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
