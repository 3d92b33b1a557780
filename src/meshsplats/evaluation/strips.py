"""Presentation of scores: image strips and crops, tables; and images from elsewhere to score."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from meshsplats._common.words import natural_key
from meshsplats.datasets.image_files import is_hidden
from meshsplats.evaluation.report import ImageAt, Report, ScoredView
from meshsplats.images.writing import amplified_error, strip
from meshsplats.scene.camera import Camera

CROP_SHARE = 4
"""The shorter side of an image divided by the side of its crop."""
CROP_SCALE = 3
"""Factor by which crops are enlarged, without smoothing."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def view_strip(scored: ScoredView, amplify: float) -> np.ndarray:
    """(h', w', 3): ground truth, each method, and the amplified error of the first, with captions."""
    images = [scored.target, *scored.images.values()]
    captions = ["truth", *(f"{name} {scored.scores[name].psnr:.2f} dB" for name in scored.images)]
    first = next(iter(scored.images.values()))
    return strip(
        [*images, amplified_error(scored.target, first, amplify)], [*captions, f"error x {amplify:g}"]
    )


def view_crop(scored: ScoredView, amplify: float) -> np.ndarray:
    """The same for the crop with the largest error of the first method, enlarged."""
    first = next(iter(scored.images.values()))
    top, left, side = worst_window(np.square(first - scored.target).sum(axis=2))
    part = (slice(top, top + side), slice(left, left + side))

    def enlarged(image: np.ndarray) -> np.ndarray:
        return image[part].repeat(CROP_SCALE, axis=0).repeat(CROP_SCALE, axis=1)

    images = [enlarged(p) for p in (scored.target, *scored.images.values())]
    return strip(
        [*images, enlarged(amplified_error(scored.target, first, amplify))],
        ["truth", *scored.images, "error"],
    )


def worst_window(error: np.ndarray) -> tuple[int, int, int]:
    """Top, left and side of the square window with the largest sum of ``error`` (h, w)."""
    side = max(1, min(error.shape) // CROP_SHARE)
    total = np.pad(error.astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    top, left = np.unravel_index(int(sums.argmax()), sums.shape)
    return int(top), int(left), side


def image_folder(folder: str | os.PathLike[str], cameras: Sequence[Camera]) -> ImageAt:
    """Images from elsewhere, one file for each of ``cameras``.

    Files are matched to views by name, without folder and suffix. If no name matches and there are as many
    files as views, files in natural order (2 before 10) are matched to the views in their order. Images with
    alpha are composited over the background.

    Raises FileNotFoundError for a missing folder or image; the result raises ValueError for an image of
    another size than its camera's.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder of images at {folder}")
    files = [
        p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file() and not is_hidden(p.name)
    ]
    by_name = {p.stem: p for p in files}
    stems = [Path(camera.name).stem for camera in cameras]
    if all(stem in by_name for stem in stems):
        chosen = [by_name[stem] for stem in stems]
    elif len(files) == len(cameras) and not any(stem in by_name for stem in stems):
        chosen = sorted(files, key=lambda path: natural_key(path.name))
    else:
        missing = [stem for stem in stems if stem not in by_name]
        raise FileNotFoundError(
            f"{folder}: {len(files)} images for {len(cameras)} views, none named {missing[0]!r}"
            f" ({len(missing)} missing); name them as the views, or give exactly one for each view"
        )
    paths = {id(camera): path for camera, path in zip(cameras, chosen, strict=True)}

    def at(camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray | None]:
        from meshsplats.images.reading import load_image

        path = paths[id(camera)]
        pixels = load_image(path).astype(np.float32) / 255
        if pixels.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"{path} has {pixels.shape[1]} x {pixels.shape[0]} pixels, the view"
                f" {camera.width} x {camera.height}"
            )
        if pixels.shape[2] == 3:
            return pixels, None
        alpha = pixels[..., 3]
        over = np.asarray(background, np.float32)
        return pixels[..., :3] * alpha[..., None] + (1 - alpha[..., None]) * over, alpha

    return at


def mesh_names(paths: Sequence[Path]) -> dict[str, Path]:
    """A name for each mesh in tables: ``mesh`` for a single one, else that of its file, with the folders
    above that make names differ. Raises ValueError if two are the same."""
    if len(paths) == 1:
        return {"mesh": paths[0]}
    whole = [Path(os.path.abspath(path)) for path in paths]
    longest = max((len(path.parts) for path in whole), default=0)
    forms = [[path.stem for path in whole], [path.name for path in whole]]
    forms += [["/".join(path.parts[-k:]) for path in whole] for k in range(2, longest + 1)]
    for names in forms:
        if len(set(names)) == len(names):
            return dict(zip(names, paths, strict=True))
    raise ValueError("a mesh was given twice")


def markdown_table(
    reports: Sequence[Report],
    *,
    title: str = "",
    reported: Mapping[str, tuple[float, float, float]] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """A Markdown table of the scores of each scene and method, and their means over several scenes.

    ``reported`` adds figures of the literature (PSNR, SSIM, LPIPS) by name; ``notes`` follow the table.
    Columns without a value are left out.
    """
    header, table = score_table(reports, reported or {})
    lines = [f"# {title}", ""] if title else []
    lines += [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    lines += [f"| {' | '.join(row)} |" for row in table]
    return "\n".join([*lines, *(f"\n{note}" for note in notes)]) + "\n"


_COLUMNS = {
    "PSNR": ("mean", "psnr", 2),
    "median PSNR": ("median", "psnr", 2),
    "SSIM": ("mean", "ssim", 4),
    "LPIPS": ("mean", "lpips", 4),
    "PSNR colour-corrected": ("mean", "psnr_exposure", 2),
    "floater px": ("mean", "floaters", 1),
}
"""Header: statistic, score and number of digits."""


def score_table(
    reports: Sequence[Report], reported: Mapping[str, tuple[float, float, float]]
) -> tuple[list[str], list[list[str]]]:
    """Header and rows of ``markdown_table``."""
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
